"""Conversations with a ChargePoint, in simulated time."""

import asyncio
from dataclasses import replace
from math import inf
from typing import Any

import pytest

from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    PortMissingError,
    ReplyTimeoutError,
    WrongChargerError,
)
from custom_components.evse_bus.evse.evbox import EvboxCharger, EvboxConfig
from custom_components.evse_bus.evse.model import (
    Capability,
    ChargerConfig,
    CurrentLimit,
    Fault,
    OrderChange,
    Orders,
    PauseReason,
)
from custom_components.evse_bus.evse.schedule import Kind
from tests.evse.simulated_line import until
from tests.simulated_time import now, simulate
from tests.virtual import Car, EvboxChargePoint, Module
from tests.virtual.evbox_frames import frame

from .scene import ORDERS, EvboxLine, Scene, updates

SERIAL = 1923054


def box(*modules: Module, min_interval: int = 1) -> EvboxChargePoint:
    return EvboxChargePoint(
        SERIAL, list(modules) or [Module()], min_interval=min_interval
    )


def six(line: EvboxLine) -> list[bool]:
    return [max(order.limits + order.fallback) <= 6.0 for order in line.orders]


# -- Configuration -------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {"command": 67},
        {"address": -1},
        {"address": 100_000_000},
        {"information": bytes(15)},
    ],
)
def test_a_configuration_that_cannot_be_encoded_is_refused(
    values: dict[str, Any],
) -> None:
    config = EvboxConfig(key="a", name="A", address=1)
    with pytest.raises(ValueError, match=r"68|digits|16"):
        replace(config, **values)


def test_the_configuration_of_another_protocol_is_refused() -> None:
    charger = EvboxCharger(EvboxConfig(key="a", name="A", address=1), ORDERS)
    with pytest.raises(TypeError, match="EvboxConfig"):
        charger.reconfigure(ChargerConfig(key="a", name="A", address=1))


def test_the_capabilities_of_each_command() -> None:
    one = EvboxCharger(EvboxConfig(key="a", name="A", address=1), ORDERS)
    two = EvboxCharger(EvboxConfig(key="a", name="A", address=1, command=69), ORDERS)
    assert one.capabilities - two.capabilities == {
        Capability.VOLTAGE,
        Capability.POWER,
    }
    assert two.capabilities - one.capabilities == {Capability.ESTIMATED_POWER}
    for absent in (Capability.STATUS, Capability.PLUGGED, Capability.OFFERED_CURRENT):
        assert absent not in one.capabilities | two.capabilities


# -- Orders and readings -------------------------------------------------------------


def test_from_the_first_request_to_the_reading() -> None:
    async def scene() -> None:
        car = Car(max_current=10.0, phases=1, cos_phi=0.9)
        point = box(Module(car, energy_wh=5000), Module(min_current=8.0))
        car.plug_in()
        async with Scene.of(point) as stage:
            information = bytes(range(16))
            charger = stage.add(information=information)
            await until(lambda: charger.reading)
            first = stage.line.orders[0]
            assert first.limits == first.fallback == (6.0, 6.0, 6.0)
            assert (first.command, first.timeout) == (68, 60)
            assert (first.serial, first.information) == ("01923054", information)
            assert charger.reading is not None
            assert charger.reading.maximum_current is None
            await asyncio.sleep(30.0)
            assert six(stage.line)[:3] == [True, True, False]
            assert stage.line.orders[-1].limits == (16.0, 16.0, 16.0)
            assert charger.setpoint.currents == (16.0, 16.0, 16.0)
            reading = charger.reading
            one, two = reading.connectors[1], reading.connectors[2]
            assert reading.maximum_current == 35.0
            assert one.current == (10.0, 0.0, 0.0)
            assert one.power == 10.0 * 230 * 0.9
            assert (one.charging, two.charging) == (True, False)
            assert (one.status, one.plugged, reading.allowed) == (None, None, None)
            assert one.energy == pytest.approx(point.modules[0].energy_wh, abs=10)
            assert (two.energy, two.minimum_current) == (0, 8.0)
            assert charger.info is not None
            assert charger.info.serial == "1923054"
            assert reading.details == {
                "command": 68,
                "modules": 2,
                "reported_maximum_current": 35.0,
                "ordered_timeout": 60,
                "effective_timeout": 60,
                "sent_currents": "16 / 16 / 16",
                "sent_fail_safe": "6 / 6 / 6",
                "sent_timeout": 60,
            }
            assert charger.faults == frozenset()

    simulate(scene())


