"""One line's scheduler: one task owns the line, one exchange at a time.

`schedule.choose` picks the next turn, `exchange.Wire` has the exchange, `port.Port` the
port and `jobs.JobQueue` the commands; this module has the turns: presence, deadlines.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
import logging
from math import inf
from typing import Final, Self

from .charger import Charger
from .conversation import Conversation, FollowUp, RunningConversation
from .errors import (
    EvseError,
    ImplausibleReplyError,
    LineError,
    LineLostError,
    NotAvailableError,
    NotConfirmedError,
    WrongChargerError,
)
from .exchange import Turn, Wire
from .framing import Frame, Framer, Timing
from .jobs import Job, JobOwner, JobQueue
from .line import Line
from .listeners import Observable
from .load import ENDS_AT, Overload, Recurring, find_overload
from .master import BusMaster, ChargerGroup
from .model import OrderChange, Persistence
from .port import Port
from .schedule import Kind, Slot, Turns, choose
from .throttle import RateLimiter
from .timer import WakeTimer

_LOGGER = logging.getLogger(__name__)

STOP_PATIENCE: Final = 6.0
"""Longest time a stop waits for a conversation begun (waking a car: 3 s), s."""
FAILURE_PAUSE: Final = 1.0
"""Pause after a failure that belongs to no turn, s: without it the loop would spin."""
FAILURES_LOGGED: Final = 20
FAILURES_WINDOW: Final = 3600.0
"""Unexpected failures logged with a traceback within this time, s."""


class Bus(Observable):
    """All chargers of one line, and the line."""

    def __init__(
        self,
        line: Line,
        framer: Framer[Frame],
        timing: Timing,
        name: str = "",
        *,
        group: ChargerGroup | None = None,
    ) -> None:
        """Put chargers on with `add`, then `start`.

        ``group``: what all its chargers belong to, the master of the bus included.
        Listeners are called when the port is lost or back.
        """
        super().__init__()
        self.line = line
        self.wire = Wire(line, framer, timing)
        self.wire.on_unsolicited = self._on_unsolicited
        self.wire.on_times_changed = self._update_times
        self.chargers: dict[str, Charger] = {}
        self.group = group
        self.master = group if isinstance(group, BusMaster) else None
        self._jobs = JobQueue()
        self._task: asyncio.Task[None] | None = None
        self.stop_patience = STOP_PATIENCE
        """Longest time a stop waits for a conversation begun, s; one that must not be
        left half done raises it meanwhile."""
        self._stopping = False
        self._timer = WakeTimer()
        self.port = Port(self.wire, name or line.url, self._timer)
        self.port.on_open = self._on_open
        self.port.on_closed = self._jobs.fail_all
        self.port.on_lost = self._on_lost
        self.wire.gateway.on_changed = self.updated
        self._turn_of: Slot | None = None
        self._turn_over = asyncio.Event()
        self._last = Turns()
        self.overload: Overload | None = None
        """The deadline that cannot be kept at the speed of the line."""
        self.too_slow = False
        """Replies come later than they may be waited for."""
        self._failures = RateLimiter(FAILURES_LOGGED, FAILURES_WINDOW)
        if group is not None:
            group.bus = self
            group.resume(line.memory)

    @property
    def name(self) -> str:
        """Return its name, for messages."""
        return self.port.name

    @name.setter
    def name(self, name: str) -> None:
        self.port.name = name

    @property
    def connected(self) -> bool:
        """Return whether the port is open."""
        return self.port.connected

    # -- Life --------------------------------------------------------------------

    async def start(self) -> None:
        """Open the port and start; no effect on a bus that runs.

        A line that the other end opens may be opened later. Raises LineError when the
        port cannot be opened, NotAvailableError when `stop` came first.
        """
        if self._task is not None:
            return
        self._stopping = False
        await self.port.open()
        if self._stopping:
            await self.port.close()
            message = f"{self.name} was stopped while it started"
            raise NotAvailableError(message)
        self._task = asyncio.create_task(self._run(), name=f"bus {self.name}")

    async def stop(self) -> None:
        """End conversations that have begun, close the port, leave nothing behind."""
        self._stopping = True
        self.port.give_up()
        stopped = NotAvailableError(f"{self.name} is stopped")
        self._jobs.fail_all(stopped, begun=False)
        if self._task is not None:
            self.reschedule()
            done, _ = await asyncio.wait({self._task}, timeout=self.stop_patience)
            if not done:
                self._task.cancel()
                with suppress(asyncio.CancelledError):
                    await self._task
            self._task = None
        self._jobs.fail_all(stopped)
        await self.port.close()

    async def __aenter__(self) -> Self:
        """Start, and stop at the end of the block."""
        await self.start()
        return self

    async def __aexit__(self, *_exc: object) -> None:
        """Stop."""
        await self.stop()

    def add(self, charger: Charger) -> None:
        """Put a charger on the bus; the others are not disturbed."""
        charger.bus = self
        self.chargers[charger.config.key] = charger
        if self.group is not None:
            self.group.added(charger)
        self._set_times(charger)
        charger.resume(self.line.memory)
        if self.connected:
            self._respect_minimum(charger)
        self.reschedule()

    async def remove(self, charger: Charger) -> None:
        """Take a charger off; a conversation begun (waking a car) is ended first."""
        self._drop_jobs(charger, begun=False)
        with suppress(TimeoutError):
            async with asyncio.timeout(STOP_PATIENCE):
                while self._is_busy_with(charger):
                    self._turn_over.clear()
                    await self._turn_over.wait()
        self.chargers.pop(charger.config.key, None)
        self._drop_jobs(charger, begun=True)
        if self.group is not None:
            self.group.removed(charger)
        charger.bus = None

    def _is_busy_with(self, charger: Charger) -> bool:
        if self._turn_of is not None and _belongs(self._turn_of, charger):
            return True
        return self.connected and any(
            job.begun for job in self._jobs if job.owner is charger
        )

    def _drop_jobs(self, charger: Charger, *, begun: bool) -> None:
        gone = NotAvailableError(f"{charger.config.name} was removed")
        for job in self._jobs:
            if job.owner is charger and not job.under_way and (begun or not job.begun):
                self._jobs.fail(job, gone)

    # -- Commands ----------------------------------------------------------------

    async def submit(self, job: Job) -> object:
        """Queue a command and return its result.

        Raises what its conversation raises, SupersededError when a newer one
        took its place, LineLostError when the port is gone.
        """
        if (refusal := self._refusal) is not None:
            raise refusal
        if (waiting := self._jobs.merge(job)) is not None:
            self.wire.statistics.merged += 1
            job = waiting
        else:
            self._enqueue(job)
        self.reschedule()
        # The caller may give up; the command itself is still carried out. (A shield
        # would log a failure that no caller is left to handle.)
        await asyncio.wait({job.future})
        return job.future.result()

    def queue(self, job: Job) -> bool:
        """Queue a command that has no caller; return whether it can be sent now."""
        if self._refusal is not None:
            return False
        self._enqueue(job)
        self.reschedule()
        return True

    def _enqueue(self, job: Job) -> None:
        self._jobs.add(job)
        self._respect_minimum(self._charger_of(job))

    @property
    def _refusal(self) -> EvseError | None:
        """Return why no command can be sent now."""
        if self._stopping or self._task is None:
            return NotAvailableError(f"{self.name} is stopped")
        if not self.connected:
            return LineLostError(f"{self.name} is not connected")
        return None if self.master is None else self.master.refusal

    async def run[T](
        self, conversation: Conversation[T], *, kind: Kind = Kind.PROBE
    ) -> T:
        """Hold a conversation that belongs to no charger (a scan)."""
        job = Job(
            owner=None,
            kind=kind,
            due=self.now,
            worst_case=self.wire.exchange_time(),
            conversation=conversation,
        )
        return await self.submit(job)  # type: ignore[return-value] # the job's own

    def supersede(self, owner: JobOwner, which: Callable[[OrderChange], bool]) -> None:
        """Drop waiting order changes that a newer command makes wrong."""
        self._jobs.supersede(owner, which)

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

    def reschedule(self) -> None:
        """Choose the next turn anew: something has changed."""
        self._timer.wake()

    def find_overload(self) -> Overload | None:
        """Return the deadline that cannot be kept at the speed of the line.

        Less than before is needed to call an overload over.
        """
        share = 1.0 if self.overload is None else ENDS_AT
        turns = [
            Recurring(charger.slot.usual or 0.0, charger.keep_alive)
            for charger in self.chargers.values()
            if charger.keep_alive is not None
        ]
        if self.master is not None:
            turns.append(Recurring(self.master.slot.worst_case, self.master.period))
        lost = [
            charger.exchanges_per_turn * self.wire.lost_time(charger.longest_request)
            for charger in self.chargers.values()
        ]
        return find_overload(turns, max(lost, default=0.0), share=share)

    def _check_load(self) -> None:
        """Call the listeners when deadlines can be kept no more, or again."""
        overload, too_slow = self.find_overload(), self.wire.round_trip.too_slow
        changed = (overload is None, too_slow) != (self.overload is None, self.too_slow)
        self.overload, self.too_slow = overload, too_slow
        if changed:
            self.updated()

    def _set_times(self, charger: Charger) -> None:
        charger.slot.worst_case = self.worst_case(charger)
        usual = self.wire.usual_time(charger.longest_request)
        if usual is not None:
            charger.slot.usual = charger.exchanges_per_turn * usual

    def _update_times(self) -> None:
        for charger in self.chargers.values():
            self._set_times(charger)
        for job in self._jobs:
            owner = self._charger_of(job)
            if owner is not None and job.change is not None:
                job.worst_case = self.worst_case(owner)
        self._check_load()

    def worst_case(self, charger: Charger) -> float:
        """Return the longest time one turn of a charger can take, s."""
        return charger.exchanges_per_turn * self.wire.exchange_time(
            charger.longest_request
        )

    # -- The one task that owns the line -----------------------------------------

    async def _run(self) -> None:
        while True:
            slot = None
            try:
                if self.now >= self.port.renew_at:
                    await self.port.renew()
                if not self.line.is_open and not await self.port.reopen():
                    return
                expires_at = self._expire_ceilings()
                slots = self._slots()
                if self._stopping and not slots:
                    return
                choice = choose(slots, self.now, self._last)
                slot = choice.slot
                if slot is None:
                    wake_at = min(choice.wake_at, self.port.renew_at, expires_at)
                    await self._timer.sleep_until(wake_at)
                    continue
                self.wire.statistics.for_deadline += choice.for_deadline
                if choice.is_extra:
                    self._last.extra = self.now
                await self._serve(slot)
            except Exception:
                # Without this task all chargers of the bus would fall silent.
                level = (
                    logging.ERROR if self._failures.take(self.now) else logging.DEBUG
                )
                _LOGGER.log(
                    level,
                    "%s: a turn failed unexpectedly",
                    self.name,
                    exc_info=True,
                )
                if slot is None:
                    await asyncio.sleep(FAILURE_PAUSE)
                else:
                    slot.ready = self.now + self.wire.timing.backoff

    async def _serve(self, slot: Slot) -> None:
        started = self.now
        self._turn_of = slot
        try:
            await self._turn(slot, started)
        finally:
            self._turn_of = None
            self._turn_over.set()
            self.wire.statistics.busy(started, self.now)

    def _expire_ceilings(self) -> float:
        """Lower the ceilings that were not renewed; return when the next one is due."""
        now = self.now
        governed = [charger.governance for charger in self.chargers.values()]
        return min((one.expire_ceiling(now) for one in governed), default=inf)

    def _slots(self) -> list[Slot]:
        if self._stopping:
            return [job for job in self._jobs if job.begun]
        if self.master is not None and self.master.silent:
            return [self.master.slot]
        slots: list[Slot] = [charger.slot for charger in self.chargers.values()]
        slots.extend(self._jobs.eligible())
        if self.master is not None:
            slots.append(self.master.slot)
        return slots

    async def _turn(self, slot: Slot, now: float) -> None:
        if self.master is not None and slot is self.master.slot:
            await self._master_turn(self.master, now)
            return
        if slot.kind is Kind.PROBE:
            self._last.probe = now
        slot.turn_at = now
        if slot.meets is not None:
            slot.meets.turn_at = now
        charger = self._charger_of(slot)
        if charger is not None and now > charger.slot.start_by:
            charger.statistics.missed_deadlines += 1
            self.wire.statistics.missed_deadlines += 1
        if isinstance(slot, Job):
            await self._jobs.serve(slot, self.wire, connected=lambda: self.connected)
            if charger is not None and slot.is_poll and slot.future.done():
                self._poll_ended(charger, slot.outcome, is_planned=True)
        elif charger is not None:
            await self._poll_turn(charger)
        if charger is not None:
            await charger.governance.keep_pause()
        self._respect_minimum(charger)

    def _charger_of(self, slot: Slot) -> Charger | None:
        if isinstance(slot, Job):
            return slot.owner if isinstance(slot.owner, Charger) else None
        return next(one for one in self.chargers.values() if one.slot is slot)

    async def _master_turn(self, master: BusMaster, now: float) -> None:
        late = now > master.slot.start_by
        master.statistics.missed_deadlines += late
        self.wire.statistics.missed_deadlines += late
        master.slot.served = master.slot.turn_at = now
        try:
            await master.turn(Turn(self.wire, master.statistics))
        except EvseError as error:
            _LOGGER.debug("%s: %s", self.name, error)
            master.failed(self.now)
        except Exception:
            # A mistake of ours must not end the bus for all other chargers.
            _LOGGER.exception("%s: the master's turn failed unexpectedly", self.name)
            master.failed(self.now)

    async def _poll_turn(self, charger: Charger) -> None:
        charger.standing_orders.expire(self.now)
        poll = RunningConversation(
            charger.poll(Turn(self.wire, charger.statistics)), bursts=charger.bursts
        )
        try:
            pause = await poll.go_on()
        except EvseError as error:
            self._poll_ended(charger, error)
        except Exception as error:
            # A mistake of ours must not end the bus for all other chargers.
            _LOGGER.exception("%s: a poll failed unexpectedly", charger.config.name)
            charger.on_missed(self.now, repr(error))
        else:
            if pause is None:
                self._poll_ended(charger, poll.result)
                return
            # It counts as answered or missed when it ends.
            charger.plan(self.now)
            goes_on = FollowUp(charger.poll, pause.pause, pause.worst_case)
            self._follow_up(charger, goes_on, Persistence.STANDING, poll)
            if charger.fingerprint != charger.last_fingerprint:
                charger.updated()

    def _poll_ended(
        self, charger: Charger, outcome: object, *, is_planned: bool = False
    ) -> None:
        """Take note of the end of a poll: its result, or the error in any turn.

        ``is_planned``: the next poll is planned since its first turn.
        """
        error = outcome
        if isinstance(outcome, NotConfirmedError):
            # In a later turn it stands for another one.
            error = outcome.__cause__ or outcome
        if isinstance(error, LineError):
            self._skip_poll(charger, error)
        elif isinstance(error, ImplausibleReplyError):
            # It did answer; an implausible reply changes nothing.
            _LOGGER.debug("%s: %s", charger.config.name, error)
            charger.statistics.implausible += 1
            charger.plan(self.now)
        elif isinstance(error, Exception):
            _LOGGER.debug("%s: %s", charger.config.name, error)
            if isinstance(error, WrongChargerError):
                charger.on_wrong_charger(error.found)
            charger.on_missed(self.now, str(error))
        else:
            charger.on_reply(self.now)
            if not is_planned:
                charger.plan(self.now)
            if isinstance(outcome, FollowUp):
                self._follow_up(charger, outcome, Persistence.STANDING)
            if charger.fingerprint != charger.last_fingerprint:
                # Its time-out may have been raised.
                self._check_load()
                charger.updated()

    def _skip_poll(self, charger: Charger, error: LineError) -> None:
        """Postpone a poll that the line itself has prevented."""
        if not isinstance(error, LineLostError):
            _LOGGER.debug("%s: %s", self.name, error)
            self.wire.statistics.line_busy += 1
        now = self.now
        patience = self.wire.timing.silence_patience
        charger.slot.ready = now + max(patience, charger.minimum_pause(now))
        charger.on_prevented(now, str(error))

    def _follow_up(
        self,
        charger: Charger,
        follow_up: FollowUp,
        persistence: Persistence,
        running: RunningConversation[FollowUp | None] | None = None,
    ) -> None:
        """Queue a conversation without a caller; ``running``: the poll that goes on."""
        now = self.now
        self._jobs.add(
            Job(
                owner=charger,
                kind=Kind.PAUSE,
                ready=now + follow_up.pause,
                due=now,
                worst_case=follow_up.worst_case or self.worst_case(charger),
                conversation=follow_up.conversation,
                running=running,
                is_poll=running is not None,
                persistence=persistence,
            )
        )
        self.reschedule()

    def _respect_minimum(self, charger: Charger | None) -> None:
        """Postpone all turns of a charger to the end of its minimum interval."""
        if charger is None:
            return
        now = self.now
        earliest = now + charger.minimum_pause(now)
        charger.slot.ready = max(charger.slot.ready, earliest)
        for job in self._jobs:
            if job.owner is charger and not (
                charger.pauses_hurry and job.kind is Kind.PAUSE
            ):
                job.ready = max(job.ready, earliest)

    def _on_unsolicited(self, frame: Frame) -> bool:
        if self.master is not None and self.master.on_unsolicited(frame):
            return True
        for charger in tuple(self.chargers.values()):
            if (follow_up := charger.on_unsolicited(frame)) is not None:
                self._follow_up(charger, follow_up, Persistence.ONCE)
                return True
        return False

    # -- The port ----------------------------------------------------------------

    def _on_open(self, is_new: bool) -> None:  # noqa: FBT001 - a callback
        now = self.now
        for charger in self.chargers.values():
            if is_new:
                charger.on_line_open()
            else:
                charger.on_line_reopened()
            # Its last request may have arrived right before the line was lost.
            charger.slot.ready = now + charger.minimum_pause(now)
        if self.master is not None:
            self.master.on_line_open(now)
        if is_new:
            self.updated()

    def _on_lost(self, error: LineLostError) -> None:
        # Commands may have come while an attempt to open it again was under way.
        self._jobs.fail_all(error)
        if self.master is not None:
            self.master.slot.start_by = inf
        self._abandon_chargers(str(error))
        self.updated()

    def silence(self, why: str) -> None:
        """Fail all waiting commands and drop all readings: the bus falls silent."""
        self._jobs.fail_all(NotAvailableError(why))
        self._abandon_chargers(why)
        self.reschedule()

    def _abandon_chargers(self, why: str) -> None:
        for charger in self.chargers.values():
            charger.slot.start_by = inf
            charger.set_unavailable(why)


def _belongs(slot: Slot, charger: Charger) -> bool:
    return slot is charger.slot or (isinstance(slot, Job) and slot.owner is charger)
