"""The status blocks byte by byte, in the order of the tables in the manual."""

from __future__ import annotations

from datetime import datetime

from . import ews_status
from .car import Car
from .ews_box import EwsBox
from .ews_rfid import Card

# The fields of one port in `rc`, with the widths of the manual: 54 bytes.
CHARGING = """
41 14 0D 01 02 01 00
0000000A 0000000B 0000000C 0000000D 0000000E 0000000F
01 01 00
FB50 012C 0137
60
01 0203 0405 414E4E4100000000
"""
NOTHING = """
00 00 20 00 00 00 00
00000000 00000000 00000000 00000000 00000000 00000000
00 00 01
04B0 04B0 01BE
00
00 0000 0000 0000000000000000
"""


def box_at_work() -> EwsBox:
    car = Car(phases=1)
    car.plugged = car.requesting = True
    car.current = 10.0
    car.cos_phi = 1.0
    box = EwsBox(cars=(car,), fan=True)
    one, two = box.ports
    one.status, one.cable, one.limit, one.start_mode = 0x41, 20, 13, 2
    one.wants_fan = one.optimised = one.cable_in = True
    one.lock.locked = one.relay.closed = two.rcd_tripped = True
    session = one.session
    session.seconds, session.wh = 10.9, 11.9
    session.last_seconds, session.last_wh = 12.0, 13.0
    session.total_wh, session.cycles = 14.0, 15
    session.card = Card(0x0203, 0x0405, "ANNA")
    return box


def test_rc() -> None:
    box = box_at_work()
    assert ews_status.rc(box) == bytes.fromhex(CHARGING + NOTHING)


def test_rd() -> None:
    box = box_at_work()
    one, two = box.ports
    two.limit = 6
    two.session.last_card = Card(0x0607, 0x0809, "BOB")
    one.session.last_end = (2026, 11, 22, 6, 7, 8)
    expected = """
    000008FC 00000000
    15 64
    03 00
    14 00
    0D 06
    00 0000 0000 0000000000000000
    01 0607 0809 424F420000000000
    07EA 0B 16 06 07 08
    0000 00 00 00 00 00
    """
    assert ews_status.rd(box) == bytes.fromhex(expected)


def test_rs() -> None:
    box = box_at_work()
    box.set_clock(datetime(2026, 11, 22, 6, 7, 8))  # noqa: DTZ001 - as the box's
    box.present_card(Card(0x0203, 0x0405, "ANNA"))
    parts = (
        b"M165300103\x00",
        b"\x03",
        b"012345678901",
        b"\x00\x01\xe2\x40",
        b"\xbe\xef",
        b"Web 1.0".ljust(20, b"\x00"),
        b"\x00",
        box.mac,
        b"\x00",
        bytes(4),
        b"\x20",
        b"\x01",
        bytes.fromhex("07EA 0B 16 06 07 08"),
        b"\x00",
        b"MCR6241-100",
        b"\x01",
        bytes.fromhex("04112233445566"),
        b"\x00\x00",
        bytes.fromhex("0203 0405"),
        b"ANNA\x00\x00\x00\x00",
    )
    expected = b"".join(parts)
    assert len(expected) == 105
    assert ews_status.rs(box) == expected
    box.cards.add(1, 0x0203)
    assert ews_status.rs(box)[91] == 1
