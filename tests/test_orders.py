"""Orders on disk: there before the port opens, a lowering before it is sent."""

import asyncio
from typing import Any
from unittest.mock import patch

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers import issue_registry as ir
from homeassistant.helpers.storage import Store
from homeassistant.util.file import WriteError
from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.orders import OrderStore, decode, encode
from tests.common import (
    call,
    charger_of,
    get_entity,
    running,
    setup_bus,
    state_of,
    wait_for_state,
)
from tests.virtual import AblBox, EvboxChargePoint, VirtualBus, orders_in

STORE = "evse_bus.bus"
ABL = "abl1"

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
    record = (
        encode(Orders(limit=CurrentLimit(current=current), allowed=allowed)) | changed
    )
    return {"version": 1, "minor_version": 1, "key": STORE, "data": {ABL: record}}


def issues(hass: HomeAssistant) -> set[str]:
    return {key for domain, key in ir.async_get(hass).issues if domain == DOMAIN}


@given(orders)
def test_what_is_stored_is_what_is_read(wish: Orders) -> None:
    assert decode(encode(wish)) == wish


@given(
    orders,
    st.sampled_from(["limit", "fail_safe", "fail_safe_timeout", "allowed"]),
    st.sampled_from([None, "16", float("nan"), float("inf"), -1, [], {}, "yes"]),
)
def test_damage_is_never_an_order(wish: Orders, field: str, damage: object) -> None:
    if field == "allowed" and damage is None:
        return
    record = encode(wish) | {field: damage}
    if field in ("limit", "fail_safe"):
        record[field] = {"current": damage, "phases": [None] * 3}
    with pytest.raises((RefusedOrderError, TypeError, ValueError, KeyError)):
        decode(record)


async def test_orders_outlive_a_restart(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[STORE] = stored(9.0, allowed=False)
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
    record = encode(Orders(limit=CurrentLimit(current=14.0), allowed=False))
    hass_storage[STORE] = {
        "version": 1,
        "minor_version": 1,
        "key": STORE,
        "data": {"evbox1923054": record},
    }
    async with running(hass, box) as (_, bus):
        await bus.wait_for_async(lambda: box.orders)
        assert orders_in(bus.log.bursts())[0].limits == (0, 0, 0)


async def test_first_orders_are_the_fail_safe(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    async with running(hass, AblBox(1), fail_safe_current=7.5) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        assert state_of(hass, limit) == "7.5"
        record = hass_storage[STORE]["data"][ABL]
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
            writes.append((data["data"][ABL]["limit"]["current"], box.ic_amps))

        with patch.object(Store, "_async_write_data", watched):
            await call(hass, "number.set_value", limit, value=8)
            # On disk while the box still stood at the old limit.
            assert writes == [(8.0, pytest.approx(15.96))]
            await call(hass, "number.set_value", limit, value=12)
            assert len(writes) == 1
            # A raise is written after it was confirmed.
            await entry.runtime_data.orders.async_close()
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
        assert hass_storage[STORE]["data"][ABL]["limit"]["current"] == 6.0


async def test_a_full_disk_does_not_stop_a_lowering(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        full = WriteError(OSError(28, "No space left on device"))
        with patch.object(Store, "_async_write_data", side_effect=full):
            for value in (12, 10, 8):
                await call(hass, "number.set_value", limit, value=value)
        assert box.ic_amps == pytest.approx(7.98)
        assert issues(hass) == {"orders_not_stored_bus"}
        assert caplog.text.count("Orders cannot be stored") == 1

        # Once it can be written again, all is well.
        await call(hass, "number.set_value", limit, value=7)
        assert not issues(hass)


@pytest.mark.parametrize(
    "damaged",
    [
        pytest.param(None, id="missing"),
        pytest.param(stored(16.0, limit={"current": -3, "phases": []}), id="negative"),
        pytest.param(stored(16.0, limit="sixteen"), id="shape"),
        pytest.param({**stored(16.0), "version": 99}, id="future"),
        pytest.param({"version": 1, "key": STORE, "data": ["nothing"]}, id="list"),
    ],
)
async def test_lost_orders_become_the_fail_safe_and_are_told(
    hass: HomeAssistant, hass_storage: dict[str, Any], damaged: dict[str, Any] | None
) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger_of(box, fail_safe_current=6.5)
        )
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        await hass.config_entries.async_unload(entry.entry_id)
        hass_storage.pop(STORE)
        if damaged is not None:
            hass_storage[STORE] = damaged

        await hass.config_entries.async_setup(entry.entry_id)
        limit = await get_entity(hass, "number", entry, "charging_current")
        await wait_for_state(hass, limit, "6.5")
        assert issues(hass) == {f"orders_lost_{ABL}"}
        await bus.wait_for_async(lambda: box.ic_amps <= 6.5)
        await call(hass, "number.set_value", limit, value=10)
        assert not issues(hass)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_orders_of_chargers_that_are_no_more(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    file = stored(9.0)
    file["data"]["removed"] = file["data"][ABL]
    hass_storage[STORE] = file
    async with running(hass, AblBox(1)):
        assert list(hass_storage[STORE]["data"]) == [ABL]


async def test_the_same_order_is_not_written_again(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    store = OrderStore(hass, "bus")
    await store.async_load()
    wish = Orders(limit=CurrentLimit(current=10.0))
    await store.async_commit("a", wish)
    hass_storage.pop(STORE)
    await store.async_commit("a", wish)
    assert STORE not in hass_storage
    await store.async_commit("a", Orders(limit=CurrentLimit(current=8.0)))
    assert STORE in hass_storage
    await store.async_remove()
    assert STORE not in hass_storage


async def test_a_lowering_is_written_also_when_its_action_is_given_up(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[STORE] = stored(14.0)
    disk = asyncio.Event()
    writing = asyncio.Event()
    write = Store._async_write_data

    async def slow(self: Store, data: dict[str, Any]) -> None:
        writing.set()
        await disk.wait()
        await write(self, data)

    store = OrderStore(hass, "bus")
    await store.async_load()
    lower = Orders(limit=CurrentLimit(current=8.0))
    with patch.object(Store, "_async_write_data", slow):
        commit = asyncio.create_task(store.async_commit(ABL, lower))
        await writing.wait()
        commit.cancel()
        await asyncio.wait({commit})
        assert commit.cancelled()
        disk.set()
        await hass.async_block_till_done()
    assert hass_storage[STORE]["data"][ABL]["limit"]["current"] == 8.0


async def test_who_reads_next_waits_for_what_is_being_written(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[STORE] = stored(14.0)
    disk = asyncio.Event()
    writing = asyncio.Event()
    write = Store._async_write_data

    async def slow(self: Store, data: dict[str, Any]) -> None:
        writing.set()
        await disk.wait()
        await write(self, data)

    store = OrderStore(hass, "bus")
    await store.async_load()
    lower = Orders(limit=CurrentLimit(current=8.0))
    with patch.object(Store, "_async_write_data", slow):
        commit = asyncio.create_task(store.async_commit(ABL, lower))
        await writing.wait()
        close = asyncio.create_task(store.async_close())
        await asyncio.wait({close}, timeout=0.05)
        assert not close.done()
        disk.set()
        await asyncio.gather(commit, close)
    after = OrderStore(hass, "bus")
    await after.async_load()
    assert after.get(ABL) == lower
