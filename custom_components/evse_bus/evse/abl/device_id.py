"""Another device-ID for one box, written to register 0x002C (PROTOCOLS.md, 2).

Boxes with one device-ID obey the same writes, so nothing is written before it is proved
that one box alone answers, by its serial number, and right before each write again.

The sequence is E2, device-ID, reset. It is not known whether a device-ID counts from
its write or from the reset on: after the write the box is looked for at both. Once it
was sent only a reset follows: no device-ID is left that a power cut would bring in.
"""

import asyncio
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import Final
from weakref import WeakSet

from ..address_change import (
    AddressChange,
    AddressChanged,
    AddressChangeError,
    Problem,
)
from ..bus import STOP_PATIENCE, Bus
from ..conversation import rest
from ..errors import (
    EvseError,
    ExchangeRefusedError,
    GarbledReplyError,
    LineError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from ..modbus import ModbusFrame
from ..protocol import Progress
from ..schedule import Kind
from .charger import AblCharger
from .config import Pauses
from .exchanges import collect, collect_confirmations
from .reader import read
from .registers import (
    ADDRESSES,
    CONFIGURATION_REGISTER,
    INFO,
    READING,
    SERIAL,
    STATE_REGISTER,
    Reading,
    StateCode,
    write_answer,
    write_configuration,
    write_state,
)
from .states import A1, B1, B2, C2, C3, C4, E0, E2, state_of
from .steps import hold_polls, recover
from .writer import Cleanup

CLEAN_REPLIES: Final = 10
"""Clean replies in a row, with one serial number, that prove a box to be alone."""
MOST_REQUESTS: Final = 30
"""Requests within which they have to come."""
MOST_UNREADABLE: Final = 6
"""Unreadable replies among them that are taken for a second box."""
CLEAN_PAUSE: Final = 0.1
"""Pause between two of them, s."""
REACH_ATTEMPTS: Final = 6
"""Requests until a box counts as absent; one asleep loses the first ones."""
SILENT_REQUESTS: Final = 4
"""Unanswered requests that prove a device-ID free: two pairs."""
PAIR: Final = 2
"""Unanswered requests after which a box does not answer now."""
DOUBTFUL: Final = 2
"""Replies of another box in a row that are believed: checksums are weak."""
MOST_DOUBTS: Final = 5
"""Requests without a readable reply, some of them garbled, until that is believed."""
WRITES: Final = 3
"""Attempts at each write; each one after a look at the box."""
STATE_LOOKS: Final = 3
"""Readings of the state that show that no car is plugged in."""
STATE_READS: Final = 4
"""Requests until a state counts as not readable."""
BOOT_PATIENCE: Final = 20.0
"""Longest time from the reset until the box is found, s."""
UNFINISHED_PATIENCE: Final = 60.0
"""Longest time a stop of the bus waits for a change that has begun, s."""
LONGEST_TURN: Final = 3
"""Exchanges of one turn: state, serial number, write."""

_CHANGING: Final = WeakSet[Bus]()
"""The buses on which a device-ID is being changed."""
_PLUGGED: Final = frozenset({B1, B2, C2, C3, C4})


class _Stage(IntEnum):
    """How far it has come."""

    CHECKED = 0
    """Nothing was written."""
    SET_UP = 1
    """E2 was sent."""
    WRITTEN = 2
    """The device-ID was sent."""


class _Answer(Enum):
    """What answers at a device-ID."""

    OURS = "ours"
    OTHER = "other"
    UNREADABLE = "unreadable"
    """Perhaps several boxes at once."""
    SILENT = "silent"


class _Outcome(Enum):
    """What was replied to a write."""

    CONFIRMED = "confirmed"
    REFUSED = "refused"
    SEVERAL = "several replies"
    """It has reached another box, too."""
    UNREADABLE = "an unreadable reply"
    """Perhaps of several boxes at once."""
    UNANSWERED = "no reply"


@dataclass(frozen=True, slots=True)
class _Seen:
    """What a look at both device-IDs has shown."""

    at_old: _Answer = _Answer.SILENT
    """Not looked for where the box is at its new one."""
    at_new: _Answer = _Answer.SILENT
    state: int | None = None
    """State of the box, where it was found; ``None``: not readable."""

    @property
    def is_silent(self) -> bool:
        """Return whether nothing answers."""
        return self.at_old is self.at_new is _Answer.SILENT

    def place(self, change: AddressChange) -> int | None:
        """Return the device-ID at which the box was found."""
        if self.at_new is _Answer.OURS:
            return change.new
        return change.old if self.at_old is _Answer.OURS else None

    @property
    def problem(self) -> Problem:
        """Return what is wrong with a box that has not got its new device-ID."""
        found = _Answer.OURS in (self.at_old, self.at_new)
        if found and self.state == E2:
            return Problem.IN_SET_UP
        if self.at_new in (_Answer.OTHER, _Answer.UNREADABLE):
            return Problem.SEVERAL_AT_NEW
        if found:
            return Problem.NOT_TAKEN
        if self.at_old is not _Answer.SILENT:
            return Problem.SECOND_CHARGER
        return Problem.LOST


class DeviceIdChange:
    """One change of a device-ID, as a conversation."""

    def __init__(
        self, change: AddressChange, bus: Bus, readers: Iterable[AblCharger]
    ) -> None:
        """``readers``: the chargers set up at either device-ID; their polls wait.

        Raises RefusedOrderError for an invalid device-ID.
        """
        if not {change.old, change.new} <= set(ADDRESSES) or change.old == change.new:
            message = f"device-ID {change.old} cannot become {change.new}"
            raise RefusedOrderError(message)
        self.change = change
        self.stage = _Stage.CHECKED
        self.done: AddressChanged | None = None
        """Its result, once the box has its new device-ID."""
        self.given_up = False
        """Its caller has gone: nothing is written unless it has begun."""
        self.progress: Progress = lambda _share: None
        self._share = 0.0
        self._bus = bus
        self._readers = tuple(readers)
        self._own: AblCharger | None = None
        """The charger set up for this box."""
        self._serial = ""
        self._was_disabled = False
        self._worst_case = LONGEST_TURN * bus.wire.exchange_time()
        self._pauses: Pauses = AblCharger.pauses

    async def run(self, turn: Turn) -> AddressChanged:
        """Carry it out, one change of a bus at a time; a conversation.

        Two at once might give one device-ID to two boxes. Raises AddressChangeError,
        NotAvailableError, and what an exchange raises.
        """
        if self._bus in _CHANGING:
            message = f"another device-ID is being changed on {self._bus.name}"
            raise NotAvailableError(message)
        _CHANGING.add(self._bus)
        try:
            return await self._run(turn)
        finally:
            # Also when the bus ends it, whether or not its caller still waits.
            _CHANGING.discard(self._bus)
            self._bus.stop_patience = STOP_PATIENCE

    async def _run(self, turn: Turn) -> AddressChanged:
        if await self._is_at_new_already(turn):
            self.stage = _Stage.WRITTEN
        else:
            await self._prove_alone(turn)
            await self._prove_free(turn)
            await self._leave_old_set_up(turn)
            await self._enter_set_up(turn)
            await self._write_id(turn)
        self._advance(0.8)
        await self._settle(turn)
        return await self._finish(turn)

    def _advance(self, share: float) -> None:
        """Report the progress, which never goes back."""
        self._share = max(self._share, share)
        self.progress(self._share)

    def ended_by(self, error: EvseError) -> EvseError:
        """Return the error for the caller when the line or the bus has ended it."""
        if self.stage is _Stage.CHECKED:
            return error
        return self._failed(Problem.INTERRUPTED, str(error))

    # -- Nothing is written ----------------------------------------------------------

    async def _is_at_new_already(self, turn: Turn) -> bool:
        """Find out the serial number; return whether the box is at its new ID already.

        That is so when an earlier change was interrupted after its write.
        """
        try:
            await self._find(turn)
        except AddressChangeError as error:
            if self.change.serial is None or error.problem is Problem.IN_USE:
                raise
            self._identify(self.change.serial)
            found = await self._who(turn, self.change.new, patience=REACH_ATTEMPTS)
            if found is not _Answer.OURS:
                raise
            return True
        return False

    async def _find(self, turn: Turn) -> None:
        """Read the serial number at the old device-ID."""
        unreadable = False
        for attempt in range(REACH_ATTEMPTS):
            if attempt:
                await self._rest(turn, self._pauses.retry)
            number: str | None = None
            try:
                number = (await read(turn, self.change.old, SERIAL)).number
            except GarbledReplyError:
                unreadable = True
                continue
            except ReplyTimeoutError:
                continue
            except ExchangeRefusedError:
                pass
            self._identify(number)
            return
        if unreadable:
            raise self._failed(Problem.SEVERAL, "no readable reply")
        # Perhaps there is a box without that register.
        is_there = await self._answers_info(turn)
        problem = Problem.NO_SERIAL if is_there else Problem.NO_REPLY
        raise self._failed(problem, "its serial number cannot be read")

    async def _answers_info(self, turn: Turn) -> bool:
        """Return whether a box is there that only has no serial number."""
        for _ in range(PAIR):
            await self._rest(turn, self._pauses.retry)
            with suppress(ReplyTimeoutError):
                await read(turn, self.change.old, INFO)
                return True
        return False

    def _identify(self, number: str | None) -> None:
        if number is None or len(set(number)) == 1:
            # Erased, or never set: another box may have the same.
            raise self._failed(Problem.NO_SERIAL, "it has no serial number of its own")
        if self.change.serial not in (None, number):
            raise self._failed(Problem.OTHER_CHARGER, f"serial number {number}")
        self._serial = number
        for reader in self._readers:
            expected = reader.config.serial or reader.serial
            if reader.config.address == self.change.new and expected != number:
                raise self._failed(Problem.IN_USE, "it is set up for another box")
            if expected in (None, number):
                self._own = reader
            else:
                # Its own box may have been replaced by this one without a miss.
                reader.invalidate()

    async def _prove_alone(self, turn: Turn) -> None:
        clean = unreadable = other = 0
        for _ in range(MOST_REQUESTS):
            self._require_caller()
            answer = await self._ask(turn, self.change.old)
            clean = clean + 1 if answer is _Answer.OURS else 0
            unreadable += answer is _Answer.UNREADABLE
            other = other + 1 if answer is _Answer.OTHER else 0
            self._advance(0.4 * clean / CLEAN_REPLIES)
            if clean == CLEAN_REPLIES:
                return
            if unreadable == MOST_UNREADABLE or other == DOUBTFUL:
                break
            await self._rest(turn, CLEAN_PAUSE)
        problem = Problem.SEVERAL if unreadable or other else Problem.NO_REPLY
        message = f"less than {CLEAN_REPLIES} clean replies in a row"
        raise self._failed(problem, message)

    async def _prove_free(self, turn: Turn) -> None:
        """Check that nothing answers at the new device-ID, a box asleep included."""
        silent, unreadable = 0, False
        while silent < SILENT_REQUESTS:
            await self._rest(turn, self._pauses.retry)
            try:
                await collect(turn, self.change.new, INFO)
            except GarbledReplyError:
                if unreadable:
                    break
                # A disturbance, or several boxes: once more from the beginning.
                silent, unreadable = 0, True
            except ReplyTimeoutError:
                silent += 1
                self._advance(0.4 + 0.2 * silent / SILENT_REQUESTS)
            except ExchangeRefusedError:
                break
            else:
                break
        else:
            return
        raise self._failed(Problem.IN_USE, "something answers there")

    async def _leave_old_set_up(self, turn: Turn) -> None:
        """Lead a box out of E2 in which an earlier change has left it.

        In E2 it does not show whether a car is plugged in.
        """
        if await self._state_code(turn, self.change.old) == E2:
            self._require_caller()
            await self._leave_set_up(turn)

    async def _check_state(self, turn: Turn) -> None:
        """Raise unless it is in A1, or in E0 and the user has confirmed the rest."""
        status = await self._read_state(turn, self.change.old)
        if status is None:
            raise self._failed(Problem.NO_REPLY, "its state cannot be read")
        if status.state in _PLUGGED or (status.state == A1 and status.plugged):
            raise self._failed(Problem.PLUGGED, "a car is plugged in", status)
        if status.state not in (A1, E0):
            raise self._failed(Problem.STATE, "possible in A1 and E0 only", status)
        if status.state == E0 and not self.change.unplugged:
            message = "in E0 it does not show whether a car is plugged in"
            raise self._failed(Problem.CAR_UNKNOWN, message, status)
        self._was_disabled = status.state == E0

    def _require_caller(self) -> None:
        if self.given_up:
            raise self._failed(Problem.GIVEN_UP, "its caller has gone")

    # -- Set-up ------------------------------------------------------------------------

    async def _enter_set_up(self, turn: Turn) -> None:
        for _ in range(STATE_LOOKS - 1):
            await self._check_state(turn)
            await self._rest(turn, self._pauses.verify)
        self._require_caller()
        state: int | None = None
        outcome = _Outcome.UNANSWERED
        for attempt in range(WRITES):
            if attempt == 0 or state not in (E2, None):
                await self._check_state(turn)
            if attempt == 0:
                await self._require_ours(turn)
            else:
                await self._require_alone(turn, self.change.old)
            self._begin(_Stage.SET_UP)
            outcome = await self._write_state(turn, self.change.old, StateCode.E2)
            await self._rest(turn, self._pauses.settings)
            state = await self._state_code(turn, self.change.old)
            if outcome is _Outcome.SEVERAL:
                break
            if outcome is _Outcome.UNREADABLE:
                # Once more: a box refuses it in E2, and two of them do so together.
                continue
            if state is None and outcome is not _Outcome.CONFIRMED:
                await self._leave_set_up(turn)
                break
            if state in (E2, None):
                # If not readable, it does not answer reads there.
                return
        self._end_cleanup()
        message = f"it does not change to E2: {outcome.value}"
        several = outcome in (_Outcome.SEVERAL, _Outcome.UNREADABLE)
        problem = Problem.SECOND_CHARGER if several else Problem.REFUSED
        raise self._failed(problem, message)

    async def _write_id(self, turn: Turn) -> None:
        """Write the device-ID until it is confirmed, or until the box has it."""
        old, new = self.change.old, self.change.new
        request = write_configuration(old, new)
        for attempt in range(WRITES):
            if attempt and await self._who(turn, new) is not _Answer.SILENT:
                return
            await self._require_alone(turn, old)
            self._begin(_Stage.WRITTEN)
            outcome = await self._write(turn, request, self._id_confirmed)
            if outcome is _Outcome.REFUSED and attempt == 0:
                # It has no new device-ID, so a reset is not needed.
                self._begin(_Stage.SET_UP)
                await self._leave_set_up(turn)
                raise self._failed(Problem.REFUSED, "it refuses the device-ID")
            if outcome is _Outcome.SEVERAL:
                self._end_cleanup()
                message = "another box has taken the device-ID, too"
                raise self._failed(Problem.SECOND_CHARGER, message)
            await self._rest(turn, self._pauses.settings)
            if outcome is _Outcome.CONFIRMED:
                return

    def _id_confirmed(self, frame: ModbusFrame) -> bool | None:
        """Return whether a frame confirms the write, from either device-ID."""
        for address in (self.change.old, self.change.new):
            if write_answer(address, CONFIGURATION_REGISTER)(frame):
                return True
        return None

    async def _leave_set_up(self, turn: Turn) -> None:
        """Lead the box out of E2 without a reset: no device-ID was written."""
        old = self.change.old
        code = StateCode.E0 if self._was_disabled else StateCode.A1
        for _ in range(WRITES):
            await self._require_alone(turn, old)
            await self._write_state(turn, old, code)
            await self._rest(turn, self._pauses.settings)
            status = await self._read_state(turn, old)
            if status is not None and status.state != E2:
                self._end_cleanup()
                return
        raise self._failed(Problem.IN_SET_UP, "it does not leave E2")

    def _begin(self, stage: _Stage) -> None:
        """Enter a stage; note how the charger leaves E2 if that ends too early."""
        self.stage = stage
        # A box left in E2 lets no car charge; behind a slow adapter the way out takes
        # long.
        self._bus.stop_patience = UNFINISHED_PATIENCE
        if self._own is None:
            return
        # An order that comes meanwhile must not be sent to another box there.
        self._own.invalidate()
        leave = StateCode.A1 if stage is _Stage.SET_UP else StateCode.RESET
        self._own.pending_cleanup = (
            Cleanup(StateCode.E0) if self._was_disabled else Cleanup(leave, E2)
        )

    def _end_cleanup(self) -> None:
        if self._own is not None:
            self._own.pending_cleanup = None

    # -- Reset -------------------------------------------------------------------------

    async def _settle(self, turn: Turn) -> None:
        """Reset the box until it is out of E2 with its new device-ID.

        Raises AddressChangeError with what has become of it.
        """
        resets = 0
        until = turn.now + BOOT_PATIENCE
        seen = _Seen()
        while turn.now < until:
            before, seen = seen, await self._look(turn)
            if seen.at_new is _Answer.OURS and seen.state not in (None, E2):
                return
            place = seen.place(self.change)
            if seen.state == E2 and place is not None:
                if resets == WRITES:
                    break
                resets += 1
                await self._reset(turn, place)
                until = turn.now + BOOT_PATIENCE
            elif seen.is_silent and not resets:
                # It may answer no reads in E2.
                resets = 1
                await self._reset_unseen(turn)
                until = turn.now + BOOT_PATIENCE
            elif seen == before and not seen.is_silent and seen.state is not None:
                break
            await self._rest(turn, self._pauses.boot)
        problem = seen.problem
        if problem is Problem.SECOND_CHARGER:
            # What would end its set-up would reach the other one, too.
            self._end_cleanup()
        raise self._failed(problem, f"{seen}")

    async def _look(self, turn: Turn) -> _Seen:
        """Look for the box at both device-IDs, and at its state."""
        old, new = self.change.old, self.change.new
        at_new = await self._who(turn, new)
        if at_new is _Answer.OURS:
            return _Seen(at_new=at_new, state=await self._state_code(turn, new))
        at_old = await self._who(turn, old)
        state = None
        if at_old is _Answer.OURS:
            state = await self._state_code(turn, old)
        return _Seen(at_new=at_new, at_old=at_old, state=state)

    async def _state_code(self, turn: Turn, address: int) -> int | None:
        status = await self._read_state(turn, address)
        return None if status is None else status.state

    async def _reset(self, turn: Turn, address: int) -> None:
        with suppress(AddressChangeError):
            await self._require_alone(turn, address)
            await self._write_state(turn, address, StateCode.RESET)

    async def _reset_unseen(self, turn: Turn) -> None:
        """Reset a box that answers no reads; nothing is sent where another one does."""
        for address in (self.change.old, self.change.new):
            if await self._who(turn, address) is not _Answer.SILENT:
                return
            outcome = await self._write_state(turn, address, StateCode.RESET)
            if outcome is _Outcome.CONFIRMED:
                return

    async def _finish(self, turn: Turn) -> AddressChanged:
        """Bring back what the reset has ended; look for another box at the old ID."""
        self.done = AddressChanged(serial=self._serial)
        if self._own is not None:
            self._own.invalidate()
            self._own.move(self.change.new)
        enabled = not await self._restore(turn)
        self.done = replace(self.done, enabled=enabled)
        self._advance(0.9)
        for _ in range(PAIR):
            await self._rest(turn, self._pauses.retry)
            at_old = await self._who(turn, self.change.old)
            if at_old is _Answer.OURS:
                raise self._failed(Problem.BOTH, "it answers at both device-IDs")
            if at_old is not _Answer.SILENT:
                self.done = replace(self.done, old_in_use=True)
                break
        self._advance(1.0)
        return self.done

    async def _restore(self, turn: Turn) -> bool:
        """Bring back limit and E0; return whether the outlet is as it was."""
        if self._own is not None:
            await rest(worst_case=self._bus.worst_case(self._own))
            with suppress(EvseError):
                await recover(self._own, turn, was_disabled=self._was_disabled)
                return True
            return not self._was_disabled
        if not self._was_disabled:
            return True
        for _ in range(WRITES):
            if await self._who(turn, self.change.new) is not _Answer.OURS:
                break
            await self._write_state(turn, self.change.new, StateCode.E0)
            await self._rest(turn, self._pauses.settings)
            if await self._state_code(turn, self.change.new) == E0:
                return True
        return False

    # -- Exchanges ---------------------------------------------------------------------

    async def _rest(self, turn: Turn, pause: float) -> None:
        """Give the bus to others; the box is not polled while it is being set up."""
        self._hold(turn)
        await rest(pause, worst_case=self._worst_case)
        self._hold(turn)

    def _hold(self, turn: Turn) -> None:
        if self.stage is not _Stage.CHECKED:
            for reader in self._readers:
                hold_polls(reader, turn)

    async def _ask(self, turn: Turn, address: int) -> _Answer:
        """Read the serial number at a device-ID, and wait for every reply."""
        try:
            replies = await collect(turn, address, SERIAL, disturbed=False)
        except GarbledReplyError:
            return _Answer.UNREADABLE
        except ReplyTimeoutError:
            return _Answer.SILENT
        except ExchangeRefusedError:
            return _Answer.OTHER
        if len(replies) > 1:
            return _Answer.UNREADABLE
        [serial] = replies
        return _Answer.OURS if serial.number == self._serial else _Answer.OTHER

    async def _who(self, turn: Turn, address: int, *, patience: int = PAIR) -> _Answer:
        """Return what answers at a device-ID; asked again where that is not clear.

        ``patience``: requests until it counts as silent. What is written next follows
        the last request at once, in the same turn.
        """
        silent = unreadable = other = 0
        while True:
            answer = await self._ask(turn, address)
            if answer is _Answer.OURS:
                return answer
            silent += answer is _Answer.SILENT
            unreadable += answer is _Answer.UNREADABLE
            other = other + 1 if answer is _Answer.OTHER else 0
            if other == DOUBTFUL:
                return answer
            if silent == patience and not unreadable:
                return answer
            if unreadable and silent + unreadable >= MOST_DOUBTS:
                return _Answer.UNREADABLE
            await self._rest(turn, self._pauses.retry)

    async def _require_ours(self, turn: Turn) -> None:
        """Raise unless the box answers alone at its old device-ID."""
        answer = await self._who(turn, self.change.old)
        if answer is not _Answer.OURS:
            silent = answer is _Answer.SILENT
            problem = Problem.NO_REPLY if silent else Problem.SEVERAL
            raise self._failed(problem, f"{answer.value} before the first write")

    async def _require_alone(self, turn: Turn, address: int) -> None:
        """Raise when another box answers; the box itself may be silent in E2."""
        answer = await self._who(turn, address)
        if answer not in (_Answer.OURS, _Answer.SILENT):
            self._end_cleanup()
            message = f"another box answers at {address}"
            raise self._failed(Problem.SECOND_CHARGER, message)

    async def _read_state(self, turn: Turn, address: int) -> Reading | None:
        """Return the state; ``None``: no readable reply."""
        for attempt in range(STATE_READS):
            if attempt:
                await self._rest(turn, self._pauses.verify)
            with suppress(ReplyTimeoutError, ExchangeRefusedError):
                replies = await collect(turn, address, READING, disturbed=False)
                if len(replies) == 1:
                    return replies[0]
        return None

    async def _write_state(self, turn: Turn, address: int, code: StateCode) -> _Outcome:
        answer = write_answer(address, STATE_REGISTER)
        return await self._write(turn, write_state(address, code), answer)

    @staticmethod
    async def _write(
        turn: Turn, request: bytes, accept: Callable[[ModbusFrame], bool | None]
    ) -> _Outcome:
        """Send a write, and wait for every reply."""
        try:
            replies = await collect_confirmations(turn, request, accept)
        except GarbledReplyError:
            return _Outcome.UNREADABLE
        except ReplyTimeoutError:
            return _Outcome.UNANSWERED
        if len(replies) > 1:
            return _Outcome.SEVERAL
        return _Outcome.CONFIRMED if replies == [None] else _Outcome.REFUSED

    def _failed(
        self, problem: Problem, message: str, status: Reading | None = None
    ) -> AddressChangeError:
        old, new = self.change.old, self.change.new
        return AddressChangeError(
            f"device-ID {old} to {new}: {message}",
            problem,
            old=str(old),
            new=str(new),
            serial=self._serial or self.change.serial or "?",
            state="?" if status is None else state_of(status.state).name,
        )


async def change_device_id(
    bus: Bus, change: AddressChange, progress: Progress
) -> AddressChanged:
    """Give the one box that answers at a device-ID another one.

    Where a charger is set up at the old one no other command of it is carried out
    meanwhile, and it follows if the box is its own. Raises AddressChangeError; before
    anything is written also LineLostError and NotAvailableError.
    """
    readers = [
        one
        for one in bus.chargers.values()
        if isinstance(one, AblCharger)
        and one.config.address in (change.old, change.new)
    ]
    sequence = DeviceIdChange(change, bus, readers)
    sequence.progress = progress
    owner = next((one for one in readers if one.config.address == change.old), None)
    try:
        if owner is not None:
            return await owner.run(owner.exclusive("set_address", sequence.run))
        return await bus.run(sequence.run, kind=Kind.COMMAND)
    except asyncio.CancelledError:
        sequence.given_up = True
        raise
    except (LineError, NotAvailableError, NotConfirmedError) as error:
        if sequence.done is not None:
            return sequence.done
        raise sequence.ended_by(error) from error
