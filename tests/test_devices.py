"""Devices: the bus, its chargers behind it, their modules that come and go."""

from collections.abc import Iterator

from homeassistant.core import HomeAssistant
from homeassistant.helpers import (
    device_registry as dr,
    entity_registry as er,
)
import pytest

from custom_components.evse_bus import async_remove_config_entry_device
from custom_components.evse_bus.const import DOMAIN, SUBENTRY_CHARGER
from tests.common import (
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
)
from tests.virtual import AblBox, EvboxChargePoint, SmartEvse


async def test_devices_hang_together(hass: HomeAssistant) -> None:
    async with running(hass, EvboxChargePoint(1923054, 2), poll_interval=1.0) as (
        entry,
        _,
    ):
        await get_entity(hass, "sensor", entry, "2_power")
        devices = dr.async_get(hass)
        find = devices.async_get_device_by_identifier
        bus = find((DOMAIN, "bus"), "bus")
        box = find((DOMAIN, "evbox_1923054"), "bus")
        assert bus.via_device_id is None
        assert bus.config_subentry_id is None
        assert box.via_device_id == bus.id
        assert box.config_subentry_id == "evbox1923054"
        assert (box.manufacturer, box.serial_number) == ("EVBox", "1923054")
        for number in (1, 2):
            module = devices.async_get_child_device_by_identifier(
                (DOMAIN, f"evbox_1923054_{number}"), "bus"
            )
            assert module.parent_device_id == box.id
            assert module.name == f"Module {number}"
            power = entity_id(hass, "sensor", entry, f"{number}_power")
            assert er.async_get(hass).async_get(power).device_id == module.id


async def test_what_a_charger_was_stays_known_while_it_is_off(
    hass: HomeAssistant,
) -> None:
    box = SmartEvse("2.20", unit=1)
    async with running(hass, box) as (entry, bus):

        def shown() -> tuple[str | None, ...]:
            device = dr.async_get(hass).async_get_device_by_identifier(
                (DOMAIN, "smartevse1"), "bus"
            )
            return device.manufacturer, device.model, device.sw_version

        status = await get_entity(hass, "sensor", entry, "1_status")
        before = shown()
        assert before == ("Stegen Electronics", "SmartEVSE v2", "2.20")
        bus.remove(box)
        await wait_for_state(hass, status, "unavailable")
        assert shown() == before
        await hass.config_entries.async_reload(entry.entry_id)
        assert shown() == before
        # Another firmware was loaded meanwhile.
        bus.add(SmartEvse("2.17", load_balance=1))
        await get_entity(hass, "sensor", entry, "1_status")
        assert shown() == (*before[:2], "2.17")


async def test_the_only_connector_is_no_device(hass: HomeAssistant) -> None:
    known_by = f"abl_{AblBox(3).serial}"
    async with running(hass, AblBox(3)) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        box = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, known_by), "bus"
        )
        assert er.async_get(hass).async_get(status).device_id == box.id
        assert (box.manufacturer, box.sw_version) == ("ABL", "1.2")
        assert not dr.async_get(hass).async_get_child_device_by_identifier(
            (DOMAIN, f"{known_by}_1"), "bus"
        )


@pytest.fixture
def two_modules() -> Iterator[EvboxChargePoint]:
    return EvboxChargePoint(1923054, 2)


async def test_a_module_that_is_gone_can_be_deleted(
    hass: HomeAssistant, two_modules: EvboxChargePoint
) -> None:
    async with running(hass, two_modules, poll_interval=1.0) as (entry, _):
        power = await get_entity(hass, "sensor", entry, "2_power")
        devices = dr.async_get(hass)
        module = devices.async_get_child_device_by_identifier(
            (DOMAIN, "evbox_1923054_2"), "bus"
        )
        for device in (
            devices.async_get_device_by_identifier((DOMAIN, "bus"), "bus"),
            devices.async_get_device_by_identifier((DOMAIN, "evbox_1923054"), "bus"),
            module,
        ):
            assert not await async_remove_config_entry_device(hass, entry, device)

        two_modules.remove_module()
        await wait_for_state(hass, power, "unavailable")
        assert await async_remove_config_entry_device(hass, entry, module)
        devices.async_remove_device(module.id)
        await hass.async_block_till_done()
        assert hass.states.get(power) is None

        # It comes back as a module that was never seen.
        two_modules.add_module()
        await get_entity(hass, "sensor", entry, "2_power")


async def test_the_second_module_makes_devices_of_both(hass: HomeAssistant) -> None:
    # A box that answers at once after a reload: it asks for no interval.
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=1.0) as (entry, _):
        first = await get_entity(hass, "sensor", entry, "1_power")
        entities = er.async_get(hass)
        charger_id = entities.async_get(first).device_id
        box.add_module()
        second = await get_entity(hass, "sensor", entry, "2_power")
        assert entities.async_get(first).device_id != charger_id
        parents = {
            dr.async_get(hass)
            .async_get(entities.async_get(one).device_id)
            .parent_device_id
            for one in (first, second)
        }
        assert parents == {charger_id}
        assert state_of(hass, first) == "0.0"

        # So it stays, also when only one is left at the next start.
        box.remove_module()
        await wait_for_state(hass, second, "unavailable")
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_for_state(hass, first, "0.0")
        assert entities.async_get(first).device_id != charger_id
        assert entry.subentries["evbox1923054"].subentry_type == SUBENTRY_CHARGER


async def test_a_device_of_a_bus_that_is_not_running(hass: HomeAssistant) -> None:
    """Nobody knows then what is still there: nothing is deleted, nothing fails."""
    box = EvboxChargePoint(1923054, 2, min_interval=0)
    async with running(hass, box, poll_interval=0.5) as (entry, _):
        await get_entity(hass, "sensor", entry, "2_energy")
        await hass.config_entries.async_unload(entry.entry_id)
        child = dr.async_get(hass).async_get_child_device_by_identifier(
            (DOMAIN, "evbox_1923054_2"), "bus"
        )
        assert not await async_remove_config_entry_device(hass, entry, child)
