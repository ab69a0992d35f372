"""Records of an EWS-Box about its ports: ``rc``, ``rd``.

Source of the tables: manual, 3.2.4, the command of each. Two ports a box; pairs are
port 1, port 2. Names and cards are private: no repr shows them.
"""

from datetime import datetime
from enum import KEEP, IntEnum, IntFlag
from typing import Final

from ...errors import ImplausibleReplyError
from ...fields import Field, Flag, Flags, Number, Text, Unused
from ...structs import Struct, coded, optional, pair, record
from .fields import Centivolts, Moment

type Pair[V] = tuple[V, V]

_AMPERES: Final = range(81)
"""A control pilot offers no more than 80 A (IEC 61851-1, annex A)."""
_PERCENT: Final = range(101)
_WATTS: Final = range(100_001)
"""Twice the power of three phases of 70 A: a meter counted by pulses may jump."""


@record
class Card:
    """A card that is logged in."""

    group: int = coded(Number(width=2), secret=True)
    number: int = coded(Number(width=2), secret=True)
    """Within its group."""
    user: str = coded(Text(width=8), secret=True)


CARD: Final = Struct(Card, "3.2.4 rc: card")


# -- rc: the two ports -------------------------------------------------------------


class PortFlags(IntFlag, boundary=KEEP):
    """Requests of the car."""

    VENTILATION = 1 << 0


class StartRelease(IntEnum):
    """Whether a start was requested or allowed."""

    NONE = 0
    """Not in the manual, which has 1 and 2 only."""
    REQUESTED = 1
    """A start was requested, and waits for the server to allow it."""
    RELEASED = 2


class ChargeResult(IntEnum):
    """Result of the last charge; valid after its end."""

    STOPPED = 1
    PILOT_LOST = 3
    """The cable was pulled at the car: not a fault."""
    CABLE_LOST = 4
    RCD = 5
    METER = 6
    SERVER_TIMEOUT = 7
    VENTILATION = 8
    PILOT_UNSTABLE = 9


class KeysAndLeds(IntFlag, boundary=KEEP):
    """Keys pressed and LEDs lit."""

    KEY_1 = 1 << 0
    KEY_2 = 1 << 1
    KEY_3 = 1 << 2
    KEY_4 = 1 << 3
    LED_RED = 1 << 4
    LED_GREEN = 1 << 5
    LED_ORANGE = 1 << 6
    LED_SPARE = 1 << 7


@record
class PortStatus:
    """Status of one port (``rc``); ``None``: not known to a port in mode 1."""

    state: int = coded(Number(width=1))
    """Status byte, see `states`."""
    cable_current: int | None = coded(Number(width=1, unit="A", possible=_AMPERES))
    """Rated current of the cable, A; 0: none known."""
    offered_current: int | None = coded(Number(width=1, unit="A", possible=_AMPERES))
    """Highest current that the box offers now, A."""
    flags: PortFlags = coded(Flags(kind=PortFlags))
    start_code: int = coded(Number(width=1))
    """See `start`."""
    optimised: bool = coded(Flag())
    """The next start is an optimised one."""
    result_code: int = coded(Number(width=1))
    """See `result`."""
    session_time: int = coded(Number(width=4, unit="s"))
    """Of the charge under way, s."""
    session_energy: int = coded(Number(width=4, unit="Wh"))
    """Of the charge under way, Wh."""
    last_time: int = coded(Number(width=4, unit="s"))
    """Of the last charge, s."""
    last_energy: int = coded(Number(width=4, unit="Wh"))
    """Of the last charge, Wh."""
    total_energy: int = coded(Number(width=4, unit="Wh"))
    """Meter total, Wh; ``cr`` sets it."""
    meter_cycles: int = coded(Number(width=4))
    """"Absolute meter cycle counter"; no unit is named."""
    locked: bool | None = coded(Flag())
    contactor: bool = coded(Flag())
    """The contactor is closed."""
    rcd_tripped: bool = coded(Flag())
    pwm_minimum: float | None = coded(Centivolts())
    """Lowest level of the control pilot, V."""
    pwm_maximum: float | None = coded(Centivolts())
    """Highest level of the control pilot, V."""
    cable_voltage: float | None = coded(Centivolts())
    """At the proximity contact, V."""
    keys_and_leds: KeysAndLeds = coded(Flags(kind=KeysAndLeds))
    card: Card | None = coded(optional(CARD), secret=True)
    """The card that is logged in at this port."""

    @property
    def start(self) -> StartRelease | None:
        """Return whether a start was requested or released; ``None``: unknown code."""
        known = self.start_code in StartRelease
        return StartRelease(self.start_code) if known else None

    @property
    def result(self) -> ChargeResult | None:
        """Return how the last charge ended; ``None``: no charge, or unknown code."""
        known = self.result_code in ChargeResult
        return ChargeResult(self.result_code) if known else None


