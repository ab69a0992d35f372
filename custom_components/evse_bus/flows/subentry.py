"""Add one charger to a bus that is set up, or change its set-up."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, override

from homeassistant.config_entries import (
    ConfigEntryState,
    ConfigSubentry,
    ConfigSubentryData,
    ConfigSubentryFlow,
    SubentryFlowContext,
    SubentryFlowResult,
)
from homeassistant.const import CONF_ADDRESS, CONF_NAME

from ..configuration import charger_unique_id, protocol_of
from ..connections import Connections, ListenerConnections
from ..const import (
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_SERIAL,
    SUBENTRY_CHARGER,
)
from ..evse.errors import NotAvailableError
from ..evse.scan import Address, ScanResult
from .address import ADDRESSES, Errors, typed_addresses
from .charger import (
    charger_data,
    charger_form,
    charger_suggestions,
    check_charger,
)
from .listener import found_box
from .search import async_search, nothing_imposed
from .steps import ChargerSteps

if TYPE_CHECKING:
    from ..coordinator import EvseBusConfigEntry
    from ..evse.protocol import Progress


class ChargerSubentryFlow(
    ChargerSteps[SubentryFlowContext, SubentryFlowResult, tuple[str, str]],
    ConfigSubentryFlow,
):
    """Add or change one charger."""

    at_once = False
    step_after_error = "manual"

    @override
    def others(self) -> list[ConfigSubentry]:
        """Return the other chargers of the bus."""
        own = self.context.get("subentry_id")
        return [
            one
            for one in self._get_entry().get_subentries_of_type(SUBENTRY_CHARGER)
            if one.subentry_id != own
        ]

    async def async_step_user(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> SubentryFlowResult:
        """Choose how to find the charger."""
        entry = self._get_entry()
        self.protocol = protocol_of(entry.data)
        self.bus_data = dict(entry.data)
        if self._is_full():
            return self.async_abort(reason=self._full_reason)
        # A search that sets limits is left to the charger's own first turn; and
        # the address that every box answers to is not for a bus with others on it.
        searchable = not (self.protocol.probe_sets_limits or self.protocol.dials_in)
        if not searchable or entry.state is not ConfigEntryState.LOADED:
            return await self.async_step_manual()
        return self.async_show_menu(
            step_id="user",
            menu_options=list(self.choices()),
            description_placeholders=self.placeholders(),
        )

    @property
    def _full_reason(self) -> str:
        return "one_ews_box" if self.protocol.key == "ews" else "one_box"

    def _is_full(self) -> bool:
        """Return whether no further charger can be on this bus."""
        return ADDRESSES[self.protocol.key].alone and bool(self.others())

    def _lines(self) -> Connections | None:
        """Return the lines of the bus; ``None``: it is not set up now."""
        entry: EvseBusConfigEntry = self._get_entry()
        if entry.state is not ConfigEntryState.LOADED:
            return None
        return entry.runtime_data.connections

    @override
    def waiting(self) -> list[str]:
        """Return the serial numbers of boxes that have dialled and are not set up."""
        lines = self._lines()
        if not isinstance(lines, ListenerConnections):
            return []
        strangers = lines.listener.strangers
        self._report = ScanResult(
            found=tuple(found_box(one.serial, one.firmware) for one in strangers)
        )
        return [one.serial for one in strangers]

    @override
    async def async_scan(self, progress: Progress) -> ScanResult:
        """Search between the turns of the chargers that are running."""
        lines = self._lines()
        if lines is None or lines.shared_bus is None:
            raise NotAvailableError(self._get_entry().title)
        searches = nothing_imposed(self.protocol)
        return await async_search(self.protocol, lines.shared_bus, searches, progress)

    @override
    def finish(self, chargers: list[ConfigSubentryData]) -> SubentryFlowResult:
        """Create the charger."""
        [charger] = chargers
        # Another dialogue may have been quicker.
        if self._is_full():
            return self.async_abort(reason=self._full_reason)
        if charger["data"][CONF_ADDRESS] in self.taken():
            return self.async_abort(reason="already_configured")
        return self.async_create_entry(
            title=charger["title"],
            data=charger["data"],
            unique_id=charger["unique_id"],
        )

    # -- Reconfiguration ---------------------------------------------------------

    async def async_step_reconfigure(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Change a charger's set-up, or where and who it is."""
        entry = self._get_entry()
        subentry = self._get_reconfigure_subentry()
        self.protocol = protocol_of(entry.data)
        errors: Errors = {}
        if user_input is not None:
            addresses, errors = typed_addresses(self.protocol, user_input, self.taken())
            others = self.others()
            errors |= check_charger(user_input, [one.data for one in others])
            if not errors:
                [address] = addresses
                serial = self._serial(address, user_input)
                identity = charger_unique_id(self.protocol.key, serial, address)
                if identity in {one.unique_id for one in others}:
                    errors["base"] = "already_configured"
                elif self.is_elsewhere(address, but=subentry):
                    errors["base"] = "box_already_set_up"
                else:
                    data = charger_data(address, serial, user_input)
                    return self.async_update_and_abort(
                        entry,
                        subentry,
                        unique_id=identity,
                        title=user_input[CONF_NAME].strip(),
                        data=data | _fail_safe(subentry.data, data),
                    )
        return self.async_show_form(
            step_id="reconfigure" if self.protocol.ports == 1 else "reconfigure_box",
            data_schema=self.add_suggested_values_to_schema(
                charger_form(self.protocol, ask_address=True, new=False),
                user_input or charger_suggestions(self.protocol, subentry),
            ),
            errors=errors,
            description_placeholders={"name": subentry.title},
        )

    async def async_step_reconfigure_box(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Change the same of a box with ports of its own: it has texts of its own."""
        return await self.async_step_reconfigure(user_input)

    def _serial(self, address: Address, typed: dict[str, Any]) -> str | None:
        form = ADDRESSES[self.protocol.key]
        if form.is_serial:
            return form.serial(address)
        return typed.get(CONF_SERIAL, "").strip() or None


def _fail_safe(stored: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fail-safe values first confirmed, within the new limit."""
    kept = {
        CONF_FAIL_SAFE_CURRENT: min(
            stored[CONF_FAIL_SAFE_CURRENT], new[CONF_INSTALLATION_LIMIT]
        )
    }
    if CONF_FAIL_SAFE_TIMEOUT in stored:
        kept[CONF_FAIL_SAFE_TIMEOUT] = stored[CONF_FAIL_SAFE_TIMEOUT]
    return kept
