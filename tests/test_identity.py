"""A box is known by its serial number: it may move, and be replaced by another."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import HomeAssistant
from homeassistant.data_entry_flow import FlowResultType
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
from tests.flow import NOWHERE, Flow, charger, issue, offers, port_step
from tests.listening import dialling, listening, offered
from tests.virtual import (
    AblBox,
    EvboxChargePoint,
    EwsBox,
    Module,
    SmartEvse,
    VirtualBus,
)
from tests.virtual.device import Device

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


async def replaced(hass: HomeAssistant, key: str) -> Flow:
    """Open the repair of a box that was replaced, as soon as it is reported."""

    def is_reported() -> bool:
        found = issue(hass, key)
        return found is not None and found.is_fixable

    await wait_until(hass, is_reported)
    assert issues(hass) == {key}
    return await Flow.repair(hass, key)


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


async def test_a_wrong_box_is_accepted_from_its_repair_issue(
    hass: HomeAssistant,
) -> None:
    old, new = AblBox(1), AblBox(1, serial="2W22xy00000009")
    async with running(hass, old, title="Charger") as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_estimated_energy")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=12)
        await hass.async_block_till_done()
        kept = furnish(hass, limit)
        bus.remove(old)
        await wait_for_state(hass, kept.limit, "unavailable")
        bus.add(new)
        flow = await replaced(hass, "wrong_charger_abl1")
        found = issue(hass, "wrong_charger_abl1")
        assert found is not None
        assert found.translation_placeholders is not None
        # As the user has named it.
        assert found.translation_placeholders["charger"] == "Family's"
        assert flow.step == "confirm"
        assert flow.tells("2W22xy00000009", old.serial, "It starts with 6 A")
        assert not new.writes
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        await wait_for_state(hass, kept.limit, "6.0")
        await bus.wait_for_async(lambda: new.ic_amps <= 6)
        await all_there(hass, kept)
        [subentry] = entry.subentries.values()
        assert subentry.unique_id == identity(entry) == "abl_2W22xy00000009"
        assert subentry.data["address"] == 1
        assert not issues(hass)


async def test_a_wrong_chargepoint_and_a_wrong_ews_box_are_accepted(
    hass: HomeAssistant,
) -> None:
    old = EvboxChargePoint(1923054, 1, min_interval=0)
    with VirtualBus.in_loop(old) as bus:
        # Addressed as "whoever is there": that stays.
        anyone = stored_charger("evbox", 0, poll_interval=0.5)
        entry = await setup_bus(hass, "evbox", bus.url, anyone)
        status = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_until(hass, lambda: entry.subentries["evbox0"].data["serial"])
        old.serial = "00000777"
        flow = await replaced(hass, "wrong_charger_evbox0")
        await flow.submit()
        stored = entry.subentries["evbox0"].data
        assert (stored["address"], stored["serial"]) == (0, "777")
        await wait_for_state(hass, status, "35.0")
        assert identity(entry) == "evbox_777"
        await hass.config_entries.async_remove(entry.entry_id)

    async with running(hass, EwsBox(), title="Charger") as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "2_status")
        box = EwsBox(serial="000000000077")
        bus.unplug()
        await wait_for_state(hass, status, "unavailable")
        [before] = bus.devices
        bus.remove(before)
        bus.add(box)
        bus.replug()
        flow = await replaced(hass, "wrong_charger_ews01_1")
        await flow.submit()
        await wait_for_state(hass, status, "available")
        assert identity(entry) == "ews_000000000077"
        await bus.wait_for_async(lambda: [one.limit for one in box.ports] == [6, 6])
        assert not issues(hass)


async def test_swapped_boxes_have_not_replaced_each_other(hass: HomeAssistant) -> None:
    one, two = AblBox(1), AblBox(2, serial="2W22xy00000002")
    async with running(hass, one, two) as (entry, bus):
        for index in (0, 1):
            await get_entity(hass, "sensor", entry, "1_status", index=index)
        bus.unplug()
        one.device_id, two.device_id = 2, 1
        bus.replug()
        await wait_until(hass, lambda: len(issues(hass)) == 2)
        await hass.async_block_till_done()
        for key, other in (("abl1", "Charger 2"), ("abl2", "Charger 1")):
            found = issue(hass, f"wrong_charger_{key}")
            assert found is not None
            assert found.translation_key == "wrong_charger"
            assert found.translation_placeholders is not None
            assert found.translation_placeholders["other"] == f"{other} (Bus)"
            assert not found.is_fixable
        # One of them is removed, so its box is free to take the other's place.
        hass.config_entries.async_remove_subentry(entry, "abl2")
        await hass.async_block_till_done()
        flow = await Flow.repair(hass, "wrong_charger_abl1")
        assert flow.tells(two.serial)


@pytest.mark.parametrize("meanwhile", ["removed", "added elsewhere"])
async def test_a_repair_that_no_longer_makes_sense(
    hass: HomeAssistant, meanwhile: str
) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        bus.unplug()
        box.serial = "2W22xy00000009"
        bus.replug()
        flow = await replaced(hass, "wrong_charger_abl1")
        reason = "charger_gone"
        if meanwhile == "removed":
            hass.config_entries.async_remove_subentry(entry, "abl1")
        else:
            other = stored_charger("abl", 7, serial=box.serial, title="Other")
            bus_entry("abl", NOWHERE, other, entry_id="other").add_to_hass(hass)
            reason = "box_already_set_up"
        await flow.submit()
        assert flow.result["reason"] == reason


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
        await hass.async_block_till_done()
        assert issues(hass) == {"set_up_twice_01B"}
        # Its identity is read before anything is written.
        assert not two.writes
        # The rest of its bus runs on, and it is silent, also after a restart.
        assert state_of(hass, status) == "available"
        assert await hass.config_entries.async_reload("new")
        await get_entity(hass, "sensor", new, "1_status", index=1)
        assert list(new.runtime_data.chargers) == ["abl2"]
        assert not two.writes
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


async def test_a_box_that_was_not_accepted_does_not_become_the_expected_one(
    hass: HomeAssistant,
) -> None:
    """Its cable is put right, and its older subentry is removed later."""
    one, two, right = AblBox(1), AblBox(1), AblBox(1, serial="2W22xy00000009")
    with VirtualBus.in_loop(one) as old_bus, VirtualBus.in_loop(two) as new_bus:
        known = twin("Old", "01A", serial=one.serial)
        old = await setup_bus(hass, "abl", old_bus.url, known, entry_id="old")
        new = await setup_bus(
            hass, "abl", new_bus.url, twin("New", "01B"), entry_id="new"
        )
        await wait_until(hass, lambda: issues(hass) == {"set_up_twice_01B"})
        await wait_until(hass, lambda: not new.runtime_data.chargers)
        assert new.subentries["01B"].data["serial"] is None
        new_bus.remove(two)
        new_bus.add(right)
        hass.config_entries.async_remove_subentry(old, "01A")
        await wait_until(hass, lambda: "01B" in new.runtime_data.chargers)
        await get_entity(hass, "sensor", new, "1_status")
        assert new.subentries["01B"].data["serial"] == right.serial
        assert "refused" not in new.subentries["01B"].data
        assert not issues(hass)
        for entry in (old, new):
            await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.usefixtures("socket_enabled")
@pytest.mark.parametrize("older", ["line", "network"])
async def test_an_ews_box_on_a_line_and_on_the_network_has_one_master(
    hass: HomeAssistant, older: str
) -> None:
    """Typed in on RS-232 without its serial number; it may be connected both ways."""
    serial = "012345678901"
    on_line, on_network = EwsBox(serial=serial), EwsBox(serial=serial)
    known = stored_charger("ews", serial, serial=serial, title="Known")
    known = {**known, "subentry_id": "02"}
    anyone = stored_charger("ews", "", title="Anyone")
    anyone = {**anyone, "subentry_id": "01" if older == "line" else "03"}
    async with listening(hass, known) as network:
        with (
            dialling(network, on_network),
            VirtualBus.in_loop(on_line) as bus,
        ):
            await get_entity(hass, "sensor", network, "2_status")
            line = await setup_bus(hass, "ews", bus.url, anyone, entry_id="line")
            second = known if older == "line" else anyone
            reported = {f"set_up_twice_{second['subentry_id']}"}
            await wait_until(hass, lambda: issues(hass) == reported)
            entries = (line, network) if older == "line" else (network, line)
            first, other = (entry.runtime_data for entry in entries)
            await wait_until(hass, lambda: not other.chargers)
            assert len(first.chargers) == 2
            box = on_network if older == "line" else on_line
            writes = len(box.writes)
            assert older == "line" or not writes
            limit = await get_entity(hass, "number", entries[0], "2_charging_current")
            await call(hass, "number.set_value", limit, value=9)
            await hass.async_block_till_done()
            assert issues(hass) == reported
            assert len(box.writes) == writes
            # Nor is it offered as an unknown box.
            assert not offers(hass)
            await hass.config_entries.async_unload("line")


async def test_a_chargepoint_that_turns_out_to_be_set_up_elsewhere_is_let_go(
    hass: HomeAssistant,
) -> None:
    """Each of its messages sets limits; the last one comes when its number is read."""
    one, two = (EvboxChargePoint(77, 1, min_interval=0) for _ in range(2))
    with VirtualBus.in_loop(one) as old_bus, VirtualBus.in_loop(two) as new_bus:
        known = stored_charger("evbox", 77, serial="77", title="Old", poll_interval=0.5)
        old = await setup_bus(
            hass, "evbox", old_bus.url, {**known, "subentry_id": "01"}, entry_id="old"
        )
        anyone = stored_charger("evbox", 0, title="New", poll_interval=0.5)
        new = await setup_bus(
            hass, "evbox", new_bus.url, {**anyone, "subentry_id": "02"}, entry_id="new"
        )
        await wait_until(hass, lambda: issues(hass) == {"set_up_twice_02"})
        await wait_until(hass, lambda: not new.runtime_data.chargers)
        # Two replies have to agree on the number.
        assert len(two.orders) == 2
        limit = await get_entity(hass, "number", old, "charging_current")
        await call(hass, "number.set_value", limit, value=9)
        assert len(two.orders) == 2
        for entry in (old, new):
            await hass.config_entries.async_unload(entry.entry_id)


# -- The scheme: after the first release, a change needs a migration ---------------------


@pytest.mark.parametrize(
    ("device", "last", "prefix"),
    [
        (AblBox(3, serial="2W22xy03"), "1_estimated_energy", "abl_2W22xy03"),
        (EvboxChargePoint(77, 1, min_interval=0), "1_energy", "evbox_77"),
        (EwsBox(serial="728000000012"), "2_energy", "ews_728000000012"),
        (SmartEvse("2.30+", serial=4711), "charging_current", "smartevse1"),
    ],
    ids=["abl", "evbox", "ews", "smartevse"],
)
async def test_what_stands_on_the_identity(
    hass: HomeAssistant,
    hass_storage: dict[str, Any],
    *,
    device: Device,
    last: str,
    prefix: str,
) -> None:
    ports = [f"{prefix}_1", f"{prefix}_2"] if prefix.startswith("ews") else []
    async with running(hass, device, poll_interval=0.5) as (entry, _):
        has_meter = last.endswith("energy")
        platform = "sensor" if has_meter else "number"
        entity = await get_entity(hass, platform, entry, last)
        await wait_for_state(hass, entity, lambda state: state.state)
        await hass.async_block_till_done()
        registry = dr.async_get(hass)
        keys = [
            key
            for one in (
                *dr.async_entries_for_config_entry(registry, "bus"),
                *dr.async_child_entries_for_config_entry(registry, "bus"),
            )
            for _, key in one.identifiers
        ]
        assert sorted(keys) == sorted(["bus", prefix, *ports])
        assert all(one.unique_id.startswith(f"{prefix}_") for one in ours(hass))
        await shut_down(hass, entry)
    kind = "serial" if has_meter else "subentry"
    orders = [f"{kind}:{one}" for one in ports or [prefix]]
    assert sorted(hass_storage[ORDERS_KEY]["data"]) == orders
    totals = hass_storage.get(TOTALS_KEY, {"data": {}})["data"]
    assert (f"{prefix}_{last}" in totals) is has_meter