def test_command_69_estimates_power() -> None:
    async def scene() -> None:
        car = Car(max_current=10.0, cos_phi=0.9)
        car.plug_in()
        async with Scene.of(box(Module(car))) as stage:
            charger = stage.add(command=69, voltage=240.0)
            await asyncio.sleep(30.0)
            assert charger.reading is not None
            one = charger.reading.connectors[1]
            assert one.estimated_power == pytest.approx(3 * 10 * 240 * 0.9)
            assert (one.power, one.voltage) == (None, (None, None, None))
            assert charger.info is not None
            assert charger.info.serial is None
            assert {order.command for order in stage.line.orders} == {69}

    simulate(scene())


def test_a_pause_is_0_a_on_all_phases_and_a_limit_does_not_end_it() -> None:
    async def scene() -> None:
        async with Scene.of(box()) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            await charger.change_orders(OrderChange(allowed=False))
            assert stage.line.orders[-1].limits == (0.0, 0.0, 0.0)
            await charger.change_orders(OrderChange(current=20.0))
            assert stage.line.orders[-1].limits == (0.0, 0.0, 0.0)
            await charger.change_orders(OrderChange(allowed=True))
            assert stage.line.orders[-1].limits == (20.0, 20.0, 20.0)

    simulate(scene())


def test_single_phases_and_the_fail_back() -> None:
    async def scene() -> None:
        async with Scene.of(box()) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            await charger.change_orders(
                OrderChange(
                    current=20.0,
                    phases=(None, 10.5, 7.0),
                    fail_safe_current=8.0,
                    fail_safe_phases=(0.0, None, 4.5),
                    fail_safe_timeout=90,
                )
            )
            order = stage.line.orders[-1]
            assert order.limits == (20.0, 10.5, 7.0)
            assert order.fallback == (0.0, 8.0, 4.5)
            assert order.timeout == 90

    simulate(scene())


@pytest.mark.parametrize(
    ("one_phase_modules", "paused", "limits"),
    [
        (False, 0.0, (0.0, 0.0, 0.0)),
        (False, 5.9, (0.0, 0.0, 0.0)),
        (True, 0.0, (20.0, 0.0, 20.0)),
        (True, 5.9, (20.0, 0.0, 20.0)),
    ],
)
def test_a_phase_below_the_minimum(
    one_phase_modules: bool,  # noqa: FBT001 - a parameter of the test
    paused: float,
    limits: tuple[float, float, float],
) -> None:
    """It pauses all of them, unless the user has one-phase modules."""

    async def scene() -> None:
        async with Scene.of(box()) as stage:
            charger = stage.add(one_phase_modules=one_phase_modules)
            await asyncio.sleep(10.0)
            await charger.change_orders(OrderChange(current=20.0))
            await charger.change_orders(OrderChange(phases=(None, paused, None)))
            assert stage.line.orders[-1].limits == limits
            assert charger.orders.limit.phases == (None, paused, None)
            stopped = not any(limits)
            assert charger.pause_reason is (
                PauseReason.LIMIT_TOO_LOW if stopped else None
            )
            await charger.change_orders(OrderChange(phases=(None, 6.0, None)))
            assert stage.line.orders[-1].limits == (20.0, 6.0, 20.0)
            assert charger.pause_reason is None

    simulate(scene())


def test_the_smallest_minimum_of_the_modules_counts() -> None:
    async def scene() -> None:
        point = box(Module(min_current=12.0), Module(min_current=8.0))
        async with Scene.of(point) as stage:
            charger = stage.add(orders=Orders(limit=CurrentLimit(current=7.0)))
            await asyncio.sleep(10.0)
            assert charger.limits.minimum == 8.0
            assert stage.line.orders[-1].limits == (0.0, 0.0, 0.0)
            await charger.change_orders(OrderChange(current=7.9))
            assert charger.orders.limit.current == 7.9
            assert stage.line.orders[-1].limits == (0.0, 0.0, 0.0)
            assert charger.pause_reason is PauseReason.LIMIT_TOO_LOW
            await charger.change_orders(OrderChange(current=8.0))
            assert charger.pause_reason is None
            assert stage.line.orders[-1].limits == (8.0, 8.0, 8.0)

    simulate(scene())


