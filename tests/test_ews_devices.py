"""The devices of an EWS-Box: the box, and its ports as parts of it."""

from homeassistant.config_entries import ConfigEntry
from homeassistant.core import HomeAssistant
from homeassistant.helpers import (
    device_registry as dr,
    entity_registry as er,
    issue_registry as ir,
)

from custom_components.evse_bus import async_remove_config_entry_device
from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.coordinator import BUS
from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
)
from tests.ews import charge, polled, quick_car
from tests.virtual import EwsBox

YARD = f"ews_{EwsBox().serial}"


def device(hass: HomeAssistant, key: str) -> dr.DeviceEntry | None:
    return dr.async_get(hass).async_get_device_by_identifier((DOMAIN, key), "bus")


def child(hass: HomeAssistant, key: str) -> dr.ChildDeviceEntry | None:
    return dr.async_get(hass).async_get_child_device_by_identifier((DOMAIN, key), "bus")


def by_device(hass: HomeAssistant) -> dict[str, set[str]]:
    """Return the unique ids of the entities of each device."""
    found: dict[str, set[str]] = {}
    for one in er.async_entries_for_config_entry(er.async_get(hass), "bus"):
        found.setdefault(one.device_id or "", set()).add(one.unique_id)
    return found


def use_ports(hass: HomeAssistant, entry: ConfigEntry, ports: int) -> None:
    """Let the user say how many ports of the box are used."""
    subentry = entry.subentries["ews01"]
    hass.config_entries.async_update_subentry(
        entry,
        subentry,
        data={**subentry.data, "ports": ports, "installation_limit_2": 16.0},
    )


async def test_a_box_and_its_two_ports(hass: HomeAssistant) -> None:
    async with running(hass, EwsBox(rfid=True)) as (entry, _):
        await get_entity(hass, "sensor", entry, "2_status")
        await get_entity(hass, "event", entry, "card")
        await hass.async_block_till_done()
        bus, box = device(hass, "bus"), device(hass, YARD)
        assert bus is not None
        assert box is not None
        assert bus.via_device_id is None
        assert box.via_device_id == bus.id
        assert box.config_subentry_id == "ews01"
        assert (box.name, box.manufacturer, box.model) == (
            "Yard",
            "P-CHARGE",
            "EWS-Box",
        )
        assert (box.serial_number, box.sw_version) == ("012345678901", "M165300103")
        found = by_device(hass)
        # What is of the whole box is there once.
        assert found[box.id] == {
            f"{YARD}_{key}"
            for key in ("card", "fail_safe", "reset", "server_connected", "ventilating")
        }
        for number in (1, 2):
            port = child(hass, f"{YARD}_{number}")
            assert port is not None
            assert port.parent_device_id == box.id
            assert port.name == f"Port {number}"
            assert port.config_subentry_id == "ews01"
            assert all(one.startswith(f"{YARD}_{number}_") for one in found[port.id])
            assert f"{YARD}_{number}_charging_current" in found[port.id]
            assert f"{YARD}_{number}_status" in found[port.id]
        names = {
            er.async_get(hass).async_get(one.entity_id).original_name  # type: ignore[union-attr]
            for one in er.async_entries_for_config_entry(er.async_get(hass), "bus")
        }
        assert None not in names


async def test_with_one_port_all_is_the_boxs(hass: HomeAssistant) -> None:
    box = EwsBox(ports=1, cars=(quick_car(),))
    async with running(hass, box, ports=1) as (entry, bus):
        await charge(hass, entry, bus, box)
        registered = device(hass, YARD)
        assert registered is not None
        assert child(hass, f"{YARD}_1") is None
        found = by_device(hass)
        mine = {one for one in found[registered.id] if one.startswith(f"{YARD}_")}
        assert {
            f"{YARD}_{key}" for key in ("1_status", "1_charging_current", "reset")
        } <= mine
        assert not any(f"{YARD}_2" in one for ids in found.values() for one in ids)
        assert len(found) == 2
        limit = entity_id(hass, "number", entry, "1_charging_current")
        assert limit == "number.yard_charging_current"


