"""A charger's set-up is changed while the bus runs: at once, and only there."""

from itertools import pairwise
from typing import Any

from homeassistant.const import STATE_UNAVAILABLE
from homeassistant.core import HomeAssistant

from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    wait_for_state,
)
from tests.virtual import AblBox, Car, EvboxChargePoint, orders_in, requests_in


def change(hass: HomeAssistant, entry: Any, key: str, **data: object) -> None:  # noqa: ANN401 - a mock's entry
    """Change a charger's stored set-up as its form does."""
    subentry = entry.subentries[key]
    hass.config_entries.async_update_subentry(
        entry, subentry, data={**subentry.data, **data}
    )


async def test_a_lower_installation_limit_does_not_wait_for_the_next_poll(
    hass: HomeAssistant,
) -> None:
    box = AblBox(1)
    # Nobody could see the next poll.
    async with running(hass, box, poll_interval=3600.0) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        change(hass, entry, "abl1", installation_limit=10.0)
        await bus.wait_for_async(lambda: box.ic_amps <= 10, timeout=5)


async def test_a_lower_installation_limit_of_an_evbox(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=1)
    async with running(
        hass, box, poll_interval=15.0, fail_safe_current=16.0, fail_safe_timeout=60
    ) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        await call(hass, "number.set_value", limit, value=16)
        change(hass, entry, "evbox1923054", installation_limit=10.0)
        await bus.wait_for_async(lambda: box.limits_in_force == (10, 10, 10), timeout=5)
        assert orders_in(bus.log.bursts())[-1].fallback == (10, 10, 10)


async def test_entities_of_an_order_lifetime_come_and_go_with_it(
    hass: HomeAssistant,
) -> None:
    async with running(hass, AblBox(1)) as (entry, bus):
        await get_entity(hass, "number", entry, "charging_current")
        assert entity_id(hass, "number", entry, "fail_safe_current") is None
        change(hass, entry, "abl1", order_lifetime=30)
        await get_entity(hass, "number", entry, "fail_safe_current")
        await get_entity(hass, "binary_sensor", entry, "orders_expired")

        change(hass, entry, "abl1", order_lifetime=None)
        await hass.async_block_till_done()
        assert entity_id(hass, "number", entry, "fail_safe_current") is None
        assert entity_id(hass, "binary_sensor", entry, "orders_expired") is None
        assert bus.opened == 1

        # And again.
        change(hass, entry, "abl1", order_lifetime=30)
        await get_entity(hass, "number", entry, "fail_safe_current")


async def test_a_longer_poll_interval_does_not_end_the_estimate(
    hass: HomeAssistant,
) -> None:
    """What was a gap before is the time between two readings now."""
    car = Car(reaction=0.0, ramp=0.1)
    box = AblBox(1, car=car)
    async with running(hass, box, fail_safe_current=16.0) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status")
        estimate = entry.runtime_data.chargers["abl1"].charger._energy
        before = estimate._longest
        change(hass, entry, "abl1", poll_interval=60.0)
        await hass.async_block_till_done()
        assert before < 60 < estimate._longest


async def test_others_are_polled_as_ever_while_one_is_changed(
    hass: HomeAssistant,
) -> None:
    """The wire is the witness: no poll of the other comes late."""
    period = 0.25
    one = AblBox(1)
    two = AblBox(2, serial="2W22xy00000002")
    async with running(hass, one, two, poll_interval=period) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        await get_entity(hass, "sensor", entry, "1_status", index=1)

        def polls() -> list[float]:
            return [
                request.t
                for request in requests_in(bus.log.bursts())
                if request.device_id == 1 and request.register == 0x2E
            ]

        async def some_polls() -> None:
            seen = len(polls())
            await bus.wait_for_async(lambda: len(polls()) > seen + 2)

        await some_polls()
        begun = len(polls())
        limit = await get_entity(hass, "number", entry, "charging_current", index=1)
        change(hass, entry, "abl2", installation_limit=10.0)
        await some_polls()
        # Made anew, at an address where nobody is; then taken away.
        change(hass, entry, "abl2", address=3)
        await wait_for_state(hass, limit, STATE_UNAVAILABLE)
        await some_polls()
        hass.config_entries.async_remove_subentry(entry, "abl2")
        await hass.async_block_till_done()
        await some_polls()

        times = polls()[begun:]
        gaps = [later - earlier for earlier, later in pairwise(times)]
        # A period, and at most one exchange with the other that came to nothing.
        timing = entry.runtime_data.protocol.timing
        assert max(gaps) < period + timing.reply_timeout + 0.15
        assert bus.opened == 1
