"""What a virtual SmartEVSE remembers for the tests."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RegisterWrite:
    """A write that the box understood: when (its time), what, and what became of it.

    `taken`: how many registers took their value, by the box's own count; the override
    of a 2.17 is taken although it does not count.
    """

    t: float
    unit: int
    function: int
    register: int
    values: tuple[int, ...]
    taken: int
    answered: bool


@dataclass(frozen=True, slots=True)
class BalanceBroadcast:
    """Charge currents heard from a master: when (box's time), and 0.1 A per unit."""

    t: float
    currents: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Handshake:
    """A request of a slave (01 to 04) or an acknowledgement (81 to 84), box's time."""

    t: float
    register: int
    value: int
