"""Home Assistant as the master of SmartEVSE nodes from 2.20 on, 3.x included."""

from typing import Any

from homeassistant.const import EVENT_HOMEASSISTANT_STOP
from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers import device_registry as dr, entity_registry as er
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry
from syrupy.assertion import SnapshotAssertion

from custom_components.evse_bus.diagnostics import async_get_config_entry_diagnostics
from tests.common import (
    call,
    charger,
    entity_id,
    get_entity,
    running,
    setup_bus,
    shut_down,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.entity_table import device_table, entity_table
from tests.flow import Flow
from tests.smartevse import car, shorten
from tests.test_coordinator import issue
from tests.test_entities import UNSTEADY
from tests.test_smartevse_master import SUPPLY, both_charge, bus_entity
from tests.virtual import SmartEvse, VirtualBus, smartevse_requests_in

FAMILIES = [
    pytest.param(("2.20", "2.20", "2.20"), id="2.20"),
    pytest.param(("2.30", "2.30+", "3"), id="later"),
]
UNITS = (2, 5, 8)


@pytest.fixture(autouse=True)
def quick_master(monkeypatch: pytest.MonkeyPatch) -> None:
    """Listen for less long before we speak."""
    shorten(monkeypatch, LISTENING=0.6)


def nodes(*dialects: str, units: tuple[int, ...] = UNITS) -> list[SmartEvse]:
    """Return nodes with a car each."""
    return [
        SmartEvse(
            dialect, load_balance=unit, car=car(), max_current=16, serial=unit * 1111
        )
        for dialect, unit in zip(dialects, units, strict=False)
    ]


async def all_charge(
    hass: HomeAssistant, entry: MockConfigEntry, boxes: list[SmartEvse]
) -> None:
    """Plug all cars in once all boxes were read: before, a request is refused."""
    for index in range(len(boxes)):
        await get_entity(hass, "sensor", entry, "1_status", index=index)
    await both_charge(hass, entry, boxes)


def most_at_once(bus: VirtualBus) -> float:
    """Return the highest sum that was broadcast, A."""
    return max(
        sum(one.values) / 10
        for one in smartevse_requests_in(bus)
        if one.unit == 9 and len(one.values) >= 8
    )


def offered(boxes: list[SmartEvse]) -> list[float]:
    return [box.pilot_current if box.contactor else 0 for box in boxes]


@pytest.mark.parametrize("dialects", FAMILIES)
async def test_orders_reach_the_cars_of_nodes(
    hass: HomeAssistant, dialects: tuple[str, ...]
) -> None:
    boxes = nodes(*dialects)
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await all_charge(hass, entry, boxes)
        await bus.wait_for_async(
            lambda: round(sum(offered(boxes)), 1) >= 19.8, timeout=60
        )
        assert max(offered(boxes)) < 7
        stored = [box.flash_writes for box in boxes]

        # One of them off: the others share what it leaves.
        for index, box in enumerate(boxes):
            allowed = entity_id(hass, "switch", entry, "charging_allowed", index=index)
            others = [one for one in boxes if one is not box]
            await call(hass, "switch.turn_off", allowed)
            assert not box.contactor
            await bus.wait_for_async(lambda: offered(others) == [10, 10], timeout=60)  # noqa: B023
            assert state_of(hass, allowed) == "off"
            await call(hass, "switch.turn_on", allowed)
            await bus.wait_for_async(lambda: box.contactor, timeout=120)  # noqa: B023

        # A lower limit for one of them, and for all together.
        limit = entity_id(hass, "number", entry, "charging_current", index=2)
        await call(hass, "number.set_value", limit, value=6)
        await bus.wait_for_async(lambda: offered(boxes) == [7, 7, 6], timeout=60)
        supply = bus_entity(hass, "number", "shared_supply")
        await call(hass, "number.set_value", supply, value=18.3)
        await bus.wait_for_async(lambda: sum(offered(boxes)) <= 18.3, timeout=5)
        assert most_at_once(bus) <= 20
        # A pause of a 3.x is no write to its flash memory.
        assert [box.flash_writes for box in boxes] == stored


@pytest.mark.parametrize("dialects", FAMILIES)
async def test_nodes_charge_on_over_a_restart(
    hass: HomeAssistant, dialects: tuple[str, ...]
) -> None:
    boxes = nodes(*dialects[1:])
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await all_charge(hass, entry, boxes)
        await bus.wait_for_async(lambda: offered(boxes) == [10, 10], timeout=60)
        await shut_down(hass, entry)
        await hass.config_entries.async_setup(entry.entry_id)
        for index in range(2):
            status = await get_entity(hass, "sensor", entry, "1_status", index=index)
            await wait_for_state(hass, status, "charging")
        before = len(boxes[0].broadcasts)
        await bus.wait_for_async(
            lambda: len(boxes[0].broadcasts) > before + 3, timeout=15
        )
        await bus.wait_for_async(lambda: offered(boxes) == [10, 10], timeout=60)
        assert not any(box.error for box in boxes)
        assert most_at_once(bus) <= 20


async def test_the_fail_safe_is_that_of_the_firmware(hass: HomeAssistant) -> None:
    dialects = {"2.30": "stops", "2.30+": "stops", "3.6": "unproven", "3": "stops"}
    boxes = nodes(*dialects, units=(2, 3, 4, 5))
    async with running(hass, *boxes, supply=SUPPLY) as (entry, _):
        for index, expected in enumerate(dialects.values()):
            found = await get_entity(hass, "sensor", entry, "fail_safe", index=index)
            await wait_for_state(hass, found, expected)


@pytest.mark.parametrize("removed", [0, 1, 2])
async def test_a_node_that_is_removed_while_it_charges_is_stopped(
    hass: HomeAssistant, removed: int
) -> None:
    """Also a 3.x, whose access is not written: its value in the broadcast is 0."""
    boxes = nodes("2.30", "2.30+", "3")
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await all_charge(hass, entry, boxes)
        gone = boxes[removed]
        stored = gone.flash_writes
        subentry = list(entry.subentries)[removed]
        hass.config_entries.async_remove_subentry(entry, subentry)
        await bus.wait_for_async(lambda: not gone.contactor, timeout=10)
        await hass.async_block_till_done()
        assert gone.flash_writes == stored
        others = [box for box in boxes if box is not gone]
        await bus.wait_for_async(lambda: offered(others) == [10, 10], timeout=60)
        # It asks again, and nobody grants it anything.
        until = bus.now() + 90
        await bus.wait_for_async(lambda: bus.now() > until, timeout=100)
        assert not gone.contactor
        assert most_at_once(bus) <= 20


@pytest.mark.parametrize("unloaded", [True, False])
async def test_no_box_is_left_behind_that_goes_on_for_ever(
    hass: HomeAssistant,
    caplog: pytest.LogCaptureFixture,
    unloaded: bool,  # noqa: FBT001
) -> None:
    """The others stop by themselves; a reload must not stop them."""
    proven, unproven = boxes = nodes("2.30", "3.6")
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await all_charge(hass, entry, boxes)
        if unloaded:
            assert await hass.config_entries.async_unload(entry.entry_id)
        else:
            hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
            await hass.async_block_till_done()
        assert not unproven.pilot_current
        assert proven.contactor
        await bus.wait_for_async(lambda: not unproven.contactor, timeout=10)
        await bus.wait_for_async(lambda: not proven.contactor, timeout=12)
        until = bus.now() + 60
        await bus.wait_for_async(lambda: bus.now() > until, timeout=70)
        assert not unproven.contactor
        assert unproven.access
    assert "failed" not in caplog.text


async def test_a_node_whose_address_is_changed_is_stopped_at_the_old_one(
    hass: HomeAssistant,
) -> None:
    """Here alone: the box keeps its number, and nothing answers at the new one."""
    boxes = nodes("2.30", "3")
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await all_charge(hass, entry, boxes)
        await bus.wait_for_async(lambda: offered(boxes) == [10, 10], timeout=60)
        stored = boxes[1].flash_writes
        moved = list(entry.subentries.values())[1]
        flow = await Flow.change_settings(hass, entry, moved)
        typed = {
            "name": moved.title,
            "slave": "7",
            "installation_limit": 16,
            "expert": {"poll_interval": 2, "voltage": 230},
        }
        await flow.submit(typed)
        assert moved.data["address"] == 7
        assert moved.data["dialect"] == "3.x"
        await bus.wait_for_async(lambda: not boxes[1].contactor, timeout=15)
        assert boxes[1].flash_writes == stored
        await bus.wait_for_async(lambda: offered(boxes) == [16, 0], timeout=60)

        # Back again: it charges as before.
        flow = await Flow.change_settings(hass, entry, moved)
        await flow.submit({**typed, "slave": "5"})
        await bus.wait_for_async(lambda: offered(boxes) == [10, 10], timeout=200)
        assert most_at_once(bus) <= 20


@pytest.mark.usefixtures("all_entities_enabled")
async def test_entities_and_devices_of_nodes(
    hass: HomeAssistant, snapshot: SnapshotAssertion
) -> None:
    boxes = nodes("2.30", "3.6", "3")
    async with running(hass, *boxes, supply=SUPPLY, poll_interval=2) as (entry, _):
        for index in range(3):
            limit = await get_entity(
                hass, "number", entry, "setting_maximum_current", index=index
            )
            await wait_for_state(hass, limit, "16")
        await hass.async_block_till_done()
        shown = [
            one
            for one in er.async_entries_for_config_entry(
                er.async_get(hass), entry.entry_id
            )
            if one.config_subentry_id == list(entry.subentries)[1]
        ]
        assert entity_table(hass, shown, UNSTEADY) == snapshot
        registry = dr.async_get(hass)
        devices = dr.async_entries_for_config_entry(registry, entry.entry_id)
        assert device_table(devices) == snapshot


# -- Access in the flash memory of a 3.x -------------------------------------------------


@pytest.mark.usefixtures("all_entities_enabled")
async def test_access_is_stored_in_a_3_x_on_request(hass: HomeAssistant) -> None:
    boxes = nodes("3")
    [box] = boxes
    async with running(hass, *boxes, supply=SUPPLY) as (entry, bus):
        await all_charge(hass, entry, boxes)
        before = box.flash_writes
        stored = await get_entity(hass, "switch", entry, "stored_access")
        allowed = entity_id(hass, "switch", entry, "charging_allowed")
        assert state_of(hass, stored) == "on"
        for _ in range(2):
            # Written once: it wears out.
            await call(hass, "switch.turn_off", stored)
            assert box.flash_writes == before + 1
        await bus.wait_for_async(lambda: not box.contactor, timeout=10)
        assert not box.access
        await wait_for_state(hass, allowed, "off")
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "switch.turn_on", allowed)
        assert refused.value.translation_key == "smartevse_access_stored_off"
        assert box.flash_writes == before + 1

        await call(hass, "switch.turn_on", stored)
        assert box.flash_writes == before + 2
        await call(hass, "switch.turn_on", allowed)
        await bus.wait_for_async(lambda: box.contactor, timeout=120)
        assert box.flash_writes == before + 2


