"""Boxes that dial a listener and are not set up: told to the user, nothing more."""

from contextlib import suppress
from typing import TYPE_CHECKING, Final

from homeassistant.config_entries import SOURCE_INTEGRATION_DISCOVERY
from homeassistant.core import callback
from homeassistant.data_entry_flow import UnknownFlow
from homeassistant.helpers import discovery_flow
from homeassistant.helpers.discovery_flow import DiscoveryKey

from .const import DOMAIN

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigEntry, ConfigSubentry
    from homeassistant.core import HomeAssistant

    from .evse.ews import Stranger

CONF_ENTRY: Final = "entry_id"
CONF_FIRMWARE: Final = "firmware"
CONF_PEER: Final = "peer"


@callback
def async_wants_to_connect(
    hass: HomeAssistant, entry: ConfigEntry, stranger: Stranger
) -> None:
    """Offer a box that has dialled; it may be added, or ignored."""
    unique_id = box_unique_id(stranger.serial)
    if is_set_up(hass, unique_id):
        return
    discovery_flow.async_create_flow(
        hass,
        DOMAIN,
        context={"source": SOURCE_INTEGRATION_DISCOVERY},
        data={
            CONF_ENTRY: entry.entry_id,
            "serial": stranger.serial,
            CONF_FIRMWARE: stranger.firmware,
            CONF_PEER: str(stranger.peer or ""),
        },
        # Who is no longer ignored is offered again at once, not when it dials next.
        discovery_key=DiscoveryKey(domain=DOMAIN, key=unique_id, version=1),
    )


def box_unique_id(serial: str) -> str:
    """Return the unique id of an EWS-Box, however it is connected."""
    return f"ews_{serial}"


def is_set_up(hass: HomeAssistant, unique_id: str) -> bool:
    """Return whether a box is set up, at this listener or anywhere else."""
    return any(
        subentry.unique_id == unique_id
        for entry in hass.config_entries.async_entries(DOMAIN)
        for subentry in entry.subentries.values()
    )


@callback
def async_set_up_now(hass: HomeAssistant, subentry: ConfigSubentry) -> None:
    """Take back the offer of a box that has been set up in another way."""
    # The dialogue that has just added it may be about to end by itself.
    hass.loop.call_soon(_take_back, hass, subentry.unique_id)


def _take_back(hass: HomeAssistant, unique_id: str | None) -> None:
    manager = hass.config_entries.flow
    for flow in manager.async_progress_by_handler(
        DOMAIN,
        match_context={
            "source": SOURCE_INTEGRATION_DISCOVERY,
            "unique_id": unique_id,
        },
    ):
        with suppress(UnknownFlow):
            manager.async_abort(flow["flow_id"])
