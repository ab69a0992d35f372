"""A made-up sixth protocol: its folder, a line in the registry, and texts are enough.

The folder is tests/sixth. Nothing in the integration knows it, and still it is offered,
searched, configured, polled and shown.
"""

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any

from homeassistant.core import HomeAssistant
from homeassistant.data_entry_flow import FlowResultType
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers import device_registry as dr
from homeassistant.helpers.selector import SelectSelector
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests import flow as flows
from tests.common import (
    call,
    get_entity,
    setup_bus,
    state_of,
    wait_for_state,
)
from tests.flow import Flow, charger, fields, port_step
from tests.sixth import PROTOCOL
from tests.sixth.virtual import VirtualSextant
from tests.test_diagnostics import diagnostics, texts
from tests.virtual import VirtualBus

FOLDER = Path(__file__).parent / "sixth"
INTEGRATION = Path(__file__).parents[1] / "custom_components/evse_bus"
SERIAL = "SX-0042"
CONFIG = {
    "address": 3,
    "serial": SERIAL,
    "installation_limit": 16.0,
    "voltage": 230.0,
    "poll_interval": 0.1,
    "order_lifetime": None,
    "fail_safe_current": 6.0,
    "lamp": 55,
}


def merged(texts: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested texts with more of them."""
    return {
        key: merged(texts.get(key, {}), more[key])
        if isinstance(more.get(key), Mapping)
        else more.get(key, texts.get(key))
        for key in {**texts, **more}
    }


@pytest.fixture(autouse=True)
def sixth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the line in the registry, and the texts."""
    monkeypatch.setitem(PROTOCOLS, PROTOCOL.key, PROTOCOL)
    known = flows.english()
    own = json.loads((FOLDER / "texts.json").read_text())
    monkeypatch.setattr(flows, "english", lambda: merged(known, own))


async def running(
    hass: HomeAssistant, bus: VirtualBus, **data: object
) -> MockConfigEntry:
    """Set up a bus with one box, as the flow would."""
    return await setup_bus(
        hass,
        "sextant",
        bus.url,
        {
            "subentry_id": "sextant3",
            "subentry_type": "charger",
            "title": "Garage",
            "unique_id": f"sextant_{SERIAL}",
            "data": CONFIG | data,
        },
    )


def test_nothing_in_the_integration_knows_it() -> None:
    for path in INTEGRATION.rglob("*"):
        if path.suffix in (".py", ".json", ".yaml"):
            assert "sextant" not in path.read_text().lower(), path
    assert "custom_components" not in (FOLDER / "virtual.py").read_text()


@pytest.mark.usefixtures("not_set_up")
async def test_it_is_offered_searched_and_added(hass: HomeAssistant) -> None:
    one, two = VirtualSextant(3, SERIAL), VirtualSextant(8, "SX-0099")
    with VirtualBus.in_loop(one, two) as bus:
        flow = await Flow.add_bus(hass)
        [choice] = flow.result["data_schema"].schema.values()
        assert isinstance(choice, SelectSelector)
        makes = choice.config["options"]
        assert makes == ["evbox", "abl", "smartevse", "ews", "sextant"]
        flow.abort()

        flow = await port_step(hass, "sextant", bus.url)
        assert flow.result["progress_action"] == "scan_sextant"
        await flow.wait()
        assert flow.step == "select"
        assert fields(flow)["chargers"] == ["3", "8"]
        await flow.submit({"chargers": ["3"], "installation_limit": 13})
        assert flow.tells("Charger 1 of 1", SERIAL, "own maximum 16 A")
        assert fields(flow)["name"] == "Sextant 3"
        assert fields(flow)["expert"]["lamp"] == 40
        await flow.submit(charger("Garage", 13, expert={"lamp": 55}))
        assert flow.step == "confirm_sextant"
        assert flow.tells("| Garage | 3 | 13 A | 6 A |")
        await flow.submit()
        assert not one.limits

    assert flow.result["type"] is FlowResultType.CREATE_ENTRY
    entry = flow.result["result"]
    assert entry.title == f"Sextant bus ({Path(bus.url).name})"
    [subentry] = entry.subentries.values()
    assert subentry.unique_id == f"sextant_{SERIAL}"
    assert subentry.data["address"] == 3
    assert subentry.data["lamp"] == 55


@pytest.mark.usefixtures("not_set_up")
async def test_addresses_are_typed(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(baud=57600, parity="N") as bus:
        flow = await port_step(hass, "sextant", bus.url)
        await flow.wait()
        assert flow.step == "nothing_found"
        await flow.choose("manual")
        await flow.submit({"dials": ["4", "4"]})
        assert flow.errors == {"dials": "address_twice"}
        await flow.submit({"dials": ["4", "5"]})
        assert fields(flow)["name"] == "Sextant 4"
        flow.abort()


async def test_entities_and_commands(hass: HomeAssistant) -> None:
    box = VirtualSextant(3, SERIAL)
    with VirtualBus.in_loop(box) as bus:
        entry = await running(hass, bus)
        status = await get_entity(hass, "sensor", entry, "1_status")
        assert state_of(hass, status) == "available"
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        assert state_of(hass, energy) == "1.234"
        await bus.wait_for_async(lambda: box.lamp == 55)
        offered = await get_entity(hass, "sensor", entry, "offered_current")
        await wait_for_state(hass, offered, "6.0")

        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=11.5)
        assert box.limit == 115
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", allowed)
        assert box.limit == 0

        box.key_switch = False
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "switch.turn_on", allowed)
        assert refused.value.translation_key == "sextant_key_switch"
        text = flows.english()["exceptions"]["sextant_key_switch"]["message"]
        assert text.format(**refused.value.translation_placeholders or {}) == (
            "Garage refuses (code 7): its key switch is off."
        )

        device = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, "sextant3"), "bus"
        )
        assert device is not None
        assert (device.manufacturer, device.model) == ("Sextant", "S6")
        assert (device.sw_version, device.serial_number) == ("1.4", SERIAL)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_diagnostics_tell_neither_serial_number_nor_owner(
    hass: HomeAssistant,
) -> None:
    box = VirtualSextant(3, SERIAL, owner="Erika Miller")
    with VirtualBus.in_loop(box) as bus:
        entry = await running(hass, bus)
        await get_entity(hass, "sensor", entry, "1_status")
        data = await diagnostics(hass, entry)
        [shown] = data["chargers"]
        assert shown["info"]["options"] == {"owner": "**REDACTED**"}
        assert shown["info"]["serial"] == "**REDACTED**"
        assert shown["config"]["address"] == 3
        assert shown["config"]["lamp"] == 55
        everything = "\n".join(texts({**data, "frames": []}))
        assert SERIAL not in everything
        assert "Erika" not in everything
        frames = [bytes.fromhex(frame["hex"]) for frame in data["frames"]]
        assert not any(SERIAL.encode() in frame for frame in frames)
        assert any(frame.startswith(b"$3i*******,1.4,") for frame in frames)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_charger_is_added_and_reconfigured(hass: HomeAssistant) -> None:
    one, two = VirtualSextant(3, SERIAL), VirtualSextant(8, "SX-0099")
    with VirtualBus.in_loop(one, two) as bus:
        entry = await running(hass, bus)
        await get_entity(hass, "sensor", entry, "1_status")
        running_charger = entry.runtime_data.chargers["sextant3"].charger

        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        await flow.submit({"chargers": "8"})
        await flow.submit(charger("Yard"))
        assert flow.step == "confirm_sextant"
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        await hass.async_block_till_done()
        await bus.wait_for_async(lambda: two.lamp == 40)

        subentry = entry.subentries["sextant3"]
        flow = await Flow.change_settings(hass, entry, subentry)
        assert fields(flow)["dial"] == "3"
        assert fields(flow)["expert"]["lamp"] == 55
        typed = {"name": "Garage", "installation_limit": 13}
        await flow.submit({**typed, "dial": "8", "expert": {}})
        assert flow.errors == {"dial": "address_taken"}
        await flow.submit({**typed, "dial": "3", "expert": {"lamp": 5}})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        await bus.wait_for_async(lambda: one.lamp == 5)
        # The option is one that a running charger follows.
        assert entry.runtime_data.chargers["sextant3"].charger is running_charger
        await hass.config_entries.async_unload(entry.entry_id)
