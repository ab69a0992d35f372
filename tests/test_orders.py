"""Orders on disk: there before the port opens, a lowering before it is sent."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

from homeassistant.config_entries import ConfigEntryState, ConfigSubentry
from homeassistant.const import EVENT_HOMEASSISTANT_FINAL_WRITE
from homeassistant.core import CoreState, HomeAssistant
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers import device_registry as dr, issue_registry as ir
from homeassistant.helpers.storage import Store
from homeassistant.util import dt as dt_util
from homeassistant.util.file import WriteError
from hypothesis import given, strategies as st
import pytest
from pytest_homeassistant_custom_component.common import async_fire_time_changed

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.evse.safety import cautious
from custom_components.evse_bus.stores.orders import (
    KNOWN_KEY,
    ORDERS_KEY,
    RETRY_LIMIT,
    OrderStore,
    Record,
    allows_more,
    decode,
    encode,
    stopped,
)
from tests.common import (
    call,
    charger,
    charger_of,
    crash,
    forget_orders,
    get_entity,
    orders_file,
    running,
    setup_bus,
    shut_down,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.virtual import AblBox, EvboxChargePoint, SmartEvse, VirtualBus, orders_in

ABL = "abl1"
ABL_KEY = f"serial:abl_{AblBox(1).serial}"
FULL = WriteError(OSError(28, "No space left on device"))
REAL = {
    name: getattr(Store, name)
    for name in ("_async_load", "_async_write_data", "async_remove")
}
"""Methods that the test plugin replaces."""

amperes = st.floats(0, 80, allow_nan=False)
phases = st.tuples(*[st.none() | amperes] * 3)
limits = st.builds(CurrentLimit, current=amperes, phases=phases)
orders = st.builds(
    Orders,
    limit=limits,
    allowed=st.none() | st.booleans(),
    fail_safe=limits,
    fail_safe_timeout=st.integers(1, 65535),
)


def stored(current: float, *, allowed: bool | None = None, **changed: Any) -> dict:  # noqa: ANN401 - damaged on purpose
    """Return a file with the orders of one ABL box."""
    orders = Orders(limit=CurrentLimit(current=current), allowed=allowed)
    file = orders_file(abl=Record(orders, ABL))
    file["data"] = {ABL_KEY: file["data"]["abl"] | changed}
    return file


def issues(hass: HomeAssistant) -> set[str]:
    return {key for domain, key in ir.async_get(hass).issues if domain == DOMAIN}


@given(orders)
def test_what_is_stored_is_what_is_read(wish: Orders) -> None:
    record = Record(wish, "owner", lost=True)
    assert decode(encode(record)) == record


@given(
    orders,
    st.sampled_from(["limit", "fail_safe", "fail_safe_timeout", "allowed", "lost"]),
    st.sampled_from([None, "16", float("nan"), float("inf"), -1, [], {}, "yes"]),
)
def test_damage_is_never_an_order(wish: Orders, field: str, damage: object) -> None:
    if field == "allowed" and damage is None:
        return
    record = encode(Record(wish)) | {field: damage}
    if field in ("limit", "fail_safe"):
        record[field] = {"current": damage, "phases": [None] * 3}
    with pytest.raises((RefusedOrderError, TypeError, ValueError, KeyError)):
        decode(record)


async def test_orders_outlive_a_restart(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(9.0, allowed=False)
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        assert state_of(hass, limit) == "9.0"
        await wait_for_state(hass, switch, "off")
        await bus.wait_for_async(lambda: box.ic_amps == 0)
    assert box.limits_written[0] == 0x3E8
    assert not issues(hass)


async def test_evbox_imposes_what_was_stored_with_its_first_frame(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = EvboxChargePoint(1923054, 1)
    orders = Orders(limit=CurrentLimit(current=14.0), allowed=False)
    hass_storage[ORDERS_KEY] = orders_file(
        serial__evbox_1923054=Record(orders, "evbox1923054")
    )
    async with running(hass, box) as (_, bus):
        await bus.wait_for_async(lambda: box.orders)
        assert orders_in(bus.log.bursts())[0].limits == (0, 0, 0)


async def test_first_orders_are_the_fail_safe(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    async with running(hass, AblBox(1), fail_safe_current=7.5) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        assert state_of(hass, limit) == "7.5"
        record = hass_storage[ORDERS_KEY]["data"][ABL_KEY]
        assert record["limit"]["current"] == 7.5
        assert record["allowed"] is None
        assert not issues(hass)


async def test_a_lowering_is_stored_before_it_is_sent(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        await entry.runtime_data.orders.async_flush()
        writes = []

        async def watched(self: Store, data: dict[str, Any]) -> None:  # noqa: ARG001 - as Store's
            writes.append((data["data"][ABL_KEY]["limit"]["current"], box.ic_amps))

        with patch.object(Store, "_async_write_data", watched):
            await call(hass, "number.set_value", limit, value=8)
            # On disk while the box still stood at the old limit.
            assert writes == [(8.0, pytest.approx(15.96))]
            await call(hass, "number.set_value", limit, value=12)
            assert len(writes) == 1
            # A raise is written after it was confirmed.
            await entry.runtime_data.orders.async_flush()
            assert writes[1] == (12.0, pytest.approx(12.0, abs=0.06))


async def test_a_raise_waits_for_its_confirmation(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        bus.remove(box)
        with pytest.raises(HomeAssistantError):
            await call(hass, "number.set_value", limit, value=16)
        assert entry.runtime_data.chargers[ABL].charger.orders.limit.current == 6.0
        assert hass_storage[ORDERS_KEY]["data"][ABL_KEY]["limit"]["current"] == 6.0


# -- A disk that refuses ---------------------------------------------------------


@contextmanager
def full_disk() -> Iterator[None]:
    with patch.object(Store, "_async_write_data", side_effect=FULL):
        yield


async def wait_for_retry(hass: HomeAssistant) -> None:
    async_fire_time_changed(hass, dt_util.utcnow() + timedelta(seconds=RETRY_LIMIT))
    await hass.async_block_till_done()


async def test_a_full_disk_does_not_stop_a_lowering(
    hass: HomeAssistant, hass_storage: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        with full_disk():
            for value in (12, 10, 8):
                await call(hass, "number.set_value", limit, value=value)
            assert box.ic_amps == pytest.approx(7.98)
            assert issues(hass) == {"orders_not_stored"}
            await wait_for_retry(hass)
            assert issues(hass) == {"orders_not_stored"}
            assert caplog.text.count("Orders cannot be stored") == 1

        # Once the disk takes it, it is written without another order.
        await wait_for_retry(hass)
        assert not issues(hass)
        record = hass_storage[ORDERS_KEY]["data"][ABL_KEY]
        assert record["limit"]["current"] == 8.0


async def test_a_refused_lowering_is_in_force_after_a_restart(
    hass: HomeAssistant,
) -> None:
    """The disk was full for a moment only; nobody gave another order."""
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        await entry.runtime_data.orders.async_flush()
        with full_disk():
            await call(hass, "number.set_value", limit, value=8)
        await shut_down(hass, entry)
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, limit, "8.0")
        assert not issues(hass)


async def test_a_restart_on_a_full_disk_never_restores_the_higher_order(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """The stored order allows more, and the lower one cannot be written: it goes."""
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.3) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        await call(hass, "number.set_value", limit, value=16)
        await entry.runtime_data.orders.async_flush()
        with full_disk():
            await call(hass, "number.set_value", limit, value=8)
            await crash(hass, entry, hass_storage)
            sent = len(orders_in(bus.log.bursts()))
            await hass.config_entries.async_setup(entry.entry_id)
            await bus.wait_for_async(
                lambda: len(orders_in(bus.log.bursts())) > sent + 3
            )
            assert {one.limits for one in orders_in(bus.log.bursts())[sent:]} == {
                (0, 0, 0)
            }
            assert state_of(hass, switch) == "off"
            assert issues(hass) == {"orders_lost_evbox1923054", "orders_not_stored"}
        await wait_for_retry(hass)
        await call(hass, "switch.turn_on", switch)
        assert not issues(hass)
        # Its fail-safe current, as confirmed in the flow.
        await wait_for_state(hass, limit, "6.0")


async def test_a_new_charger_waits_until_its_orders_are_stored(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """Started before, it would be a new one again after a restart."""
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    full = full_disk()
    full.__enter__()
    async with running(hass, box, poll_interval=0.3) as (entry, bus):
        assert not entry.runtime_data.chargers
        assert issues(hass) == {"orders_not_stored"}
        assert ORDERS_KEY not in hass_storage
        await asyncio.sleep(0.5)
        assert not bus.log.bursts()
        full.__exit__(None, None, None)
        await wait_for_retry(hass)
        await get_entity(hass, "number", entry, "charging_current")
        assert not issues(hass)
        key = "serial:evbox_1923054"
        assert key in hass_storage[ORDERS_KEY]["data"]
        assert hass_storage[KNOWN_KEY]["data"] == {"keys": [key]}


async def test_a_new_charger_that_was_never_stored_can_be_removed(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    one, two = AblBox(1), AblBox(2, serial="2W22xy00000002")
    with VirtualBus.in_loop(one, two) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        await get_entity(hass, "sensor", entry, "1_status")
        with full_disk():
            hass.config_entries.async_add_subentry(
                entry, ConfigSubentry(**charger("abl", 2))
            )
            await hass.async_block_till_done()
            assert list(entry.runtime_data.chargers) == ["abl1"]
            hass.config_entries.async_remove_subentry(entry, "abl2")
            await hass.async_block_till_done()
        await wait_for_retry(hass)
        assert list(hass_storage[ORDERS_KEY]["data"]) == [ABL_KEY]
        assert hass_storage[KNOWN_KEY]["data"] == {"keys": [ABL_KEY, "subentry:abl1"]}
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_new_shared_supply_waits_until_it_is_stored(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = SmartEvse(load_balance=2)
    with VirtualBus.in_loop(box) as bus:
        with full_disk():
            entry = await setup_bus(
                hass, "smartevse_master", bus.url, charger_of(box), supply_limit=20.0
            )
            assert entry.state is ConfigEntryState.SETUP_RETRY
            assert entry.reason == "The orders of this bus cannot be stored on disk"
            assert issues(hass) == {"orders_not_stored"}
            assert not bus.opened
        async_fire_time_changed(hass, dt_util.utcnow() + timedelta(minutes=5))
        await get_entity(hass, "sensor", entry, "1_status")
        assert entry.state is ConfigEntryState.LOADED
        assert hass_storage[ORDERS_KEY]["data"]["bus:bus"]["supply"] is None
        assert not issues(hass)
        await hass.config_entries.async_unload(entry.entry_id)


@contextmanager
def real_files(hass: HomeAssistant, folder: Path) -> Iterator[Path]:
    """Write to real files; the file of orders is returned."""
    hass.config.config_dir = str(folder)
    with patch.multiple(Store, **REAL):
        yield folder / ".storage" / ORDERS_KEY


@pytest.mark.parametrize("fails_first", [False, True])
async def test_what_is_ordered_while_home_assistant_stops_is_written_at_once(
    hass: HomeAssistant, tmp_path: Path, *, fails_first: bool
) -> None:
    """A write that is only planned may never happen."""

    def order(current: float) -> Orders:
        return Orders(limit=CurrentLimit(current=current))

    with real_files(hass, tmp_path) as file:

        def on_disk() -> float:
            record = json.loads(file.read_text())["data"]["a"]
            return float(record["limit"]["current"])

        store = OrderStore(hass)
        await store.async_load()
        assert await store.async_begin(("a",), order(16), stopped(order(16)))
        assert on_disk() == 16
        if fails_first:
            with full_disk():
                await store.async_commit("a", order(14))
            # It allows more than was ordered, and cannot be replaced: it is deleted.
            assert not file.exists()
        hass.set_state(CoreState.stopping)
        await store.async_commit("a", order(8))
        assert on_disk() == 8
        # A raise is written with the flush at the end of a bus's stop.
        await store.async_commit("a", order(9))
        await store.async_flush()
        assert on_disk() == 9
        # Whatever comes later is written with the final writes.
        await store.async_commit("a", order(10))
        hass.set_state(CoreState.final_write)
        hass.bus.async_fire(EVENT_HOMEASSISTANT_FINAL_WRITE)
        await hass.async_block_till_done()
        assert on_disk() == 10
        hass.set_state(CoreState.running)


# -- Orders that are lost --------------------------------------------------------


@pytest.mark.parametrize(
    "damaged",
    [
        pytest.param(None, id="missing"),
        pytest.param(stored(16.0, limit={"current": -3, "phases": []}), id="negative"),
        pytest.param(stored(16.0, limit="sixteen"), id="shape"),
        pytest.param({**stored(16.0), "version": 99}, id="future"),
        pytest.param({**stored(16.0), "data": ["nothing"]}, id="list"),
    ],
)
async def test_lost_orders_stop_a_charger_until_the_user_allows_it(
    hass: HomeAssistant, hass_storage: dict[str, Any], damaged: dict[str, Any] | None
) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger_of(box, fail_safe_current=6.5)
        )
        limit = await get_entity(hass, "number", entry, "charging_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "number.set_value", limit, value=16)
        await shut_down(hass, entry)
        hass_storage.pop(ORDERS_KEY)
        if damaged is not None:
            hass_storage[ORDERS_KEY] = damaged

        lost = {f"orders_lost_{ABL}"}
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, limit, "6.5")
        await wait_for_state(hass, switch, "off")
        await bus.wait_for_async(lambda: box.ic_amps == 0)
        assert issues(hass) == lost

        # An automation that only sets the limit hides it from nobody, nor a restart.
        await call(hass, "number.set_value", limit, value=10)
        assert issues(hass) == lost
        await shut_down(hass, entry)
        assert not issues(hass)
        await hass.config_entries.async_setup(entry.entry_id)
        assert issues(hass) == lost
        await wait_for_state(hass, switch, "off")
        assert box.ic_amps == 0

        await call(hass, "switch.turn_on", switch)
        await bus.wait_for_async(lambda: box.ic_amps == pytest.approx(9.96))
        assert not issues(hass)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_charger_in_the_device_registry_has_had_orders(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """Both files are lost: only the registry tells it from a new one."""
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger_of(box))
        await get_entity(hass, "number", entry, "charging_current")
        await shut_down(hass, entry)
        hass_storage.pop(ORDERS_KEY)
        hass_storage.pop(KNOWN_KEY)

        await hass.config_entries.async_setup(entry.entry_id)
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await wait_for_state(hass, switch, "off")
        await bus.wait_for_async(lambda: box.ic_amps == 0)
        assert issues(hass) == {f"orders_lost_{ABL}"}
        await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.parametrize(
    "content", ["", "{", '{"version": 1}', "[]", "null", "\0" * 99]
)
async def test_a_damaged_file_stops_all_its_chargers(
    hass: HomeAssistant, tmp_path: Path, content: str
) -> None:
    order = Orders(limit=CurrentLimit(current=16.0), allowed=True)
    first = Orders(limit=CurrentLimit(current=6.0))
    with real_files(hass, tmp_path) as file:
        store = OrderStore(hass)
        await store.async_load()
        for key in ("a", "b"):
            assert await store.async_begin((key,), first, stopped(first)) == first
            await store.async_commit(key, order)
        await store.async_flush()
        file.write_text(content)

        for _ in range(2):
            store = OrderStore(hass)
            await store.async_load()
            for key in ("a", "b"):
                begun = await store.async_begin((key,), first, stopped(first))
                assert begun == stopped(first)
                assert store.is_lost(key)
        # A charger that is really new is not stopped.
        assert await store.async_begin(("c",), first, stopped(first)) == first


async def test_a_lost_order_can_be_accepted(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """By switching off what is off."""
    box = AblBox(1)
    hass_storage[KNOWN_KEY] = {"version": 1, "data": {"keys": [ABL_KEY]}}
    async with running(hass, box) as (entry, _):
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        assert issues(hass) == {f"orders_lost_{ABL}"}
        await call(hass, "switch.turn_off", switch)
        assert not issues(hass)
        record = hass_storage[ORDERS_KEY]["data"][ABL_KEY]
        assert (record["allowed"], record["lost"]) == (False, False)


async def test_an_evbox_whose_orders_are_lost_gets_no_current(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """It got 6 A: its first frame imposes the orders."""
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.3) as (entry, bus):
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", switch)
        await shut_down(hass, entry)
        del hass_storage[ORDERS_KEY]
        # The registry of devices may be lost as well.
        registry = dr.async_get(hass)
        for device in dr.async_entries_for_config_entry(registry, "bus"):
            registry.async_remove_device(device.id)
        sent = len(orders_in(bus.log.bursts()))
        await hass.config_entries.async_setup(entry.entry_id)
        await bus.wait_for_async(lambda: len(orders_in(bus.log.bursts())) > sent + 3)
        limits = {one.limits for one in orders_in(bus.log.bursts())[sent:]}
        assert limits == {(0, 0, 0)}


@pytest.mark.parametrize("keys", [None, "abl", [1, None], {}])
async def test_a_damaged_list_of_known_chargers_costs_no_order(
    hass: HomeAssistant, hass_storage: dict[str, Any], keys: object
) -> None:
    hass_storage[ORDERS_KEY] = stored(9.0, allowed=False)
    hass_storage[KNOWN_KEY] = {"version": 1, "data": {"keys": keys}}
    async with running(hass, AblBox(1)) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        assert state_of(hass, limit) == "9.0"
        assert not issues(hass)
        assert hass_storage[KNOWN_KEY]["data"] == {"keys": [ABL_KEY]}


# -- Chargers that move ----------------------------------------------------------


async def test_a_charger_takes_its_orders_to_another_bus(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = AblBox(1)
    async with running(hass, box, fail_safe_current=7.0) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=9)
        await call(
            hass,
            "switch.turn_off",
            await get_entity(hass, "switch", entry, "charging_allowed"),
        )
    await hass.config_entries.async_remove(entry.entry_id)
    await hass.async_block_till_done()
    forget_orders(hass)
    with VirtualBus.in_loop(box) as bus:
        other = {**charger_of(box, fail_safe_current=6.5), "subentry_id": "again"}
        entry = await setup_bus(hass, "abl", bus.url, other, entry_id="other")
        limit = await get_entity(hass, "number", entry, "charging_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        assert state_of(hass, limit) == "9.0"
        await wait_for_state(hass, switch, "off")
        assert box.ic_amps == 0
        assert not issues(hass)
        # The fail-safe current is what was confirmed when it was added again.
        record = hass_storage[ORDERS_KEY]["data"][ABL_KEY]
        assert (record["owner"], record["fail_safe"]["current"]) == ("again", 6.5)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_charger_added_without_its_serial_number_finds_its_orders(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """As soon as the number is read; it never gets more than was ordered before."""
    orders = Orders(limit=CurrentLimit(current=5.0), allowed=False)
    hass_storage[ORDERS_KEY] = orders_file(abl=Record(orders, "earlier"))
    data = hass_storage[ORDERS_KEY]["data"]
    data[ABL_KEY] = data.pop("abl")
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        limit = await get_entity(hass, "number", entry, "charging_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await wait_for_state(hass, limit, "5.0")
        await wait_for_state(hass, switch, "off")
        await bus.wait_for_async(lambda: box.ic_amps == 0)
        await call(hass, "number.set_value", limit, value=12)
        await call(hass, "switch.turn_on", switch)
        await bus.wait_for_async(lambda: box.ic_amps > 11)
        await shut_down(hass, entry)
        assert list(hass_storage[ORDERS_KEY]["data"]) == [ABL_KEY]
        record = hass_storage[ORDERS_KEY]["data"][ABL_KEY]
        assert (record["limit"]["current"], record["allowed"]) == (12.0, True)


async def test_a_serial_number_that_becomes_known_takes_the_orders_along(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        before = entry.runtime_data.chargers[ABL].charger
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=12)
        await wait_until(hass, lambda: entry.subentries[ABL].data["serial"])
        await hass.async_block_till_done()
        # In place: it was polled without a break.
        assert entry.runtime_data.chargers[ABL].charger is before
        await shut_down(hass, entry)
        assert list(hass_storage[ORDERS_KEY]["data"]) == [ABL_KEY]
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, limit, "12.0")
        await hass.config_entries.async_unload(entry.entry_id)


@given(orders, orders, st.none() | orders)
def test_another_box_gets_no_more_than_the_box_before(
    first: Orders, before: Orders, earlier: Orders | None
) -> None:
    """Nor more than a new one, nor than it was allowed itself at another time."""
    hass = Mock(data={})
    hass.config.config_dir = hass.config.path.return_value = "/nowhere"
    store = OrderStore(hass)
    store._records = {
        "serial:evbox_1": Record(before, "here"),
        "serial:evbox_5": Record(before, "elsewhere"),
    }
    if earlier is not None:
        store._records["serial:evbox_2"] = Record(earlier, "before")
    store.hand_over("here", "serial:evbox_2", first)
    order = store.get("serial:evbox_2")
    assert isinstance(order, Orders)
    for one in (first, before, earlier):
        assert one is None or not allows_more(order, one)
    # The old box keeps its own, without a claim on this place.
    assert store._records["serial:evbox_1"] == Record(before, "")
    assert store._records["serial:evbox_5"] == Record(before, "elsewhere")
    store.hand_over("here", "serial:evbox_3", first)
    assert store.get("serial:evbox_3") == cautious(first, order)


# -- The store alone -------------------------------------------------------------


async def test_the_same_order_is_not_written_again(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    store = OrderStore(hass)
    await store.async_load()
    wish = Orders(limit=CurrentLimit(current=10.0))
    await store.async_commit("subentry:a", wish)
    hass_storage.pop(ORDERS_KEY)
    await store.async_commit("subentry:a", wish)
    assert ORDERS_KEY not in hass_storage
    await store.async_commit("subentry:a", Orders(limit=CurrentLimit(current=8.0)))
    assert ORDERS_KEY in hass_storage
    await store.async_forget(["subentry:a"])
    assert hass_storage[ORDERS_KEY]["data"] == {}
    assert hass_storage[KNOWN_KEY]["data"] == {"keys": []}


async def test_a_lowering_is_written_also_when_its_action_is_given_up(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(14.0)
    disk = asyncio.Event()
    writing = asyncio.Event()
    write = Store._async_write_data

    async def slow(self: Store, data: dict[str, Any]) -> None:
        writing.set()
        await disk.wait()
        await write(self, data)

    store = OrderStore(hass)
    await store.async_load()
    lower = Orders(limit=CurrentLimit(current=8.0))
    with patch.object(Store, "_async_write_data", slow):
        commit = asyncio.create_task(store.async_commit(ABL_KEY, lower))
        await writing.wait()
        commit.cancel()
        await asyncio.wait({commit})
        assert commit.cancelled()
        disk.set()
        await hass.async_block_till_done()
    assert hass_storage[ORDERS_KEY]["data"][ABL_KEY]["limit"]["current"] == 8.0


async def test_a_flush_waits_for_what_is_being_written(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(14.0)
    disk = asyncio.Event()
    writing = asyncio.Event()
    write = Store._async_write_data

    async def slow(self: Store, data: dict[str, Any]) -> None:
        writing.set()
        await disk.wait()
        await write(self, data)

    store = OrderStore(hass)
    await store.async_load()
    lower = Orders(limit=CurrentLimit(current=8.0))
    with patch.object(Store, "_async_write_data", slow):
        commit = asyncio.create_task(store.async_commit(ABL_KEY, lower))
        await writing.wait()
        flush = asyncio.create_task(store.async_flush())
        await asyncio.wait({flush}, timeout=0.05)
        assert not flush.done()
        disk.set()
        await asyncio.gather(commit, flush)
    after = OrderStore(hass)
    await after.async_load()
    assert after.get(ABL_KEY) == lower