def test_no_modules_and_twenty_modules() -> None:
    async def scene() -> None:
        point = box()
        point.modules.clear()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            assert charger.reading is not None
            assert dict(charger.reading.connectors) == {}
            assert stage.line.orders[-1].limits == (16.0, 16.0, 16.0)
            for number in range(20):
                point.add_module(Module(energy_wh=1000.0 * number))
            await asyncio.sleep(12.0)
            assert len(charger.reading.connectors) == 20
            assert charger.reading.connectors[20].energy == 19_000

    simulate(scene())


def test_the_meters_when_a_module_is_removed() -> None:
    async def scene() -> None:
        point = box(Module(energy_wh=5000), Module(energy_wh=70_000))
        async with Scene.of(point) as stage:
            charger = stage.add()
            seen: list[tuple[int, float | None, int]] = []

            def listen() -> None:
                assert charger.reading is not None
                for number, one in charger.reading.connectors.items():
                    seen.append((number, one.energy, one.meter_generation))

            charger.subscribe(listen)
            await asyncio.sleep(10.0)
            point.remove_module(0)
            await asyncio.sleep(10.0)
            assert set(seen) == {
                (1, None, 0),
                (1, 5000, 0),
                (2, None, 0),
                (2, 70_000, 0),
                (1, 70_000, 1),
            }

    simulate(scene())


# -- Times ---------------------------------------------------------------------------


@pytest.mark.parametrize("interval", [0, 1, 2, 20])
def test_the_minimum_interval_is_kept_also_by_commands(interval: int) -> None:
    async def scene() -> None:
        point = box(min_interval=interval)
        async with Scene.of(point) as stage:
            charger = stage.add(poll_interval=0.5)
            await asyncio.sleep(60.0)
            for current in range(6, 14):
                await charger.change_orders(OrderChange(current=float(current)))
                assert stage.line.orders[-1].limits[0] == current
                await asyncio.sleep(0.3)
            assert charger.minimum_interval == interval
        # The first requests are sent before a minimum interval is known.
        assert min(stage.line.pauses()) >= max(interval, 0.2)
        assert point.counters.too_soon == 0

    simulate(scene())


@pytest.mark.parametrize(
    ("poll", "interval", "timeout", "period"),
    [
        (5.0, 1, 60, 5.0),
        (30.0, 1, 60, 20.0),
        (5.0, 20, 60, 20.0),
        (0.0, 1, 60, 1.0),
        (5.0, 1, 9, 3.0),
        (5.0, 1, 1, 1.0),
    ],
)
def test_the_period(poll: float, interval: int, timeout: int, period: float) -> None:
    async def scene() -> None:
        point = box(min_interval=interval)
        orders = replace(ORDERS, fail_safe_timeout=timeout)
        async with Scene.of(point) as stage:
            stage.add(poll_interval=poll, orders=orders)
            await asyncio.sleep(200.0)
        assert stage.line.pauses()[-5:] == pytest.approx(5 * [period], abs=0.2)
        assert (point.counters.fail_backs, point.counters.too_soon) == (0, 0)
        assert stage.bus.wire.statistics.missed_deadlines == 0

    simulate(scene())


@pytest.mark.parametrize(
    ("interval", "ordered", "sent"),
    [(20, 5, 60), (1, 1, 3), (0, 1, 3), (1, 600, 600), (20, 0xFFFF, 0xFFFF)],
)
def test_a_time_out_below_three_intervals_is_raised(
    interval: int, ordered: int, sent: int
) -> None:
    async def scene() -> None:
        async with Scene.of(box(min_interval=interval)) as stage:
            charger = stage.add(orders=replace(ORDERS, fail_safe_timeout=ordered))
            assert charger.effective_timeout == max(ordered, 60)
            await asyncio.sleep(100.0)
            assert charger.effective_timeout == sent
            assert stage.line.orders[-1].timeout == sent
            assert charger.reading is not None
            assert charger.reading.details["ordered_timeout"] == ordered
            assert charger.reading.details["effective_timeout"] == sent

    simulate(scene())


