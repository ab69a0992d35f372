"""A box is known by its serial number: it may move, and be replaced by another."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import HomeAssistant
from homeassistant.helpers import (
    area_registry as ar,
    device_registry as dr,
    entity_registry as er,
    issue_registry as ir,
)
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.energy import TOTALS_KEY
from custom_components.evse_bus.stores.orders import ORDERS_KEY
from tests.common import (
    bus_entry,
    call,
    charger as stored_charger,
    crash,
    get_entity,
    identity,
    running,
    setup_bus,
    shut_down,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.flow import Flow, charger, port_step
from tests.listening import dialling, listening, offered
from tests.virtual import AblBox, EvboxChargePoint, EwsBox, Module, VirtualBus

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigEntry

pytestmark = pytest.mark.usefixtures("quick_search")

FAST = {"poll_interval": 0.2}


@dataclass(frozen=True)
class Furnished:
    """What a user has made of a charger in Home Assistant."""

    ids: dict[str, str]
    """Registry id of each entity, by its entity id: history hangs on both."""
    limit: str
    device: str

    def assert_kept(self, hass: HomeAssistant) -> None:
        """Everything is there again, in its place."""
        registry = er.async_get(hass)
        now = {one.entity_id: one.id for one in ours(hass)}
        assert now == self.ids
        limit = registry.async_get(self.limit)
        assert limit is not None
        assert (limit.name, limit.icon) == ("Amps", "mdi:car")
        assert limit.device_id is not None
        device = dr.async_get(hass).async_get(limit.device_id)
        assert isinstance(device, dr.DeviceEntry | dr.ChildDeviceEntry)
        parent = getattr(device, "parent_device_id", None) or device.id
        assert parent == self.device
        box = dr.async_get(hass).async_get(self.device)
        assert isinstance(box, dr.DeviceEntry)
        area = ar.async_get(hass).async_get_area_by_name("Car park")
        assert area is not None
        assert (box.name_by_user, box.area_id) == ("Family's", area.id)


def ours(hass: HomeAssistant) -> list[er.RegistryEntry]:
    """Return the registered entities of all chargers."""
    return [
        one
        for one in er.async_get(hass).entities.values()
        if one.platform == DOMAIN and one.config_subentry_id is not None
    ]


def furnish(hass: HomeAssistant, limit: str) -> Furnished:
    """Name things as a user does."""
    registry, devices = er.async_get(hass), dr.async_get(hass)
    registry.async_update_entity(limit, new_entity_id="number.amps")
    registry.async_update_entity("number.amps", name="Amps", icon="mdi:car")
    entity = registry.async_get("number.amps")
    assert entity is not None
    assert entity.device_id is not None
    device = devices.async_get(entity.device_id)
    assert isinstance(device, dr.DeviceEntry | dr.ChildDeviceEntry)
    box = getattr(device, "parent_device_id", None) or device.id
    area = ar.async_get(hass).async_get_or_create("Car park")
    devices.async_update_device(box, name_by_user="Family's", area_id=area.id)
    return Furnished(
        ids={one.entity_id: one.id for one in ours(hass)},
        limit="number.amps",
        device=box,
    )


async def remove_charger(hass: HomeAssistant, entry: ConfigEntry) -> None:
    """Remove a bus's only charger, as the user does."""
    [subentry_id] = entry.subentries
    hass.config_entries.async_remove_subentry(entry, subentry_id)
    await hass.async_block_till_done()
    assert not ours(hass)


async def all_there(hass: HomeAssistant, kept: Furnished) -> None:
    await wait_until(hass, lambda: len(ours(hass)) == len(kept.ids))
    await hass.async_block_till_done()
    kept.assert_kept(hass)


def issues(hass: HomeAssistant) -> set[str]:
    return {key for domain, key in ir.async_get(hass).issues if domain == DOMAIN}


