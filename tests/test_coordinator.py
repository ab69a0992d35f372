"""What the coordinator makes of what chargers tell: issues, listeners, economy."""

from homeassistant.const import EVENT_STATE_CHANGED, EVENT_STATE_REPORTED
from homeassistant.core import HomeAssistant, callback
import pytest

from custom_components.evse_bus.coordinator import BUS
from tests.common import (
    call,
    charger,
    entity_id,
    get_entity,
    running,
    setup_bus,
    wait_for_state,
    wait_until,
)
from tests.flow import issue
from tests.virtual import AblBox, Car, EvboxChargePoint, Module, VirtualBus


async def test_someone_elses_charger_answers(hass: HomeAssistant) -> None:
    box = AblBox(1, serial="2W22xy00000009")
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger("abl", 1, serial="2W22xy00000001")
        )
        problem = await get_entity(hass, "binary_sensor", entry, "problem")
        await wait_for_state(hass, problem, "on")
        found = issue(hass, "wrong_charger_abl1")
        assert found.translation_placeholders["expected"] == "2W22xy00000001"
        fault = entity_id(hass, "sensor", entry, "fault")
        assert hass.states.get(fault).state == "wrong_charger"
        limit = entity_id(hass, "number", entry, "charging_current")
        assert hass.states.get(limit).state == "unavailable"
        assert not box.writes

        # The right one comes back.
        box.serial = "2W22xy00000001"
        await wait_for_state(hass, problem, "off")
        assert issue(hass, "wrong_charger_abl1") is None
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_chargepoint_swapped_for_another(hass: HomeAssistant) -> None:
    """Addressed as "whoever is there", another one must not get the orders."""
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass, "evbox", bus.url, charger("evbox", 0, poll_interval=0.5)
        )
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        # Two replies have to agree on it, as on the serial number.
        await wait_for_state(hass, maximum, "35.0")
        await hass.async_block_till_done()
        assert entry.subentries["evbox0"].data["serial"] == "1923054"
        box.serial = "01923055"
        await wait_for_state(hass, maximum, "unavailable")
        assert issue(hass, "wrong_charger_evbox0")
        sent = len(box.orders)

        # The user says that it is the new one: set up again, it is spoken to.
        subentry = entry.subentries["evbox0"]
        hass.config_entries.async_update_subentry(
            entry,
            subentry,
            data={**subentry.data, "serial": "1923055", "identity": "evbox_1923055"},
        )
        await wait_for_state(hass, maximum, "35.0")
        assert len(box.orders) > sent
        assert issue(hass, "wrong_charger_evbox0") is None
        await hass.config_entries.async_unload(entry.entry_id)


async def test_two_boxes_with_one_id(hass: HomeAssistant) -> None:
    one, two = AblBox(1), AblBox(1, serial="2W22xy00000002")
    with VirtualBus.in_loop(one, two) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        await wait_until(hass, lambda: issue(hass, "duplicate_address_abl1"))
        assert not one.writes
        assert not two.writes
        bus.remove(two)
        await wait_until(hass, lambda: not issue(hass, "duplicate_address_abl1"))
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_timeout_too_short_for_the_interval(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=1)
    async with running(hass, box, poll_interval=1.0, fail_safe_timeout=2) as (entry, _):
        timeout = await get_entity(hass, "number", entry, "fail_safe_timeout")
        await wait_until(
            hass,
            lambda: (
                (found := issue(hass, "timeout_raised_evbox1923054"))
                and found.translation_placeholders["used"] == "3"
            ),
        )
        assert box.orders[-1].timeout >= 3
        await call(hass, "number.set_value", timeout, value=30)
        await wait_until(hass, lambda: not issue(hass, "timeout_raised_evbox1923054"))


async def test_issues_go_with_the_charger(hass: HomeAssistant) -> None:
    box = AblBox(1, serial="2W22xy00000009")
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger("abl", 1, serial="2W22xy00000001")
        )
        await wait_until(hass, lambda: issue(hass, "wrong_charger_abl1"))
        hass.config_entries.async_remove_subentry(entry, "abl1")
        await hass.async_block_till_done()
        assert issue(hass, "wrong_charger_abl1") is None
        await hass.config_entries.async_unload(entry.entry_id)


