"""Config flow of a bus: protocol, port, search, chargers; reconfiguration."""

from collections.abc import Mapping
from typing import Any, Final, override

from homeassistant.config_entries import (
    ConfigEntryState,
    ConfigFlowResult,
    ConfigSubentryData,
    ConfigSubentryFlow,
    OptionsFlow,
)
from homeassistant.const import CONF_DEVICE
from homeassistant.core import callback
from homeassistant.data_entry_flow import AbortFlow

from .configuration import line_settings, protocol_of
from .const import (
    CONF_COMMAND,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_PROTOCOL,
    CONF_SUPPLY_LIMIT,
    DOMAIN,
    SUBENTRY_CHARGER,
)
from .coordinator import EvseBusConfigEntry
from .evse.errors import RefusedOrderError
from .evse.protocol import Progress, Protocol
from .evse.protocols import PROTOCOLS
from .evse.scan import ScanResult
from .flows.address import ADDRESSES, Errors, typed_addresses
from .flows.charger import CONF_EXPERT, short_name
from .flows.listener import ListenerOptionsFlow, ListenerSteps
from .flows.schema import (
    SUGGESTED_LIMIT,
    bus_data,
    check_impose,
    impose_form,
    port_form,
    port_suggestions,
    protocol_form,
)
from .flows.search import (
    Imposed,
    async_search,
    async_try_port,
    imposed,
    is_same_port,
    nothing_imposed,
    port_name,
)
from .flows.subentry import ChargerSubentryFlow
from .flows.supply import check_supply, supply_data, supply_form

_INTERFACES: Final = {"ews": "RS-232"}
"""Interface of the adapter, where it is not RS-485."""
_URL_EXAMPLES: Final = "`socket://192.0.2.5:4001`, `rfc2217://192.0.2.5:2217`"
"""Not translated: URLs are the same in every language."""


