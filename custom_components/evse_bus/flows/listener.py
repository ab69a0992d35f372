"""Set up a listener that EWS-Boxes dial, change it, and add a box that has dialled."""

from collections.abc import Mapping
from contextlib import suppress
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

from ..connections import address_name
from ..const import (
    CONF_ALLOWED,
    CONF_PROTOCOL,
    CONF_SERIAL,
    DOMAIN,
    LOGGER,
    SUBENTRY_CHARGER,
)
from ..coordinator import EvseBusConfigEntry
from ..discovery import CONF_ENTRY, CONF_FIRMWARE, CONF_PEER, box_unique_id, is_set_up
from ..evse.errors import (
    EvseError,
    LineError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
)
from ..evse.ews import Listener
from ..evse.protocols import PROTOCOLS
from ..evse.readings import ChargerInfo
from ..evse.scan import FoundCharger
from .address import Errors
from .charger import Candidate, short_name
from .steps import ChargerSteps

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

FIRST_PORT: Final = 4712
"""The first TCP port that is offered; the manual names none."""
_OFFERED: Final = range(FIRST_PORT, FIRST_PORT + 100)
HIGHEST_PORT: Final = 65535

_LISTEN_ERRORS: Final[Mapping[type[EvseError], str]] = {
    PortBusyError: "listen_busy",
    PortMissingError: "listen_missing",
    PortPermissionError: "listen_permission",
    LineError: "cannot_listen",
}
"""What is said of an error; the first that fits."""


# -- Where to listen -------------------------------------------------------------


def listen_form(addresses: Mapping[str, str], port: int) -> vol.Schema:
    """Ask for an address of this machine and a port; another address can be typed."""
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
    """Return where to listen, of a filled-in form, and what is wrong with it."""
    try:
        host = str(ip_address(typed[CONF_HOST].strip()))
    except ValueError:
        return {}, {CONF_HOST: "bad_address"}
    port = typed[CONF_PORT]
    # The number field lets NaN through every range.
    if port not in range(1, HIGHEST_PORT + 1):
        return {}, {CONF_PORT: "bad_port"}
    return {CONF_HOST: host, CONF_PORT: int(port)}, {}


async def async_try_listen(data: Mapping[str, Any]) -> Errors:
    """Listen for a moment; return what is wrong."""
    listener = Listener(data[CONF_HOST], data[CONF_PORT])
    try:
        await listener.start()
    except LineError as error:
        kind = next(kind for kind in _LISTEN_ERRORS if isinstance(error, kind))
        if kind is LineError:
            where = address_name(data[CONF_HOST], data[CONF_PORT])
            LOGGER.warning("Nobody can dial %s: %s", where, error)
        return {"base": _LISTEN_ERRORS[kind]}
    await listener.stop()
    return {}


async def async_own_addresses(hass: HomeAssistant) -> dict[str, str]:
    """Return this machine's addresses and what to call them.

    The one that it is reached by usually comes first. The boxes know IPv4 only, and
    their network may well be one that Home Assistant does nothing else in.
    """
    addresses: dict[str, str] = {}
    with suppress(HomeAssistantError):
        # It has no network now.
        first = await network.async_get_source_ip(hass)
        addresses[first] = first
    for adapter in await network.async_get_adapters(hass):
        for one in adapter["ipv4"]:
            address = one["address"]
            if address in addresses or not ip_address(address).is_loopback:
                addresses[address] = f"{address} ({adapter['name']})"
    return addresses


def free_port(host: str) -> int:
    """Return a port that nobody uses; blocks on the network for a moment."""
    for port in _OFFERED:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return port
    return FIRST_PORT