def test_a_short_time_out_leaves_room_for_commands() -> None:
    async def scene() -> None:
        point = box(min_interval=1)
        async with Scene.of(point) as stage:
            charger = stage.add(orders=replace(ORDERS, fail_safe_timeout=1))
            await asyncio.sleep(10.0)
            for current in (10.0, 12.0, 14.0):
                started = now()
                await charger.change_orders(OrderChange(current=current))
                assert now() - started < 1.6
                await asyncio.sleep(5.0)
        assert point.counters.fail_backs == 0

    simulate(scene())


def test_unanswered_requests_are_repeated_before_the_time_out() -> None:
    async def scene() -> None:
        point = box(min_interval=1)
        async with Scene.of(point) as stage:
            charger = stage.add(orders=replace(ORDERS, fail_safe_timeout=9))
            await asyncio.sleep(10.0)
            for _ in range(20):
                stage.line.faults.once("lose")
                stage.line.faults.once("lose")
                await asyncio.sleep(10.0)
                assert charger.available
        assert charger.statistics.timeouts >= 20
        assert (point.counters.fail_backs, point.counters.too_soon) == (0, 0)

    simulate(scene())


def test_a_deadline_stands_until_the_box_is_unavailable() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            assert charger.slot.start_by < now() + 60.0
            point.faults.dead = True
            await until(lambda: charger.misses == 1)
            assert charger.available
            assert charger.slot.ready < charger.slot.start_by < inf
            with updates(charger) as calls:
                await until(lambda: not charger.available)
            assert len(calls) == 1
            assert (charger.reading, charger.slot.start_by) == (None, inf)
            assert charger.slot.kind is Kind.PROBE

    simulate(scene())


def test_it_falls_back_when_we_stop_and_not_before() -> None:
    async def scene() -> None:
        point = box()
        stage = Scene.of(point)
        async with stage:
            stage.add()
            await asyncio.sleep(300.0)
            point.step()
            assert point.counters.fail_backs == 0
            assert point.limits_in_force == (16.0, 16.0, 16.0)
        await asyncio.sleep(54.0)
        point.step()
        assert not point.failed_back
        await asyncio.sleep(7.0)
        point.step()
        assert point.failed_back
        assert point.limits_in_force == (6.0, 6.0, 6.0)

    simulate(scene())


def test_after_an_absence_6_a_and_then_the_orders_that_stand() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            assert not six(stage.line)[-1]
            point.faults.dead = True
            await until(lambda: not charger.available)
            silent = len(stage.line.sent)
            await asyncio.sleep(60.0)
            point.faults.dead = False
            point.power_cycle()
            await until(lambda: charger.available)
            assert all(six(stage.line)[silent:])
            # No longer pause: it charges at its own maximum until a request comes.
            assert max(stage.line.pauses()) < 12.0
            await asyncio.sleep(5.0)
            assert stage.line.orders[-1].limits == (16.0, 16.0, 16.0)

    simulate(scene())


def test_after_a_lost_port_the_minimum_interval_is_kept() -> None:
    async def scene() -> None:
        point = box(min_interval=20)
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(41.0)
            sent = len(stage.line.sent)
            stage.line.refuse_open = PortMissingError("away")
            stage.line.unplug()
            await asyncio.sleep(3.0)
            stage.line.refuse_open = None
            await asyncio.sleep(27.0)
            assert stage.line.is_open
            assert charger.available
            assert all(six(stage.line)[sent:])
        assert min(stage.line.pauses()) >= 20.0
        assert point.counters.too_soon == 0

    simulate(scene())


