"""Home Assistant as the master of SmartEVSE slaves: one supply, one master."""

import asyncio
from typing import Any
from unittest.mock import patch

from homeassistant.const import EVENT_HOMEASSISTANT_STOP
from homeassistant.core import HomeAssistant
from homeassistant.exceptions import ServiceValidationError
from homeassistant.helpers import entity_registry as er
from homeassistant.helpers.storage import Store
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.diagnostics import async_get_config_entry_diagnostics
from custom_components.evse_bus.stores.orders import ORDERS_KEY, Record, SupplyOrder
from tests.common import (
    call,
    charger,
    entity_id,
    get_entity,
    orders_file,
    running,
    setup_bus,
    shut_down,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.smartevse import car, shorten
from tests.test_coordinator import issue
from tests.virtual import SmartEvse, VirtualBus, smartevse_requests_in

SUPPLY = {"supply_limit": 20.0, "supply_minimum": 6.0}


@pytest.fixture(autouse=True)
def quick_master(monkeypatch: pytest.MonkeyPatch) -> None:
    """Listen for less long before we speak; the others' time runs faster."""
    shorten(monkeypatch, LISTENING=0.6, STAY_SILENT=1.0)


def slaves(count: int = 2, **options: Any) -> list[SmartEvse]:  # noqa: ANN401 - a box's
    """Return slaves with a car each."""
    return [
        SmartEvse(load_balance=unit, car=car(), max_current=16, **options)
        for unit in range(2, 2 + count)
    ]


def bus_entity(hass: HomeAssistant, platform: str, key: str) -> str:
    """Return an entity of the bus itself."""
    found = er.async_get(hass).async_get_entity_id(platform, DOMAIN, f"bus_{key}")
    assert found
    return found


def broadcasts(bus: VirtualBus) -> list[tuple[int, ...]]:
    """Return the currents that were broadcast, 0.1 A for units 1 to 4."""
    return [
        one.values
        for one in smartevse_requests_in(bus)
        if (one.unit, one.register) == (0, 1)
    ]


async def both_charge(
    hass: HomeAssistant, entry: MockConfigEntry, boxes: list[SmartEvse]
) -> None:
    """Plug both cars in, and let them charge as much as they may."""
    for index, box in enumerate(boxes):
        limit = await get_entity(hass, "number", entry, "charging_current", index=index)
        allowed = await get_entity(
            hass, "switch", entry, "charging_allowed", index=index
        )
        await call(hass, "switch.turn_on", allowed)
        await call(hass, "number.set_value", limit, value=16)
        box.car.plug_in()
        status = await get_entity(hass, "sensor", entry, "1_status", index=index)
        await wait_for_state(hass, status, "charging")


def stored_supply(storage: dict[str, Any]) -> float | None:
    record = storage[ORDERS_KEY]["data"]["bus:bus"]
    return record["supply"]  # type: ignore[no-any-return]


async def test_a_supply_is_shared(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        supply = bus_entity(hass, "number", "shared_supply")
        attributes = hass.states.get(supply).attributes
        assert state_of(hass, supply) == "20.0"
        assert (attributes["min"], attributes["max"]) == (0, 20.0)
        await bus.wait_for_async(
            lambda: [one.pilot_current for one in boxes] == [10, 10]
        )
        said = len(broadcasts(bus))
        await call(hass, "number.set_value", supply, value=14.55)
        # When the action returns it is being told.
        await bus.wait_for_async(
            lambda: broadcasts(bus)[-1] == (0, 72, 72, 0), timeout=0.5
        )
        assert state_of(hass, supply) == "14.5"
        assert stored_supply(hass_storage) == 14.5
        offered = await get_entity(hass, "sensor", entry, "offered_current")
        await wait_for_state(hass, offered, "7.2")
        # What one may ask for does not go down with its share.
        limit = entity_id(hass, "number", entry, "charging_current")
        assert state_of(hass, limit) == "16.0"
        assert hass.states.get(limit).attributes["max"] == 16.0
        for absurd in (20.1, -1, float("nan")):
            with pytest.raises(ServiceValidationError):
                await call(hass, "number.set_value", supply, value=absurd)
        assert max(map(sum, broadcasts(bus)[said:])) <= 200


async def test_the_shared_supply_outlives_a_restart(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = orders_file(bus__bus=Record(SupplyOrder(8.0)))
    boxes = slaves()
    async with running(
        hass, *boxes, supply=SUPPLY, fail_safe_current=16.0, installation_limit=16.0
    ) as (entry, bus):
        supply = bus_entity(hass, "number", "shared_supply")
        assert state_of(hass, supply) == "8.0"
        boxes[0].car.plug_in()
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "charging")
        await bus.wait_for_async(lambda: boxes[0].pilot_current == 8.0)
        assert max(one[1] for one in broadcasts(bus)) <= 80
        assert not issue(hass, "supply_lost_bus")


async def test_a_lost_supply_is_told(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    async with running(hass, *slaves(), supply=SUPPLY) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status")
        await shut_down(hass, entry)
        del hass_storage[ORDERS_KEY]
        await hass.config_entries.async_setup(entry.entry_id)
        supply = bus_entity(hass, "number", "shared_supply")
        assert state_of(hass, supply) == "6.0"
        assert issue(hass, "supply_lost_bus")
        await call(hass, "number.set_value", supply, value=20)
        assert not issue(hass, "supply_lost_bus")


async def test_an_order_that_nobody_waits_for_any_more_counts(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """An automation that begins anew cancels what it waits for: here, the disk."""
    disk = asyncio.Event()
    writing = asyncio.Event()
    write = Store._async_write_data

    async def slow(self: Store, data: dict[str, Any]) -> None:
        writing.set()
        await disk.wait()
        await write(self, data)

    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        await entry.runtime_data.orders.async_flush()
        supply = bus_entity(hass, "number", "shared_supply")
        with patch.object(Store, "_async_write_data", slow):
            action = asyncio.create_task(
                call(hass, "number.set_value", supply, value=13.0)
            )
            await writing.wait()
            action.cancel()
            await asyncio.wait({action})
            disk.set()
            await bus.wait_for_async(lambda: broadcasts(bus)[-1] == (0, 65, 65, 0))
        assert state_of(hass, supply) == "13.0"
        assert stored_supply(hass_storage) == 13.0


async def test_a_smaller_installation_counts_at_once(hass: HomeAssistant) -> None:
    """Without a reload: the slaves hear their master all the time."""
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        coordinator = entry.runtime_data
        supply = bus_entity(hass, "number", "shared_supply")
        hass.config_entries.async_update_entry(
            entry, data={**entry.data, "supply_limit": 13.0}
        )
        await wait_for_state(hass, supply, "13.0")
        await bus.wait_for_async(lambda: broadcasts(bus)[-1] == (0, 65, 65, 0))
        assert hass.states.get(supply).attributes["max"] == 13.0
        assert entry.runtime_data is coordinator
        assert bus.opened == 1
        # A larger minimum: only one of them can have it.
        hass.config_entries.async_update_entry(
            entry, data={**entry.data, "supply_minimum": 10.0}
        )
        await bus.wait_for_async(
            lambda: sorted(one.contactor for one in boxes) == [False, True], timeout=10
        )
        # Another port is another bus.
        hass.config_entries.async_update_entry(
            entry, data={**entry.data, "baudrate": 9600}
        )
        await wait_until(hass, lambda: entry.runtime_data is not coordinator)


async def test_off_is_off_for_one_and_the_other_gets_more(hass: HomeAssistant) -> None:
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", allowed)
        assert not boxes[0].contactor
        assert not boxes[0].access
        assert state_of(hass, allowed) == "off"
        await bus.wait_for_async(lambda: boxes[1].pilot_current == 16)
        assert boxes[1].contactor


async def test_without_supply_they_wait_and_are_still_allowed(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No sun: access is off in the boxes, and nobody has to switch them on again."""
    shorten(monkeypatch, WITHHELD_FOR=1.0)
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        supply = bus_entity(hass, "number", "shared_supply")
        one, two = [
            await get_entity(hass, "switch", entry, "charging_allowed", index=index)
            for index in range(2)
        ]
        status = entity_id(hass, "sensor", entry, "1_status")
        await call(hass, "number.set_value", supply, value=5)
        await bus.wait_for_async(lambda: not any(box.contactor for box in boxes))
        await wait_for_state(hass, status, "suspended_evse")
        assert not any(box.access for box in boxes)
        assert (state_of(hass, one), state_of(hass, two)) == ("on", "on")
        problem = entity_id(hass, "binary_sensor", entry, "problem")
        assert state_of(hass, problem) == "off"
        # Off is the user's word, also then.
        await call(hass, "switch.turn_off", two)
        assert state_of(hass, two) == "off"

        await call(hass, "number.set_value", supply, value=20)
        await bus.wait_for_async(lambda: boxes[0].contactor, timeout=10)
        await wait_for_state(hass, status, "charging")
        assert not boxes[1].access
        assert state_of(hass, two) == "off"


async def test_a_slave_that_is_removed_while_it_charges_is_stopped(
    hass: HomeAssistant,
) -> None:
    """It would follow what the others are told, and nobody would count it."""
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        gone = next(iter(entry.subentries.values()))
        hass.config_entries.async_remove_subentry(entry, gone.subentry_id)
        await bus.wait_for_async(lambda: not boxes[0].contactor, timeout=10)
        await hass.async_block_till_done()
        assert not boxes[0].access
        assert boxes[1].contactor
        await bus.wait_for_async(lambda: boxes[1].pilot_current == 16, timeout=10)


async def test_the_slaves_stop_without_home_assistant(hass: HomeAssistant) -> None:
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY, time_scale=2) as (entry, bus):
        await both_charge(hass, entry, boxes)
        fail_safe = await get_entity(hass, "sensor", entry, "fail_safe")
        assert state_of(hass, fail_safe) == "stops"
        hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
        await hass.async_block_till_done()
        assert all(one.contactor for one in boxes)
        await bus.wait_for_async(
            lambda: not any(one.contactor for one in boxes), timeout=7
        )
        # Their own doing: nobody has told them to.
        assert all(one.access for one in boxes)


async def test_a_reload_does_not_stop_them(hass: HomeAssistant) -> None:
    boxes = slaves()
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await both_charge(hass, entry, boxes)
        status = entity_id(hass, "sensor", entry, "1_status")
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_for_state(hass, status, "charging")
        heard = len(broadcasts(bus))
        await bus.wait_for_async(lambda: len(broadcasts(bus)) > heard + 1)
        assert all(one.contactor for one in boxes)
        assert not any(one.error for one in boxes)


async def test_another_master(hass: HomeAssistant) -> None:
    boxes = slaves(1)
    other = SmartEvse(load_balance=1)
    with VirtualBus.in_loop(*boxes, time_scale=4) as bus:
        entry = await setup_bus(
            hass, "smartevse_master", bus.url, charger("smartevse_master", 2), **SUPPLY
        )
        status = await get_entity(hass, "sensor", entry, "1_status")
        second = bus_entity(hass, "binary_sensor", "second_master")
        assert state_of(hass, second) == "off"

        bus.add(other)
        await wait_for_state(hass, second, "on")
        assert issue(hass, "second_master_bus")
        assert state_of(hass, status) == "unavailable"
        allowed = entity_id(hass, "switch", entry, "charging_allowed")
        assert state_of(hass, allowed) == "unavailable"
        master = (await async_get_config_entry_diagnostics(hass, entry))["master"]
        assert (master["silent"], master["noticed"]) == (True, ["second_master"])
        # What they share can be said all the same; it counts when we speak again.
        supply = bus_entity(hass, "number", "shared_supply")
        await call(hass, "number.set_value", supply, value=9)
        sent = len(bus.log.bursts())

        bus.remove(other)
        await wait_for_state(hass, second, "off")
        assert not issue(hass, "second_master_bus")
        await wait_for_state(hass, status, "available")
        assert state_of(hass, supply) == "9.0"
        assert len(bus.log.bursts()) > sent
        await hass.config_entries.async_unload(entry.entry_id)


async def test_the_issue_of_another_master_goes_with_the_bus(
    hass: HomeAssistant,
) -> None:
    boxes = (*slaves(1), SmartEvse(load_balance=1))
    with VirtualBus.in_loop(*boxes, time_scale=4) as bus:
        entry = await setup_bus(
            hass, "smartevse_master", bus.url, charger("smartevse_master", 2), **SUPPLY
        )
        await wait_until(hass, lambda: issue(hass, "second_master_bus"))
        await hass.config_entries.async_unload(entry.entry_id)
        assert not issue(hass, "second_master_bus")
        # It was there first: not a word was said.
        assert not smartevse_requests_in(bus)


async def test_a_slave_of_a_later_firmware(hass: HomeAssistant) -> None:
    box = SmartEvse("2.30+", load_balance=2)
    async with running(hass, box, supply=SUPPLY) as (entry, bus):
        limit = entity_id(hass, "number", entry, "charging_current")
        await wait_until(hass, lambda: state_of(hass, limit) != "unavailable")
        problem = await get_entity(hass, "binary_sensor", entry, "problem")
        await wait_for_state(hass, problem, "off")
        await bus.wait_for_async(lambda: box.broadcasts)
        assert not box.writes
