"""Which replies to a reading command count: those that another one agrees with.

The checksum of this protocol is an XOR of 8 bits: two bit flips in the same place of
two bytes pass it, about every eighth pair. So a reply counts if it equals the one that
counted before it, or the one read right before it. Values of a charge run, and those
of the pilot are noisy: of replies that only differ in such values `CONFIRMATIONS` in a
row are needed, each within reach of the one before. Where the meters of a port run
faster than they can, its state counts without them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from ..meter import CONFIRMATIONS, most_energy
from .wire.box_status import BoxFlags, BoxStatus
from .wire.status import Details, PortStatus

_READOUT: Final = 1.0
"""The box may count a unit (s, Wh) between two replies, however soon they come."""
_CLOCK: Final = 2.0
"""A clock in whole seconds may be off by so much between two replies, s."""
_VOLTS: Final = 0.5
"""Noise of a measured level, V."""
_POWER_SHARE: Final = 0.1
_POWER: Final = 100.0
"""Noise of a measured power: a share of it, plus an amount, W."""


@dataclass(frozen=True, slots=True)
class _Read[T]:
    """A reply, decoded."""

    value: T
    at: float
    """Loop time, s."""


class Agreement[T]:
    """The replies to one reading command, one after the other."""

    def __init__(
        self,
        same: Callable[[T, T, float], bool],
        continues: Callable[[T, T, float], bool],
        like: Callable[[T, T], bool] = lambda _before, _after: False,
    ) -> None:
        """Take the comparisons of two replies and of the time between them, s.

        ``same``: neither of them is damaged. ``continues``: the second only differs in
        values that run or are noisy. ``like``: all but the meters is the same.
        """
        self._same = same
        self._continues = continues
        self._like = like
        self._counted: _Read[T] | None = None

    def forget(self) -> None:
        """Drop the reply that counted last: another box may be there."""
        self._counted = None

    def begin(self) -> Series[T]:
        """Return a new series of replies, which are read in a row."""
        return Series(self)

    def counts(self, value: T, now: float) -> None:
        """Keep a reply that counts."""
        self._counted = _Read(value, now)

    def repeats_counted(self, read: _Read[T]) -> bool:
        """Return whether a reply repeats the one that counted last."""
        return self._counted is not None and self.is_same(self._counted, read)

    def is_same(self, before: _Read[T], after: _Read[T]) -> bool:
        """Return whether the second reply repeats the first."""
        return self._same(before.value, after.value, after.at - before.at)

    def is_continued(self, before: _Read[T], after: _Read[T]) -> bool:
        """Return whether the second reply is within reach of the first."""
        return self._continues(before.value, after.value, after.at - before.at)

    def is_like(self, before: _Read[T], after: _Read[T]) -> bool:
        """Return whether two replies differ in their meters alone."""
        return self._like(before.value, after.value)


class Series[T]:
    """Replies to one command that are read in a row until one counts."""

    def __init__(self, agreement: Agreement[T]) -> None:
        """Begin without a reply."""
        self._agreement = agreement
        self._row: list[_Read[T]] = []
        self.like: T | None = None
        """The last reply of which all but the meters agrees with the one before."""

    def agrees(self, value: T, now: float) -> bool:
        """Add a reply; return whether others agree with it."""
        agreement, row = self._agreement, self._row
        read = _Read(value, now)
        last = row[-1] if row else None
        if last is not None and agreement.is_like(last, read):
            self.like = value
        if last is not None and not agreement.is_continued(last, read):
            row.clear()
        row.append(read)
        return (
            agreement.repeats_counted(read)
            or (last is not None and agreement.is_same(last, read))
            or len(row) >= CONFIRMATIONS
        )

    def interrupt(self) -> None:
        """Take note of a reply that no box gives: the row begins anew."""
        self._row.clear()


def equal[T](before: T, after: T, _seconds: float) -> bool:
    """Return whether two replies are equal."""
    return before == after


def never[T](_before: T, _after: T, _seconds: float) -> bool:
    """Return False: such replies have no value that runs."""
    return False


def box_continues(before: BoxStatus, after: BoxStatus, seconds: float) -> bool:
    """Return whether two replies to ``rs`` agree; the clock runs.

    A box may clear its restart flag when it is read.
    """
    if _constant(before) != _constant(after):
        return False
    if before.clock is None or after.clock is None:
        return before.clock == after.clock
    passed = (after.clock - before.clock).total_seconds()
    return abs(passed - seconds) <= _CLOCK


def _constant(status: BoxStatus) -> BoxStatus:
    flags = status.flags & ~BoxFlags.RESTARTED
    return replace(status, clock=None, flags=flags)


def ports_continue(
    before: tuple[PortStatus, ...], after: tuple[PortStatus, ...], seconds: float
) -> bool:
    """Return whether the second reply to ``rc`` is within reach of the first."""
    return len(before) == len(after) and all(
        _port_continues(one, other, seconds)
        for one, other in zip(before, after, strict=True)
    )


def _port_continues(before: PortStatus, after: PortStatus, seconds: float) -> bool:
    counted = _READOUT + most_energy(seconds, slack=0.0)
    return (
        0 <= after.session_time - before.session_time <= seconds + _READOUT
        and 0 <= after.session_energy - before.session_energy <= counted
        and 0 <= after.total_energy - before.total_energy <= counted
        and _is_like(before, after)
    )


def ports_are_like(
    before: tuple[PortStatus, ...], after: tuple[PortStatus, ...]
) -> bool:
    """Return whether two replies to ``rc`` differ in their meters alone."""
    return len(before) == len(after) and all(
        _is_like(one, other) for one, other in zip(before, after, strict=True)
    )


def _is_like(before: PortStatus, after: PortStatus) -> bool:
    return (
        _is_near(before.pwm_minimum, after.pwm_minimum)
        and _is_near(before.pwm_maximum, after.pwm_maximum)
        and _is_near(before.cable_voltage, after.cable_voltage)
        and after
        == replace(
            before,
            session_time=after.session_time,
            session_energy=after.session_energy,
            total_energy=after.total_energy,
            pwm_minimum=after.pwm_minimum,
            pwm_maximum=after.pwm_maximum,
            cable_voltage=after.cable_voltage,
        )
    )


def _is_near(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one == other
    return abs(one - other) <= _VOLTS


def details_continue(before: Details, after: Details, _seconds: float) -> bool:
    """Return whether two replies to ``rd`` differ in their power alone, and little."""
    return after == replace(before, power=after.power) and all(
        abs(one - other) <= _POWER + _POWER_SHARE * max(one, other)
        for one, other in zip(before.power, after.power, strict=True)
    )
