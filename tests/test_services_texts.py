"""What the forms of the actions offer, name and take is one thing."""

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import ServiceValidationError
from homeassistant.helpers import service
from homeassistant.util.yaml import load_yaml_dict
from hypothesis import given, strategies as st
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.actions import cards, fields, leds
from custom_components.evse_bus.actions.parameters import (
    BLOCKS,
    LOCK_TYPES,
    READABLE,
    TIME_ZONES,
)
from custom_components.evse_bus.actions.table import ACTIONS
from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.errors import ActionError
from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.ews.wire.answers import Refusal
from custom_components.evse_bus.evse.ews.wire.cards import ENTRIES, LARGEST
from custom_components.evse_bus.evse.ews.wire.commands import PortLeds, set_leds
from tests.flow import english, has_range
from tests.reasons import reason_keys

from .services import WRITERS

HERE = Path(__file__).parents[1] / "custom_components/evse_bus"
ICONS = json.loads((HERE / "icons.json").read_text())["services"]


def descriptions() -> dict[str, Any]:
    """Return what is in services.yaml, without the parts that are used again."""
    read = load_yaml_dict(str(HERE / "services.yaml"))
    return {key: value for key, value in read.items() if not key.startswith(".")}


def fields_of(name: str) -> dict[str, Any]:
    """Return the fields of an action, those in sections as well."""
    fields: dict[str, Any] = {}
    for key, field in descriptions()[name]["fields"].items():
        if "selector" in field:
            fields[key] = field
        else:
            assert not fields.keys() & field["fields"].keys()
            fields |= field["fields"]
    return fields


def sections_of(name: str) -> set[str]:
    return {
        key
        for key, field in descriptions()[name]["fields"].items()
        if "selector" not in field
    }


def test_every_action_is_described() -> None:
    assert descriptions().keys() == ACTIONS.keys()
    assert english()["services"].keys() == ACTIONS.keys()
    assert ICONS.keys() == ACTIONS.keys()


@pytest.mark.parametrize("name", ACTIONS)
def test_the_form_has_what_the_action_takes(name: str) -> None:
    action = ACTIONS[name]
    fields = fields_of(name)
    assert fields.keys() == {"device_id", *action.required, *action.optional}
    needed = {key for key, field in fields.items() if field.get("required")}
    assert needed == {"device_id", *action.required}
    assert fields["device_id"]["selector"] == {"device": {"integration": DOMAIN}}


@pytest.mark.parametrize("name", ACTIONS)
def test_everything_in_the_form_has_a_text(name: str) -> None:
    texts = english()["services"][name]
    assert texts["name"]
    assert texts["description"].endswith(".")
    assert texts["fields"].keys() == fields_of(name).keys()
    for text in texts["fields"].values():
        assert text["name"]
        assert text["description"].endswith(".")
    assert texts.get("sections", {}).keys() == sections_of(name)
    assert ICONS[name].get("sections", {}).keys() == sections_of(name)


def selects(fields: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        field["selector"]["select"]
        for field in fields.values()
        if "select" in field["selector"]
    ]


def test_choices_are_those_that_are_taken_and_have_texts() -> None:
    entry = fields_of("write_card_list")["entries"]["selector"]["object"]
    found = [one for name in ACTIONS for one in selects(fields_of(name))]
    found += selects(entry["fields"])
    options = {
        "led": [*leds.STATES],
        "card_kind": [*cards.KINDS],
        "parameter_block": [*READABLE],
        "lock_type": [*LOCK_TYPES],
        "box_time_zone": [*TIME_ZONES],
    }
    assert {one["translation_key"] for one in found} == options.keys()
    for one in found:
        key = one["translation_key"]
        assert one["options"] == options[key]
        assert english()["selector"][key]["options"].keys() == set(options[key])
    texts = english()["selector"][entry["translation_key"]]["fields"]
    assert texts.keys() == entry["fields"].keys()


