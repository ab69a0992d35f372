"""The virtual box packs its records by itself, from the same manual."""

from dataclasses import fields
from datetime import datetime
from ipaddress import IPv4Address
from typing import Any

from hypothesis import given, strategies as st

from custom_components.evse_bus.evse.ews.wire.answers import (
    confirmed,
    decode_firmware_id,
)
from custom_components.evse_bus.evse.ews.wire.box_status import decode_box, decode_dhcp
from custom_components.evse_bus.evse.ews.wire.cards import (
    AcceptedCard,
    EntryKind,
    accept_card,
    card_entry,
    decode_cards,
    write_cards,
)
from custom_components.evse_bus.evse.ews.wire.commands import (
    PortLeds,
    ReaderTarget,
    blinking,
    card_reader,
    erase_rom,
    set_clock,
    set_leds,
    set_meter,
    write_rom,
)
from custom_components.evse_bus.evse.ews.wire.frames import CommandId, Request
from custom_components.evse_bus.evse.ews.wire.parameters import (
    EXTRA_BLOCK,
    INSTALLATION_BLOCK,
    SYSTEM_BLOCK,
    USER_BLOCK,
)
from custom_components.evse_bus.evse.ews.wire.status import (
    PortStatus,
    decode_details,
    decode_ports,
)
from tests.virtual import ews_parameters, ews_status
from tests.virtual.ews_box import EwsBox
from tests.virtual.ews_commands import COMMANDS

byte = st.integers(0, 0xFF)
double = st.integers(0, 0xFFFF)
word = st.integers(0, 0xFFFFFFFF)
amperes = st.integers(0, 80)
flag = st.booleans()
volts = st.integers(0, 1500)
address = word.map(IPv4Address)
text = st.text("aZ09-äß", min_size=1, max_size=12)


def values(record: Any) -> list[Any]:  # noqa: ANN401 - any of the blocks
    return [getattr(record, field.name) for field in fields(record)]


_port = st.tuples(
    *(byte, amperes, amperes, byte, byte, flag, byte),
    *(6 * [word]),
    *(3 * [flag]),
    *(st.integers(-1500, 1500), st.integers(-1500, 1500), volts, byte),
)


@given(_port, _port)
def test_rc(one: tuple[Any, ...], two: tuple[Any, ...]) -> None:
    data = b"".join(ews_status.RC.pack(*port, bytes(13)) for port in (one, two))

    def raw(port: PortStatus) -> tuple[Any, ...]:
        known = values(port)
        assert known.pop() is None
        known[16:19] = [round(100 * voltage) for voltage in known[16:19]]
        return tuple(known)

    assert tuple(raw(port) for port in decode_ports(data)) == (one, two)


@given(st.tuples(st.integers(1, 2), byte, word, byte, flag, byte, flag, byte))
def test_rp(numbers: tuple[Any, ...]) -> None:
    ports, mode, pulses, lock, fan, most, restart, cable = numbers
    data = ews_parameters.SP.pack(
        b"secret", ports, mode, pulses, lock, b"4711", fan, most, restart, cable
    )
    assert values(SYSTEM_BLOCK.decode(data)) == [
        *("secret", ports, mode, pulses, lock, "4711", fan, most, restart, cable)
    ]


@given(st.tuples(text, address, double, address, address, address, double, byte, byte))
def test_ru(known: tuple[Any, ...]) -> None:
    packed = [
        one.packed
        if isinstance(one, IPv4Address)
        else one.encode("latin-1")
        if isinstance(one, str)
        else one
        for one in known
    ]
    assert values(USER_BLOCK.decode(ews_parameters.SU.pack(*packed))) == [*known]


@given(st.tuples(*5 * [text]))
def test_ri(texts: tuple[str, ...]) -> None:
    data = ews_parameters.SI.pack(*(one.encode("latin-1") for one in texts))
    assert values(INSTALLATION_BLOCK.decode(data)) == [*texts]


@given(
    st.tuples(
        word, byte, double, double, flag, flag, st.binary(min_size=53, max_size=53)
    )
)
def test_rz(known: tuple[Any, ...]) -> None:
    data = ews_parameters.SZ.pack(*known)
    assert values(EXTRA_BLOCK.decode(data)) == [*known]


def box_at(seconds: float) -> EwsBox:
    box = EwsBox(manual_io=True, mode1=(False, True))
    box.now = lambda: seconds  # type: ignore[method-assign]
    return box


def ask(box: EwsBox, command: CommandId) -> bytes:
    return COMMANDS[command](box, b"")


def tell(box: EwsBox, request: Request) -> None:
    assert confirmed(request.command)(
        COMMANDS[request.command](box, request.parameters)
    )


def test_all_records_of_a_box_are_decoded() -> None:
    box = box_at(100.0)
    system = SYSTEM_BLOCK.decode(ask(box, CommandId.READ_SYSTEM))
    assert system.mode_1 == (False, True)
    one, two = decode_ports(ask(box, CommandId.READ_PORTS), system.mode_1)
    assert (one.offered_current, one.pwm_maximum, two.locked) == (32, 12.0, None)
    assert decode_details(ask(box, CommandId.READ_DETAILS)).pwm_duty == (100, 100)
    status = decode_box(ask(box, CommandId.READ_BOX))
    assert (status.serial, status.maximum_current) == ("012345678901", 32)
    assert status.clock == datetime.fromisoformat("2000-01-01T00:01:40")
    assert decode_firmware_id(ask(box, CommandId.READ_FIRMWARE_ID)) == "M165300103"
    box.user.own_ip, box.lease = bytes(4), 3600
    assert decode_dhcp(ask(box, CommandId.READ_DHCP)).lease == 3600


def test_all_commands_to_a_box_are_accepted() -> None:
    box = box_at(100.0)
    tell(box, set_meter(1, 123456))
    tell(box, set_clock(datetime.fromisoformat("2026-01-02T03:04:05")))
    tell(box, accept_card(AcceptedCard(group=1, number=2, user="Max")))
    tell(box, set_leds(PortLeds(red=blinking(100, 200)), PortLeds()))
    cards = decode_cards(ask(box, CommandId.READ_CARDS))
    cards = cards.with_entries({3: card_entry(EntryKind.CARD, 7, 42)})
    tell(box, write_cards(cards))
    for block, name, value in (
        (SYSTEM_BLOCK, "pulses_per_kwh", 500),
        (USER_BLOCK, "server_port", 8080),
        (INSTALLATION_BLOCK, "town", "Köln"),
        (EXTRA_BLOCK, "voltage_2", 231),
    ):
        secrets = dict.fromkeys(block.secrets, "")
        before = ask(box, block.read)
        tell(box, block.change(before, {name: value, **secrets}))
        assert getattr(block.decode(ask(box, block.read)), name) == value
    port = decode_ports(ask(box, CommandId.READ_PORTS))[0]
    assert port.total_energy == 123456
    clock = decode_box(ask(box, CommandId.READ_BOX)).clock
    assert clock == datetime.fromisoformat("2026-01-02T03:04:05")
    assert box.cards.allows(7, 42)
    assert not box.cards.allows(7, 43)


def test_firmware_and_card_reader() -> None:
    box = box_at(100.0)
    tell(box, erase_rom(0, 1024))
    tell(box, write_rom(16, b"firmware"))
    assert box.rom[16:24] == b"firmware"
    request = card_reader(ReaderTarget.READER, 1, b"id")
    assert COMMANDS["mc"](box, request.parameters).startswith(b"\0MCR")