class ListenerSteps(ChargerSteps[ConfigFlowContext, ConfigFlowResult, str], ConfigFlow):
    """The steps of the config flow that only boxes on the network need."""

    def __init__(self) -> None:
        """Start without a listener."""
        super().__init__()
        self._listener: EvseBusConfigEntry | None = None
        """Whose box is being added."""
        self._discovered: FoundCharger
        self._peer = ""

    async def async_step_ews_network(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ConfigFlowResult:
        """Let boxes dial in."""
        self.protocol = PROTOCOLS["ews_network"]
        return await self.async_step_listen()

    async def async_step_listen(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Choose where to listen; boxes are added when they dial."""
        data, result = await self._async_listen("listen", user_input)
        if result is not None:
            return result
        host = data[CONF_HOST]
        if ip_address(host).is_unspecified:
            # That is no address that could be dialled.
            host = next(iter(await async_own_addresses(self.hass)), host)
        return self.async_create_entry(
            title=listener_title(data),
            data=data,
            description="listening",
            description_placeholders={"address": host, "port": str(data[CONF_PORT])},
        )

    async def async_step_reconfigure_listen(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Change where to listen."""
        entry = self._get_reconfigure_entry()
        data, result = await self._async_listen("reconfigure_listen", user_input, entry)
        if result is not None:
            return result
        own = entry.title != listener_title(entry.data)
        title = entry.title if own else listener_title(data)
        # A loaded listener hears of changes and reloads by itself.
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
        """Return an entry's data, or the form to show; ``entry`` is being changed."""
        errors: Errors = {}
        if typed is not None:
            where, errors = listen_data(typed)
            if not errors:
                errors = await self._async_check_listen(where, entry)
            if not errors:
                return {CONF_PROTOCOL: "ews_network", **where}, None
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
        """Return what is wrong; aborts when another entry listens there."""
        self._async_abort_entries_match(dict(where))
        if (
            entry is not None
            and entry.state is ConfigEntryState.LOADED
            and where[CONF_PORT] == entry.data[CONF_PORT]
        ):
            hosts = {where[CONF_HOST], entry.data[CONF_HOST]}
            if len(hosts) == 1:
                # We listen there ourselves.
                return {}
            if any(ip_address(host).is_unspecified for host in hosts):
                # We have the port ourselves: only the address is looked at.
                return await async_try_listen({**where, CONF_PORT: 0})
        return await async_try_listen(where)

    # -- A box that has dialled ----------------------------------------------------

    @override
    async def async_step_integration_discovery(
        self, discovery_info: dict[str, Any]
    ) -> ConfigFlowResult:
        """Offer a box that has dialled and is not set up."""
        serial = discovery_info[CONF_SERIAL]
        unique_id = box_unique_id(serial)
        await self.async_set_unique_id(unique_id)
        # An ignored one is such an entry, too.
        self._abort_if_unique_id_configured()
        entry = self.hass.config_entries.async_get_entry(discovery_info[CONF_ENTRY])
        if is_set_up(self.hass, unique_id):
            return self.async_abort(reason="box_already_set_up")
        if entry is None:
            return self.async_abort(reason="listener_gone")
        self._listener = entry
        self.protocol = PROTOCOLS["ews_network"]
        self.bus_data = dict(entry.data)
        self.context["title_placeholders"] = {
            "name": f"{short_name(self.protocol)} {serial}"
        }
        self._discovered = found_box(serial, discovery_info[CONF_FIRMWARE])
        self._peer = discovery_info[CONF_PEER]
        return await self.async_step_discovered()

    async def async_step_discovered(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Say who has dialled; whether it is the right box, only the user can tell."""
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
                "peer": self._peer or "?",
            },
        )

    @override
    def others(self) -> list[ConfigSubentry]:
        """Return the boxes that the listener has already."""
        return (
            [] if self._listener is None else list(self._listener.subentries.values())
        )

    def add_box(self, boxes: list[ConfigSubentryData]) -> ConfigFlowResult:
        """Add a box that has dialled to its listener."""
        [box] = boxes
        entries = self.hass.config_entries
        entry = self._listener
        if entry is None or entry not in entries.async_entries(DOMAIN):
            return self.async_abort(reason="listener_gone")
        unique_id = box["unique_id"]
        if unique_id is not None and is_set_up(self.hass, unique_id):
            return self.async_abort(reason="box_already_set_up")
        entries.async_add_subentry(
            entry,
            ConfigSubentry(
                data=MappingProxyType(dict(box["data"])),
                subentry_type=SUBENTRY_CHARGER,
                title=box["title"],
                unique_id=unique_id,
            ),
        )
        return self.async_abort(
            reason="box_added",
            description_placeholders={"name": box["title"], "listener": entry.title},
        )


def found_box(serial: str, firmware: str | None) -> FoundCharger:
    """Return what a box tells that is not set up: who it is, and nothing else."""
    info = ChargerInfo(
        manufacturer="P-CHARGE",
        model="EWS-Box",
        serial=serial,
        # Anybody may have dialled, and texts can have links in them.
        firmware=re.sub(r"[^\w.-]", "", firmware or "") or None,
    )
    return FoundCharger(address=serial, serial=serial, info=info)


def listener_title(data: Mapping[str, Any]) -> str:
    """Return a listener's name, as long as nobody gave it another."""
    return f"EWS-Boxes ({address_name(data[CONF_HOST], data[CONF_PORT])})"


# -- Who may dial ----------------------------------------------------------------


class ListenerOptionsFlow(OptionsFlow):
    """Restrict from which addresses boxes may dial."""

    async def async_step_init(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Ask for addresses and networks; none: all may."""
        wrong = ""
        if user_input is not None:
            typed = [text.strip() for text in user_input.get(CONF_ALLOWED, ())]
            wrong = next((text for text in typed if text and not _network(text)), "")
            if not wrong:
                # Each only once, in the order in which they were typed.
                allowed = dict.fromkeys(filter(None, map(_network, typed)))
                return self.async_create_entry(data={CONF_ALLOWED: list(allowed)})
        form = vol.Schema(
            {
                vol.Optional(CONF_ALLOWED): TextSelector(
                    TextSelectorConfig(multiple=True)
                )
            }
        )
        return self.async_show_form(
            step_id="init",
            data_schema=self.add_suggested_values_to_schema(
                form, self.config_entry.options if user_input is None else user_input
            ),
            errors={CONF_ALLOWED: "bad_network"} if wrong else {},
            description_placeholders={"network": wrong},
        )


def _network(text: str) -> str | None:
    """Return a network, or the address of one machine, as it is stored."""
    try:
        made = ip_network(text, strict=False)
    except ValueError:
        return None
    return str(made.network_address) if made.num_addresses == 1 else str(made)
