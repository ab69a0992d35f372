"""Stored parameters, cards, keys, LEDs and firmware of the virtual EWS-Box."""

from __future__ import annotations

import struct

import pytest

from .car import Car
from .ews_box import EwsBox
from .ews_parameters import CardList
from .ews_rfid import Card
from .test_ews_box import OK, REFUSED, charging, line_to

CHANGED = struct.pack(
    ">12sBBIB4sBBBB", b"secret", 2, 0x0D, 2000, 1, b"1234", 1, 16, 1, 0
)


def test_system_parameters() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        assert client.ask("sp", CHANGED) == OK
        assert client.ports()[0]["status"] == 0xF0
        assert client.ask("sp", CHANGED) == REFUSED
        bus.advance(2)
        assert client.ask("rp") == CHANGED
        assert client.ports()[0]["offered"] == 16
        for at, value in ((12, 3), (13, 0x20), (18, 4), (24, 5), (26, 8)):
            wrong = bytearray(CHANGED)
            wrong[at] = value
            assert client.ask("sp", bytes(wrong)) == REFUSED, at
        assert client.ask("sp", CHANGED[:-1]) == REFUSED


def test_system_parameters_not_while_charging() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        charging(bus, box, client, car)
        assert client.ask("sp", CHANGED) == REFUSED
        client.order(1, 6)
        assert client.ask("sp", CHANGED) == OK


@pytest.mark.parametrize(
    ("masking", "shown"),
    [("no", b"secret".ljust(12, b"\x00")), ("zeros", bytes(12)), ("stars", b"*" * 12)],
)
def test_masked_passwords(masking: str, shown: bytes) -> None:
    box = EwsBox(masking=masking)  # type: ignore[arg-type]
    box.system.admin_password = box.user.user_password = b"secret".ljust(12, b"\x00")
    with line_to(box) as (bus, client):
        assert client.ask("rp")[:12] == client.ask("ru")[:12] == shown
        block = client.ask("ru")
        assert client.ask("su", block) == OK
        assert box.user.user_password == shown
        bus.advance(0)


def test_user_parameters_info_and_extra() -> None:
    box = EwsBox()
    with line_to(box) as (_, client):
        user = struct.pack(
            ">12s4sH4s4s4sHBB", b"", bytes(4), 5000, b"abcd", b"efgh", b"ijkl", 77, 0, 1
        )
        assert client.ask("su", user) == OK
        assert client.ask("ru") == user
        assert client.ask("su", user[:-1] + b"\x02") == REFUSED
        assert client.ask("rg") != bytes(28)
        info = bytes(range(130))
        assert client.ask("si", info) == OK
        assert client.ask("ri") == info
        assert client.ask("si", info + b"x") == REFUSED
        extra = struct.pack(">IBHHBB53s", 500, 13, 231, 229, 1, 0, b"")
        assert client.ask("sz", extra) == OK
        assert client.ask("rz") == extra
        assert [p["offered"] for p in client.ports()] == [32, 13]
        assert client.ask("sz", extra[:-1] + b"\x01") == REFUSED
        assert client.ask("sz", b"\x00\x00\x00\x00\x05" + extra[5:]) == REFUSED


def test_card_list() -> None:
    box = EwsBox()
    with line_to(box) as (_, client):
        entries = struct.pack(
            ">64I", 1 << 28 | 5 << 14, 2 << 28 | 6 << 14 | 7, *[0] * 62
        )
        assert client.ask("sf", entries) == OK
        assert client.ask("rf") == entries
        assert client.ask("sf", b"\x40" + entries[1:]) == REFUSED
        assert client.ask("sf", entries[:-4]) == REFUSED
        assert box.cards.allows(5, 9)
        assert box.cards.allows(6, 7)
        assert not box.cards.allows(6, 8)


