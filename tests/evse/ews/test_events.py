"""Events of a charge: card, energy, time, result."""

import asyncio
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.events import (
    ChargeEnded,
    ChargeStarted,
    StartRequested,
)
from custom_components.evse_bus.evse.ews.events import charge_ended, start_requested
from custom_components.evse_bus.evse.ews.wire.status import (
    Card,
    PortStatus,
    decode_ports,
)
from custom_components.evse_bus.evse.model import Command, OrderChange, SessionResult
from tests.virtual.ews_rfid import Card as VirtualCard
from tests.virtual.ews_session import Session

from .scene import EwsScene, play
from .wire import PORTS

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)
IDLE = decode_ports(PORTS)[1]


def port(session: tuple[int, int], last: tuple[int, int]) -> PortStatus:
    """Return how a port is, with seconds and Wh of this charge and the last one."""
    return replace(
        IDLE,
        session_time=session[0],
        session_energy=session[1],
        last_time=last[0],
        last_energy=last[1],
        result_code=1,
    )


@pytest.mark.parametrize(
    ("running", "status"),
    [
        # Taken over; the counters stay, or are reset.
        (port((90, 900), (5, 50)), port((100, 1000), (100, 1000))),
        (port((90, 900), (5, 50)), port((0, 0), (100, 1000))),
        # Taken over with a pause before, and nothing new since.
        (port((90, 900), (60, 600)), port((0, 0), (100, 1000))),
        # Taken over later only.
        (port((90, 900), (5, 50)), port((100, 1000), (5, 50))),
        (port((100, 1000), (5, 50)), port((0, 0), (5, 50))),
        # As long as the one before.
        (port((100, 1000), (100, 1000)), port((0, 0), (100, 1000))),
        # Without a status of it under way.
        (None, port((0, 0), (100, 1000))),
    ],
)
def test_energy_and_time_of_a_charge(
    running: PortStatus | None, status: PortStatus
) -> None:
    ended = charge_ended(2, running, status)
    assert ended == ChargeEnded(
        port=2, result=SessionResult.STOPPED, energy=1000, duration=100
    )


def test_card_of_a_start_request() -> None:
    card = Card(group=7, number=42, user="MAXMUSTR")
    asked = start_requested(1, replace(IDLE, card=card, optimised=True))
    assert (asked.group, asked.number, asked.optimised) == (7, 42, True)
    assert repr(asked) == "StartRequested(port=1, optimised=True)"
    without_card = start_requested(2, replace(IDLE, card=None))
    assert without_card == StartRequested(port=2, optimised=False)


# -- On the virtual box --------------------------------------------------------------


def ends(scene: EwsScene) -> list[ChargeEnded]:
    return [one for one in scene.events if isinstance(one, ChargeEnded)]


class Late(Session):
    """Takes a charge over when the car has left, and resets its counters then."""

    def end(self, result: int, at: tuple[int, ...]) -> None:
        self.result, self.last_end = result, at

    def gone(self) -> None:
        if self.seconds:
            self.last_seconds, self.last_wh = self.seconds, self.wh
        super().gone()


class AtOnce(Session):
    """Takes a charge over at its end, and resets its counters at once."""

    def end(self, result: int, at: tuple[int, ...]) -> None:
        super().end(result, at)
        self.seconds = self.wh = 0.0


