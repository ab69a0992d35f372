"""Flow of a subentry: add a charger to a bus, or reconfigure it."""

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
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

from ..chargers.kinds import Member, find_mix
from ..configuration import protocol_of
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
from ..identity import another_box, another_box_texts, kept_data
from .address import Errors, another_form, typed_addresses
from .charger import (
    NO,
    charger_data,
    charger_form,
    charger_suggestions,
    check_charger,
)
from .listener import found_box
from .search import async_search, read_only_probe
from .steps import ChargerSteps

if TYPE_CHECKING:
    from ..coordinator import EvseBusConfigEntry
    from ..evse.bus import Bus
    from ..evse.protocol import Progress


class ChargerSubentryFlow(
    ChargerSteps[SubentryFlowContext, SubentryFlowResult, tuple[str, str]],
    ConfigSubentryFlow,
):
    """Flow that adds or reconfigures one charger."""

    adds_several = False
    step_after_error = "manual"

    def __init__(self) -> None:
        """Start with the choice of what to change."""
        super().__init__()
        self._settings = False
        """The configuration is being changed, not the charger itself."""

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
        # A search that sets limits would reach the running chargers, too.
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
        return f"one_{self.protocol.make.key}"

    def _is_full(self) -> bool:
        """Return whether no further charger can be on this bus."""
        return self.protocol.address.single and bool(self.others())

    def _connections(self) -> Connections | None:
        """Return the connections of the bus; ``None``: it is not loaded."""
        entry: EvseBusConfigEntry = self._get_entry()
        if entry.state is not ConfigEntryState.LOADED:
            return None
        return entry.runtime_data.connections

    @override
    def waiting(self) -> list[str]:
        """Return the serial numbers of unknown boxes that are connected."""
        connections = self._connections()
        if not isinstance(connections, ListenerConnections):
            return []
        unknown = connections.listener.unknown_boxes
        self._result = ScanResult(found=tuple(map(found_box, unknown)))
        return [one.serial for one in unknown]

    @override
    async def async_scan(self, progress: Progress) -> ScanResult:
        """Search between the turns of the running chargers."""
        async with self.started_bus() as bus:
            probe = read_only_probe(self.protocol)
            return await async_search(self.protocol, bus, [probe], progress)

    @override
    @asynccontextmanager
    async def started_bus(self) -> AsyncIterator[Bus]:
        if (bus := self._running_bus()) is None:
            raise NotAvailableError(self._get_entry().title)
        yield bus

    def _running_bus(self) -> Bus | None:
        connections = self._connections()
        return None if connections is None else connections.shared_bus

    @override
    def finish(self, chargers: list[ConfigSubentryData]) -> SubentryFlowResult:
        """Create the charger."""
        [charger] = chargers
        # Another flow may have added it in the meantime.
        if self._is_full():
            return self.async_abort(reason=self._full_reason)
        if charger["data"][CONF_ADDRESS] in self.taken():
            return self.async_abort(reason="already_configured")
        if (other := self.find_held()) is not None:
            return self.abort_held(other)
        if (refused := self.abort_mix()) is not None:
            return refused
        return self.async_create_entry(
            title=charger["title"],
            data=charger["data"],
            unique_id=charger["unique_id"],
        )

    # -- Reconfiguration ---------------------------------------------------------

    async def async_step_reconfigure(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Change the configuration of a charger, its address or serial number."""
        entry = self._get_entry()
        subentry = self._get_reconfigure_subentry()
        self.protocol = protocol_of(entry.data)
        if user_input is None and not self._settings:
            new_address = ["new_address"] if self._can_change_address() else []
            return self.async_show_menu(
                step_id="change",
                menu_options=["settings", *new_address, "replace"],
                description_placeholders={"name": subentry.title},
            )
        stored = subentry.data
        known: str | None = stored.get(CONF_SERIAL)
        errors: Errors = {}
        mix: str | None = None
        if user_input is not None:
            asked = known is None or not self.protocol.address.is_serial
            address, errors = self._address(subentry, user_input, asked=asked)
            beside = [one.data for one in self.others()]
            errors |= check_charger(self.protocol, user_input, beside)
            serial = known or self._typed_serial(address, user_input)
            if not errors and known is None and self.find_holder([serial], subentry):
                errors["base"] = "box_already_set_up"
            if not errors:
                title = user_input[CONF_NAME].strip()
                data = charger_data(self.protocol, address, serial, user_input)
                data |= kept_data(self.protocol, subentry)
                own = Member(address, data, title)
                others = map(Member.of_stored, self.others())
                mix = find_mix(self.protocol, [*others, own])
                if mix is None:
                    return self.async_update_and_abort(
                        entry,
                        subentry,
                        title=title,
                        data=data | _fail_safe(stored, data),
                    )
                errors["base"] = "mixed_firmware"
        form = charger_form(
            self.protocol, ask_address=True, ask_serial=known is None, new=False
        )
        return self.async_show_form(
            step_id="reconfigure" if self.protocol.ports == 1 else "reconfigure_box",
            data_schema=self.add_suggested_values_to_schema(
                form, user_input or charger_suggestions(self.protocol, subentry)
            ),
            errors=errors,
            description_placeholders={
                "name": subentry.title,
                "holder": self.held_by,
                "chargers": mix or NO,
            },
        )

    async def async_step_reconfigure_box(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Change the same of a box with several ports, with texts of its own."""
        return await self.async_step_reconfigure(user_input)

    async def async_step_settings(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> SubentryFlowResult:
        """Change the configuration, not the charger itself."""
        self._settings = True
        return await self.async_step_reconfigure()

    def _address(
        self, subentry: ConfigSubentry, typed: Mapping[str, Any], *, asked: bool
    ) -> tuple[Address, Errors]:
        """Return the address in a form, else the present one, and the errors.

        ``asked``: the form has a field for it.
        """
        present: Address = subentry.data[CONF_ADDRESS]
        if not asked:
            return present, {}
        addresses, errors = typed_addresses(self.protocol.address, typed, self.taken())
        return next(iter(addresses), present), errors

    def _typed_serial(self, address: Address, typed: Mapping[str, Any]) -> str | None:
        form = self.protocol.address
        if form.is_serial:
            return form.serial(address)
        return typed.get(CONF_SERIAL, "").strip() or None

    # -- Another box -------------------------------------------------------------

    async def async_step_replace(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Let another box take the place of one, with its names and settings."""
        subentry = self._get_reconfigure_subentry()
        form = self.protocol.address
        field = form.key if form.is_serial else CONF_SERIAL
        present = subentry.data.get(CONF_SERIAL)
        errors: Errors = {}
        if user_input is not None:
            address, errors = self._address(subentry, user_input, asked=form.is_serial)
            serial = self._typed_serial(address, user_input)
            if not errors and serial is not None and serial == present:
                errors[field] = "same_box"
            if not errors and self.find_holder([serial], subentry):
                errors[field] = "box_already_set_up"
            if not errors:
                change = another_box(self.protocol, subentry, address, serial)
                return self.async_update_and_abort(
                    self._get_entry(), subentry, **change
                )
        found = self._other_serial(subentry)
        return self.async_show_form(
            step_id="replace",
            data_schema=self.add_suggested_values_to_schema(
                another_form(form, known=self.waiting()),
                user_input or ({field: found} if found else {}),
            ),
            errors=errors,
            description_placeholders={
                **another_box_texts(self.protocol, subentry),
                "holder": self.held_by,
            },
        )

    def _other_serial(self, subentry: ConfigSubentry) -> str | None:
        """Return the serial number of the box that answers in a charger's place."""
        entry: EvseBusConfigEntry = self._get_entry()
        if entry.state is not ConfigEntryState.LOADED:
            return None
        return entry.runtime_data.other_serial(subentry.subentry_id)

    # -- Another address, over the wire ------------------------------------------

    def _can_change_address(self) -> bool:
        return (
            self.protocol.change_address is not None and self._running_bus() is not None
        )

    async def async_step_change(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Choose what to change; a page that is loaded again asks for this step."""
        return await self.async_step_reconfigure(user_input)

    async def async_step_new_address(
        self, user_input: dict[str, Any] | None = None
    ) -> SubentryFlowResult:
        """Ask for the new address of the charger."""
        subentry = self._get_reconfigure_subentry()
        self.moving = subentry.data.get(CONF_SERIAL) or self.moving
        old = int(subentry.data[CONF_ADDRESS])
        return await self.async_ask_address(
            ("new_address", "address_changed"),
            [old],
            user_input,
            name=subentry.title,
        )

    async def async_step_address_changed(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> SubentryFlowResult:
        """Report the new address, which is stored since the charger has moved."""
        reason = "address_changed"
        if self.changed is not None and self.changed.enabled:
            reason = "address_changed_enabled"
        elif self.changed is not None and self.changed.old_in_use:
            reason = "address_changed_old_in_use"
        name = self._get_reconfigure_subentry().title
        return self.async_abort(
            reason=reason,
            description_placeholders=self.change_texts() | {"name": name},
        )

    @override
    def used_addresses(self) -> set[Address]:
        own = self.context.get("subentry_id")
        subentry = self._get_entry().subentries.get(own or "")
        used = super().used_addresses()
        return used if subentry is None else used | {subentry.data[CONF_ADDRESS]}


def _fail_safe(stored: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fail-safe values of the first form, within the new limit."""
    kept = {
        CONF_FAIL_SAFE_CURRENT: min(
            stored[CONF_FAIL_SAFE_CURRENT], new[CONF_INSTALLATION_LIMIT]
        )
    }
    if CONF_FAIL_SAFE_TIMEOUT in stored:
        kept[CONF_FAIL_SAFE_TIMEOUT] = stored[CONF_FAIL_SAFE_TIMEOUT]
    return kept