def test_expired_orders_become_the_fail_safe() -> None:
    async def scene() -> None:
        async with Scene.of(box()) as stage:
            charger = stage.add(order_lifetime=60.0)
            await asyncio.sleep(50.0)
            assert stage.line.orders[-1].limits == (16.0, 16.0, 16.0)
            await asyncio.sleep(20.0)
            assert stage.line.orders[-1].limits == (6.0, 6.0, 6.0)
            await charger.change_orders(OrderChange(current=16.0))
            assert stage.line.orders[-1].limits == (16.0, 16.0, 16.0)

    simulate(scene())


def test_expired_orders_stay_so_while_the_fail_safe_changes() -> None:
    async def scene() -> None:
        async with Scene.of(box()) as stage:
            charger = stage.add(order_lifetime=60.0)
            await asyncio.sleep(70.0)
            since = len(stage.line.orders)
            await charger.change_orders(OrderChange(fail_safe_current=8.0))
            await asyncio.sleep(70.0)
            sent = [order.limits for order in stage.line.orders[since:]]
            assert set(sent) == {(8.0, 8.0, 8.0)}

    simulate(scene())


# -- Implausible replies --------------------------------------------------------------


def test_a_stray_wrong_value_is_never_shown() -> None:
    async def scene() -> None:
        point = box(Module(energy_wh=5000))
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            before = charger.reading
            distortions: tuple[dict[str, float], ...] = (
                {"current": 60.0},
                {"cos_phi": 1.5},
                {"voltage": 500.0},
                {"energy_jump": 100_000},
                {"energy_jump": -1000},
            )
            for number, values in enumerate(distortions, 1):
                point.distort(**values)
                with updates(charger) as calls:
                    await asyncio.sleep(10.0)
                assert calls == []
                assert charger.reading == before
                assert charger.statistics.implausible == number
                assert charger.available

    simulate(scene())


def test_implausible_values_that_stay_are_shown_with_a_fault() -> None:
    async def scene() -> None:
        point = box(Module(energy_wh=5000))
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            point.distort(cos_phi=1.5, times=None)
            await asyncio.sleep(15.0)
            assert charger.reading is not None
            assert charger.reading.connectors[1].cos_phi == (1.5, 1.5, 1.5)
            assert charger.faults == {Fault.IMPLAUSIBLE}
            assert charger.statistics.implausible == 2
            point.undistort()
            await asyncio.sleep(10.0)
            assert charger.faults == frozenset()

    simulate(scene())


def test_a_real_over_current_is_shown() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(40.0)
            point.distort(current=60.0, times=None)
            await asyncio.sleep(20.0)
            assert charger.reading is not None
            assert charger.reading.connectors[1].current == (60.0, 60.0, 60.0)
            assert charger.faults == {Fault.OVERCURRENT, Fault.LIMIT_EXCEEDED}
            point.undistort()
            await asyncio.sleep(10.0)
            assert charger.faults == frozenset()

    simulate(scene())


def test_inconsistent_implausible_replies_make_it_unavailable() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            for number in range(12):
                point.undistort()
                point.distort(
                    **({"cos_phi": 1.5} if number % 2 else {"voltage": 400.0})
                )
                count = len(point.orders)
                await until(lambda at=count: len(point.orders) > at)  # type: ignore[misc]
            assert not charger.available
            assert charger.reading is None
            assert Fault.IMPLAUSIBLE in charger.faults
            # It is there, so its orders are still sent, with 6 A at most.
            assert six(stage.line)[-1]
            assert point.counters.fail_backs == 0
            await asyncio.sleep(10.0)
            assert charger.available
            assert charger.faults == frozenset()

    simulate(scene())


def test_a_limit_that_is_not_kept_is_a_fault() -> None:
    async def scene() -> None:
        car = Car(max_current=32.0, greedy=1.3)
        point = box(Module(car))
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            car.plug_in()
            await asyncio.sleep(40.0)
            assert charger.faults == {Fault.LIMIT_EXCEEDED}
            car.greedy = 1.0
            await charger.change_orders(OrderChange(current=15.0))
            await asyncio.sleep(30.0)
            assert charger.faults == frozenset()

    simulate(scene())


