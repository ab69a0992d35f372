"""Messages built from the tables of the manual, without the library."""

INFO = bytes.fromhex("02 000b 49 6966 05 ff000001 000000fe 48")
"""Port 1 and a card changed; key 1 of port 1 pressed, key 4 released after 0.1 s; key
4 of port 2 released after 25.4 s. BCC by hand: 00^0b^49^69^66^05^ff^01^fe = 48."""


def message(letter: str, params: bytes, *, counts_id: bool = True) -> bytes:
    """Return STX, length, message-id, parameters, BCC."""
    head = bytes((len(params) >> 8, len(params) & 0xFF))
    bcc = ord(letter) if counts_id else 0
    for byte in head + params:
        bcc ^= byte
    return b"\x02" + head + letter.encode("latin-1") + params + bytes((bcc,))


def answer(name: str, data: bytes = b"", *, counts_id: bool = True) -> bytes:
    """Return an answer of the box."""
    return message("A", name.encode() + data, counts_id=counts_id)


# One answer to rc, byte by byte as the table of 3.2.4 has it.
PORT_CHARGING = bytes.fromhex(
    "41"  # charging, optimised
    "20 10"  # cable 32 A, offered 16 A
    "01"  # ventilation asked for
    "02"  # start released
    "01"  # the next start is an optimised one
    "03"  # last result: cable pulled at the car
    "00000e10 00000bb8"  # 3600 s and 3000 Wh so far
    "00001c20 00002710"  # last time 7200 s and 10000 Wh
    "00bc614e 0000002a"  # 12345678 Wh in all, 42 cycles
    "01 01 00"  # locked, contactor closed, RCD not tripped
    "fb50 0258 00fa"  # -12.00 V, 6.00 V, 2.50 V
    "21"  # LED green, key 1
    "01 0007 002a 4d6178204d000000"  # group 7, card 42, "Max M"
)
PORT_IDLE = bytes(23) + bytes.fromhex("00000064") + bytes(27)
"""Nothing but a meter that stands at 100 Wh."""
PORTS = PORT_CHARGING + PORT_IDLE

DETAILS = bytes.fromhex(
    "00002b5c 00000000"  # 11100 W, 0 W
    "35 64"  # duty 53 %, 100 %
    "42 41"  # low-level pilot
    "20 00"  # low-level cable 32 A, 0 A
    "10 00"  # limit 16 A, none
    "01 0007 002a 4d6178204d000000"
    "00 0000 0000 0000000000000000"
    "07de 06 1e 17 3b 3a"  # 2014-06-30 23:59:58
    "0000 00 00 00 00 00"
)

BOX = (
    b"M165300103\0"
    + bytes.fromhex("0d")  # restarted, backup present and charged
    + b"169300001234"
    + bytes.fromhex("00012345 beef")  # website size and CRC
    + b"Website 1.3\0\0\0\0\0\0\0\0\0"
    + bytes.fromhex("00 0004a3010203")  # LAN right, MAC
    + bytes.fromhex("01 c0a80017")  # server connected, web client 192.168.0.23
    + bytes.fromhex("20 00")  # 32 A, no ventilation
    + bytes.fromhex("07de 0c 1f 01 02 03")  # 2014-12-31 01:02:03
    + bytes.fromhex("00")
    + b"MCR 6241 \0\0"
    + bytes.fromhex("01 04112233445566 01 00 0007 002a")
    + b"Max M\0\0\0"
)

DHCP = bytes.fromhex("c0a80105 c0a80101 ffffff00 c0a80101 0a000001 00015180 0000a8c0")