def test_kinds_of_cards() -> None:
    cards = CardList(kinds="3.1.6")
    cards.add(1, 5, 9)
    cards.add(2, 6)
    cards.add(3, 6, 1)
    assert cards.allows(5, 9)
    assert not cards.allows(5, 8)
    assert cards.allows(6, 2)
    assert not cards.allows(6, 1)


def test_a_start_key_requests_a_start_from_the_server() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(1)
        box.press_key(1, 1)
        message = client.next()
        assert message
        assert message.parameters == b"if\x04" + bytes(8)
        one = client.ports()[0]
        assert (one["status"], one["start_mode"]) == (0x30, 1)
        box.press_key(1, 3)
        assert client.ports()[0]["optimised"] == 1
        assert client.order(1, 3) == 0
        bus.advance(1)
        assert client.ports()[0]["status"] == 0x41
        box.press_key(1, 2)
        bus.advance(1)
        assert client.ports()[0]["status"] == 0x50


def test_a_start_key_starts_standalone() -> None:
    car = Car()
    box = EwsBox(cars=(None, car), mode="standalone")
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(1)
        box.press_key(2, 1)
        bus.advance(1)
        assert client.ports()[1]["status"] == 0x40
        assert not client.unasked


def test_the_web_page() -> None:
    car = Car()
    box = EwsBox(cars=(None, car), mode="standalone")
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(1)
        box.start_on_web_page(2)
        bus.advance(1)
        assert client.ports()[1]["status"] == 0x40
        box.stop_on_web_page(2)
        bus.advance(1)
        assert client.ports()[1]["status"] == 0x50


def test_keys_of_the_server() -> None:
    """Manual I/O: 255 when pressed, the time in tenths when released."""
    box = EwsBox(manual_io=True)
    with line_to(box) as (bus, client):
        box.press_key(2, 4, seconds=1.2)
        assert client.ports()[1]["keys"] & 0x0F == 0b1000
        bus.advance(2)
        box.press_key(1, 1, seconds=60)
        bus.advance(61)
        assert client.ports()[1]["keys"] == 0
        keys = [m.parameters[3:] for m in client.unasked]
        assert keys == [
            bytes((0, 0, 0, 0, 0, 0, 0, 255)),
            bytes((0, 0, 0, 0, 0, 0, 0, 12)),
            bytes((255, 0, 0, 0, 0, 0, 0, 0)),
            bytes((254, 0, 0, 0, 0, 0, 0, 0)),
        ]
        assert all(m.parameters[2] == 0 for m in client.unasked)


def test_leds_of_the_server() -> None:
    unchanged, on, off = (0xFFFF, 0xFFFF, 0), (0xFFFF, 0, 0), (0, 7, 0)
    box = EwsBox(manual_io=True)
    with line_to(box) as (bus, client):

        def leds(*patterns: tuple[int, int, int]) -> int:
            values = [v for p in (*patterns, *[unchanged] * 8)[:8] for v in p]
            assert client.ask("se", struct.pack(">24H", *values)) == OK
            return client.ports()[0]["keys"]

        assert leds(on, off, on) == 0b0101_0000
        assert leds(unchanged, on, off) == 0b0011_0000
        blinking = {leds((500, 500, 0))}
        for _ in range(4):
            bus.advance(0.3)
            blinking.add(client.ports()[0]["keys"])
        assert blinking == {0b0011_0000, 0b0010_0000}
        assert client.ask("se", b"") == REFUSED


def test_leds_of_the_box() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        assert client.ask("se", bytes(48)) == REFUSED
        charging(bus, box, client, car)
        assert client.ports()[0]["keys"] == 0b0010_0000
        client.order(1, 4)
        bus.advance(0.1)
        assert client.ports()[0]["keys"] == 0b0110_0000


