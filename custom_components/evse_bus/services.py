"""The actions: what a P-CHARGE EWS-Box can do that no entity stands for.

Each takes a device: a box, or one of its ports. The other fields are checked in
`actions/`, with an error that names the field.
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from homeassistant.const import ATTR_DEVICE_ID
from homeassistant.core import (
    HomeAssistant,
    ServiceCall,
    ServiceResponse,
    SupportsResponse,
    callback,
)
from homeassistant.helpers import config_validation as cv
from homeassistant.helpers.service import (
    async_get_device_and_config_entry,
    async_register_admin_service,
)
import probatio as vol

from .actions import cards, leds, parameters as blocks
from .actions.fields import meter_total
from .const import DOMAIN
from .errors import ActionError, failed_action, translated_errors, wrong_action
from .evse.errors import NotConfirmedError
from .evse.ews import EwsPort

if TYPE_CHECKING:
    from homeassistant.helpers.device_registry import AnyDeviceEntry

    from .coordinator import BusCoordinator, EvseBusConfigEntry
    from .managed_charger import ManagedCharger

CONF_TOTAL: Final = "total"


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """One action: what it takes, who may call it, and what it does."""

    run: Callable[[EwsPort, Mapping[str, Any]], Awaitable[ServiceResponse]]
    required: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    admin: bool = True
    """Only administrators may: it changes what is set up, or tells what is private."""
    responds: bool = False
    """It only tells something."""
    of_port: bool = False
    """It means one port; the others mean the whole box."""
    unconfirmed: ActionError | None = None
    """What is said when the box does not confirm it; ``None``: as of any command."""

    @property
    def schema(self) -> vol.Schema:
        """Return what its data looks like; the values are checked when it runs."""
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
        # For an automation that answers whoever holds a card to the reader.
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


@callback
def async_register(hass: HomeAssistant) -> None:
    """Register the actions: once, whatever becomes of the buses."""
    for name, action in ACTIONS.items():
        register = (
            partial(async_register_admin_service, hass)
            if action.admin
            else hass.services.async_register
        )
        register(
            DOMAIN,
            name,
            partial(_async_run, action),
            schema=action.schema,
            supports_response=(
                SupportsResponse.ONLY if action.responds else SupportsResponse.NONE
            ),
        )


async def _async_run(action: Action, call: ServiceCall) -> ServiceResponse:
    coordinator, managed, charger = _target(call, of_port=action.of_port)
    name = managed.name if action.of_port else managed.subentry.title
    with translated_errors(name, coordinator.port):
        try:
            return await action.run(charger, call.data)
        except NotConfirmedError as error:
            if action.unconfirmed is None:
                raise
            given = ", ".join(key for key in action.optional if key in call.data)
            raise failed_action(
                action.unconfirmed, charger=name, fields=given
            ) from error


def _target(
    call: ServiceCall, *, of_port: bool
) -> tuple[BusCoordinator, ManagedCharger, EwsPort]:
    """Return who is meant; raises ServiceValidationError.

    The box stands for its first port: that is as good as any for what concerns the
    whole box. ``of_port``: only where it has no other.
    """
    entry: EvseBusConfigEntry
    device, entry = async_get_device_and_config_entry(
        call.hass, DOMAIN, call.data[ATTR_DEVICE_ID]
    )
    keys = {key for domain, key in device.identifiers if domain == DOMAIN}
    coordinator = entry.runtime_data
    ports = [
        (managed, managed.charger)
        for managed in coordinator.chargers.values()
        if {managed.key, managed.subentry_id} & keys
        and isinstance(managed.charger, EwsPort)
    ]
    if not ports:
        raise wrong_action(ActionError.NOT_EWS_BOX, device=_name(device))
    if of_port and len(ports) > 1:
        raise wrong_action(ActionError.CHOOSE_PORT, device=_name(device))
    managed, charger = min(ports, key=lambda one: one[1].port)
    return coordinator, managed, charger


def _name(device: AnyDeviceEntry) -> str:
    return device.name_by_user or device.name or device.id
