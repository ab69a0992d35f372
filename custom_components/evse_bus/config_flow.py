"""Config flow of a bus: protocol, port, search, chargers; reconfiguration."""

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
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
from .connections import line_memory
from .const import (
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_PROTOCOL,
    CONF_SUPPLY_LIMIT,
    DOMAIN,
    SUBENTRY_CHARGER,
)
from .coordinator import EvseBusConfigEntry
from .evse.bus import Bus
from .evse.errors import LineLostError, RefusedOrderError
from .evse.gateway import speaks_modbus_tcp
from .evse.protocol import Progress, Protocol
from .evse.protocols import protocols_by_make
from .evse.scan import ScanResult
from .flows.address import Errors, typed_addresses
from .flows.charger import CONF_EXPERT
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
    Probe,
    async_search,
    async_try_port,
    is_same_port,
    is_same_url,
    port_name,
    probes,
    read_only_probe,
)
from .flows.subentry import ChargerSubentryFlow
from .flows.supply import check_supply, supply_data, supply_form

_URL_EXAMPLES: Final = "`socket://192.0.2.5:4001`, `rfc2217://192.0.2.5:2217`"
"""Not translated: URLs are the same in every language."""


class EvseBusConfigFlow(ListenerSteps, domain=DOMAIN):
    """Config flow for one bus."""

    VERSION = 1
    MINOR_VERSION = 1

    adds_several = True
    step_after_error = "port"

    def __init__(self) -> None:
        """Start without a search."""
        super().__init__()
        self._protocols: list[Protocol] = []
        """Protocols of the chosen make."""
        self._searches: list[Probe] = []

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
            self._protocols = protocols_by_make()[user_input[CONF_PROTOCOL]]
            if len(self._protocols) == 1:
                return await self._async_use(self._protocols[0])
            return await self._async_choose_protocol()
        return self.async_show_form(step_id="user", data_schema=protocol_form())

    async def _async_choose_protocol(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ConfigFlowResult:
        """Choose one of several protocols of a make."""
        menu = self._protocols[0].make.menu
        return self.async_show_menu(
            step_id=self.add_step(menu, self._async_choose_protocol),
            menu_options=[
                self.add_step(protocol.choice, partial(self._async_use, protocol))
                for protocol in self._protocols
            ],
        )

    async def _async_use(
        self,
        protocol: Protocol,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ConfigFlowResult:
        """Set up a bus of this protocol, or a listener if its boxes dial."""
        self.protocol = protocol
        if protocol.dials_in:
            return await self.async_step_listen()
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
                self._searches = [read_only_probe(self.protocol)]
                if self.protocol.circuit is not None:
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
            return {"base": "bad_line_settings"}
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
            form = self.protocol.address
            addresses = [form.any] if single and form.any is not None else []
            if not single:
                addresses, wrong = typed_addresses(form, user_input)
                errors |= wrong
            if not errors:
                self._searches = probes(self.protocol, addresses, user_input)
                self.suggestions |= {
                    key: user_input[key]
                    for key in (
                        CONF_INSTALLATION_LIMIT,
                        CONF_FAIL_SAFE_CURRENT,
                        CONF_FAIL_SAFE_TIMEOUT,
                    )
                }
                if single:
                    self.suggestions[CONF_EXPERT] = {
                        option.name: user_input[option.name]
                        for option in self.protocol.options
                        if option.before_search
                    }
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
        lost: LineLostError | None = None
        result = ScanResult()
        try:
            async with self.started_bus() as bus:
                result = await async_search(
                    self.protocol, bus, self._searches, progress
                )
        except LineLostError as error:
            lost = error
        if not result.found and not result.gateway:
            # The bus is closed again: an adapter may accept one connection only.
            gateway = await speaks_modbus_tcp(
                self.bus_data[CONF_DEVICE],
                line_settings(self.bus_data),
                closes=lost is not None,
            )
            result = replace(result, gateway=gateway)
        if lost is not None and not result.gateway:
            raise lost
        return result

    @override
    @asynccontextmanager
    async def started_bus(self) -> AsyncIterator[Bus]:
        bus = self.protocol.bus(
            self.bus_data[CONF_DEVICE],
            settings=line_settings(self.bus_data),
            memory=line_memory(self.hass, self.bus_data[CONF_DEVICE]),
        )
        try:
            await bus.start()
            yield bus
        finally:
            await bus.stop()

    @override
    def finish(self, chargers: list[ConfigSubentryData]) -> ConfigFlowResult:
        """Create the config entry of the bus, with its chargers."""
        if self._listener is not None:
            return self.add_box(chargers)
        # Another flow may have added the bus in the meantime.
        device = self.bus_data[CONF_DEVICE]
        for other in self._async_current_entries(include_ignore=False):
            if is_same_url(device, other.data.get(CONF_DEVICE, "")):
                return self.async_abort(reason="already_configured")
        if (held := self.find_held()) is not None:
            return self.abort_held(held)
        if (refused := self.abort_mix()) is not None:
            return refused
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
        "interface": protocol.interface,
        "settings": str(protocol.settings),
        "examples": _URL_EXAMPLES,
    }


def _title(data: Mapping[str, Any]) -> str:
    """Return the default title of a bus."""
    return f"{protocol_of(data).make.name} bus ({port_name(data[CONF_DEVICE])})"