def test_a_card_first_then_the_key() -> None:
    car = Car()
    box = EwsBox(cars=(car,), rfid=True)
    box.cards.add(1, 5)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(1)
        box.present_card(Card(5, 77, "ANNA"))
        box.remove_card()
        message = client.next()
        assert message
        assert message.parameters[2] == 1
        box.press_key(1, 1)
        bus.advance(1)
        one = client.ports()[0]
        assert (one["status"], one["group"], one["card"]) == (0x40, 5, 77)
        assert one["name"] == b"ANNA".ljust(8, b"\x00")
        # Only the card that started may stop, presented again.
        box.press_key(1, 2)
        bus.advance(1)
        assert client.ports()[0]["status"] == 0x40
        box.present_card(Card(5, 78))
        box.press_key(1, 2)
        bus.advance(1)
        assert client.ports()[0]["status"] == 0x40
        box.present_card(Card(5, 77))
        box.press_key(1, 2)
        bus.advance(1)
        assert client.ports()[0]["status"] == 0x50
        assert client.ask("rd")[16:21] == bytes((1, 0, 5, 0, 77))


def test_an_unknown_card_requests_a_start_from_the_server() -> None:
    car = Car()
    box = EwsBox(cars=(car,), rfid=True)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(1)
        box.press_key(1, 1)
        assert client.ports()[0]["start_mode"] == 0
        box.present_card(Card(9, 9))
        one = client.ports()[0]
        assert (one["start_mode"], one["group"]) == (1, 9)
        assert client.ask("rs")[71:72] == b"\x00"
        assert client.ask("rs")[83:84] == b"\x01"
        assert client.ask("rs")[91] == 0


@pytest.mark.parametrize("tag", [b"", b"1234567"])
def test_a_foreign_card_is_accepted_by_the_server(tag: bytes) -> None:
    car = Car()
    box = EwsBox(cars=(car,), rfid=True)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(1)
        box.press_key(1, 1)
        box.present_card(Card(foreign=True))
        assert client.ports()[0]["start_mode"] == 0
        assert client.ask("rs")[92] == 1
        card = struct.pack(">HH8s", 3, 4, b"BOB")
        assert client.ask("ma", card[:-1]) == REFUSED
        assert client.ask("ma", card + tag) == OK
        bus.advance(1)
        one = client.ports()[0]
        assert (one["status"], one["group"], one["card"]) == (0x40, 3, 4)
        assert client.ask("rs")[91] == 1


def test_a_server_that_reads_the_cards_itself_names_the_user() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        assert client.ask("ma", struct.pack(">HH8s", 3, 4, b"BOB")) == OK
        charging(bus, box, client, car)
        one = client.ports()[0]
        assert (one["logged_in"], one["group"], one["card"]) == (1, 3, 4)


def test_the_reader() -> None:
    box = EwsBox(rfid=True)
    with line_to(box) as (bus, client):
        assert client.ask("mc", b"\x01\x01id") == OK + b"MCR6241-100"
        assert client.ask("mc", b"\x02\x01xx") == REFUSED
        box.present_card()
        assert client.ask("mc", b"\x02\x01xx")[:1] == OK
        assert client.ask("mc", b"\x03\x01") == REFUSED
        box.reader.fitted = False
        bus.advance(0.1)
        assert client.ports()[0]["status"] == 0xA7
        assert client.order(1, 3) == 10
        assert client.ask("rs")[71] == 1


def test_firmware() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    image = bytes(range(256)) * 8
    with line_to(box) as (bus, client):
        charging(bus, box, client, car)
        assert client.ask("fw") == REFUSED
        assert client.ask("oe", struct.pack(">II", 0, 0x30001)) == REFUSED
        assert client.ask("oe", struct.pack(">II", 0, 0x10000)) == OK
        for start in range(0, len(image), 1024):
            part = image[start : start + 1024]
            address = struct.pack(">II", start, len(part))
            assert client.ask("ow", address + part) == OK
            assert client.ask("ow", address + part) == REFUSED
        assert client.ask("ow", struct.pack(">II", 4096, 2) + b"x") == REFUSED
        assert client.ask("fw") == OK
        bus.wait_for(lambda: box.restarts == 1)
        assert box.activated == [image[:-1]]
        assert box.ports[0].session.result == 1