_MODE_3_ONLY: Final = frozenset(
    {
        "cable_current",
        "offered_current",
        "locked",
        "pwm_minimum",
        "pwm_maximum",
        "cable_voltage",
    }
)

PORT: Final = Struct(PortStatus, "3.2.4 rc")


def _mode_1(known: Field[object]) -> Field[object]:
    if known.name in _MODE_3_ONLY:
        return Unused(name=known.name, width=known.width)
    return known


PORT_MODE_1: Final = Struct(
    PortStatus, "3.2.4 rc", tuple(_mode_1(one) for one in PORT.fields)
)
"""A port in mode 1 (a household socket): six of the fields have no meaning there."""

LENGTH_PORTS: Final = 2 * PORT.length


def decode_ports(
    data: bytes, mode_1: Pair[bool] = (False, False), count: int = 2
) -> tuple[PortStatus, ...]:
    """Decode the answer to ``rc``: the status of port 1 and, if there is one, port 2.

    ``mode_1``: which of them are in mode 1, ``count``: how many there are
    (`parameters.SystemParameters`); bytes of a port that does not exist are ignored.
    Raises ImplausibleReplyError.
    """
    if len(data) != LENGTH_PORTS:
        message = f"{PORT.source}: {len(data)} bytes, not {LENGTH_PORTS}"
        raise ImplausibleReplyError(message)
    return tuple(
        (PORT_MODE_1 if mode_1[at] else PORT).decode(
            data[at * PORT.length :][: PORT.length]
        )
        for at in range(count)
    )


# -- rd: more of the two ports -----------------------------------------------------


@record
class Details:
    """Details of port 1 and port 2 (``rd``)."""

    power: Pair[int] = coded(pair(Number(width=4, unit="W", possible=_WATTS)))
    """W. The manual calls it energy; its unit is that of power."""
    pwm_duty: Pair[int] = coded(pair(Number(width=1, unit="%", possible=_PERCENT)))
    """Duty cycle of the control pilot, %."""
    pilot_code: Pair[int] = coded(pair(Number(width=1)))
    """"Low-level PWM state A", raw."""
    cable_code: Pair[int] = coded(pair(Number(width=1)))
    """"Low-level cable current detection in A", raw."""
    limit: Pair[int] = coded(pair(Number(width=1, unit="A")))
    """As set with ``st``, A; 0: none. Not checked: a wrong one is sent again."""
    last_card: Pair[Card | None] = coded(pair(optional(CARD)), secret=True)
    """The card of the last charge."""
    last_end: Pair[datetime | None] = coded(pair(Moment()))
    """When the last charge ended, in the box's time zone."""


DETAILS: Final = Struct(Details, "3.2.4 rd")


def decode_details(data: bytes) -> Details:
    """Decode the answer to ``rd``; later firmware appends to it.

    Raises ImplausibleReplyError.
    """
    return DETAILS.decode(data, longer=True)
