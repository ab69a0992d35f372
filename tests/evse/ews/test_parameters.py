"""Parameters: read byte by byte, changed without touching anything else."""

from ipaddress import IPv4Address

from hypothesis import assume, given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import (
    ImplausibleReplyError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews.wire.frames import Bcc
from custom_components.evse_bus.evse.ews.wire.parameters import (
    BLOCKS,
    EXTRA_BLOCK,
    INSTALLATION_BLOCK,
    SYSTEM_BLOCK,
    USER_BLOCK,
    Block,
    CableMode,
    ExtraParameters,
    InstallationInfo,
    LockType,
    Shown,
    SystemMode,
    SystemParameters,
    TimeZone,
    UserParameters,
    shown,
)

from .wire import message

SYSTEM = (
    b"topsecret\0\0\0"
    + bytes.fromhex("02")  # ports
    + bytes.fromhex("e3")  # server, with cards; three unknown bits
    + bytes.fromhex("000003e8")  # 1000 pulses a kWh
    + bytes.fromhex("01")  # Walther
    + b"4711"
    + bytes.fromhex("01 10 01")  # ventilation, 16 A, restart
    + bytes.fromhex("84")  # port 2 in mode 1; an unknown bit
)
USER = (
    b"mypass\0\0\0\0\0\0"
    + bytes.fromhex("00000000 2710 c0a80101 ffffff00 c0a80102 1f90")
    + bytes.fromhex("00 01")
)
INSTALLATION = (
    b"M\xfcller".ljust(30, b"\0")
    + b"Am Weg 1".ljust(30, b"\0")
    + b"Erfurt".ljust(30, b"\0")
    + b"0361 1".ljust(20, b"\0")
    + b"K-77".ljust(20, b"\0")
)
EXTRA = bytes.fromhex("000001f4 0d 00e6 00e7 01 00") + bytes(range(53))


def test_rp() -> None:
    system = SYSTEM_BLOCK.decode(SYSTEM)
    assert system == SystemParameters(
        admin_password="topsecret",  # noqa: S106 - the vector's
        ports=2,
        mode=SystemMode.SERVER | SystemMode.CARDS | SystemMode(0xE0),
        pulses_per_kwh=1000,
        lock_type=LockType.WALTHER,
        card_pin="4711",
        ventilation=True,
        maximum_current=16,
        restart_after_power_failure=True,
        cable_mode=CableMode.PORT_2_MODE_1 | CableMode(0x80),
    )
    assert system.mode_1 == (False, True)
    assert not system.fixed_cable
    fixed = SYSTEM_BLOCK.decode(SYSTEM[:-1] + b"\x03")
    assert fixed.mode_1 == (True, False)
    assert fixed.fixed_cable


def test_ru() -> None:
    assert USER_BLOCK.decode(USER) == UserParameters(
        user_password="mypass",  # noqa: S106 - the vector's
        address=IPv4Address("0.0.0.0"),  # noqa: S104 - by DHCP
        source_port=10000,
        gateway=IPv4Address("192.168.1.1"),
        netmask=IPv4Address("255.255.255.0"),
        server=IPv4Address("192.168.1.2"),
        server_port=8080,
        language=0,
        zone_code=TimeZone.CET,
    )


def test_ri() -> None:
    assert INSTALLATION_BLOCK.decode(INSTALLATION) == InstallationInfo(
        name="Müller",
        street="Am Weg 1",
        town="Erfurt",
        telephone="0361 1",
        customer_number="K-77",
    )


def test_rz() -> None:
    assert EXTRA_BLOCK.decode(EXTRA) == ExtraParameters(
        pulses_per_kwh_2=500,
        maximum_current_2=13,
        voltage_1=230,
        voltage_2=231,
        compatible_1=True,
        compatible_2=False,
        reserved=bytes(range(53)),
    )


def test_which_commands_read_and_write() -> None:
    assert [(block.read, block.write) for block in BLOCKS] == [
        ("rp", "sp"),
        ("ru", "su"),
        ("ri", "si"),
        ("rz", "sz"),
    ]


# -- Changing ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("block", "before", "changes", "at", "wire"),
    [
        (SYSTEM_BLOCK, SYSTEM, {"maximum_current": 13}, 24, "0d"),
        (SYSTEM_BLOCK, SYSTEM, {"maximum_current": 0}, 24, "00"),
        (SYSTEM_BLOCK, SYSTEM, {"lock_type": LockType.FCT_LOW}, 18, "03"),
        (SYSTEM_BLOCK, SYSTEM, {"ports": 1, "ventilation": False}, 12, "01"),
        (USER_BLOCK, USER, {"server": IPv4Address("10.0.0.9")}, 26, "0a000009"),
        (USER_BLOCK, USER, {"source_port": 65526}, 16, "fff6"),
        (INSTALLATION_BLOCK, INSTALLATION, {"town": "Köln"}, 60, "4bf66c6e"),
        (EXTRA_BLOCK, EXTRA, {"voltage_2": 400}, 7, "0190"),
    ],
)
def test_a_change_on_the_wire(
    block: Block[object],
    before: bytes,
    changes: dict[str, object],
    at: int,
    wire: str,
) -> None:
    request = block.change(before, changes)
    assert request.command is block.write
    after = request.parameters
    new = bytes.fromhex(wire)
    assert after[at : at + len(new)] == new
    rest = [place for place in range(len(before)) if before[place] != after[place]]
    # ventilation and town have more than one byte to change.
    assert set(rest) <= {*range(at, at + len(new)), 23, 64, 65}
    assert request.encode(Bcc.ALL) == message("C", block.write.encode() + after)


