"""A duty of the whole bus: its hard deadline, its silence; in simulated time."""

import asyncio
import itertools
from typing import override

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.conversation import FollowUp
from custom_components.evse_bus.evse.errors import (
    LineBusyError,
    LineLostError,
    NotAvailableError,
)
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.framing import Frame
from custom_components.evse_bus.evse.master import BusMaster
from custom_components.evse_bus.evse.model import Fault, OrderChange
from custom_components.evse_bus.evse.schedule import Kind
from tests.simulated_time import now, simulate

from .telegram import TIMING, Scene, SimulatedCharger, Telegram, TelegramFramer

PERIOD = 2.0
SLACK = 0.02
CALL = b"@\xffB\x00"


class Beat(BusMaster):
    """Says ``B`` to everybody every two seconds."""

    def __init__(self) -> None:
        super().__init__()
        self.beats: list[float] = []
        self.quiet_until = 0.0
        self.raises: list[Exception] = []
        self.opened = 0

    @property
    @override
    def silent(self) -> bool:
        return now() < self.quiet_until

    @property
    @override
    def period(self) -> float:
        return PERIOD

    @property
    @override
    def refusal(self) -> NotAvailableError | None:
        return NotAvailableError("hush") if self.silent else None

    @override
    def on_line_open(self, now: float) -> None:
        self.opened += 1
        self._next(now)

    @override
    def failed(self, now: float) -> None:
        self._next(now)

    @override
    async def turn(self, turn: Turn) -> None:
        if self.raises:
            raise self.raises.pop()
        if self.silent:
            self._next(self.quiet_until)
            return
        planned = self.slot.ready
        await turn.send(CALL)
        self.beats.append(turn.sent_at or 0.0)
        self._next(planned + PERIOD)

    def _next(self, at: float) -> None:
        self.slot.ready = self.slot.due = at
        self.slot.start_by = at + SLACK

    @override
    def on_unsolicited(self, frame: Frame) -> bool:
        if isinstance(frame, Telegram) and frame.command == ord("!"):
            self.quiet_until = now() + 60
            self.notice(Fault.SECOND_MASTER, present=True)
            assert self.bus is not None
            self.bus.silence("somebody else is master")
            self._next(self.quiet_until)
            return True
        return False