async def test_a_second_port_comes_and_goes(hass: HomeAssistant) -> None:
    """The first one charges on, and keeps its entities and their history."""
    box = EwsBox(cars=(quick_car(), quick_car()))
    async with running(hass, box, ports=1) as (entry, bus):
        one = await charge(hass, entry, bus, box)
        status = await get_entity(hass, "sensor", entry, "1_status")
        registry = er.async_get(hass)
        before = {
            entity.unique_id: entity.entity_id
            for entity in er.async_entries_for_config_entry(registry, "bus")
        }
        opened = bus.opened

        use_ports(hass, entry, 2)
        two = await get_entity(hass, "number", entry, "2_charging_current")
        await call(hass, "number.set_value", two, value=12)
        assert box.ports[1].limit == 12
        first = child(hass, f"{YARD}_1")
        assert first is not None
        assert child(hass, f"{YARD}_2") is not None
        known = registry.async_get(status)
        assert known is not None
        assert known.device_id == first.id
        for unique_id, entity in before.items():
            platform = entity.partition(".")[0]
            assert registry.async_get_entity_id(platform, DOMAIN, unique_id) == entity

        use_ports(hass, entry, 1)
        await hass.async_block_till_done()
        assert child(hass, f"{YARD}_2") is None
        assert hass.states.get(two) is None
        assert registry.async_get(two) is None
        await polled(bus, box)
        assert (state_of(hass, status), state_of(hass, one)) == ("charging", "on")
        assert bus.opened == opened
        assert not ir.async_get(hass).issues
        # A port that comes back has the orders that it had.
        use_ports(hass, entry, 2)
        two = await get_entity(hass, "number", entry, "2_charging_current")
        await wait_for_state(hass, two, "12.0")
        await bus.wait_for_async(lambda: box.ports[1].limit == 12)
        assert not ir.async_get(hass).issues


async def test_a_port_that_is_used_cannot_be_deleted(hass: HomeAssistant) -> None:
    async with running(hass, EwsBox()) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "2_status")
        found = (
            device(hass, "bus"),
            device(hass, YARD),
            child(hass, f"{YARD}_1"),
            child(hass, f"{YARD}_2"),
        )
        assert None not in found
        bus.unplug()
        await wait_for_state(hass, status, "unavailable")
        for one in found:
            assert one is not None
            assert not await async_remove_config_entry_device(hass, entry, one)  # type: ignore[arg-type]


async def test_a_box_that_is_removed(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        await charge(hass, entry, bus, box)
        told = len(box.writes)
        hass.config_entries.async_remove_subentry(entry, "ews01")
        await hass.async_block_till_done()
        assert device(hass, YARD) is None
        assert child(hass, f"{YARD}_1") is None
        assert set(by_device(hass)) == {device(hass, "bus").id}  # type: ignore[union-attr]
        assert not entry.runtime_data.chargers
        assert not entry.runtime_data.bus.chargers
        # It is not stopped: it was only taken off.
        assert box.ports[0].contactor
        assert len(box.writes) == told


async def test_a_port_that_charges_costs_its_own_entities(
    hass: HomeAssistant,
) -> None:
    """Of what one port tells the entities of the other hear nothing."""
    box = EwsBox(cars=(quick_car(), None))
    async with running(hass, box) as (entry, bus):
        await get_entity(hass, "sensor", entry, "2_status")
        await bus.wait_for_async(lambda: box.ports[1].limit == 6)
        await polled(bus, box)
        await hass.async_block_till_done()
        coordinator = entry.runtime_data
        called: set[str] = set()
        for key, context in {
            "bus": BUS,
            "one": ("ews01_1", 1),
            "two": ("ews01_2", None),
            "two, connector": ("ews01_2", 2),
        }.items():
            coordinator.async_add_listener(lambda key=key: called.add(key), context)
        await charge(hass, entry, bus, box)
        await polled(bus, box)
        assert called == {"one"}
