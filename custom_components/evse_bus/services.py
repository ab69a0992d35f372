"""Actions: functions of a charger that no entity covers; see `actions.table`.

Each takes a device: a box, or one of its ports. The other fields are checked in
`actions/`, with an error that names the field.
"""

from functools import partial
from typing import TYPE_CHECKING

from homeassistant.const import ATTR_DEVICE_ID
from homeassistant.core import (
    HomeAssistant,
    ServiceCall,
    ServiceResponse,
    SupportsResponse,
    callback,
)
from homeassistant.helpers.service import (
    async_get_device_and_config_entry,
    async_register_admin_service,
)

from .actions.table import ACTIONS, Action, Target, has_actions
from .const import DOMAIN
from .errors import ActionError, failed_action, translated_errors, wrong_action
from .evse.errors import NotConfirmedError

if TYPE_CHECKING:
    from homeassistant.helpers.device_registry import AnyDeviceEntry

    from .chargers.managed import ManagedCharger
    from .coordinator import BusCoordinator, EvseBusConfigEntry


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
) -> tuple[BusCoordinator, ManagedCharger, Target]:
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
        if {managed.unique_key, managed.identity} & keys
        and has_actions(managed.charger)
    ]
    if not ports:
        raise wrong_action(ActionError.NOT_EWS_BOX, device=_name(device))
    if of_port and len(ports) > 1:
        raise wrong_action(ActionError.CHOOSE_PORT, device=_name(device))
    managed, charger = min(ports, key=lambda one: one[1].number)
    return coordinator, managed, charger


def _name(device: AnyDeviceEntry) -> str:
    return device.name_by_user or device.name or device.id