class BeatScene(Scene):
    """A bus with a duty beside its chargers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.beat = Beat()
        bus = Bus(self.line, TelegramFramer(), TIMING, "simulated", group=self.beat)
        for charger in tuple(self.bus.chargers.values()):
            bus.add(charger)
        self.bus = bus

    def gaps(self) -> list[float]:
        return [b - a for a, b in itertools.pairwise(self.beat.beats)]


def test_its_deadline_holds_whatever_else_the_bus_does() -> None:
    async def scene() -> None:
        async with BeatScene(addresses=(1, 2, 3, 4), interval=0.0) as bus:
            bus.line.devices[3].alive = False
            bus.line.devices[4].delay = 0.2
            for value in range(6, 30):
                change = bus.charger(1 + value % 2).change_orders(
                    OrderChange(current=float(value))
                )
                await asyncio.gather(change, asyncio.sleep(value / 11))
            await asyncio.sleep(60)
            assert max(bus.gaps()) <= PERIOD + SLACK
            assert min(bus.gaps()) >= PERIOD - SLACK
            # Without drift: planned from the plan, not from when it went.
            total = bus.beat.beats[-1] - bus.beat.beats[0]
            assert total == pytest.approx(PERIOD * len(bus.gaps()), abs=SLACK)
            assert bus.bus.wire.statistics.missed_deadlines == 0
            assert bus.bus.wire.statistics.sent_only == len(bus.beat.beats)
            assert bus.charger(1).polls > 100

    simulate(scene())


def test_what_nobody_answers_is_waited_out_and_not_longer() -> None:
    async def scene() -> None:
        async with BeatScene(interval=1.0) as bus:
            await asyncio.sleep(10)
            for sent in bus.line.sent:
                if sent.command != "B":
                    continue
                over = sent.when + len(CALL) * bus.line.settings.byte_time
                after = [one.when for one in bus.line.sent if one.when > sent.when]
                assert min(after) >= over
            assert bus.bus.wire.statistics.timeouts == 0

    simulate(scene())


def test_silence_is_for_everybody_and_ends() -> None:
    async def scene() -> None:
        async with BeatScene(addresses=(1, 2), interval=0.5) as bus:
            await asyncio.sleep(3)
            told: list[frozenset[Fault]] = []
            bus.beat.subscribe(lambda: told.append(bus.beat.noticed))
            waiting = asyncio.ensure_future(
                bus.charger(1).change_orders(OrderChange(current=8.0))
            )
            await asyncio.sleep(0)
            bus.line.hear(b"@\xff!\x00")
            silent_from = now()
            assert told == [frozenset({Fault.SECOND_MASTER})]
            assert not bus.charger(1).available
            with pytest.raises(NotAvailableError, match="somebody else"):
                await waiting
            with pytest.raises(NotAvailableError, match="hush"):
                await bus.charger(2).change_orders(OrderChange(allowed=False))
            await asyncio.sleep(59)
            # What was on its way may end; nothing new begins.
            late = [s for s in bus.line.sent if s.when > silent_from + 0.3]
            assert late == []
            # The lowering stands all the same.
            assert bus.charger(2).orders.allowed is False
            await asyncio.sleep(5)
            assert bus.charger(1).available
            assert bus.beat.beats[-1] > silent_from + 60

    simulate(scene())


@pytest.mark.parametrize("error", [LineBusyError("busy"), RuntimeError("a mistake")])
def test_a_failed_turn_is_tried_again(
    error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    async def scene() -> None:
        async with BeatScene() as bus:
            await asyncio.sleep(5)
            before = len(bus.beat.beats)
            bus.beat.raises = [error, error]
            await asyncio.sleep(5)
            assert len(bus.beat.beats) >= before + 2
            assert max(bus.gaps()) <= PERIOD + 3 * SLACK
            assert bus.charger(1).available

    simulate(scene())
    unexpectedly = "the master's turn failed unexpectedly" in caplog.text
    assert unexpectedly == isinstance(error, RuntimeError)


def test_a_lost_port_ends_it_and_a_port_that_is_back_begins_it_anew() -> None:
    async def scene() -> None:
        async with BeatScene() as bus:
            await asyncio.sleep(5)
            bus.line.refuse_open = LineLostError("gone")
            bus.line.unplug()
            lost = now()
            await asyncio.sleep(20)
            assert bus.beat.beats[-1] <= lost
            bus.line.refuse_open = None
            await asyncio.sleep(40)
            assert bus.beat.opened == 2
            assert now() - bus.beat.beats[-1] <= PERIOD + SLACK

    simulate(scene())


def test_a_short_answer_to_an_unasked_frame_fits_before_a_deadline() -> None:
    """An acknowledgement must not wait as a whole exchange would."""

    class Short(SimulatedCharger):
        @override
        def on_unsolicited(self, frame: Frame) -> FollowUp | None:
            async def answer(turn: Turn) -> None:
                self.asked.append(await turn.send(b"@\x01!\x00"))  # type: ignore[arg-type]

            return FollowUp(answer, worst_case=0.002)

    async def scene() -> None:
        async with BeatScene(interval=1.0) as bus:
            await bus.bus.remove(bus.charger(1))
            config = bus.make(1).config
            short = Short(config, bus.make(1).orders)
            bus.bus.add(short)
            await asyncio.sleep(5)
            # Right before the deadline: an exchange would no longer fit, this does.
            soon = bus.beat.slot.ready - 0.05
            await asyncio.sleep(soon - now())
            bus.line.hear(b"@\x01?\x00")
            await asyncio.sleep(0.02)
            assert short.asked
            assert max(bus.gaps()) <= PERIOD + SLACK

    simulate(scene())


def test_its_turn_ranks_with_pauses() -> None:
    assert Beat().slot.kind is Kind.PAUSE