# -- Moves ---------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["charger", "bus"])
async def test_an_abl_box_moves_to_another_bus(
    hass: HomeAssistant, hass_storage: dict[str, Any], what: str
) -> None:
    """Another port and another device-ID; the charger or its whole bus is removed."""
    box = AblBox(1)
    async with running(hass, box, title="Charger") as (entry, _):
        await get_entity(hass, "sensor", entry, "1_estimated_energy")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=9)
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", switch)
        await hass.async_block_till_done()
        kept = furnish(hass, limit)
        if what == "charger":
            await remove_charger(hass, entry)
    if what == "bus":
        await hass.config_entries.async_remove(entry.entry_id)
        await hass.async_block_till_done()
        assert not ours(hass)
    # The restart in between finds only what is on disk.
    totals = hass_storage[TOTALS_KEY]["data"]
    assert list(totals) == [f"abl_{box.serial}_1_estimated_energy"]
    moved = AblBox(4, serial=box.serial)
    with VirtualBus.in_loop(moved) as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        await flow.submit({"chargers": ["4"], "installation_limit": 16})
        await flow.submit(charger("Charger", fail_safe_current=6.5, expert=FAST))
        await flow.submit()
        await hass.async_block_till_done()
        other = flow.result["result"]
        assert other.entry_id != entry.entry_id
        await get_entity(hass, "sensor", other, "1_estimated_energy")
        await all_there(hass, kept)
        await wait_for_state(hass, kept.limit, "9.0")
        await wait_for_state(hass, switch, "off")
        assert moved.ic_amps == 0
        assert not issues(hass)
        await hass.config_entries.async_unload(other.entry_id)


async def test_an_evbox_is_removed_and_typed_in_again(hass: HomeAssistant) -> None:
    modules = [Module(energy_wh=5000), Module(energy_wh=7000)]
    box = EvboxChargePoint(1923054, modules, min_interval=0)
    async with running(hass, box, title="Charger", poll_interval=0.5) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "2_energy")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await wait_for_state(hass, energy, "7.0")
        await call(hass, "number.set_value", limit, value=9)
        await hass.async_block_till_done()
        kept = furnish(hass, limit)
        await remove_charger(hass, entry)
        flow = await Flow.add_charger(hass, entry)
        await flow.submit({"serial_number": "01923054"})
        typed = charger("Charger", fail_safe_timeout=60, expert={"poll_interval": 0.5})
        await flow.submit(typed)
        await flow.submit()
        await hass.async_block_till_done()
        await wait_for_state(hass, energy, "7.0")
        await all_there(hass, kept)
        assert state_of(hass, kept.limit) == "9.0"
        assert not issues(hass)


@pytest.mark.usefixtures("socket_enabled")
async def test_an_ews_box_moves_from_rs_232_to_the_network(hass: HomeAssistant) -> None:
    box = EwsBox(rfid=True)
    async with running(hass, box, title="Charger") as (entry, _):
        await get_entity(hass, "sensor", entry, "2_energy")
        await get_entity(hass, "event", entry, "card")
        limit = await get_entity(hass, "number", entry, "2_charging_current")
        await call(hass, "number.set_value", limit, value=9)
        await hass.async_block_till_done()
        kept = furnish(hass, limit)
        await remove_charger(hass, entry)
    lines = {one for one in kept.ids if "connect" in one}
    async with listening(hass) as other:
        with dialling(other, box):
            flow = await Flow.discovered(hass, await offered(hass))
            await flow.submit()
            typed = {"installation_limit": 16, "installation_limit_2": 16}
            await flow.submit(
                charger("Charger", ports="2", expert=FAST, **typed),
            )
            await flow.submit()
            await get_entity(hass, "sensor", other, "2_energy")
            await get_entity(hass, "event", other, "card")
            await hass.async_block_till_done()
            # Behind a listener a box has a line, and so statistics, of its own.
            now = {one.entity_id: one.id for one in ours(hass)}
            assert {one: now.get(one) for one in kept.ids} == kept.ids
            assert not lines - now.keys()
            await wait_for_state(hass, kept.limit, "9.0")
            assert not issues(hass)


