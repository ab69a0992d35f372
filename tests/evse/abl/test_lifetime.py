"""Orders that are not renewed become the fail-safe, and start nothing."""

from custom_components.evse_bus.evse.model import (
    OrderChange,
)
from tests.virtual import AblBox, Car

from .scene import Scene, config, orders, until

PAUSE = 1000
ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def limit(current: float) -> OrderChange:
    return OrderChange(current=current)


def plugged() -> Car:
    car = Car(ramp=0.1, reaction=0.0)
    car.plug_in()
    return car


async def test_orders_that_are_not_renewed_become_the_fail_safe() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(
            config(order_lifetime=1.0), orders(16, allowed=True, fail_safe=8)
        )
        await until(lambda: charger.orders_expired)
        await until(lambda: scene.writes() == [133])
        await scene.polled(charger)
        assert charger.statistics.reasserted == 0
        assert charger.orders.limit.current == 16
        await charger.change_orders(limit(12))
        assert scene.writes() == [133, 200]
        assert not charger.orders_expired


async def test_a_higher_fail_safe_is_written_once() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(
            config(order_lifetime=1.0), orders(6, fail_safe=10)
        )
        await until(lambda: scene.writes() == [100, 166])
        box.set_by_other_master(7)
        await scene.polled(charger, 4)
        assert scene.writes() == [100, 166]


async def test_expired_orders_start_no_stopped_car() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(
            config(order_lifetime=0.8), orders(6, allowed=False, fail_safe=10)
        )
        await until(lambda: charger.orders_expired)
        await scene.polled(charger, 4)
        assert scene.writes() == [PAUSE]


async def test_a_fail_safe_of_0_a_ends_with_the_next_limit() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(
            config(order_lifetime=0.8), orders(10, allowed=True, fail_safe=0)
        )
        await until(lambda: box.ic_amps == 0)
        await scene.polled(charger)
        await charger.change_orders(limit(10))
        assert scene.writes() == [166, PAUSE, 166]


async def test_a_new_fail_safe_does_not_renew_the_orders() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(
            config(order_lifetime=0.8), orders(16, allowed=True, fail_safe=8)
        )
        await until(lambda: scene.writes() == [133])
        await charger.change_orders(OrderChange(fail_safe_current=6))
        await scene.polled(charger)
        assert scene.writes() == [133, 100]
