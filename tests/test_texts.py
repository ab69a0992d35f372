"""Every key that the code names has a text, and every text belongs to a key."""

import json
from pathlib import Path

from homeassistant.components.sensor import SensorDeviceClass
import pytest

from custom_components.evse_bus import (
    binary_sensor,
    button,
    event as events,
    number,
    select as selects,
    sensor_tables,
    switch as switches,
)
from custom_components.evse_bus.errors import (
    _COMMAND_KEYS,
    _LISTEN_KEYS,
    _PORT_KEYS,
    ActionError,
)
from custom_components.evse_bus.evse.ews.wire.answers import Refusal
from custom_components.evse_bus.evse.ews.wire.parameters import HiddenSecretError
from custom_components.evse_bus.evse.options import Choice, HexBytes, Quantity
from custom_components.evse_bus.evse.protocol import Protocol
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from custom_components.evse_bus.issues import (
    BEGINS_ABOVE_LIMIT,
    DUPLICATE_ADDRESS,
    ENERGY_NOT_COUNTED,
    LINE_TOO_SLOW,
    LOST,
    LOWER_MAXIMUM,
    MIXED_FIRMWARE,
    MODBUS_TCP,
    NO_SUCH_PORT,
    NOT_STORED,
    REPLACED,
    REPLIES_TOO_LATE,
    SECOND_MASTER,
    SET_UP_TWICE,
    SHARED_ADDRESS,
    SUPPLY_LOST,
    TIMEOUT_RAISED,
    UNKNOWN_FIRMWARE,
    WRONG_CHARGER,
)
from tests.flow import english
from tests.reasons import reason_keys

HERE = Path(__file__).parents[1] / "custom_components/evse_bus"

DESCRIPTIONS = {
    "binary_sensor": [
        *binary_sensor.BOX_SENSORS,
        *binary_sensor.CONNECTOR_SENSORS,
        binary_sensor.CONNECTED,
        binary_sensor.ORDERS_EXPIRED,
        binary_sensor.PROBLEM,
        binary_sensor.SECOND_MASTER,
    ],
    "button": button.BUTTONS,
    "event": events.EVENTS,
    "number": [
        *number.NUMBERS,
        *number.SETTINGS,
        number.SUPPLY,
    ],
    "select": [selects.MODE, selects.MODE_AT_START],
    "sensor": [
        *sensor_tables.BUS_SENSORS,
        *sensor_tables.LISTENER_SENSORS,
        sensor_tables.CONNECTED_BOXES,
        *sensor_tables.CHARGER_SENSORS,
        *sensor_tables.CHARGER_STATISTICS,
        *sensor_tables.CONNECTOR_SENSORS,
        sensor_tables.ENERGY,
        sensor_tables.ESTIMATED_ENERGY,
        sensor_tables.FAULT,
    ],
    "switch": [
        *switches.COMMANDS,
        *switches.CONNECTOR_COMMANDS,
        switches.ALLOWED,
    ],
}


@pytest.mark.parametrize("platform", DESCRIPTIONS)
def test_entities_have_names(platform: str) -> None:
    texts = english()["entity"][platform]
    used = set()
    for description in DESCRIPTIONS[platform]:
        if description.translation_key is None:
            # Its device class names it.
            assert description.device_class, description.key
            continue
        used.add(description.translation_key)
        placeholders = description.translation_placeholders or {}
        text = texts[description.translation_key]
        assert text["name"].format(**placeholders)
        if (options := getattr(description, "options", None)) is not None:
            assert text["state"].keys() == set(options)
    assert used == texts.keys()


@pytest.mark.parametrize("platform", DESCRIPTIONS)
def test_icons_belong_to_entities(platform: str) -> None:
    icons = json.loads((HERE / "icons.json").read_text())["entity"].get(platform, {})
    for description in DESCRIPTIONS[platform]:
        key = description.translation_key
        if key is not None and description.device_class in (
            None,
            SensorDeviceClass.ENUM,
        ):
            assert key in icons, key
    assert icons.keys() <= english()["entity"][platform].keys()


def test_errors_have_texts() -> None:
    texts = english()["exceptions"]
    keys = {key for _, key in (*_PORT_KEYS, *_LISTEN_KEYS, *_COMMAND_KEYS)}
    own = {f"ews_{reason}" for reason in Refusal} | {HiddenSecretError.text_key}
    assert keys | own | reason_keys() | set(ActionError) | {NOT_STORED} == texts.keys()
    placeholders = dict.fromkeys(("charger", "port", "error", "expected", "found"), "x")
    for key in keys:
        assert texts[key]["message"].format(**placeholders)
    for key in own:
        assert texts[key]["message"].format(charger="x", code="x", secrets="x")


def test_issues_have_texts() -> None:
    assert english()["issues"].keys() == {
        DUPLICATE_ADDRESS,
        ENERGY_NOT_COUNTED,
        LINE_TOO_SLOW,
        LOST,
        MODBUS_TCP,
        NO_SUCH_PORT,
        NOT_STORED,
        REPLACED,
        REPLIES_TOO_LATE,
        BEGINS_ABOVE_LIMIT,
        LOWER_MAXIMUM,
        SECOND_MASTER,
        SET_UP_TWICE,
        SHARED_ADDRESS,
        SUPPLY_LOST,
        TIMEOUT_RAISED,
        UNKNOWN_FIRMWARE,
        MIXED_FIRMWARE,
        WRONG_CHARGER,
    }


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=PROTOCOLS)
def test_protocols_have_texts(protocol: Protocol) -> None:
    form, make = protocol.address, protocol.make
    config = english()["config"]
    subentry = english()["config_subentries"]["charger"]
    assert make.key in english()["selector"]["protocol"]["options"]
    if make.menu:
        assert protocol.choice in config["step"][make.menu]["menu_options"]
    if form.single:
        assert f"one_{make.key}" in subentry["abort"]
    if not protocol.dials_in:
        assert f"scan_{protocol.key}" in config["progress"]
    for texts in (config, subentry):
        assert f"confirm_{protocol.key}" in texts["step"]
        assert form.error in texts["error"]
        step = texts["step"]["charger" if protocol.ports == 1 else "box"]
        for option in protocol.options:
            place = step if option.prominent else step["sections"]["expert"]
            assert option.name in place["data"]
            assert option.name in place["data_description"]
            if isinstance(option, HexBytes | Quantity):
                assert f"bad_{option.name}" in texts["error"]
            if isinstance(option, Choice):
                labels = english()["selector"][option.name]["options"]
                assert labels.keys() == option.values.keys()
                if option.alone:
                    assert f"{option.name}_not_alone" in texts["error"]
