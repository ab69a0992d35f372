"""Which phase of the house a phase of a charger is.

Installers rotate the phases from box to box, so that one-phase cars spread: the box's
L1 is not the house's L1. Which order a box has is set by the user. The names of the six
orders are those of OCPP 1.6 (ConnectorPhaseRotation): R, S, T are the house's L1, L2,
L3, in the order of the box's terminals.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Final

from .readings import Phases


class Rotation(StrEnum):
    """The house's phases at the terminals of a box."""

    RST = "rst"
    RTS = "rts"
    SRT = "srt"
    STR = "str"
    TRS = "trs"
    TSR = "tsr"
    L1 = "l1"
    """A box with one phase, at the house's L1."""
    L2 = "l2"
    L3 = "l3"
    UNKNOWN = "unknown"
    """Each phase may be any: the worst one counts."""


type Order = tuple[int, ...]
"""The house's phases, 0 to 2, at the box's L1, L2, L3."""

_ORDERS: Final[Mapping[Rotation, Order]] = {
    Rotation.RST: (0, 1, 2),
    Rotation.RTS: (0, 2, 1),
    Rotation.SRT: (1, 0, 2),
    Rotation.STR: (1, 2, 0),
    Rotation.TRS: (2, 0, 1),
    Rotation.TSR: (2, 1, 0),
    Rotation.L1: (0,),
    Rotation.L2: (1,),
    Rotation.L3: (2,),
}
ALL: Final[Order] = (0, 1, 2)


def offered_on(rotation: Rotation, wired: int) -> Order:
    """Return the house's phases on which a box may let a car draw.

    A pilot offers its current on all phases that the box is wired to.
    """
    order = _ORDERS.get(rotation)
    return ALL if order is None else order[:wired]


def in_house(currents: Phases[float], rotation: Rotation, wired: int) -> Phases[float]:
    """Return what a box certainly draws on each phase of the house, A.

    In an unknown order that is the least of its phases: on none is it less.
    """
    order = _ORDERS.get(rotation)
    if order is None:
        least = min(currents)
        return (least, least, least)
    found = dict(zip(order[:wired], currents, strict=False))
    return (found.get(0, 0.0), found.get(1, 0.0), found.get(2, 0.0))
