"""One line's scheduler: one task owns the line, one exchange at a time.

Who speaks next is `schedule.choose`'s to say, an exchange `exchange.Wire`'s;
this module has the turns: retries, presence, reopening of a lost port.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
import logging
from math import inf
from typing import Final, Self

from .alarm import Alarm
from .charger import Charger
from .duty import Duty
from .errors import (
    EvseError,
    ImplausibleReplyError,
    LineError,
    LineLostError,
    NotAvailableError,
    PortMissingError,
)
from .exchange import Talk, Wire
from .framing import Frame, Framer, Timing
from .jobs import Job, JobQueue, Later, Step
from .line import Line
from .listeners import Observed
from .losses import Losses
from .model import OrderChange, Persistence
from .schedule import Kind, Slot, choose
from .serving import serve

_LOGGER = logging.getLogger(__name__)

REOPEN_FIRST: Final = 1.0
"""First pause before a lost port is opened again, s; doubles."""
REOPEN_LIMIT: Final = 30.0
"""Longest such pause, s."""
STOP_PATIENCE: Final = 6.0
"""Longest time a stop waits for a conversation begun (waking a car: 3 s), s."""


class Bus(Observed):
    """All chargers of one line, and the line."""

    def __init__(
        self,
        line: Line,
        framer: Framer[Frame],
        timing: Timing,
        name: str = "",
        *,
        duty: Duty | None = None,
    ) -> None:
        """Put chargers on with `add`, then `start`.

        Listeners are told when the port is lost or back.
        """
        super().__init__()
        self.line = line
        self.name = name or line.url
        self.wire = Wire(line, framer, timing)
        self.wire.on_unasked = self._on_unasked
        self.chargers: dict[str, Charger] = {}
        self.connected = False
        """The port is open."""
        self._was_open = False
        self._losses = Losses(opened_by_peer=line.opened_by_peer)
        self.shared: object | None = None
        """What its chargers know together, where they are connectors of one box."""
        self._jobs = JobQueue()
        self._task: asyncio.Task[None] | None = None
        self._stopping = False
        self._alarm = Alarm()
        self._turn_of: Slot | None = None
        self._turn_over = asyncio.Event()
        self._last_probe = -inf
        line.on_lost = self._on_lost
        self.duty = duty
        if duty is not None:
            duty.bus = self

    # -- Life --------------------------------------------------------------------

    async def start(self) -> None:
        """Open the port and start; one that runs already goes on.

        A line that the other end opens is waited for. Raises LineError when the port
        cannot be opened, NotAvailableError when `stop` came first.
        """
        if self._task is not None:
            return
        self._stopping = False
        try:
            await self.line.open()
        except PortMissingError:
            if not self.line.opened_by_peer:
                raise
        if self._stopping:
            await self.line.close()
            message = f"{self.name} was stopped while it started"
            raise NotAvailableError(message)
        if self.line.is_open:
            self._on_open()
        self._task = asyncio.create_task(self._run(), name=f"bus {self.name}")

    async def stop(self) -> None:
        """Finish what is being said, close the port, leave nothing behind."""
        self._stopping = True
        stopped = NotAvailableError(f"{self.name} is stopped")
        self._jobs.fail_all(stopped, begun=False)
        if self._task is not None:
            self.look_again()
            done, _ = await asyncio.wait({self._task}, timeout=STOP_PATIENCE)
            if not done:
                self._task.cancel()
                with suppress(asyncio.CancelledError):
                    await self._task
            self._task = None
        self._jobs.fail_all(stopped)
        self.connected = False
        await self.line.close()

    async def __aenter__(self) -> Self:
        """Start, and stop at the end of the block."""
        await self.start()
        return self

    async def __aexit__(self, *_exc: object) -> None:
        """Stop."""
        await self.stop()

    def add(self, charger: Charger) -> None:
        """Put a charger on the bus; the others do not notice."""
        charger.bus = self
        self.chargers[charger.config.key] = charger
        charger.slot.worst_case = self.worst_case(charger)
        self.look_again()

    async def remove(self, charger: Charger) -> None:
        """Take a charger off; what it has begun (waking a car) is finished first."""
        self._drop_jobs(charger, begun=False)
        with suppress(TimeoutError):
            async with asyncio.timeout(STOP_PATIENCE):
                while self._is_busy_with(charger):
                    self._turn_over.clear()
                    await self._turn_over.wait()
        self.chargers.pop(charger.config.key, None)
        self._drop_jobs(charger, begun=True)
        charger.bus = None

    def _is_busy_with(self, charger: Charger) -> bool:
        if self._turn_of is not None and _belongs(self._turn_of, charger):
            return True
        return self.connected and any(
            job.begun for job in self._jobs if job.charger is charger
        )

    def _drop_jobs(self, charger: Charger, *, begun: bool) -> None:
        gone = NotAvailableError(f"{charger.config.name} was removed")
        for job in self._jobs:
            if (
                job.charger is charger
                and not job.under_way
                and (begun or not job.begun)
            ):
                self._jobs.fail(job, gone)

    # -- Commands ----------------------------------------------------------------

    async def submit(self, job: Job) -> object:
        """Queue a command and return its result.

        Raises what its conversation raises, SupersededError when a newer one
        took its place, LineLostError when the port is gone.
        """
        if self._stopping or self._task is None:
            message = f"{self.name} is stopped"
            raise NotAvailableError(message)
        if not self.connected:
            message = f"{self.name} is not connected"
            raise LineLostError(message)
        if self.duty is not None and self.duty.refusal is not None:
            raise NotAvailableError(self.duty.refusal)
        if (waiting := self._jobs.merge(job)) is not None:
            self.wire.statistics.merged += 1
            job = waiting
        else:
            self._jobs.add(job)
            self._respect_minimum(job.charger)
        self.look_again()
        # Whoever waits may give up; the command itself is still carried out. (A
        # shield would report its failure, which then interests nobody.)
        await asyncio.wait({job.future})
        return job.future.result()

    async def run[T](self, step: Step[T], *, kind: Kind = Kind.PROBE) -> T:
        """Have a conversation that belongs to no charger (a scan)."""
        job = Job(
            charger=None,
            kind=kind,
            due=asyncio.get_running_loop().time(),
            worst_case=self.wire.exchange_time(),
            step=step,
        )
        return await self.submit(job)  # type: ignore[return-value] # the step's own

    def supersede(self, charger: Charger, which: Callable[[OrderChange], bool]) -> None:
        """Drop waiting order changes that a newer command makes wrong."""
        self._jobs.supersede(charger, which)

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

    def look_again(self) -> None:
        """Choose anew who speaks next: something has changed."""
        self._alarm.ring()

    def worst_case(self, charger: Charger) -> float:
        """Return the longest time one turn of a charger can take, s."""
        return charger.exchanges_per_turn * self.wire.exchange_time(
            charger.longest_request
        )

    # -- The one task that owns the line -----------------------------------------

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            slot = None
            try:
                if not self.line.is_open and not await self._reopen():
                    return
                slots = self._slots()
                if self._stopping and not slots:
                    return
                choice = choose(slots, loop.time(), self._last_probe)
                slot = choice.slot
                if slot is None:
                    await self._alarm.sleep_until(choice.wake_at)
                    continue
                self.wire.statistics.for_deadline += choice.for_deadline
                await self._serve(slot)
            except Exception:
                # Without this task all chargers of the bus would fall silent.
                _LOGGER.exception("%s: a turn failed unforeseen", self.name)
                if slot is not None:
                    slot.ready = loop.time() + self.wire.timing.backoff

    async def _serve(self, slot: Slot) -> None:
        now = asyncio.get_running_loop().time()
        self._turn_of = slot
        try:
            await self._turn(slot, now)
        finally:
            self._turn_of = None
            self._turn_over.set()
            self.wire.statistics.busy(now, asyncio.get_running_loop().time())

    def _slots(self) -> list[Slot]:
        if self._stopping:
            return [job for job in self._jobs if job.begun]
        if self.duty is not None and self.duty.silent:
            return [self.duty.slot]
        slots: list[Slot] = [charger.slot for charger in self.chargers.values()]
        slots.extend(self._jobs.eligible())
        if self.duty is not None:
            slots.append(self.duty.slot)
        return slots

    async def _turn(self, slot: Slot, now: float) -> None:
        if self.duty is not None and slot is self.duty.slot:
            await self._duty_turn(self.duty, now)
            return
        if slot.kind is Kind.PROBE:
            self._last_probe = now
        if isinstance(slot, Job):
            charger = slot.charger
        else:
            charger = next(one for one in self.chargers.values() if one.slot is slot)
        if charger is not None and now > charger.slot.start_by:
            charger.statistics.missed_deadlines += 1
            self.wire.statistics.missed_deadlines += 1
        if isinstance(slot, Job):
            await serve(slot, self.wire, self._jobs, connected=lambda: self.connected)
        elif charger is not None:
            await self._poll_turn(charger)
        self._respect_minimum(charger)

    async def _duty_turn(self, duty: Duty, now: float) -> None:
        late = now > duty.slot.start_by
        duty.statistics.missed_deadlines += late
        self.wire.statistics.missed_deadlines += late
        duty.slot.served = now
        try:
            await duty.turn(Talk(self.wire, duty.statistics))
        except EvseError as error:
            _LOGGER.debug("%s: %s", self.name, error)
            duty.failed(asyncio.get_running_loop().time())
        except Exception:
            # A mistake of ours must not end the bus for everybody else.
            _LOGGER.exception("%s: its own turn failed unforeseen", self.name)
            duty.failed(asyncio.get_running_loop().time())

    async def _poll_turn(self, charger: Charger) -> None:
        loop = asyncio.get_running_loop()
        charger.expire_orders(loop.time())
        try:
            later = await charger.poll(Talk(self.wire, charger.statistics))
        except LineError as error:
            self._skip_poll(charger, error)
            return
        except ImplausibleReplyError as error:
            # It did answer; what it said is held back and changes nothing.
            _LOGGER.debug("%s: %s", charger.config.name, error)
            charger.statistics.implausible += 1
            charger.plan(loop.time())
            return
        except EvseError as error:
            _LOGGER.debug("%s: %s", charger.config.name, error)
            charger.missed(loop.time())
            return
        except Exception:
            # A mistake of ours must not end the bus for everybody else.
            _LOGGER.exception("%s: a poll failed unforeseen", charger.config.name)
            charger.missed(loop.time())
            return
        now = loop.time()
        charger.heard(now)
        charger.plan(now)
        if later is not None:
            self._follow_up(charger, later, Persistence.STANDING)
        if charger.told != charger.last_told:
            charger.updated()

    def _skip_poll(self, charger: Charger, error: LineError) -> None:
        """Leave a charger alone for a while when the line itself would not do."""
        if not isinstance(error, LineLostError):
            _LOGGER.debug("%s: %s", self.name, error)
            self.wire.statistics.line_busy += 1
        now = asyncio.get_running_loop().time()
        patience = self.wire.timing.silence_patience
        charger.slot.ready = now + max(patience, charger.minimum_pause(now))

    def _follow_up(
        self, charger: Charger, later: Later[None], persistence: Persistence
    ) -> None:
        """Queue a turn that nobody waits for."""
        now = asyncio.get_running_loop().time()
        self._jobs.add(
            Job(
                charger=charger,
                kind=Kind.PAUSE,
                ready=now + later.pause,
                due=now,
                worst_case=later.worst_case or self.worst_case(charger),
                step=later.step,
                persistence=persistence,
            )
        )
        self.look_again()

    def _respect_minimum(self, charger: Charger | None) -> None:
        """Let nothing be said to a charger before its minimum interval is over."""
        if charger is None:
            return
        now = asyncio.get_running_loop().time()
        earliest = now + charger.minimum_pause(now)
        charger.slot.ready = max(charger.slot.ready, earliest)
        for job in self._jobs:
            if job.charger is charger and not (
                charger.pauses_hurry and job.kind is Kind.PAUSE
            ):
                job.ready = max(job.ready, earliest)

    def _on_unasked(self, frame: Frame) -> bool:
        if self.duty is not None and self.duty.heard(frame):
            return True
        for charger in tuple(self.chargers.values()):
            if (later := charger.on_unsolicited(frame)) is not None:
                self._follow_up(charger, later, Persistence.ONCE)
                return True
        return False

    # -- The port ----------------------------------------------------------------

    def _on_open(self) -> None:
        self.connected = self._was_open = True
        self.wire.reset()
        now = asyncio.get_running_loop().time()
        for charger in self.chargers.values():
            charger.on_line_open()
            # It may have heard us a moment ago, before the line was lost.
            charger.slot.ready = now + charger.minimum_pause(now)
        if self.duty is not None:
            self.duty.on_line_open(now)
        self.updated()

    def _on_lost(self, error: LineLostError) -> None:
        self._losses.lost(self.name, error, self.now)
        self.connected = False
        self.wire.fail(error)
        self._jobs.fail_all(error)
        if self.duty is not None:
            self.duty.slot.start_by = inf
        self._abandon_chargers()
        self.updated()
        self.look_again()

    def hush(self, why: str) -> None:
        """Let nobody speak: what waits fails, and no reading is believed any more."""
        self._jobs.fail_all(NotAvailableError(why))
        self._abandon_chargers()
        self.look_again()

    def _abandon_chargers(self) -> None:
        for charger in self.chargers.values():
            charger.slot.start_by = inf
            charger.set_unavailable()

    async def _reopen(self) -> bool:
        """Open the port again, however long it takes; False when told to stop."""
        pause = REOPEN_FIRST
        while True:
            if not self._stopping:
                await self._alarm.sleep_until(asyncio.get_running_loop().time() + pause)
            if self._stopping:
                return False
            try:
                await self.line.open()
            except LineError as error:
                _LOGGER.debug("%s: still not there: %s", self.name, error)
                pause = min(pause * 2, REOPEN_LIMIT)
                continue
            if self._was_open:
                self._losses.back(self.name)
                self.wire.statistics.reopened += 1
            self._on_open()
            return True


def _belongs(slot: Slot, charger: Charger) -> bool:
    return slot is charger.slot or (isinstance(slot, Job) and slot.charger is charger)
