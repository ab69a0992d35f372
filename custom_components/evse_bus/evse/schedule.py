"""The next turn on a bus: a pure function of the waiting slots and of the time.

The rules (they are the bus's promises, each with a test):

- hard deadlines first: nothing is started whose worst case would make one late, if the
  turns for other deadlines before it take as long as usual;
- then commands, a pause before any other;
- then polls, earliest due first;
- then probes of chargers that do not answer. On a bus that is busy all the time one
  probe is let in after each available charger has had its turn, so that a dead
  charger costs the others at most one reply time-out a round;
- where worst cases leave room for nothing but deadlines, nothing waits for ever. A
  command that meets a deadline itself takes the turn of the one that it meets, and one
  other turn is let in after each slot with a deadline has had its own.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from math import inf


class Kind(IntEnum):
    """Kind of a turn, the most urgent first."""

    PAUSE = 0
    COMMAND = 1
    POLL = 2
    PROBE = 3


@dataclass(slots=True, eq=False, kw_only=True)
class Slot:
    """A claim to a turn on the bus. All times are loop times, s."""

    kind: Kind
    ready: float = 0.0
    """Not before this (minimum interval, retry pause, back-off)."""
    due: float = 0.0
    """Order among slots of one kind: the earliest first."""
    start_by: float = inf
    """Hard deadline: must have been started by then."""
    worst_case: float = 0.0
    """Longest time one turn can take, time-out included, s."""
    usual: float | None = None
    """Time one turn usually takes, s; ``None``: not known, so the longest counts."""
    served: float = field(default=-inf)
    """Time of its last turn that was answered."""
    turn_at: float = field(default=-inf)
    """Begin of its last turn."""
    meets: Slot | None = None
    """A slot whose deadline this turn meets as well."""


@dataclass(slots=True)
class Turns:
    """Begins of the last turns that are let in once a round."""

    probe: float = -inf
    """Of a probe."""
    extra: float = -inf
    """Of any that the worst cases leave no room for."""


@dataclass(frozen=True, slots=True)
class Choice[S: Slot]:
    """The slot to serve now, or else the time of the next choice."""

    slot: S | None
    wake_at: float = inf
    for_deadline: bool = False
    """It was taken because a deadline left room for nothing else."""
    is_extra: bool = False
    """It was let in although the worst cases leave no room for it."""


def choose[S: Slot](slots: Sequence[S], now: float, last: Turns) -> Choice[S]:
    """Return the slot to serve now."""
    waiting = sorted((slot for slot in slots if slot.ready <= now), key=_order)
    deadlines = sorted(
        (slot for slot in slots if slot.start_by < inf), key=lambda slot: slot.start_by
    )
    probe = _probe_let_in(waiting, last.probe)
    candidates = _with_probe(waiting, probe)
    for slot in candidates:
        if _leaves_room(slot, deadlines, now):
            return Choice(slot)
        if _has_waited_a_round(slot, deadlines, last.extra):
            return Choice(slot, is_extra=True)
        if slot.start_by < now:
            # Late already: one served just now must not go first again and again.
            break
    # Nothing ordinary fits before a deadline: serve the deadline itself.
    for slot in deadlines:
        if slot.ready <= now and (candidates or slot.start_by <= now):
            return Choice(_rider(slot, candidates) or slot, for_deadline=True)
    return Choice(None, wake_at=_next_look(slots, deadlines, now))


def _order(slot: Slot) -> tuple[int, float]:
    return (slot.kind, slot.due)


def _has_waited_a_round(slot: Slot, deadlines: Iterable[Slot], last: float) -> bool:
    """Return whether each deadline was served since it waits, and since the last."""
    if slot.start_by < inf:
        # Its own turn comes by its deadline.
        return False
    since = max(slot.due, last)
    return all(other.turn_at >= since for other in deadlines)


def _rider[S: Slot](deadline: S, candidates: Iterable[S]) -> S | None:
    """Return a command that meets this deadline and takes no longer, if any."""
    for slot in candidates:
        if slot.meets is deadline and slot.worst_case <= deadline.worst_case:
            return slot
    return None


def _probe_let_in[S: Slot](waiting: Iterable[S], last_probe: float) -> S | None:
    """Return the probe that has waited for a whole round of polls, if any."""
    first: S | None = None
    for slot in waiting:
        if slot.kind is Kind.PROBE:
            if first is None:
                first = slot
        elif slot.kind is Kind.POLL and slot.served <= last_probe:
            return None
    return first


def _with_probe[S: Slot](waiting: list[S], probe: S | None) -> list[S]:
    """Return the order of service with one probe ranked as a poll."""
    if probe is None:
        return waiting
    return sorted(
        waiting,
        key=lambda slot: (
            (Kind.POLL, slot.due) if slot is probe else (slot.kind, slot.due)
        ),
    )


def _leaves_room(slot: Slot, deadlines: Iterable[Slot], now: float) -> bool:
    """Return whether every other deadline can still be met after this turn."""
    end = now + slot.worst_case
    for other in deadlines:
        latest = max(other.start_by, other.ready)
        # One that is late already blocks no other: a pause must still get through.
        if other is slot or other is slot.meets or latest < now:
            continue
        start = max(end, other.ready)
        if start > latest:
            return False
        end = start + (other.worst_case if other.usual is None else other.usual)
    return True


def _next_look(slots: Iterable[Slot], deadlines: Iterable[Slot], now: float) -> float:
    """Return the time at which a slot becomes ready or meets its deadline."""
    times = [slot.ready for slot in slots if slot.ready > now]
    times.extend(max(slot.start_by, slot.ready) for slot in deadlines)
    return min(times, default=inf)