class EvseBusConfigFlow(ListenerSteps, domain=DOMAIN):
    """Config flow for one bus."""

    VERSION = 1
    MINOR_VERSION = 1

    at_once = True
    step_after_error = "port"

    def __init__(self) -> None:
        """Start without a search."""
        super().__init__()
        self._searches: list[Imposed] = []

    @classmethod
    @callback
    @override
    def async_get_supported_subentry_types(
        cls, config_entry: EvseBusConfigEntry
    ) -> dict[str, type[ConfigSubentryFlow]]:
        """Return the subentry types of a bus."""
        # An ignored box is an entry, too, without data.
        if CONF_PROTOCOL not in config_entry.data:
            return {}
        return {SUBENTRY_CHARGER: ChargerSubentryFlow}

    @classmethod
    @callback
    @override
    def async_supports_options_flow(cls, config_entry: EvseBusConfigEntry) -> bool:
        """Return whether it is a listener: only that has options."""
        return CONF_PROTOCOL in config_entry.data and (
            protocol_of(config_entry.data).dials_in
        )

    @staticmethod
    @callback
    @override
    def async_get_options_flow(config_entry: EvseBusConfigEntry) -> OptionsFlow:
        """Return the options flow of a listener."""
        return ListenerOptionsFlow()

    # -- Protocol and port -------------------------------------------------------

    @override
    async def async_step_user(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Choose the make of the chargers."""
        if user_input is not None:
            make = user_input[CONF_PROTOCOL]
            if make == "smartevse":
                return await self.async_step_mode()
            if make == "ews":
                return await self.async_step_connection()
            self.protocol = PROTOCOLS[make]
            return await self.async_step_port()
        return self.async_show_form(step_id="user", data_schema=protocol_form())

    async def async_step_mode(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ConfigFlowResult:
        """Choose whether Home Assistant polls a SmartEVSE or is its master."""
        return self.async_show_menu(step_id="mode", menu_options=["polled", "master"])

    async def async_step_polled(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ConfigFlowResult:
        """Set up one polled SmartEVSE."""
        self.protocol = PROTOCOLS["smartevse"]
        return await self.async_step_port()

    async def async_step_master(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ConfigFlowResult:
        """Set up the load-balancing master of several SmartEVSEs."""
        self.protocol = PROTOCOLS["smartevse_master"]
        return await self.async_step_port()

    async def async_step_connection(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ConfigFlowResult:
        """Choose how an EWS-Box is connected."""
        return self.async_show_menu(
            step_id="connection", menu_options=["ews_serial", "ews_network"]
        )

    async def async_step_ews_serial(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ConfigFlowResult:
        """Set up one EWS-Box on RS-232."""
        self.protocol = PROTOCOLS["ews"]
        return await self.async_step_port()

    async def async_step_port(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Choose the port, and try to open it; nothing is sent."""
        errors = self.take_error()
        if user_input is not None:
            errors = await self._async_check_port(self.protocol, user_input)
            if not errors:
                if self.protocol.probe_sets_limits:
                    return await self.async_step_impose()
                self._searches = nothing_imposed(self.protocol)
                if self.protocol.master is not None:
                    return await self.async_step_supply()
                return await self.async_step_scan()
        usual = self.protocol.settings
        return self.async_show_form(
            step_id="port",
            data_schema=self.add_suggested_values_to_schema(
                port_form(usual), user_input
            ),
            errors=errors,
            description_placeholders=_port_placeholders(self.protocol),
        )

    async def _async_check_port(
        self,
        protocol: Protocol,
        typed: dict[str, Any],
        entry: EvseBusConfigEntry | None = None,
    ) -> Errors:
        """Set `bus_data`, or return the errors.

        ``entry`` is the one being reconfigured. Aborts if another bus uses the port.
        """
        try:
            self.bus_data = bus_data(protocol, typed)
        except RefusedOrderError:
            return {"base": "bad_baudrate"}
        device = self.bus_data[CONF_DEVICE]
        if not device:
            return {CONF_DEVICE: "no_port"}
        for other in self._async_current_entries(include_ignore=False):
            if protocol_of(
                other.data
            ).dials_in or not await self.hass.async_add_executor_job(
                is_same_port, device, other.data[CONF_DEVICE]
            ):
                continue
            if other is not entry:
                raise AbortFlow("already_configured")
            if entry.state is ConfigEntryState.LOADED:
                # This entry has the port open, so it exists and is not busy.
                return {}
        error = await async_try_port(device, line_settings(self.bus_data))
        return {"base": error} if error else {}

    # -- Shared supply, where Home Assistant is the master -----------------------

    async def async_step_supply(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Ask for the limit of all chargers together."""
        errors: Errors = {}
        if user_input is not None:
            errors = check_supply(user_input)
            if not errors:
                supply = supply_data(user_input)
                self.bus_data |= supply
                # No charger gets more than the shared limit.
                limit = min(SUGGESTED_LIMIT, supply[CONF_SUPPLY_LIMIT])
                self.suggestions |= supply | {CONF_INSTALLATION_LIMIT: limit}
                return await self.async_step_scan()
        return self.async_show_form(
            step_id="supply",
            data_schema=self.add_suggested_values_to_schema(
                supply_form(self.protocol), self.suggestions | (user_input or {})
            ),
            errors=errors,
            description_placeholders=self.placeholders(),
        )

    # -- Limits to set, where a search needs them --------------------------------

    async def async_step_impose(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ConfigFlowResult:
        """Warn that a search sets limits, and choose how to search."""
        return self.async_show_menu(
            step_id="impose",
            menu_options=["search_single", "search_addresses", "manual"],
            description_placeholders=self.placeholders(),
        )

    async def async_step_search_single(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Ask for the limits of the one box on a point-to-point line."""
        return await self._async_impose("search_single", user_input)

    async def async_step_search_addresses(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Ask for the addresses to search, and for the limits of these boxes."""
        return await self._async_impose("search_addresses", user_input)

    async def _async_impose(
        self, step_id: str, user_input: dict[str, Any] | None
    ) -> ConfigFlowResult:
        single = step_id == "search_single"
        errors: Errors = {}
        if user_input is not None:
            errors = check_impose(self.protocol, user_input)
            any_address = ADDRESSES[self.protocol.key].any
            addresses = [any_address] if single and any_address is not None else []
            if not single:
                addresses, wrong = typed_addresses(self.protocol, user_input)
                errors |= wrong
            if not errors:
                self._searches = imposed(self.protocol, addresses, user_input)
                self.suggestions |= {
                    key: user_input[key]
                    for key in (
                        CONF_INSTALLATION_LIMIT,
                        CONF_FAIL_SAFE_CURRENT,
                        CONF_FAIL_SAFE_TIMEOUT,
                    )
                }
                if single:
                    command = user_input[CONF_COMMAND]
                    self.suggestions[CONF_EXPERT] = {CONF_COMMAND: command}
                return await self.async_step_scan()
        return self.async_show_form(
            step_id=step_id,
            data_schema=self.add_suggested_values_to_schema(
                impose_form(self.protocol, ask_addresses=not single),
                self.suggestions | (user_input or {}),
            ),
            errors=errors,
            description_placeholders=self.placeholders(),
        )

    # -- Search and store --------------------------------------------------------

    @override
    def choices(self) -> tuple[str, ...]:
        """Return the steps to offer when a search has found nothing to add."""
        other_values = ("impose",) if self.protocol.probe_sets_limits else ()
        return ("scan", *other_values, "manual", "port")

    @override
    async def async_scan(self, progress: Progress) -> ScanResult:
        """Open the port for a search, and close it again in any case."""
        bus = self.protocol.bus(
            self.bus_data[CONF_DEVICE], settings=line_settings(self.bus_data)
        )
        try:
            await bus.start()
            return await async_search(self.protocol, bus, self._searches, progress)
        finally:
            await bus.stop()

    @override
    def finish(self, chargers: list[ConfigSubentryData]) -> ConfigFlowResult:
        """Create the config entry of the bus, with its chargers."""
        if self._listener is not None:
            return self.add_box(chargers)
        # Another flow may have added the bus in the meantime.
        self._async_abort_entries_match({CONF_DEVICE: self.bus_data[CONF_DEVICE]})
        return self.async_create_entry(
            title=_title(self.bus_data), data=self.bus_data, subentries=chargers
        )

    # -- Reconfiguration ---------------------------------------------------------

    async def async_step_reconfigure(
        self, user_input: dict[str, Any] | None = None
    ) -> ConfigFlowResult:
        """Change the port or its settings."""
        entry = self._get_reconfigure_entry()
        protocol = protocol_of(entry.data)
        if protocol.dials_in:
            return await self.async_step_reconfigure_listen()
        errors: Errors = {}
        if user_input is not None:
            errors = check_supply(user_input)
            errors |= await self._async_check_port(protocol, user_input, entry)
            if not errors:
                self.bus_data |= supply_data(user_input)
                # A title set by the user stays.
                is_own = entry.title != _title(entry.data)
                title = entry.title if is_own else _title(self.bus_data)
                # The update listener of a loaded entry reloads it.
                update = (
                    self.async_update_and_abort
                    if entry.update_listeners
                    else self.async_update_reload_and_abort
                )
                return update(entry, title=title, data=self.bus_data)
        suggestions = port_suggestions(entry.data, line_settings(entry.data))
        suggestions |= supply_data(entry.data)
        return self.async_show_form(
            step_id="reconfigure",
            data_schema=self.add_suggested_values_to_schema(
                port_form(protocol.settings, supply_form(protocol)),
                user_input or suggestions,
            ),
            errors=errors,
            description_placeholders=_port_placeholders(protocol),
        )


def _port_placeholders(protocol: Protocol) -> dict[str, str]:
    return {
        "protocol": protocol.name,
        "interface": _INTERFACES.get(protocol.key, "RS-485"),
        "settings": str(protocol.settings),
        "examples": _URL_EXAMPLES,
    }


def _title(data: Mapping[str, Any]) -> str:
    """Return the default title of a bus."""
    return f"{short_name(protocol_of(data))} bus ({port_name(data[CONF_DEVICE])})"
