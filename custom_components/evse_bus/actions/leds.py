"""Action for the LEDs of an EWS-Box in the mode that gives them to the server."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from ..errors import ActionError, wrong_action
from ..evse.ews.wire.commands import (
    LED_OFF,
    LED_ON,
    LED_UNCHANGED,
    Led,
    PortLeds,
    blinking,
)
from .fields import option, whole

if TYPE_CHECKING:
    from ..evse.ews import EwsPort

LEDS: Final = ("red", "green", "orange", "spare")
UNCHANGED: Final = "unchanged"
BLINK: Final = "blink"
STATES: Final[Mapping[str, Led | None]] = {
    "on": LED_ON,
    "off": LED_OFF,
    BLINK: None,
    UNCHANGED: LED_UNCHANGED,
}
LONGEST: Final = 0xFFFE
"""ms; the next higher value means always."""
DEFAULT_TIME: Final = 500
"""ms"""
TIMES: Final[Mapping[str, tuple[int, int, int]]] = {
    "time_on": (1, LONGEST, DEFAULT_TIME),
    "time_off": (1, LONGEST, DEFAULT_TIME),
    "offset": (0, LONGEST, 0),
}
"""Suffixes of an LED's time fields: lowest, highest and default value, ms."""


def time_keys(led: str) -> tuple[str, ...]:
    """Return the names of the fields for the times of an LED."""
    return tuple(f"{led}_{name}" for name in TIMES)


FIELDS: Final = (*LEDS, *(key for led in LEDS for key in time_keys(led)))


async def set_leds(port: EwsPort, given: Mapping[str, object]) -> None:
    """Set the LEDs of one port; those of the other port stay unchanged."""
    leds = port_leds(given)
    other = PortLeds()
    if leds == other:
        raise wrong_action(ActionError.NOTHING_TO_CHANGE)
    first, second = (leds, other) if port.number == 1 else (other, leds)
    await port.services.set_leds(first, second)


def port_leds(given: Mapping[str, object]) -> PortLeds:
    """Return the new state of the LEDs; raises ServiceValidationError."""
    return PortLeds(**{led: _led(led, given) for led in LEDS})


def _led(led: str, given: Mapping[str, object]) -> Led:
    state = given.get(led, UNCHANGED)
    if isinstance(state, bool):
        # YAML reads the words on and off as booleans.
        state = "on" if state else "off"
    steady = option(STATES)(led, state)
    if steady is None:
        return blinking(
            *(
                whole(lowest, highest)(key, given.get(key, default))
                for key, (lowest, highest, default) in zip(
                    time_keys(led), TIMES.values(), strict=True
                )
            )
        )
    for key in time_keys(led):
        if key in given:
            raise wrong_action(ActionError.LED_TIMES, field=key, led=led, state=BLINK)
    return steady
