"""What the chargers of a bus share: stored before it counts, never above the limit."""

from math import inf, nan
from typing import Any
from unittest.mock import patch

from homeassistant.core import HomeAssistant
from homeassistant.helpers.storage import Store
from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.model import Circuit, CurrentLimit, Orders
from custom_components.evse_bus.stores.orders import (
    ORDERS_KEY,
    OrderStore,
    Record,
    SupplyOrder,
    decode,
    encode,
)
from custom_components.evse_bus.supply import SharedSupply

BUS = "bus:bus"
INSTALLED = Circuit(limit=25.0, minimum=8.0)

amounts = st.none() | st.floats(0, 240)


def stored(supply: object, **chargers: Orders) -> dict[str, Any]:
    """Return a file with an order about the supply."""
    records = {key: encode(Record(orders)) for key, orders in chargers.items()}
    data = {BUS: {"supply": supply, "lost": False}, **records}
    return {"version": 1, "minor_version": 1, "key": ORDERS_KEY, "data": data}


class Sharing:
    """A supply that tells a list instead of a master."""

    def __init__(self, hass: HomeAssistant, installed: Circuit = INSTALLED) -> None:
        self.told: list[float] = []
        self.orders = OrderStore(hass)
        self.supply = SharedSupply(installed, self.orders, BUS, self.follow)

    async def follow(self, supply: Circuit) -> None:
        self.told.append(supply.limit)

    async def begin(self, *, new: bool = False) -> bool:
        """Return whether there was an order, or none was expected."""
        await self.orders.async_load()
        assert await self.supply.async_start(registered=not new)
        return not self.supply.is_lost


@given(amounts, amounts)
def test_a_raise_is_what_allows_more(one: float | None, two: float | None) -> None:
    first, second = SupplyOrder(one), SupplyOrder(two)
    both = [inf if value is None else value for value in (one, two)]
    assert second.raises(first) == (both[1] > both[0])


@pytest.mark.parametrize("damage", ["16", nan, inf, -1, [], {}, True])
def test_damage_is_never_an_order(damage: object) -> None:
    with pytest.raises((RefusedOrderError, TypeError)):
        decode({"supply": damage, "lost": False})


async def test_a_new_bus_shares_all_there_is(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    sharing = Sharing(hass)
    assert await sharing.begin(new=True)
    assert sharing.told == [25.0]
    # Nobody has said anything yet: what the installation gives may still change.
    assert hass_storage[ORDERS_KEY] == stored(None)
    await sharing.supply.async_update_installed(Circuit(limit=32.0))
    assert sharing.supply.limit == 32.0


async def test_an_order_outlives_a_restart(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(11.5, one=Orders(limit=CurrentLimit(current=9.0)))
    sharing = Sharing(hass)
    assert await sharing.begin()
    assert sharing.told == [11.5]
    assert sharing.orders.get("one") == Orders(limit=CurrentLimit(current=9.0))
    assert sharing.orders.supply("one") is None


@pytest.mark.parametrize(
    "content",
    [None, stored("x"), stored(-3), {"version": 99, "key": ORDERS_KEY, "data": 0}],
)
async def test_a_lost_order_is_as_little_as_lets_a_car_charge(
    hass: HomeAssistant, hass_storage: dict[str, Any], content: dict[str, Any] | None
) -> None:
    if content is not None:
        hass_storage[ORDERS_KEY] = content
    sharing = Sharing(hass)
    assert not await sharing.begin()
    assert sharing.told == [8.0]


async def test_it_never_exceeds_what_the_installation_gives(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(40.0)
    sharing = Sharing(hass)
    await sharing.begin()
    await sharing.supply.async_update_installed(Circuit(limit=16.0))
    await sharing.supply.async_update_installed(Circuit(limit=16.0))
    await sharing.supply.async_update_installed(Circuit(limit=32.0))
    assert sharing.told == [25.0, 16.0, 32.0]
    for absurd in (32.1, -1, nan, inf):
        with pytest.raises(RefusedOrderError):
            await sharing.supply.async_order(absurd)
    assert sharing.told == [25.0, 16.0, 32.0]


async def test_orders_are_rounded_down(hass: HomeAssistant) -> None:
    sharing = Sharing(hass)
    await sharing.begin(new=True)
    for wish in (6.97, 6.9, 0, 25):
        await sharing.supply.async_order(wish)
    assert sharing.told[1:] == [6.9, 6.9, 0.0, 25.0]


async def test_a_lowering_is_on_disk_before_it_counts(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(20.0)
    sharing = Sharing(hass)
    await sharing.begin()
    written: list[tuple[float, float]] = []

    async def watched(self: Store, data: dict[str, Any]) -> None:  # noqa: ARG001 - as Store's
        written.append((data["data"][BUS]["supply"], sharing.told[-1]))

    with patch.object(Store, "_async_write_data", watched):
        await sharing.supply.async_order(10)
        assert written == [(10.0, 20.0)]
        assert sharing.told[-1] == 10.0
        # A raise counts at once and is written soon: losing it only means less.
        await sharing.supply.async_order(14)
        assert len(written) == 1
        assert sharing.told[-1] == 14.0
        await sharing.orders.async_flush()
    assert written[1:] == [(14.0, 14.0)]


async def test_chargers_that_go_leave_it_alone(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    hass_storage[ORDERS_KEY] = stored(
        12.0, gone=Orders(limit=CurrentLimit(current=9.0))
    )
    sharing = Sharing(hass)
    await sharing.begin()
    await sharing.orders.async_forget(["gone"])
    assert hass_storage[ORDERS_KEY] == stored(12.0)