def test_unknown_bits_are_kept() -> None:
    mode = SYSTEM_BLOCK.decode(SYSTEM).mode
    request = SYSTEM_BLOCK.change(SYSTEM, {"mode": mode | SystemMode.EXCLUSIVE})
    assert request.parameters[13] == 0xF3
    request = SYSTEM_BLOCK.change(SYSTEM, {"mode": mode & ~SystemMode.CARDS})
    assert request.parameters[13] == 0xE1
    request = SYSTEM_BLOCK.change(SYSTEM, {"mode": SystemMode.SERVER})
    assert request.parameters[13] == 0xE1


@given(st.binary(min_size=53, max_size=53), st.integers(0, 0xFFFF))
def test_reserved_bytes_are_kept(reserved: bytes, voltage: int) -> None:
    before = EXTRA[:11] + reserved
    after = EXTRA_BLOCK.change(before, {"voltage_1": voltage}).parameters
    assert after == before[:5] + voltage.to_bytes(2) + before[7:]


@pytest.mark.parametrize(
    ("block", "before", "changes"),
    [
        (SYSTEM_BLOCK, SYSTEM, {"ports": 3}),
        (SYSTEM_BLOCK, SYSTEM, {"lock_type": 4}),
        (SYSTEM_BLOCK, SYSTEM, {"maximum_current": 5}),
        (SYSTEM_BLOCK, SYSTEM, {"maximum_current": 81}),
        (SYSTEM_BLOCK, SYSTEM, {"card_pin": "123"}),
        (SYSTEM_BLOCK, SYSTEM, {"admin_password": "thirteen signs"}),
        (USER_BLOCK, USER, {"source_port": 65527}),
        (USER_BLOCK, USER, {"zone_code": 2}),
        (USER_BLOCK, USER, {"user": "x"}),
        (EXTRA_BLOCK, EXTRA, {"maximum_current_2": 5}),
        (EXTRA_BLOCK, EXTRA, {}),
        (INSTALLATION_BLOCK, INSTALLATION, {"customer_number": 21 * "x"}),
    ],
)
def test_a_change_that_cannot_be(
    block: Block[object], before: bytes, changes: dict[str, object]
) -> None:
    with pytest.raises(RefusedOrderError):
        block.change(before, changes)


def test_a_block_of_another_length_is_not_written() -> None:
    for block, data in ((SYSTEM_BLOCK, SYSTEM), (EXTRA_BLOCK, EXTRA)):
        for wrong in (data[:-1], data + b"\0", b""):
            with pytest.raises(ImplausibleReplyError):
                block.decode(wrong)
            with pytest.raises(ImplausibleReplyError):
                block.change(wrong, {block.struct.fields[1].name: 1})


