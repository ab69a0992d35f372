"""What a search or a bus has learnt is known to the bus that is set up next.

A ChargePoint that asks for 20 s between two messages is the witness.
"""

import asyncio
from itertools import pairwise
from typing import Any

from homeassistant.config_entries import ConfigEntryDisabler
from homeassistant.core import HomeAssistant
from homeassistant.data_entry_flow import FlowResultType
import pytest

from custom_components.evse_bus.evse.smartevse.polled import QUIET
from tests.common import (
    call,
    charger_of,
    get_entity,
    running,
    setup_bus,
    subentry_id,
)
from tests.flow import IMPOSED, Flow, charger, port_step, smartevse_step
from tests.virtual import Car, EvboxChargePoint, SmartEvse, VirtualBus

INTERVAL = 20


def box() -> EvboxChargePoint:
    return EvboxChargePoint(1923054, min_interval=INTERVAL)


def pauses(point: EvboxChargePoint) -> list[float]:
    """Return the times between the messages that it has accepted, s."""
    return [later.t - one.t for one, later in pairwise(point.orders)]


def check(point: EvboxChargePoint, *, at_least: int) -> None:
    """Check that no message came too soon, and none much later than possible."""
    assert point.counters.too_soon == 0
    assert len(point.orders) >= at_least
    assert max(pauses(point)) < INTERVAL + 2


async def test_from_the_search_to_the_entry(hass: HomeAssistant) -> None:
    point = box()
    with VirtualBus.in_loop(point) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_single")
        await flow.submit(IMPOSED)
        await flow.wait()
        await flow.submit({"chargers": ["1923054"], "installation_limit": 20})
        await flow.submit(charger("Garage", 20, fail_safe_timeout=90))
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        entry = flow.result["result"]
        await asyncio.sleep(1.3)
        # Two for the search.
        assert len(point.orders) == 2
        await asyncio.sleep(2 * INTERVAL)
        check(point, at_least=4)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_from_one_search_to_the_next(hass: HomeAssistant) -> None:
    point = box()
    with VirtualBus.in_loop(point) as bus:
        for _ in range(2):
            flow = await port_step(hass, "evbox", bus.url)
            await flow.choose("search_single")
            await flow.submit(IMPOSED)
            await flow.wait()
            assert flow.step == "select"
            flow.abort()
            await hass.async_block_till_done()
        check(point, at_least=2)


@pytest.mark.parametrize("how", ["reload", "disable", "title"])
async def test_a_changed_entry(hass: HomeAssistant, how: str) -> None:
    point = box()
    async with running(hass, point, poll_interval=5.0) as (entry, _bus):
        entries = hass.config_entries
        await asyncio.sleep(INTERVAL * 2 + 3)
        if how == "reload":
            await entries.async_reload(entry.entry_id)
        elif how == "disable":
            by = ConfigEntryDisabler.USER
            await entries.async_set_disabled_by(entry.entry_id, by)
            await entries.async_set_disabled_by(entry.entry_id, None)
        else:
            entries.async_update_entry(entry, title="Another name")
        await asyncio.sleep(INTERVAL * 2)
        check(point, at_least=4)


@pytest.mark.parametrize("change", [{"command": 69}, {"voltage": 231.0}])
async def test_a_reconfigured_charger(
    hass: HomeAssistant, change: dict[str, Any]
) -> None:
    point = box()
    async with running(hass, point, poll_interval=5.0) as (entry, _bus):
        await asyncio.sleep(INTERVAL * 2 + 3)
        subentry = entry.subentries[subentry_id(entry)]
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, **change}
        )
        await asyncio.sleep(INTERVAL * 2)
        check(point, at_least=4)


async def test_a_charger_removed_and_added_to_a_running_bus(
    hass: HomeAssistant,
) -> None:
    point, other = box(), EvboxChargePoint(777, min_interval=INTERVAL)
    async with running(hass, point, other, poll_interval=5.0) as (entry, _bus):
        await asyncio.sleep(INTERVAL * 2 + 3)
        hass.config_entries.async_remove_subentry(entry, subentry_id(entry))
        await hass.async_block_till_done()
        flow = await Flow.add_charger(hass, entry)
        await flow.submit({"serial_number": "1923054"})
        await flow.submit(charger("Again", fail_safe_timeout=90))
        await flow.submit()
        await asyncio.sleep(INTERVAL * 2)
        check(point, at_least=4)
        check(other, at_least=4)


async def test_an_entry_removed_and_added(hass: HomeAssistant) -> None:
    point = box()
    async with running(hass, point, poll_interval=5.0) as (entry, bus):
        await asyncio.sleep(INTERVAL + 3)
        await hass.config_entries.async_remove(entry.entry_id)
        again = await setup_bus(hass, "evbox", bus.url, charger_of(point))
        await asyncio.sleep(INTERVAL * 2)
        check(point, at_least=3)
        await hass.config_entries.async_unload(again.entry_id)


@pytest.mark.parametrize("how", ["reload", "disable", "change"])
async def test_orders_that_have_expired_stay_so(hass: HomeAssistant, how: str) -> None:
    """No current comes back because the config entry is set up again."""
    point = EvboxChargePoint(1923054)
    async with running(hass, point, order_lifetime=1, poll_interval=2.0) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=12)
        await asyncio.sleep(30)
        assert point.limits_in_force == (12.0, 12.0, 12.0)
        await asyncio.sleep(40)
        assert point.limits_in_force == (6.0, 6.0, 6.0)
        before = len(point.orders)
        if how == "change":
            subentry = entry.subentries[subentry_id(entry)]
            hass.config_entries.async_update_subentry(
                entry, subentry, data={**subentry.data, "information": "01" * 16}
            )
        elif how == "reload":
            await hass.config_entries.async_reload(entry.entry_id)
        else:
            by = ConfigEntryDisabler.USER
            await hass.config_entries.async_set_disabled_by(entry.entry_id, by)
            await hass.config_entries.async_set_disabled_by(entry.entry_id, None)
        await asyncio.sleep(30)
        assert len(point.orders) > before + 5
        assert {order.limits for order in point.orders[before:]} == {(6.0,) * 3}
        await call(hass, "number.set_value", limit, value=12)
        assert point.limits_in_force == (12.0, 12.0, 12.0)


async def test_a_later_smartevse_has_its_quiet_after_a_search_and_reloads(
    hass: HomeAssistant,
) -> None:
    """Its car charges meanwhile, and is not stopped with NO_COMM."""
    point = SmartEvse("2.30", car=Car(max_current=32.0))
    with VirtualBus.in_loop(point) as bus:
        assert point.car is not None
        point.car.plug_in()
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        await flow.submit({"chargers": "1"})
        await flow.submit(charger("Yard"))
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        entry = flow.result["result"]
        for pause in (9.0, 1.0, 4.0, 12.0):
            await asyncio.sleep(pause)
            assert point.error == 0
            await hass.config_entries.async_reload(entry.entry_id)
        await asyncio.sleep(30)
        assert point.error == 0
        assert point.contactor
        await hass.config_entries.async_unload(entry.entry_id)
        # Requests of one burst are less than a second apart.
        quiets = [
            later.t - one.end
            for one, later in pairwise(bus.log.bursts())
            if later.t - one.end > 1
        ]
        assert len(quiets) > 5
        assert min(quiets) >= QUIET - 0.1
