"""Records that a virtual SmartEVSE keeps for the tests."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RegisterWrite:
    """A well-formed write: its time (the box's), its values, and its outcome.

    `taken`: the number of values accepted, by the box's own count; the override of a
    2.17 is accepted although the box does not count it.
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
    """Charge currents received from a master: the box's time, and 0.1 A per unit."""

    t: float
    currents: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Handshake:
    """A request of a slave (01 to 04) or an acknowledgement (81 to 84), box's time."""

    t: float
    register: int
    value: int