@pytest.mark.parametrize("anyway", [0.8, 9.0])
def test_a_car_that_charges_at_0_a_is_a_fault(anyway: float) -> None:
    async def scene() -> None:
        car = Car(max_current=32.0, drawn_anyway=anyway)
        car.plug_in()
        point = box(Module(car), Module())
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(40.0)
            assert charger.faults == frozenset()
            await charger.change_orders(OrderChange(allowed=False))
            # The time to follow (manual, note **), and the period.
            await asyncio.sleep(14.0)
            assert charger.faults == frozenset()
            await asyncio.sleep(10.0)
            assert charger.faults == {Fault.CHARGES_ALTHOUGH_PAUSED}
            car.drawn_anyway = 0.0
            await asyncio.sleep(10.0)
            assert charger.faults == frozenset()

    simulate(scene())


def test_a_sleeping_car_is_no_fault() -> None:
    async def scene() -> None:
        # Three modules together draw more than one car may.
        cars = [Car(drawn_anyway=0.4) for _ in range(3)]
        for car in cars:
            car.plug_in(request=False)
        async with Scene.of(box(*map(Module, cars))) as stage:
            charger = stage.add(orders=replace(ORDERS, allowed=False))
            await asyncio.sleep(60.0)
            assert charger.faults == frozenset()

    simulate(scene())


def test_a_car_that_follows_slowly_is_no_fault() -> None:
    async def scene() -> None:
        car = Car(max_current=32.0, reaction=9.0, ramp=1.0)
        car.plug_in()
        point = box(Module(car))
        async with Scene.of(point) as stage:
            charger = stage.add(orders=Orders(limit=CurrentLimit(current=32.0)))
            await asyncio.sleep(40.0)
            faults: set[Fault] = set()
            charger.subscribe(lambda: faults.update(charger.faults))
            await charger.change_orders(OrderChange(current=6.0))
            await asyncio.sleep(60.0)
            assert point.modules[0].measured()[0] == (6.0, 6.0, 6.0)
            await charger.change_orders(OrderChange(allowed=False))
            await asyncio.sleep(60.0)
            assert point.modules[0].measured()[0] == (0.0, 0.0, 0.0)
            assert faults == set()

    simulate(scene())


def test_a_command_is_repeated_until_its_reply_is_accepted() -> None:
    async def scene() -> None:
        point = box(Module(energy_wh=5000))
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            point.distort(voltage=400.0, times=2)
            await charger.change_orders(OrderChange(current=20.0))
            assert [order.limits[0] for order in stage.line.orders[-3:]] == 3 * [20.0]
            assert charger.orders.limit.current == 20.0

    simulate(scene())


def test_an_unanswered_command_fails_and_a_lowering_stands() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            point.faults.dead = True
            with pytest.raises(ReplyTimeoutError):
                await charger.change_orders(OrderChange(current=20.0))
            assert charger.orders.limit.current == 16.0
            with pytest.raises(ReplyTimeoutError):
                await charger.change_orders(OrderChange(current=8.0))
            point.faults.dead = False
            await asyncio.sleep(30.0)
            assert stage.line.orders[-1].limits == (8.0, 8.0, 8.0)
        with pytest.raises(NotAvailableError):
            await charger.change_orders(OrderChange(current=9.0))

    simulate(scene())


# -- Other stations on the line -------------------------------------------------------


def test_replies_of_other_chargepoints_are_ignored() -> None:
    async def scene() -> None:
        point = box(Module(energy_wh=5000))
        other = EvboxChargePoint(77, [Module(energy_wh=9), Module()])
        async with Scene.of(point, other) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            before = charger.reading

            def add_other_frames(data: bytes) -> bytes:
                foreign = frame("A0806800000077000101F40000000000"[:22] + "00")
                return foreign + frame("BCA001") + frame("A080690001015E00") + data

            stage.line.damage = add_other_frames
            await asyncio.sleep(20.0)
            assert charger.reading == before
            assert charger.statistics.timeouts == 0
            assert stage.bus.wire.statistics.foreign_frames > 10

    simulate(scene())


