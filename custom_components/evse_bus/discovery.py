"""Discovery flows for unknown boxes that dial a listener."""

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

from .configuration import protocol_of
from .const import CONF_ENTRY, CONF_PROTOCOL, DOMAIN
from .identity import holder

if TYPE_CHECKING:
    from homeassistant.config_entries import (
        ConfigEntry,
        ConfigFlowContext,
    )
    from homeassistant.core import HomeAssistant

    from .evse.dialling import Listener, UnknownBox

CONF_BOX: Final = "box"

MOST_OFFERS: Final = 16
"""Discovery flows at once: a client may send any number of serial numbers."""

_DISCOVERED: Final[ConfigFlowContext] = {"source": SOURCE_INTEGRATION_DISCOVERY}


@callback
def async_wants_to_connect(
    hass: HomeAssistant, entry: ConfigEntry, found: UnknownBox
) -> None:
    """Start a discovery flow for an unknown box that has dialled."""
    if hass.state is not CoreState.running:
        # Until it has started, Home Assistant would queue any number of flows.
        return
    protocol = protocol_of(entry.data)
    identity = protocol.identity(found.serial)
    flows = hass.config_entries.flow.async_progress_by_handler(
        DOMAIN, include_uninitialized=True, match_context=dict(_DISCOVERED)
    )
    if identity is None or holder(hass, identity) or len(flows) >= MOST_OFFERS:
        return
    discovery_flow.async_create_flow(
        hass,
        DOMAIN,
        context=_DISCOVERED,
        data={
            CONF_ENTRY: entry.entry_id,
            CONF_PROTOCOL: protocol.key,
            CONF_BOX: found,
        },
        # Home Assistant signals by this key when the box is no longer ignored.
        discovery_key=DiscoveryKey(domain=DOMAIN, key=identity, version=1),
    )


@callback
def async_offer_when_started(
    hass: HomeAssistant, entry: ConfigEntry, listener: Listener
) -> CALLBACK_TYPE:
    """Offer boxes that have dialled during startup, once Home Assistant has started.

    Returns a function that cancels this.
    """

    @callback
    def started(_hass: HomeAssistant) -> None:
        for found in listener.unknown_boxes:
            async_wants_to_connect(hass, entry, found)

    return async_at_started(hass, started)


@callback
def async_follow_ignored(
    hass: HomeAssistant, entry: ConfigEntry, listener: Listener
) -> CALLBACK_TYPE:
    """Offer a box as soon as it is no longer ignored, not when it dials next.

    Returns a function that ends this.
    """
    protocol = protocol_of(entry.data)

    @callback
    def removed(ignored: ConfigEntry) -> None:
        for found in listener.unknown_boxes:
            if protocol.identity(found.serial) == ignored.unique_id:
                async_wants_to_connect(hass, entry, found)

    signal = signal_discovered_config_entry_removed(DOMAIN)
    return async_dispatcher_connect(hass, signal, removed)


# -- Ending discovery flows ------------------------------------------------------


@callback
def async_set_up_now(hass: HomeAssistant, identity: str | None) -> None:
    """End the discovery flow of a box that was set up in another way."""
    if identity is not None:
        # Not at once: the flow that has just added the box ends by itself.
        hass.loop.call_soon(_end_discovery, hass, identity)


def _end_discovery(hass: HomeAssistant, identity: str) -> None:
    manager = hass.config_entries.flow
    for flow in manager.async_progress_by_handler(
        DOMAIN, match_context={**_DISCOVERED, "unique_id": identity}
    ):
        with suppress(UnknownFlow):
            manager.async_abort(flow["flow_id"])


@callback
def async_listener_gone(hass: HomeAssistant, entry: ConfigEntry) -> None:
    """End the discovery flows of a removed listener.

    A flow that is open in a browser stays, and aborts when the box is to be added.
    """
    hass.config_entries.flow.async_dismiss_discovery_flows(
        dict, lambda data: data.get(CONF_ENTRY) == entry.entry_id
    )