async def test_stored_access_is_hidden_and_a_3_x_has_it_alone(
    hass: HomeAssistant,
) -> None:
    boxes = nodes("2.30", "2.30+", "3")
    async with running(hass, *boxes, supply=SUPPLY) as (entry, _):
        for index in range(3):
            await get_entity(hass, "sensor", entry, "1_status", index=index)
        found = [
            entity_id(hass, "switch", entry, "stored_access", index=index)
            for index in range(3)
        ]
        assert found[:2] == [None, None]
        registered = er.async_get(hass).async_get(found[2] or "")
        assert registered is not None
        assert registered.disabled_by is er.RegistryEntryDisabler.INTEGRATION


# -- Boxes that need different masters ---------------------------------------------------


async def test_a_mix_that_shows_later_stops_all_writes_and_is_repaired(
    hass: HomeAssistant,
) -> None:
    """It was off, and has another firmware when it is back."""
    first, second = nodes("2.30", "2.20", units=(2, 3))
    with VirtualBus.in_loop(first) as bus:
        entry = await setup_bus(
            hass,
            "smartevse_master",
            bus.url,
            charger("smartevse_master", 2, title="Left"),
            charger("smartevse_master", 3, title="Right", dialect="2.30"),
            **SUPPLY,
        )
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_on", allowed)
        first.car.plug_in()
        await bus.wait_for_async(lambda: first.contactor, timeout=150)
        assert not issue(hass, "mixed_firmware_bus")

        bus.add(second)
        await bus.wait_for_async(lambda: issue(hass, "mixed_firmware_bus"), timeout=60)
        found = issue(hass, "mixed_firmware_bus")
        shown = found.translation_placeholders["chargers"]
        assert shown == "- Left (Slave 1 / Node 1)\n- Right (Slave 2 / Node 2)"
        await wait_until(
            hass,
            lambda: entry.subentries["smartevse_master3"].data["dialect"] == "2.20",
        )
        found = issue(hass, "mixed_firmware_bus")
        assert found.translation_placeholders == {
            "bus": "Bus",
            "chargers": "- Right (Slave 2 / Node 2): SmartEVSE v2, firmware 2.20\n\n"
            "- Left (Slave 1 / Node 1): SmartEVSE v2, firmware 2.30",
        }
        # Until it was read it has received what the other one is sent, and ignored it.
        assert not any(one.taken for one in second.writes)
        written = [len(one.writes) for one in (first, second)]
        await bus.wait_for_async(lambda: not first.contactor, timeout=15)
        await hass.async_block_till_done()
        assert [len(one.writes) for one in (first, second)] == written

        # Taken off the line, and removed here: the other one charges again.
        bus.remove(second)
        hass.config_entries.async_remove_subentry(entry, list(entry.subentries)[1])
        await wait_until(hass, lambda: not issue(hass, "mixed_firmware_bus"))
        await bus.wait_for_async(lambda: first.contactor, timeout=150)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_mix_is_known_before_any_box_was_read(hass: HomeAssistant) -> None:
    """After a restart nothing may be written to either, whichever is read first."""
    first, second = nodes("2.30", "2.20", units=(2, 3))
    with VirtualBus.in_loop(first, second) as bus:
        entry = await setup_bus(
            hass,
            "smartevse_master",
            bus.url,
            charger("smartevse_master", 2, dialect="2.30"),
            charger("smartevse_master", 3, dialect="2.20"),
            **SUPPLY,
        )
        await wait_until(hass, lambda: issue(hass, "mixed_firmware_bus"))
        await get_entity(hass, "sensor", entry, "1_status")
        assert not first.broadcasts
        assert not second.broadcasts
        assert not first.writes
        assert not second.writes
        await hass.config_entries.async_unload(entry.entry_id)
        assert not issue(hass, "mixed_firmware_bus")


# -- Privacy -----------------------------------------------------------------------------


async def test_serial_numbers_of_nodes_are_not_in_the_diagnostics(
    hass: HomeAssistant,
) -> None:
    boxes = nodes("2.30", "2.30+", "3")
    serials = [box.serial for box in boxes]
    async with running(hass, *boxes, supply=SUPPLY) as (entry, _):
        await all_charge(hass, entry, boxes)
        await wait_until(
            hass,
            lambda: all(one.data["serial"] for one in entry.subentries.values()),
        )
        data: dict[str, Any] = await async_get_config_entry_diagnostics(hass, entry)
        frames = data.pop("frames")
        read = [one["hex"] for one in frames if one["direction"] != "sent"]
        assert any(one[2:6] == "0418" for one in read), "no long status was read"
        assert any(one[2:6] == "0410" for one in read), "no short status was read"
        shown = str(data)
        for serial in serials:
            assert str(serial) not in shown
            assert all(
                f"{serial:04x}" not in one[6:] for one in read if one[2:6] == "0418"
            )
        shares = data["master"]["shares"]
        assert shares.keys() == {"2", "5", "8"}
