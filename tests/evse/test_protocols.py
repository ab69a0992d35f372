"""The declarations of all protocols: complete, and without contradictions."""

from dataclasses import fields

import pytest

from custom_components.evse_bus.evse.address import NumberAddress, TextAddress
from custom_components.evse_bus.evse.options import (
    Choice,
    HexBytes,
    Option,
    Quantity,
    Toggle,
)
from custom_components.evse_bus.evse.protocol import Protocol
from custom_components.evse_bus.evse.protocols import PROTOCOLS, protocols_by_make
from tests.sixth import PROTOCOL as SEXTANT

ALL = [*PROTOCOLS.values(), SEXTANT]
each_protocol = pytest.mark.parametrize("protocol", ALL, ids=lambda one: one.key)
each_option = pytest.mark.parametrize(
    ("protocol", "option"),
    [(protocol, option) for protocol in ALL for option in protocol.options],
    ids=lambda one: getattr(one, "key", None) or getattr(one, "name", None),
)


@each_option
def test_defaults_of_options_are_those_of_the_configuration(
    protocol: Protocol, option: Option
) -> None:
    [field] = [one for one in fields(protocol.config) if one.name == option.name]
    stored = option.store(option.default)
    assert option.load(stored) == field.default
    assert option.store(option.show(stored)) == stored


@each_protocol
def test_live_fields_are_fields_of_the_configuration(protocol: Protocol) -> None:
    names = {one.name for one in fields(protocol.config)}
    assert protocol.config.live <= names
    assert ("time_zone" in names) is protocol.sets_clock


@each_protocol
def test_a_supply_needs_a_master(protocol: Protocol) -> None:
    assert (protocol.circuit is None) == (protocol.master is None)


def test_protocols_of_a_make_are_chosen_from_a_menu() -> None:
    for protocols in protocols_by_make().values():
        several = len(protocols) > 1
        for protocol in protocols:
            assert bool(protocol.make.menu) is several
            assert bool(protocol.choice) is several
            assert bool(protocol.make.plural) or not protocol.dials_in


def test_a_box_is_known_by_its_serial_number() -> None:
    assert PROTOCOLS["abl"].identity("2W22") == "abl_2W22"
    for blank in (None, "", "  ", "00000000"):
        assert PROTOCOLS["abl"].identity(blank) is None
    # The same boxes, reached in two ways.
    for key in ("ews", "ews_network"):
        assert PROTOCOLS[key].identity("728193645508") == "ews_728193645508"
    # Of 16 bits.
    for key in ("smartevse", "smartevse_master"):
        assert PROTOCOLS[key].identity("4711") is None


# -- Addresses -------------------------------------------------------------------

SERIAL = PROTOCOLS["evbox"].address
BOX = PROTOCOLS["ews"].address


@pytest.mark.parametrize(
    ("text", "address"), [("1", 1), (" 8 ", 8), (3, 3), ("03", 3), ("9", 9)]
)
def test_numbers(text: object, address: int) -> None:
    form = NumberAddress(key="dial", lowest=1, highest=9)
    assert form.parse(text) == address
    assert form.show(address) == str(address)
    assert form.serial(address) is None


@pytest.mark.parametrize("text", ["0", "10", "-1", "1.5", "x", "", "²", "٣"])
def test_no_numbers(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - its message is not shown
        NumberAddress(key="dial", lowest=1, highest=9).parse(text)


@pytest.mark.parametrize("text", ["", "  ", "a-b", "ä", "1234567890123"])
def test_no_texts(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - its message is not shown
        TextAddress(key="box", longest=12).parse(text)


def test_addresses_that_are_serial_numbers() -> None:
    assert SERIAL.show(1923054) == "01923054"
    assert SERIAL.serial(1923054) == "1923054"
    assert SERIAL.serial(0) is None
    assert BOX.parse(" 728193645508 ") == "728193645508"
    assert BOX.serial("728193645508") == "728193645508"
    assert BOX.serial("") is None


# -- Options ---------------------------------------------------------------------


def test_choices_that_need_to_be_alone() -> None:
    option = Choice(
        name="x", default="a", values={"a": 1, "b": 2}, alone=frozenset({"b"})
    )
    assert not option.needs_solitude(1)
    assert not option.needs_solitude(None)
    assert option.needs_solitude(2)


@pytest.mark.parametrize(
    ("option", "typed"),
    [
        (Choice(name="x", default="a", values={"a": 1}), "b"),
        (HexBytes(name="x", default="00", length=1), "0"),
        (HexBytes(name="x", default="00", length=1), "0011"),
        (HexBytes(name="x", default="00", length=1), "xy"),
        (Quantity(name="x", default=1, lowest=0, highest=9, unit="%"), float("nan")),
        (Quantity(name="x", default=1, lowest=0, highest=9, unit="%"), 10),
        (Quantity(name="x", default=1, lowest=0, highest=9, unit="%"), 1.5),
    ],
)
def test_invalid_values(option: Option, typed: object) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - its message is not shown
        option.store(typed)


def test_stored_values() -> None:
    half = Quantity(
        name="x", default=1.0, lowest=0, highest=9, step=0.5, unit="A", whole=False
    )
    assert half.store(1) == 1.0
    assert isinstance(half.store(1), float)
    assert HexBytes(name="x", default="00", length=2).store("0a fF") == "0AFF"
    assert Toggle(name="x").store(typed=True) is True
