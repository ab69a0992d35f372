"""The table of all actions, with their fields and rights.

The folder of the actions knows the EWS-Box itself: its cards, LEDs and parameter blocks
are behaviour of that box, not data that a protocol could declare.
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeIs

from homeassistant.const import ATTR_DEVICE_ID
from homeassistant.core import ServiceResponse
from homeassistant.helpers import config_validation as cv
import probatio as vol

from ..errors import ActionError
from ..evse.ews import EwsPort
from . import cards, leds, parameters as blocks
from .fields import meter_total

if TYPE_CHECKING:
    from ..evse.charger import Charger

type Target = EwsPort
"""The charger that an action applies to."""

CONF_TOTAL: Final = "total"


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """One action: its fields, the required rights, and its function."""

    run: Callable[[EwsPort, Mapping[str, Any]], Awaitable[ServiceResponse]]
    required: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    admin: bool = True
    """Only for administrators: it changes the configuration or returns private data."""
    responds: bool = False
    """It returns data and changes nothing."""
    of_port: bool = False
    """It applies to one port; the others apply to the whole box."""
    unconfirmed: ActionError | None = None
    """Error if the box does not confirm it; ``None``: that of any command."""

    @property
    def schema(self) -> vol.Schema:
        """Return the schema of its fields; their values are checked when it runs."""
        return vol.Schema(
            {vol.Required(ATTR_DEVICE_ID): cv.string}
            | {vol.Required(key): cv.match_all for key in self.required}
            | {vol.Optional(key): cv.match_all for key in self.optional}
        )


async def _set_meter_total(port: EwsPort, given: Mapping[str, object]) -> None:
    await port.services.set_meter(meter_total(CONF_TOTAL, given[CONF_TOTAL]))


def _writes(block: str) -> Action:
    return Action(
        run=partial(blocks.write_parameters, block),
        optional=blocks.keys_of(block),
        unconfirmed=ActionError.PARAMETERS_NOT_TAKEN,
    )


ACTIONS: Final[Mapping[str, Action]] = {
    "accept_card": Action(
        run=cards.accept_card,
        required=(cards.CONF_GROUP, cards.CONF_NUMBER),
        optional=(cards.CONF_USER, cards.CONF_TAG),
        # Not for administrators only: an automation may accept a presented card.
        admin=False,
    ),
    "read_card_list": Action(
        run=cards.read_card_list, responds=True, unconfirmed=ActionError.NOT_READ
    ),
    "write_card_list": Action(
        run=cards.write_card_list,
        required=(cards.CONF_ENTRIES,),
        unconfirmed=ActionError.CARDS_NOT_TAKEN,
    ),
    "set_meter_total": Action(
        run=_set_meter_total, required=(CONF_TOTAL,), of_port=True
    ),
    "set_leds": Action(
        run=leds.set_leds, optional=leds.FIELDS, admin=False, of_port=True
    ),
    "read_parameters": Action(
        run=blocks.read_parameters,
        required=(blocks.CONF_BLOCK,),
        responds=True,
        unconfirmed=ActionError.NOT_READ,
    ),
    "write_system_parameters": _writes("system"),
    "write_network_parameters": _writes("network"),
    "write_installation_info": _writes("installation"),
    "write_extra_parameters": _writes("extra"),
}


def has_actions(charger: Charger) -> TypeIs[Target]:
    """Return whether the actions apply to a charger."""
    return isinstance(charger, EwsPort)
