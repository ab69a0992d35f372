"""Two dialogues at once: what one stores, the other must not store again."""

from homeassistant.core import HomeAssistant
from homeassistant.data_entry_flow import FlowResultType
import pytest

from tests.common import charger as stored_charger, setup_bus
from tests.flow import Flow, charger, port_step
from tests.virtual import AblBox, VirtualBus

pytestmark = pytest.mark.usefixtures("quick_search")


@pytest.mark.usefixtures("not_set_up")
async def test_two_dialogues_for_one_port(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        first = await port_step(hass, "abl", bus.url)
        await first.wait()
        second = await port_step(hass, "abl", bus.url)
        await second.wait()
        for flow in (first, second):
            await flow.submit({"chargers": ["1"], "installation_limit": 16})
            await flow.submit(charger("Box"))
        for flow in (first, second):
            await flow.submit()
        assert first.result["type"] is FlowResultType.CREATE_ENTRY
        assert second.result["type"] is FlowResultType.ABORT
        assert second.result["reason"] == "already_configured"


@pytest.mark.usefixtures("not_set_up")
async def test_a_search_beside_a_search_on_one_port(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        first = await port_step(hass, "abl", bus.url)
        await bus.wait_for_async(lambda: bus.log.total)
        second = await port_step(hass, "abl", bus.url)
        assert second.errors == {"base": "port_busy"}
        second.abort()
        await first.wait()
        assert first.step == "select"
        first.abort()


@pytest.mark.parametrize("second_is", ["searched", "typed"])
async def test_two_dialogues_for_one_charger(
    hass: HomeAssistant, second_is: str
) -> None:
    """Two chargers at one address would set limits of one box."""
    with VirtualBus.in_loop(AblBox(1), AblBox(2, serial="2W22xy00000002")) as bus:
        entry = await setup_bus(hass, "abl", bus.url, stored_charger("abl", 1))
        first = await Flow.add_charger(hass, entry)
        await first.choose("manual")
        await first.submit({"device_id": "2"})
        second = await Flow.add_charger(hass, entry)
        if second_is == "searched":
            await second.choose("scan")
            await second.wait()
            await second.submit({"chargers": "2"})
        else:
            await second.choose("manual")
            await second.submit({"device_id": "2"})
        # Both are at the last form when the first one is stored.
        await first.submit(charger("First"))
        await second.submit(charger("Second"))
        assert second.step == "confirm_abl"
        await first.submit()
        assert first.result["type"] is FlowResultType.CREATE_ENTRY
        await hass.async_block_till_done()
        await second.submit()
        assert second.result["type"] is FlowResultType.ABORT
        assert second.result["reason"] == "already_configured"
        addresses = [one.data["address"] for one in entry.subentries.values()]
        assert addresses == [1, 2]
        await hass.config_entries.async_unload(entry.entry_id)