# -- Another box in its place ----------------------------------------------------------


def another_box(hass: HomeAssistant, entry: ConfigEntry, serial: str) -> None:
    """Store another serial number, as *Reconfigure* does."""
    [subentry] = entry.subentries.values()
    hass.config_entries.async_update_subentry(
        entry,
        subentry,
        data={
            **subentry.data,
            "serial": serial,
            "address": int(serial),
            "identity": f"evbox_{serial}",
        },
        unique_id=f"evbox_{serial}",
    )


@pytest.mark.parametrize("restart", [None, "clean", "crash"])
async def test_another_box_takes_over_the_names_and_not_the_meter(
    hass: HomeAssistant, hass_storage: dict[str, Any], restart: str | None
) -> None:
    old = EvboxChargePoint(1923054, [Module(energy_wh=5000)], min_interval=0)
    new = EvboxChargePoint(777, [Module(energy_wh=90_000)], min_interval=0)
    async with running(hass, old, title="Charger", poll_interval=0.5) as (entry, bus):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        limit = await get_entity(hass, "number", entry, "charging_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await wait_for_state(hass, energy, "5.0")
        await call(hass, "number.set_value", limit, value=12)
        await call(hass, "switch.turn_off", switch)
        await hass.async_block_till_done()
        kept = furnish(hass, limit)
        bus.remove(old)
        if restart is not None:
            end = crash(hass, entry, hass_storage) if restart == "crash" else None
            await (end or shut_down(hass, entry))
        another_box(hass, entry, "777")
        bus.add(new)
        if restart is not None:
            await hass.config_entries.async_setup(entry.entry_id)
        await wait_until(hass, lambda: new.orders)
        # Lower than before, and stopped as before: this was ordered for this place.
        assert {one.limits for one in new.orders} == {(0, 0, 0)}
        await wait_for_state(hass, energy, "5.0")
        await all_there(hass, kept)
        assert state_of(hass, kept.limit) == "6.0"
        assert identity(entry) == "evbox_777"
        assert {one.unique_id.partition("_1_")[0] for one in ours(hass)} >= {
            "evbox_777"
        }
        assert not any("1923054" in one.unique_id for one in ours(hass))
        assert not issues(hass)
        # The new meter counts on.
        new.modules[0].energy_wh += 100
        await wait_for_state(hass, energy, "5.1")
        # The old box keeps what is its own, should it be used elsewhere.
        await shut_down(hass, entry)
        orders = hass_storage[ORDERS_KEY]["data"]["serial:evbox_1923054"]
        assert (orders["limit"]["current"], orders["allowed"]) == (12.0, False)
        assert (
            hass_storage[TOTALS_KEY]["data"]["evbox_1923054_1_energy"]["total"] == 5000
        )


# -- Set up twice ------------------------------------------------------------------------


def twin(title: str, subentry_id: str, **more: Any) -> Any:  # noqa: ANN401 - JSON
    """Return the box with device-ID 1 as it is stored; ``more`` as in `charger`."""
    box = stored_charger("abl", 1, title=title, **more)
    return {**box, "subentry_id": subentry_id}


@pytest.mark.parametrize("first", ["old", "new"])
async def test_a_box_in_two_entries_has_one_master(
    hass: HomeAssistant, first: str
) -> None:
    """As after a restored backup; whichever of them is set up first."""
    one, two = AblBox(1), AblBox(1)
    with VirtualBus.in_loop(one) as old_bus, VirtualBus.in_loop(two) as new_bus:
        buses = {
            "old": (old_bus.url, twin("Old", "01A", serial=one.serial)),
            "new": (new_bus.url, twin("New", "01B", serial=one.serial)),
        }
        order = sorted(buses, key=lambda name: name != first)
        made = {
            name: bus_entry("abl", *buses[name], title=f"{name} bus", entry_id=name)
            for name in order
        }
        for entry in made.values():
            entry.add_to_hass(hass)
        for entry in made.values():
            if entry.state is ConfigEntryState.NOT_LOADED:
                await hass.config_entries.async_setup(entry.entry_id)
        old, new = made["old"], made["new"]
        status = await get_entity(hass, "sensor", old, "1_status")
        limit = await get_entity(hass, "number", old, "charging_current")
        await call(hass, "number.set_value", limit, value=9)
        await get_entity(hass, "sensor", old, "1_estimated_energy")
        await hass.async_block_till_done()
        kept = furnish(hass, limit)
        assert new.state is ConfigEntryState.LOADED
        assert not new.runtime_data.chargers
        assert new_bus.log.total == 0
        issue = ir.async_get(hass).async_get_issue(DOMAIN, "set_up_twice_01B")
        assert issue is not None
        assert issue.translation_placeholders == {
            "charger": "New (new bus)",
            "other": "Old (old bus)",
        }
        assert issues(hass) == {"set_up_twice_01B"}

        # The user decides: the other one starts, with all that belongs to the box.
        hass.config_entries.async_remove_subentry(old, "01A")
        await wait_until(hass, lambda: new.runtime_data.chargers)
        await get_entity(hass, "sensor", new, "1_estimated_energy")
        assert not old.runtime_data.chargers
        told = old_bus.log.total
        await all_there(hass, kept)
        await wait_for_state(hass, kept.limit, "9.0")
        assert state_of(hass, status) == "available"
        assert old_bus.log.total == told
        assert not issues(hass)
        for entry in made.values():
            await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.parametrize("removed", ["old", "new"])
async def test_a_box_that_turns_out_to_be_set_up_elsewhere_is_taken_off(
    hass: HomeAssistant, removed: str
) -> None:
    """Typed in while it was off; its serial number is read later."""
    one, two = AblBox(1), AblBox(1)
    other = AblBox(2, serial="2W22xy00000002")
    with VirtualBus.in_loop(one) as old_bus, VirtualBus.in_loop(other) as new_bus:
        old = await setup_bus(
            hass,
            "abl",
            old_bus.url,
            twin("Old", "01A", serial=one.serial),
            entry_id="old",
        )
        beside = stored_charger("abl", 2, serial=other.serial, title="Beside")
        new = await setup_bus(
            hass, "abl", new_bus.url, twin("New", "01B"), beside, entry_id="new"
        )
        await get_entity(hass, "sensor", old, "1_status")
        status = await get_entity(hass, "sensor", new, "1_status", index=1)
        assert not issues(hass)
        new_bus.add(two)
        await wait_until(hass, lambda: issues(hass) == {"set_up_twice_01B"})
        await wait_until(hass, lambda: list(new.runtime_data.chargers) == ["abl2"])
        writes = len(two.writes)
        # The rest of its bus runs on, and it is silent, also after a restart.
        assert state_of(hass, status) == "available"
        assert await hass.config_entries.async_reload("new")
        await get_entity(hass, "sensor", new, "1_status", index=1)
        assert list(new.runtime_data.chargers) == ["abl2"]
        assert len(two.writes) == writes
        assert issues(hass) == {"set_up_twice_01B"}

        if removed == "new":
            hass.config_entries.async_remove_subentry(new, "01B")
            await hass.async_block_till_done()
            assert list(old.runtime_data.chargers) == ["01A"]
        else:
            await hass.config_entries.async_remove("old")
            await wait_until(hass, lambda: "01B" in new.runtime_data.chargers)
            await get_entity(hass, "sensor", new, "1_status")
        assert not issues(hass)
        for entry in (old, new):
            if entry.state is ConfigEntryState.LOADED:
                await hass.config_entries.async_unload(entry.entry_id)