def test_a_box_without_ports_is_not_believed() -> None:
    with pytest.raises(ImplausibleReplyError):
        SYSTEM_BLOCK.decode(SYSTEM[:12] + b"\0" + SYSTEM[13:])


# -- Passwords -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("secret", "expected"),
    [
        (b"topsecret\0\0\0", Shown.SHOWN),
        (b"topsecret   ", Shown.SHOWN),
        (b"exactlytwelv", Shown.SHOWN),
        (bytes(12), Shown.EMPTY),
        (12 * b" ", Shown.EMPTY),
        (b"\0hidden\0\0\0\0\0", Shown.EMPTY),
        (12 * b"*", Shown.MASKED),
        (b"****\0\0\0\0\0\0\0\0", Shown.MASKED),
        (8 * b"x" + bytes(4), Shown.MASKED),
        (12 * b"\xff", Shown.MASKED),
        (b"\x95\x95\x94\x95" + bytes(8), Shown.MASKED),
        (b"a\x01b" + bytes(9), Shown.MASKED),
        (b"0000", Shown.SHOWN),
        (b"****", Shown.MASKED),
        (bytes(4), Shown.EMPTY),
    ],
)
def test_whether_a_secret_was_read(secret: bytes, expected: Shown) -> None:
    assert shown(secret) is expected


@given(st.binary(min_size=12, max_size=12))
def test_whether_a_secret_was_read_is_known_from_the_block(secret: bytes) -> None:
    text = secret.split(b"\0")[0].decode("latin-1")
    # Spaces around a text are not kept.
    assume(text == text.strip())
    block = USER_BLOCK.decode(secret + USER[12:])
    assert USER_BLOCK.shown_secrets(block) == {"user_password": shown(secret)}


@pytest.mark.parametrize(
    ("block", "data", "change", "name"),
    [
        (SYSTEM_BLOCK, SYSTEM, {"ports": 1}, "admin_password"),
        (USER_BLOCK, USER, {"server_port": 1}, "user_password"),
    ],
)
@pytest.mark.parametrize("hidden", [bytes(12), 12 * b"*", b"***" + bytes(9)])
def test_a_hidden_password_is_not_erased(
    *,
    block: Block[object],
    data: bytes,
    change: dict[str, object],
    name: str,
    hidden: bytes,
) -> None:
    masked = hidden + data[12:]
    with pytest.raises(RefusedOrderError, match=name):
        block.change(masked, change)
    # Unless it is given, be it empty.
    for password in ("", "new"):
        request = block.change(masked, change | {name: password})
        assert request.parameters[:12] == password.encode().ljust(12, b"\0")


@pytest.mark.parametrize("hidden", [b"****", bytes(4)])
def test_a_hidden_pin_is_not_erased(hidden: bytes) -> None:
    masked = SYSTEM[:19] + hidden + SYSTEM[23:]
    with pytest.raises(RefusedOrderError, match="card_pin"):
        SYSTEM_BLOCK.change(masked, {"ports": 1, "admin_password": "new"})
    for pin in ("4711", ""):
        request = SYSTEM_BLOCK.change(masked, {"ports": 1, "card_pin": pin})
        assert request.parameters[19:23] == pin.encode().ljust(4, b"\0")


def test_a_password_that_was_read_is_written_unchanged() -> None:
    padded = b"topsecret \x00\x7f" + SYSTEM[12:]
    assert SYSTEM_BLOCK.change(padded, {"ports": 1}).parameters[:12] == padded[:12]


def test_no_repr_and_no_error_has_private_data() -> None:
    text = "".join(
        repr(block.decode(data))
        for block, data in (
            (SYSTEM_BLOCK, SYSTEM),
            (USER_BLOCK, USER),
            (INSTALLATION_BLOCK, INSTALLATION),
        )
    )
    text += repr(SYSTEM_BLOCK.change(SYSTEM, {"admin_password": "newsecret"}))
    with pytest.raises(RefusedOrderError) as caught:
        SYSTEM_BLOCK.change(SYSTEM, {"admin_password": "muchtoolongsecret"})
    text += str(caught.value)
    for private in ("secret", "4711", "mypass", "192.168", "Weg", "Erfurt", "0361"):
        assert private not in text