@pytest.mark.parametrize("kind", [Session, Late, AtOnce])
@pytest.mark.parametrize("how", ["stop", "leave", "pause and unlock", "rcd"])
def test_the_end_of_a_charge(kind: type[Session], how: str) -> None:
    """Whenever the box takes it over: also the second one, shorter than the first."""

    async def acts(scene: EwsScene) -> None:
        box = scene.box.ports[0]
        box.session = kind()
        for seconds in (120, 40):
            before = box.session.total_wh
            await scene.charge()
            await asyncio.sleep(seconds)
            if how == "stop":
                await scene.charger().command(Command.STOP_AND_UNLOCK)
            elif how == "leave":
                scene.cars[0].leave()
            elif how == "rcd":
                scene.box.trip_rcd(1)
                await asyncio.sleep(10)
                scene.box.trip_rcd(1, tripped=False)
            else:
                await scene.charger().change_orders(OFF)
                await asyncio.sleep(10)
                await scene.charger().command(Command.UNLOCK)
            await asyncio.sleep(5)
            scene.cars[0].leave()
            await scene.until(lambda: scene.status() == 0x00)
            await asyncio.sleep(5)
            charged = box.session.total_wh - before
            ended = ends(scene)[-1]
            assert ended.energy == pytest.approx(charged, rel=0.08)
            assert ended.duration == pytest.approx(seconds + 3, abs=3)
        assert len(ends(scene)) == 2
        assert scene.events.count(ChargeStarted(port=1)) == 2

    play(EwsScene(), acts)


def test_a_charge_with_a_pause_is_one() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await asyncio.sleep(60)
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(60)
        await scene.charger().change_orders(ON)
        await asyncio.sleep(60)
        await scene.charger().command(Command.STOP_AND_UNLOCK)
        await asyncio.sleep(5)
        (ended,) = ends(scene)
        assert ended.energy == pytest.approx(scene.box.ports[0].session.total_wh, abs=2)
        assert ended.duration == pytest.approx(123, abs=3)

    play(EwsScene(), acts)


def test_an_end_while_the_line_is_lost_is_reported_later() -> None:
    """A charge that was under way before the line was back is no start."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await asyncio.sleep(60)
        scene.unplug(5.0)
        scene.cars[0].leave()
        await scene.until(lambda: scene.status() == 0x00)
        await scene.until(lambda: scene.charger().reading is not None)
        await asyncio.sleep(10)
        (ended,) = ends(scene)
        assert ended.energy == pytest.approx(scene.box.ports[0].session.total_wh, abs=2)
        assert ended.result is SessionResult.PILOT_LOST
        scene.unplug(5.0)
        scene.cars[0].plug_in()
        await scene.until(lambda: scene.status() == 0x30)
        scene.box.ports[0].release_start("page")
        await scene.until(lambda: scene.charger().reading is not None)
        await asyncio.sleep(10)
        assert scene.connector().charging
        scene.unplug(5.0)
        await asyncio.sleep(10)
        assert scene.events.count(ChargeStarted(port=1)) == 1
        assert len(ends(scene)) == 1

    play(EwsScene(), acts)


def test_a_start_that_is_requested_with_a_card() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.present_card(VirtualCard(7, 42, "MAX"))
        await scene.plug(2)
        await scene.charger(2).command(Command.SET_OPTIMISED, value=True)
        scene.box.press_key(2, 1)
        await scene.until(lambda: scene.connector(2).start_requested)
        (asked,) = (one for one in scene.events if isinstance(one, StartRequested))
        assert asked == StartRequested(port=2, optimised=True, group=7, number=42)

    play(EwsScene(options={"rfid": True}), acts)


def test_a_start_that_is_requested_before_the_car_is_found() -> None:
    """Reported once permission has an effect: given earlier, it would start nothing."""

    async def acts(scene: EwsScene) -> None:
        port = scene.box.ports[0]
        port.search_time = 10.0
        await scene.until(lambda: scene.charger().reading is not None)
        scene.cars[0].plug_in()
        await scene.until(lambda: scene.connector().raw_state == "0x10")
        scene.box.press_key(1, 1)
        await asyncio.sleep(3)
        assert port.start_mode == 1
        assert scene.connector().start_requested is False
        assert not [one for one in scene.events if isinstance(one, StartRequested)]
        await scene.until(lambda: scene.connector().start_requested)
        assert scene.status() == 0x30
        requests = [one for one in scene.events if isinstance(one, StartRequested)]
        assert requests == [StartRequested(port=1, optimised=False)]
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)