async def test_one_box_at_two_addresses_of_a_bus(hass: HomeAssistant) -> None:
    """Whichever was added first counts; the other one is not polled."""
    box = AblBox(1, serial="2W22xy00000001")
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass,
            "abl",
            bus.url,
            charger("abl", 1),
            charger("abl", 2, serial=box.serial),
        )
        await wait_until(hass, lambda: issue(hass, "set_up_twice_abl2"))
        await hass.async_block_till_done()
        assert entry.subentries["abl1"].data["serial"] == box.serial
        assert list(entry.runtime_data.chargers) == ["abl1"]
        hass.config_entries.async_remove_subentry(entry, "abl2")
        await hass.async_block_till_done()
        assert issue(hass, "set_up_twice_abl2") is None
        await hass.config_entries.async_unload(entry.entry_id)


async def test_only_listeners_of_what_changed_are_called(hass: HomeAssistant) -> None:
    car = Car(reaction=0.0, ramp=0.1)
    one, two = AblBox(1), AblBox(2, car=car, serial="2W22xy00000002")
    async with running(hass, one, two) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        await get_entity(hass, "sensor", entry, "1_status", index=1)
        await bus.wait_for_async(lambda: one.ic_amps <= 6 and two.ic_amps <= 6)
        coordinator = entry.runtime_data
        called: list[str] = []
        stops = [
            coordinator.async_add_listener(lambda key=key: called.append(key), context)
            for key, context in {
                "bus": BUS,
                "one": ("abl1", None),
                "one, connector": ("abl1", 1),
                "two, connector": ("abl2", 1),
            }.items()
        ]
        car.plug_in()
        charging = entity_id(hass, "binary_sensor", entry, "1_charging", index=1)
        await wait_for_state(hass, charging, "on")
        assert set(called) == {"two, connector"}
        for stop in stops:
            stop()


async def test_a_listener_that_fails_harms_nobody_else(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    car = Car(reaction=0.0, ramp=0.1)
    async with running(hass, AblBox(1, car=car)) as (entry, bus):
        charging = await get_entity(hass, "binary_sensor", entry, "1_charging")
        coordinator = entry.runtime_data

        def fail() -> None:
            message = "a mistake somewhere else"
            raise RuntimeError(message)

        for context in (BUS, ("abl1", None), ("abl1", 1)):
            listeners = coordinator._listeners.setdefault(context, [])
            listeners.insert(0, fail)
        car.plug_in()
        await wait_for_state(hass, charging, "on")
        bus.unplug()
        await wait_for_state(hass, charging, "unavailable")
        bus.replug()
        await wait_for_state(hass, charging, "on")
        assert "a mistake somewhere else" in caplog.text


async def test_only_what_changed_is_written(hass: HomeAssistant) -> None:
    """A module that charges costs its own entities, and of them those that move."""
    car = Car(reaction=0.0, ramp=8.0)
    box = EvboxChargePoint(1923054, [Module(car), Module()], min_interval=0)
    async with running(hass, box, poll_interval=0.1, fail_safe_current=16.0) as (
        entry,
        _,
    ):
        energy = await get_entity(hass, "sensor", entry, "2_energy")
        await wait_for_state(hass, energy, lambda state: float(state.state) >= 0)
        await hass.async_block_till_done()
        coordinator = entry.runtime_data
        called: set[int] = set()
        for number in (1, 2):
            coordinator.async_add_listener(
                lambda number=number: called.add(number), ("evbox1923054", number)
            )
        changed: set[str] = set()
        reported: set[str] = set()
        for name, ids in (
            (EVENT_STATE_CHANGED, changed),
            (EVENT_STATE_REPORTED, reported),
        ):
            hass.bus.async_listen(
                name,
                callback(lambda event, ids=ids: ids.add(event.data["entity_id"])),
                event_filter=callback(lambda _data: True),
            )
        car.plug_in()
        power = entity_id(hass, "sensor", entry, "1_power")
        await wait_for_state(hass, power, lambda state: float(state.state) > 3000)
        assert called == {1}
        assert power in changed
        assert all("module_1" in one for one in changed)
        # Nothing was written that was there already.
        assert not reported
