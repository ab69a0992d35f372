"""Actions: functions of a P-CHARGE EWS-Box that no entity covers.

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


@callback
def async_register(hass: HomeAssistant) -> None:
    """Register the actions, independent of any config entry."""
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
    """Return the charger that an action applies to; raises ServiceValidationError.

    The device of a box selects its first port, which serves for the whole box.
    ``of_port``: only if the box has no other port.
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
    managed, charger = min(ports, key=lambda one: one[1].number)
    return coordinator, managed, charger


def _name(device: AnyDeviceEntry) -> str:
    return device.name_by_user or device.name or device.id
