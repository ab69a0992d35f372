"""Boxes that dial a listener and are not set up: told to the user, nothing more."""

from contextlib import suppress
from typing import TYPE_CHECKING, Final

from homeassistant.config_entries import (
    SOURCE_INTEGRATION_DISCOVERY,
    signal_discovered_config_entry_removed,
)
from homeassistant.core import CALLBACK_TYPE, CoreState, callback
from homeassistant.data_entry_flow import UnknownFlow
from homeassistant.helpers import discovery_flow
from homeassistant.helpers.discovery_flow import DiscoveryKey
from homeassistant.helpers.dispatcher import async_dispatcher_connect
from homeassistant.helpers.start import async_at_started

from .const import DOMAIN

if TYPE_CHECKING:
    from homeassistant.config_entries import (
        ConfigEntry,
        ConfigFlowContext,
        ConfigSubentry,
    )
    from homeassistant.core import HomeAssistant

    from .evse.ews import Listener, Stranger

CONF_ENTRY: Final = "entry_id"
CONF_FIRMWARE: Final = "firmware"
CONF_PEER: Final = "peer"

MOST_OFFERS: Final = 16
"""Boxes offered at once. Whoever can connect can give any number of serial numbers."""

_OFFERED: Final[ConfigFlowContext] = {"source": SOURCE_INTEGRATION_DISCOVERY}


@callback
def async_wants_to_connect(
    hass: HomeAssistant, entry: ConfigEntry, stranger: Stranger
) -> None:
    """Offer a box that has dialled; it may be added, or ignored."""
    if hass.state is not CoreState.running:
        # Home Assistant would keep any number of offers until it has started.
        return
    unique_id = box_unique_id(stranger.serial)
    flows = hass.config_entries.flow.async_progress_by_handler(
        DOMAIN, include_uninitialized=True, match_context=dict(_OFFERED)
    )
    if is_set_up(hass, unique_id) or len(flows) >= MOST_OFFERS:
        return
    discovery_flow.async_create_flow(
        hass,
        DOMAIN,
        context=_OFFERED,
        data={
            CONF_ENTRY: entry.entry_id,
            "serial": stranger.serial,
            CONF_FIRMWARE: stranger.firmware,
            CONF_PEER: str(stranger.peer or ""),
        },
        # By this we are told when it is no longer ignored.
        discovery_key=DiscoveryKey(domain=DOMAIN, key=unique_id, version=1),
    )


@callback
def async_offer_when_started(
    hass: HomeAssistant, entry: ConfigEntry, listener: Listener
) -> CALLBACK_TYPE:
    """Offer the boxes that have dialled while Home Assistant was starting.

    Returns what ends this.
    """

    @callback
    def started(_hass: HomeAssistant) -> None:
        for stranger in listener.strangers:
            async_wants_to_connect(hass, entry, stranger)

    return async_at_started(hass, started)


@callback
def async_follow_ignored(
    hass: HomeAssistant, entry: ConfigEntry, listener: Listener
) -> CALLBACK_TYPE:
    """Offer a box that is no longer ignored at once, not when it dials next.

    Returns what ends this.
    """

    @callback
    def removed(ignored: ConfigEntry) -> None:
        for stranger in listener.strangers:
            if box_unique_id(stranger.serial) == ignored.unique_id:
                async_wants_to_connect(hass, entry, stranger)

    signal = signal_discovered_config_entry_removed(DOMAIN)
    return async_dispatcher_connect(hass, signal, removed)


def box_unique_id(serial: str) -> str:
    """Return the unique id of an EWS-Box, however it is connected."""
    return f"ews_{serial}"


def is_set_up(
    hass: HomeAssistant, unique_id: str, but: ConfigSubentry | None = None
) -> bool:
    """Return whether a box is set up, at this listener or anywhere else.

    ``but``: the one that is being changed.
    """
    return any(
        subentry.unique_id == unique_id
        for entry in hass.config_entries.async_entries(DOMAIN)
        for subentry in entry.subentries.values()
        if but is None or subentry.subentry_id != but.subentry_id
    )


# -- Offers that are taken back --------------------------------------------------


@callback
def async_set_up_now(hass: HomeAssistant, subentry: ConfigSubentry) -> None:
    """Take back the offer of a box that has been set up in another way."""
    # The dialogue that has just added it may be about to end by itself.
    hass.loop.call_soon(_take_back, hass, subentry.unique_id)


def _take_back(hass: HomeAssistant, unique_id: str | None) -> None:
    manager = hass.config_entries.flow
    for flow in manager.async_progress_by_handler(
        DOMAIN, match_context={**_OFFERED, "unique_id": unique_id}
    ):
        with suppress(UnknownFlow):
            manager.async_abort(flow["flow_id"])


@callback
def async_listener_gone(hass: HomeAssistant, entry: ConfigEntry) -> None:
    """Take back all offers of a listener, but for those that somebody is looking at.

    They are told so when they try to add the box.
    """
    hass.config_entries.flow.async_dismiss_discovery_flows(
        dict, lambda data: data.get(CONF_ENTRY) == entry.entry_id
    )
