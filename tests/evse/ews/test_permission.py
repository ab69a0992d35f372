"""Pausing and starting: `sl` 6 and `sl` 3, each in its states."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    NotConfirmedError,
)
from custom_components.evse_bus.evse.events import (
    ChargeEnded,
    ChargeStarted,
    StartRequested,
)
from custom_components.evse_bus.evse.ews.wire.states import STATES
from custom_components.evse_bus.evse.model import (
    OrderChange,
    PauseReason,
    SessionResult,
    Status,
)

from .scene import EwsScene, now, play

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)
STOP, START, PAUSE = 1, 3, 6


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


@pytest.mark.parametrize("pause_status", [0x50, 0x42])
def test_a_pause_keeps_the_cable_locked_and_ends_in_the_same_charge(
    pause_status: int,
) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].pause_status = pause_status  # type: ignore[assignment]
        await scene.charge()
        await scene.charger().change_orders(OFF)
        assert scene.status() == pause_status
        assert scene.box.ports[0].locked
        assert scene.connector().status is Status.SUSPENDED_EVSE
        assert scene.reading().allowed is False
        assert scene.reading().offered_current == 0
        await asyncio.sleep(60)
        assert len(scene.line.orders(PAUSE)) == 1
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)
        await asyncio.sleep(10)
        assert scene.connector().status is Status.CHARGING
        assert not scene.unlocked()
        assert scene.starts() == ["sl 3", "sl 3"]
        assert scene.events.count(ChargeStarted(port=1)) == 1
        assert not any(isinstance(event, ChargeEnded) for event in scene.events)

    play(EwsScene(), acts)


def test_every_pause_follows_an_rc_in_the_same_turn() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(OFF)
        names = [one.name for one in scene.line.sent]
        for at, name in enumerate(names):
            if name == "sl":
                assert names[at - 1] == "rc"
        sl, rc = (scene.line.named(name)[-1] for name in ("sl", "rc"))
        assert rc.when > sl.when

    play(EwsScene(), acts)


@pytest.mark.parametrize("status", sorted(set(STATES) - {0xF0}))
def test_a_pause_is_sent_only_where_something_charges(status: int) -> None:
    async def acts(scene: EwsScene) -> None:
        port = scene.box.ports[0]
        port.step = lambda _now: None  # type: ignore[method-assign]
        port.pause = lambda: setattr(port, "status", 0x50)  # type: ignore[method-assign]
        port.status = status
        port.relay.closed = status in (0x40, 0x41)
        await scene.until(lambda: scene.connector().raw_state == f"0x{status:02X}")
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(30)
        running = status in (0x40, 0x41, 0x42, 0x43)
        assert len(scene.line.orders(PAUSE)) == running
        assert not scene.line.orders(START)

    play(EwsScene(), acts)


@pytest.mark.parametrize("status", sorted(set(STATES) - {0x30, 0xF0}))
def test_a_start_is_sent_only_to_a_car_that_waits(status: int) -> None:
    async def acts(scene: EwsScene) -> None:
        port = scene.box.ports[0]
        port.step = lambda _now: None  # type: ignore[method-assign]
        port.status = status
        await scene.until(lambda: scene.connector().raw_state == f"0x{status:02X}")
        faulted = status in (0xA0, 0xA1, 0xA2, 0xA3, 0xA4, 0xA5, 0xA7, 0xA8, 0xFF)
        if faulted:
            with pytest.raises(NotAvailableError, match="not in state"):
                await scene.charger().change_orders(ON)
        else:
            await scene.charger().change_orders(ON)
            assert scene.charger().orders.allowed is True
        await asyncio.sleep(10)
        assert not scene.line.orders()

    play(EwsScene(), acts)


def test_a_car_that_comes_later_is_not_started_by_an_old_order() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charger().change_orders(ON)
        await scene.plug()
        await asyncio.sleep(120)
        assert scene.status() == 0x30
        assert scene.reading().allowed is False
        assert not scene.line.orders()
        scene.box.press_key(1, 1)
        await scene.until(lambda: scene.connector().start_requested)
        assert StartRequested(port=1, optimised=False) in scene.events
        await asyncio.sleep(20)
        assert not scene.line.orders()
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)


def test_a_stop_at_the_box_is_not_ended_by_us() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.press_key(1, 2)
        await scene.until(lambda: scene.status() == 0x50)
        await asyncio.sleep(3)
        (ended,) = (one for one in scene.events if isinstance(one, ChargeEnded))
        assert (ended.port, ended.result) == (1, SessionResult.STOPPED)
        begin = now()
        await scene.charger().change_orders(ON)
        await scene.charger().change_orders(amperes(20.0))
        assert not scene.line.orders(since=begin)
        assert scene.charger().pause_reason is PauseReason.CHARGE_ENDED
        scene.cars[0].leave()
        await scene.until(lambda: scene.status() == 0x00)
        await asyncio.sleep(5)
        assert scene.charger().pause_reason is None

    play(EwsScene(), acts)


def test_a_limit_of_zero_pauses_and_a_higher_one_goes_on() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(amperes(0.0))
        assert scene.status() == 0x50
        assert scene.charger().waits_for_current
        await asyncio.sleep(20)
        # This limit counts if it is started at the box.
        assert scene.box.ports[0].limit == 6
        await scene.charger().change_orders(amperes(12.0))
        await scene.until(lambda: scene.status() == 0x40)
        assert scene.box.ports[0].limit == 12
        assert 0 not in scene.line.limits()
        assert not scene.unlocked()

    play(EwsScene(), acts)


def test_no_change_of_a_limit_ends_the_users_pause() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(OFF)
        for current in (0.0, 10.0, 32.0):
            await scene.charger().change_orders(amperes(current))
            await asyncio.sleep(5)
        assert scene.status() == 0x50
        assert len(scene.line.orders(START)) == 1
        assert scene.box.ports[0].limit == 32

    play(EwsScene(), acts)


def test_a_new_car_is_not_started_by_a_limit() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(amperes(0.0))
        scene.cars[0].leave()
        await scene.until(lambda: scene.status() == 0x00)
        await scene.plug()
        begin = now()
        await scene.charger().change_orders(amperes(16.0))
        await asyncio.sleep(20)
        assert not scene.line.orders(since=begin)
        assert scene.status() == 0x30

    play(EwsScene(), acts)


def test_a_start_at_the_box_against_a_pause_is_paused_again() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charger().change_orders(OFF)
        scene.cars[0].plug_in()
        await scene.until(lambda: scene.status() == 0x40)
        took = await scene.until(lambda: scene.status() == 0x50)
        assert took < 3.0
        await asyncio.sleep(30)
        assert len(scene.line.orders(PAUSE)) == 1
        assert not scene.unlocked()

    scene = EwsScene(options={"mode": "standalone"})
    scene.watchers.append(
        lambda: (
            scene.box.start_on_web_page(1)
            if scene.status() == 0x30 and not scene.starts()
            else None
        )
    )
    play(scene, acts)


def test_a_charge_that_the_box_aborts_has_not_started() -> None:
    """A car that wants ventilation where there is none: code 8, state 0x60."""

    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].wants_fan = True
        await scene.plug()
        await scene.until(lambda: scene.status() == 0x30)
        with pytest.raises(NotConfirmedError, match="aborted"):
            await scene.charger().change_orders(ON)
        assert scene.status() == 0x60
        assert scene.charger().orders.allowed is None

    play(EwsScene(), acts)


def test_a_socket_that_may_never_charge_raises() -> None:
    """Mode 1 has 16 A or nothing, and the wiring has less."""

    async def acts(scene: EwsScene) -> None:
        await asyncio.sleep(10)
        with pytest.raises(NotAvailableError, match="needs 16 A"):
            await scene.charger().change_orders(ON)
        assert scene.charger().orders.allowed is None
        assert not scene.line.orders()
        await scene.charger(2).change_orders(ON)

    options = {"mode1": (True, False)}
    play(EwsScene(installation=10.0, current=6.0, options=options), acts)