def number_fields(name: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the fields of an action that are numbers, with their bounds."""
    return [
        (key, field["selector"]["number"])
        for key, field in fields_of(name).items()
        if "number" in field["selector"]
    ]


def test_the_texts_of_numbers_name_their_ranges(subtests: pytest.Subtests) -> None:
    for name in ACTIONS:
        for key, bounds in number_fields(name):
            text = english()["services"][name]["fields"][key]["description"]
            with subtests.test(key=f"{name}.{key}"):
                assert has_range(text, bounds["min"], bounds["max"]), text
    entry = fields_of("write_card_list")["entries"]["selector"]["object"]
    texts = english()["selector"][entry["translation_key"]]["fields"]
    for key, field in entry["fields"].items():
        if (bounds := field["selector"].get("number")) is not None:
            text = texts[key]["description"]
            assert has_range(text, bounds["min"], bounds["max"]), text


def test_the_form_has_the_bounds_of_what_is_taken(subtests: pytest.Subtests) -> None:
    take: dict[str, Callable[[dict[str, object]], object]] = {
        "set_leds": lambda data: leds.port_leds(
            {next(iter(data)).split("_")[0]: "blink", **data}
        ),
        "set_meter_total": lambda data: fields.meter_total("", data["total"]),
        **{WRITERS[block]: BLOCKS[block].changes for block in BLOCKS},
    }
    for name, action in take.items():
        for key, bounds in number_fields(name):
            step = bounds.get("step", 1)
            with subtests.test(key=str(key)):
                action({key: bounds["min"]})
                action({key: bounds["max"]})
                for wrong in (bounds["min"] - step, bounds["max"] + step):
                    with pytest.raises(ServiceValidationError):
                        action({key: wrong})


def test_the_form_has_the_bounds_of_cards() -> None:
    for key, bounds in number_fields("accept_card"):
        assert (bounds["min"], bounds["max"]) == (1, LARGEST), key
    entry = fields_of("write_card_list")["entries"]["selector"]["object"]["fields"]
    assert {
        key: field["selector"]["number"]["max"]
        for key, field in entry.items()
        if key != "kind"
    } == {"entry": ENTRIES - 1, "group": LARGEST, "number": LARGEST}


async def test_home_assistant_takes_the_descriptions(hass: HomeAssistant) -> None:
    entry = MockConfigEntry(domain=DOMAIN, data={"protocol": "ews", "device": "/x"})
    entry.add_to_hass(hass)
    await hass.config_entries.async_setup(entry.entry_id)
    told = (await service.async_get_all_descriptions(hass))[DOMAIN]
    assert told.keys() == ACTIONS.keys()
    for name, action in ACTIONS.items():
        assert told[name]["fields"].keys() == descriptions()[name]["fields"].keys()
        assert told[name].get("response", {}).get("optional", None) == (
            False if action.responds else None
        )


def test_every_refusal_has_a_text() -> None:
    texts = english()["exceptions"]
    keys = {f"ews_{reason}" for reason in Refusal}
    for key in keys:
        assert "{charger}" in texts[key]["message"], key
    states = {key for key in reason_keys() if key.startswith("ews_")}
    assert {key for key in texts if key.startswith("ews_")} == {
        *keys,
        *states,
        "ews_secret_hidden",
    }
    assert set(ActionError) <= texts.keys()


# -- What passes here passes the library -----------------------------------------

ANYTHING = st.one_of(
    st.integers(-10, 100),
    st.integers(),
    st.floats(),
    st.text(max_size=40),
    st.text(st.characters(max_codepoint=255), max_size=40),
    st.booleans(),
    st.none(),
    st.ip_addresses(v=4).map(str),
    st.sampled_from([*LOCK_TYPES, *TIME_ZONES, "on", "off", "255.255.0.0"]),
    st.lists(st.integers(), max_size=2),
)


@given(st.data())
def test_what_passes_here_passes_the_library(data: st.DataObject) -> None:
    """So no message of the library about a field ever reaches people."""
    block = BLOCKS[data.draw(st.sampled_from([*BLOCKS]))]
    parameter = data.draw(st.sampled_from(block.parameters))
    value = data.draw(ANYTHING)
    try:
        changes = block.changes({parameter.key: value})
    except ServiceValidationError:
        return
    raw = bytearray(block.block.struct.length)
    if "ports" in {one.name for one in block.block.struct.fields}:
        raw[12] = 2
    told = block.block.decode(bytes(raw))
    change = changes(told)
    assert change.keys() == {parameter.field}
    secrets = dict.fromkeys(block.block.secrets, "")
    try:
        block.block.change(bytes(raw), secrets | change)
    except RefusedOrderError as error:
        message = f"{parameter.key}: {value!r}: {error}"
        raise AssertionError(message) from error


@given(st.dictionaries(st.sampled_from(leds.FIELDS), ANYTHING))
def test_leds_that_pass_here_pass_the_library(given_: dict[str, object]) -> None:
    try:
        shown = leds.port_leds(given_)
    except ServiceValidationError:
        return
    assert set_leds(shown, PortLeds()).parameters