def test_three_chargepoints_by_serial_number() -> None:
    async def scene() -> None:
        points = [EvboxChargePoint(serial, serial % 10) for serial in (11, 12, 13)]
        async with Scene.of(*points) as stage:
            chargers = [
                stage.add(serial, Orders(limit=CurrentLimit(current=serial * 1.0)))
                for serial in (11, 12, 13)
            ]
            await asyncio.sleep(30.0)
        for charger, point in zip(chargers, points, strict=True):
            assert charger.info is not None
            assert charger.info.serial == str(charger.config.address)
            assert point.orders[-1].limits[0] == charger.config.address
            assert {order.serial for order in point.orders} == {point.serial}
            assert point.counters.too_soon == 0

    simulate(scene())


def test_eight_chargepoints_of_twenty_modules_miss_no_deadline() -> None:
    async def scene() -> None:
        points = [EvboxChargePoint(serial, 20) for serial in range(1, 9)]
        async with Scene.of(*points) as stage:
            for point in points:
                stage.add(int(point.serial))
            await asyncio.sleep(300.0)
            statistics = stage.bus.wire.statistics
            assert (statistics.missed_deadlines, statistics.timeouts) == (0, 0)
        for point in points:
            assert (point.counters.fail_backs, point.counters.too_soon) == (0, 0)
            assert len(point.orders) >= 55

    simulate(scene())


# -- Another box in its place --------------------------------------------------------


def test_a_swapped_box_gets_two_requests_of_6_a_and_no_more() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add(0)
            await asyncio.sleep(10.0)
            assert charger.info is not None
            assert charger.info.serial == "1923054"
            assert not six(stage.line)[-1]
            sent = len(stage.line.sent)
            # Switched off, replaced, and switched on again.
            point.faults.dead = True
            await until(lambda: not charger.available)
            missed = len(stage.line.sent) - sent
            point.serial, point.faults.dead = "00000077", False
            with updates(charger) as calls:
                await until(lambda: charger.faults)
            assert calls
            assert charger.faults == {Fault.WRONG_CHARGER}
            assert (charger.available, charger.reading) == (False, None)
            assert charger.info.serial == "1923054"
            with pytest.raises(WrongChargerError) as error:
                await charger.change_orders(OrderChange(current=10.0))
            assert (error.value.expected, error.value.found) == ("1923054", "77")
            stage.line.unplug()
            await asyncio.sleep(300.0)
            assert len(stage.line.sent) == sent + missed + 2
            assert all(six(stage.line)[-2:])
            point.step()
            assert point.failed_back

    simulate(scene())


def test_a_box_swapped_between_two_polls_gets_6_a() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add(0)
            await asyncio.sleep(10.0)
            sent = len(stage.line.sent)
            point.serial = "00000077"
            await until(lambda: Fault.WRONG_CHARGER in charger.faults)
            assert len(stage.line.sent) == sent + 2
            assert six(stage.line)[-2:] == [False, True]
            assert charger.reading is None

    simulate(scene())


def test_the_configured_serial_number_counts() -> None:
    async def scene() -> None:
        async with Scene.of(box()) as stage:
            charger = stage.add(0, serial="77")
            await asyncio.sleep(60.0)
            assert charger.faults == {Fault.WRONG_CHARGER}
            assert len(stage.line.sent) == 2
            assert charger.reading is None
        async with Scene.of(box()) as stage:
            charger = stage.add(0, serial="01923054")
            await asyncio.sleep(10.0)
            assert charger.available

    simulate(scene())


def test_one_corrupt_serial_number_stops_nothing() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add(0)
            await asyncio.sleep(10.0)
            point.serial = "01923055"
            count = len(point.orders)
            await until(lambda: len(point.orders) > count)
            point.serial = "01923054"
            await asyncio.sleep(30.0)
            assert charger.available
            assert charger.faults == frozenset()
            assert stage.line.orders[-1].limits == (16.0, 16.0, 16.0)

    simulate(scene())


def test_addressed_by_serial_number_another_box_gets_no_request() -> None:
    async def scene() -> None:
        point = box()
        async with Scene.of(point) as stage:
            charger = stage.add()
            await asyncio.sleep(10.0)
            received = len(point.orders)
            point.serial = "00000077"
            await asyncio.sleep(60.0)
            assert not charger.available
            assert charger.faults == frozenset()
            assert len(point.orders) == received
            point.serial = "01923054"
            await asyncio.sleep(30.0)
            assert charger.available

    simulate(scene())
