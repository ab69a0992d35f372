"""Flow steps of a listener: set it up, change it, add a box that has dialled."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from ipaddress import ip_address, ip_network
import re
import socket
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, override

from homeassistant.components import network
from homeassistant.config_entries import (
    ConfigEntryState,
    ConfigFlow,
    ConfigFlowContext,
    ConfigFlowResult,
    ConfigSubentry,
    ConfigSubentryData,
    OptionsFlow,
)
from homeassistant.const import CONF_HOST, CONF_PORT
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers.selector import (
    NumberSelector,
    NumberSelectorConfig,
    NumberSelectorMode,
    SelectOptionDict,
    SelectSelector,
    SelectSelectorConfig,
    SelectSelectorMode,
    TextSelector,
    TextSelectorConfig,
)
import probatio as vol

from ..configuration import protocol_of
from ..connections import ListenerConnections, address_name
from ..const import (
    CONF_ALLOWED,
    CONF_ENTRY,
    CONF_PROTOCOL,
    CONF_SERIAL,
    DOMAIN,
    LOGGER,
    SUBENTRY_CHARGER,
)
from ..coordinator import EvseBusConfigEntry
from ..discovery import CONF_BOX
from ..evse.errors import (
    EvseError,
    LineError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
)
from ..evse.protocols import PROTOCOLS
from ..evse.scan import FoundCharger
from ..identity import holder
from .address import Errors
from .charger import Candidate
from .steps import ChargerSteps

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

    from ..evse.dialling import UnknownBox
    from ..evse.protocol import Protocol

FIRST_PORT: Final = 4712
"""First TCP port that is suggested; the manual of the EWS-Box names none."""
_SUGGESTED: Final = range(FIRST_PORT, FIRST_PORT + 100)
HIGHEST_PORT: Final = 65535

_LISTEN_ERRORS: Final[Mapping[type[EvseError], str]] = {
    PortBusyError: "listen_busy",
    PortMissingError: "listen_missing",
    PortPermissionError: "listen_permission",
    LineError: "cannot_listen",
}
"""Keys of the error texts; the first class that matches counts."""


# -- The address of a listener ---------------------------------------------------


def listen_form(addresses: Mapping[str, str], port: int) -> vol.Schema:
    """Return the form for the address of a listener: a list, or typed, and a port."""
    options = [
        SelectOptionDict(value=address, label=label)
        for address, label in addresses.items()
    ]
    return vol.Schema(
        {
            vol.Required(CONF_HOST): SelectSelector(
                SelectSelectorConfig(
                    options=options,
                    custom_value=True,
                    mode=SelectSelectorMode.DROPDOWN,
                )
            ),
            vol.Required(CONF_PORT, default=port): NumberSelector(
                NumberSelectorConfig(
                    min=1, max=HIGHEST_PORT, step=1, mode=NumberSelectorMode.BOX
                )
            ),
        }
    )


def listen_data(typed: Mapping[str, Any]) -> tuple[dict[str, Any], Errors]:
    """Return the address and port of a filled-in form, and the errors."""
    try:
        host = str(ip_address(typed[CONF_HOST].strip()))
    except ValueError:
        return {}, {CONF_HOST: "bad_address"}
    port = typed[CONF_PORT]
    # The number field lets NaN through every range.
    if port not in range(1, HIGHEST_PORT + 1):
        return {}, {CONF_PORT: "bad_port"}
    return {CONF_HOST: host, CONF_PORT: int(port)}, {}


async def async_try_listen(protocol: Protocol, data: Mapping[str, Any]) -> Errors:
    """Listen for a moment; return the errors."""
    listener = protocol.listen_at(data[CONF_HOST], data[CONF_PORT])
    try:
        await listener.start()
    except LineError as error:
        kind = next(kind for kind in _LISTEN_ERRORS if isinstance(error, kind))
        if kind is LineError:
            where = address_name(data[CONF_HOST], data[CONF_PORT])
            LOGGER.warning("Cannot listen at %s: %s", where, error)
        return {"base": _LISTEN_ERRORS[kind]}
    await listener.stop()
    return {}


async def async_own_addresses(hass: HomeAssistant) -> dict[str, str]:
    """Return the IPv4 addresses of this machine, with labels.

    The one by which it is usually reached comes first. Boxes may be in a network that
    Home Assistant uses for nothing else.
    """
    addresses: dict[str, str] = {}
    with suppress(HomeAssistantError):
        # Raised while there is no network.
        first = await network.async_get_source_ip(hass)
        addresses[first] = first
    for adapter in await network.async_get_adapters(hass):
        for one in adapter["ipv4"]:
            address = one["address"]
            if address in addresses or not ip_address(address).is_loopback:
                addresses[address] = f"{address} ({adapter['name']})"
    return addresses


def free_port(host: str) -> int:
    """Return an unused TCP port; blocks on the network for a moment."""
    for port in _SUGGESTED:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return port
    return FIRST_PORT


class ListenerSteps(ChargerSteps[ConfigFlowContext, ConfigFlowResult, str], ConfigFlow):
    """Steps of the config flow for boxes that dial in."""

    def __init__(self) -> None:
        """Start without a listener."""
        super().__init__()
        self._listener: EvseBusConfigEntry | None = None
        """The listener to which a discovered box is being added."""
        self._discovered: FoundCharger
        self._peer = ""

    async def async_step_listen(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Choose the address of the listener; boxes are added when they dial."""
        data, result = await self._async_listen("listen", user_input)
        if result is not None:
            return result
        host = data[CONF_HOST]
        if ip_address(host).is_unspecified:
            # Boxes cannot dial the unspecified address.
            host = next(iter(await async_own_addresses(self.hass)), host)
        return self.async_create_entry(
            title=listener_title(self.protocol, data),
            data=data,
            description="listening",
            description_placeholders={"address": host, "port": str(data[CONF_PORT])},
        )

    async def async_step_reconfigure_listen(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Change the address of the listener."""
        entry = self._get_reconfigure_entry()
        self.protocol = protocol_of(entry.data)
        data, result = await self._async_listen("reconfigure_listen", user_input, entry)
        if result is not None:
            return result
        # A title set by the user stays.
        is_own = entry.title != listener_title(self.protocol, entry.data)
        title = entry.title if is_own else listener_title(self.protocol, data)
        # The update listener of a loaded entry reloads it.
        update = (
            self.async_update_and_abort
            if entry.update_listeners
            else self.async_update_reload_and_abort
        )
        return update(entry, title=title, data=data)

    async def _async_listen(
        self,
        step_id: str,
        typed: dict[str, Any] | None,
        entry: EvseBusConfigEntry | None = None,
    ) -> tuple[dict[str, Any], ConfigFlowResult | None]:
        """Return the data of the entry, or the form to show.

        ``entry`` is the one being reconfigured.
        """
        errors: Errors = {}
        if typed is not None:
            where, errors = listen_data(typed)
            if not errors:
                errors = await self._async_check_listen(where, entry)
            if not errors:
                return {CONF_PROTOCOL: self.protocol.key, **where}, None
        addresses = await async_own_addresses(self.hass)
        first = next(iter(addresses), "")
        port = await self.hass.async_add_executor_job(free_port, first)
        suggested = typed or (entry.data if entry is not None else {CONF_HOST: first})
        return {}, self.async_show_form(
            step_id=step_id,
            data_schema=self.add_suggested_values_to_schema(
                listen_form(addresses, port), suggested
            ),
            errors=errors,
        )

    async def _async_check_listen(
        self, where: Mapping[str, Any], entry: EvseBusConfigEntry | None
    ) -> Errors:
        """Return the errors; aborts if another entry listens there."""
        self._async_abort_entries_match(dict(where))
        if (
            entry is not None
            and entry.state is ConfigEntryState.LOADED
            and where[CONF_PORT] == entry.data[CONF_PORT]
        ):
            hosts = {where[CONF_HOST], entry.data[CONF_HOST]}
            if len(hosts) == 1:
                # This entry listens there, so the address can be used.
                return {}
            if any(ip_address(host).is_unspecified for host in hosts):
                # This entry has the port open: check the address only.
                return await async_try_listen(self.protocol, {**where, CONF_PORT: 0})
        return await async_try_listen(self.protocol, where)

    # -- A box that has dialled ----------------------------------------------------

    @override
    async def async_step_integration_discovery(
        self, discovery_info: dict[str, Any]
    ) -> ConfigFlowResult:
        """Offer a box that has dialled and is not set up."""
        box: UnknownBox = discovery_info[CONF_BOX]
        self.protocol = PROTOCOLS[discovery_info[CONF_PROTOCOL]]
        identity = self.protocol.identity(box.serial)
        await self.async_set_unique_id(identity)
        # An ignored box is such an entry, too.
        self._abort_if_unique_id_configured()
        entry = self.hass.config_entries.async_get_entry(discovery_info[CONF_ENTRY])
        if (other := holder(self.hass, identity)) is not None:
            return self.abort_held(other)
        if entry is None:
            return self.async_abort(reason="listener_gone")
        self._listener = entry
        self.bus_data = dict(entry.data)
        self.context["title_placeholders"] = {
            "name": f"{self.protocol.make.name} {box.serial}"
        }
        self._discovered = found_box(box)
        self._peer = "?" if box.peer is None else str(box.peer)
        return await self.async_step_discovered()

    async def async_step_discovered(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Show the box that has dialled; the user decides whether to add it."""
        box = self._discovered
        if user_input is not None:
            return await self.async_begin([Candidate(address=box.address, found=box)])
        return self.async_show_form(
            step_id="discovered",
            description_placeholders={
                **self.context.get("title_placeholders", {}),
                "serial": box.serial or "?",
                "firmware": box.info.firmware or "?",
                "listener": self._listener.title if self._listener else "?",
                "peer": self._peer,
            },
        )

    @override
    def others(self) -> list[ConfigSubentry]:
        """Return the other boxes of the listener."""
        return (
            [] if self._listener is None else list(self._listener.subentries.values())
        )

    def add_box(self, boxes: list[ConfigSubentryData]) -> ConfigFlowResult:
        """Add a discovered box to its listener."""
        [box] = boxes
        entries = self.hass.config_entries
        entry = self._listener
        if entry is None or entry not in entries.async_entries(DOMAIN):
            return self.async_abort(reason="listener_gone")
        if (other := self.find_held()) is not None:
            return self.abort_held(other)
        entries.async_add_subentry(
            entry,
            ConfigSubentry(
                data=MappingProxyType(dict(box["data"])),
                subentry_type=SUBENTRY_CHARGER,
                title=box["title"],
                unique_id=box["unique_id"],
            ),
        )
        return self.async_abort(
            reason="box_added",
            description_placeholders={"name": box["title"], "listener": entry.title},
        )


def found_box(box: UnknownBox) -> FoundCharger:
    """Return an unknown box as a search result; it has reported only its identity."""
    # Any device can dial and send this text, which must not become a link.
    firmware = re.sub(r"[^\w.-]", "", box.info.firmware or "") or None
    info = replace(box.info, firmware=firmware)
    return FoundCharger(address=box.serial, serial=box.serial, info=info)


def listener_title(protocol: Protocol, data: Mapping[str, Any]) -> str:
    """Return the default title of a listener."""
    address = address_name(data[CONF_HOST], data[CONF_PORT])
    return f"{protocol.make.plural} ({address})"


# -- Options ---------------------------------------------------------------------


class ListenerOptionsFlow(OptionsFlow):
    """Options of a listener: the addresses from which boxes may dial."""

    _typed: Mapping[str, Any] | None = None
    _allowed: tuple[str, ...] = ()
    """What was typed, without duplicates."""

    async def async_step_init(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Ask for addresses and networks; none: any address is allowed."""
        wrong = ""
        if user_input is not None:
            self._typed = user_input
            typed = [text.strip() for text in user_input.get(CONF_ALLOWED, ())]
            wrong = next((text for text in typed if text and not _network(text)), "")
            if not wrong:
                self._allowed = tuple(dict.fromkeys(filter(None, map(_network, typed))))
                return await self.async_step_excludes()
        form = vol.Schema(
            {
                vol.Optional(CONF_ALLOWED): TextSelector(
                    TextSelectorConfig(multiple=True)
                )
            }
        )
        suggested = self.config_entry.options if self._typed is None else self._typed
        return self.async_show_form(
            step_id="init",
            data_schema=self.add_suggested_values_to_schema(form, suggested),
            errors={CONF_ALLOWED: "bad_network"} if wrong else {},
            description_placeholders={"network": wrong},
        )

    async def async_step_excludes(self) -> ConfigFlowResult:
        """Warn of boxes that could no longer connect."""
        if not (excluded := self._excluded()):
            return await self.async_step_save()
        return self.async_show_menu(
            step_id="excludes",
            menu_options=["init", "save"],
            description_placeholders={"boxes": "\n".join(excluded)},
        )

    def _excluded(self) -> list[str]:
        """Return the boxes whose last address would not be allowed, as a list."""
        entry: EvseBusConfigEntry = self.config_entry
        if entry.state is not ConfigEntryState.LOADED:
            return []
        connections = entry.runtime_data.connections
        if not isinstance(connections, ListenerConnections):
            return []
        excluded = connections.listener.excluded_by(map(ip_network, self._allowed))
        return [
            f"- {subentry.title} ({excluded[serial]})"
            for subentry in entry.get_subentries_of_type(SUBENTRY_CHARGER)
            if (serial := subentry.data[CONF_SERIAL]) in excluded
        ]

    async def async_step_save(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a menu has none
    ) -> ConfigFlowResult:
        """Allow these addresses and networks only."""
        return self.async_create_entry(data={CONF_ALLOWED: list(self._allowed)})


def _network(text: str) -> str | None:
    """Return a network or a single address as it is stored; ``None``: invalid."""
    try:
        made = ip_network(text, strict=False)
    except ValueError:
        return None
    return str(made.network_address) if made.num_addresses == 1 else str(made)
