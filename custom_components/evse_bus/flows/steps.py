"""Steps that adding a bus and adding a charger share: search, name, confirm."""

from abc import abstractmethod
import asyncio
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from homeassistant.config_entries import ConfigSubentry, ConfigSubentryData
from homeassistant.const import CONF_ADDRESS, CONF_NAME
from homeassistant.data_entry_flow import FlowContext, FlowHandler, FlowResult

from ..configuration import charger_unique_id, line_settings
from ..connections import connection_name
from ..const import (
    CONF_INSTALLATION_LIMIT,
    SUBENTRY_CHARGER,
)
from ..discovery import box_unique_id, is_set_up
from ..evse.scan import Address, ScanResult
from .address import ADDRESSES, Errors, manual_form, typed_addresses
from .charger import (
    Candidate,
    charger_data,
    charger_form,
    check_charger,
    confirm_row,
    default_name,
)
from .schema import (
    CONF_CHARGERS,
    SUGGESTED_LIMIT,
    check_currents,
    found_form,
    found_options,
    model_name,
)
from .search import error_key
from .supply import supply_texts

if TYPE_CHECKING:
    from ..evse.protocol import Progress, Protocol
    from ..evse.scan import FoundCharger


class ChargerSteps[
    ContextT: FlowContext,
    ResultT: FlowResult[Any, Any],
    HandlerT,
](FlowHandler[ContextT, ResultT, HandlerT]):
    """From a bus to chargers that are ready to be stored."""

    at_once: ClassVar[bool]
    """More than one charger can be added at once."""
    step_after_error: ClassVar[str]
    """Where one goes when it could not be made; shows `take_error`."""

    def __init__(self) -> None:
        """Start with nothing found."""
        super().__init__()
        self.protocol: Protocol
        self.bus_data: dict[str, Any]
        """Data of the bus's entry."""
        self.ready: list[ConfigSubentryData] = []
        self.suggestions: dict[str, Any] = {}
        """Values typed so far that the next forms offer again."""
        self._scan_task: asyncio.Task[ScanResult] | None = None
        self._report = ScanResult()
        self._error: str | None = None
        self._pending: list[Candidate] = []

    # -- What the two flows do differently ---------------------------------------

    @abstractmethod
    async def async_scan(self, progress: Progress) -> ScanResult:
        """Search the bus; leave no port open that was not open before."""

    @abstractmethod
    def finish(self, chargers: list[ConfigSubentryData]) -> ResultT:
        """Store the chargers."""

    def choices(self) -> tuple[str, ...]:
        """Return where one can go when a search brought nothing to add."""
        return ("scan", "manual")

    def others(self) -> list[ConfigSubentry]:
        """Return the chargers that the bus has already."""
        return []

    def taken(self) -> set[Address]:
        """Return their addresses."""
        return {one.data[CONF_ADDRESS] for one in self.others()}

    def waiting(self) -> list[str]:
        """Return the addresses of those that have dialled and wait to be added."""
        return []

    @property
    def several(self) -> bool:
        """Return whether more than one charger can be added now."""
        return self.at_once and not ADDRESSES[self.protocol.key].alone

    # -- Search ------------------------------------------------------------------

    async def async_step_scan(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ResultT:
        """Search, and show how far it is."""
        if self._scan_task is None:
            # The flow manager cancels it when the flow is closed.
            # It must not be over at once: the manager would hand what was typed
            # last to the step that comes after the search.
            self._scan_task = self.hass.async_create_background_task(
                self.async_scan(self.async_update_progress),
                "evse_bus search",
                eager_start=False,
            )
        if not self._scan_task.done():
            return self.async_show_progress(
                step_id="scan",
                progress_action=f"scan_{self.protocol.key}",
                description_placeholders=self.placeholders(),
                progress_task=self._scan_task,
            )
        task, self._scan_task = self._scan_task, None
        if isinstance(error := task.exception(), Exception):
            self._error = error_key(error)
            return self.async_show_progress_done(next_step_id=self.step_after_error)
        self._report = task.result()
        return self.async_show_progress_done(next_step_id=self._step_after_scan())

    def _step_after_scan(self) -> str:
        if self._report.other_master:
            return "other_master"
        if self._report.duplicates:
            return "duplicates"
        if self._report.unsupported:
            return "unsupported"
        if self._new():
            return "select"
        if self._report.found:
            return "nothing_new"
        return "unreadable" if self._report.unreadable else "nothing_found"

    def _new(self) -> list[FoundCharger]:
        taken = self.taken()
        return [one for one in self._report.found if one.address not in taken]

    def take_error(self) -> Errors:
        """Return what went wrong before this form, once."""
        error, self._error = self._error, None
        return {"base": error} if error else {}

    async def async_step_nothing_found(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Say that nobody answered, and what to try."""
        return self._menu("nothing_found")

    async def async_step_nothing_new(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Say that only chargers answered that are there already."""
        return self._menu("nothing_new")

    async def async_step_unreadable(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Say that something answered that makes no sense."""
        return self._menu("unreadable")

    async def async_step_duplicates(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Say that several chargers answer at one address."""
        show = ADDRESSES[self.protocol.key].show
        addresses = ", ".join(show(one) for one in self._report.duplicates)
        first = ("select",) if self._new() else ()
        return self._menu("duplicates", first, addresses=addresses)

    async def async_step_unsupported(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Say that chargers answered whose firmware cannot be used like this."""
        show = ADDRESSES[self.protocol.key].show
        chargers = "\n".join(
            f"- {show(one.address)}: {model_name(one)}"
            for one in self._report.unsupported
        )
        first = ("select",) if self._new() else ()
        return self._menu("unsupported", first, chargers=chargers)

    async def async_step_other_master(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Say that there is a master already, so that we must be silent."""
        return self._menu("other_master")

    def _menu(
        self, step_id: str, first: tuple[str, ...] = (), **placeholders: str
    ) -> ResultT:
        return self.async_show_menu(
            step_id=step_id,
            menu_options=[*first, *self.choices()],
            description_placeholders=self.placeholders() | placeholders,
        )

    def placeholders(self) -> dict[str, str]:
        """Return what texts may name of the bus."""
        return {
            "port": connection_name(self.bus_data),
            "protocol": self.protocol.name,
            "settings": str(line_settings(self.bus_data)),
        }

    # -- Which chargers ----------------------------------------------------------

    async def async_step_select(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Choose from what was found."""
        found = self._new()
        errors: Errors = {}
        if user_input is not None:
            chosen = user_input[CONF_CHARGERS]
            errors = check_currents(user_input)
            if not chosen:
                errors[CONF_CHARGERS] = "nothing_chosen"
            if not errors:
                if CONF_INSTALLATION_LIMIT in user_input:
                    limit = user_input[CONF_INSTALLATION_LIMIT]
                    self.suggestions[CONF_INSTALLATION_LIMIT] = limit
                wanted = {chosen} if isinstance(chosen, str) else set(chosen)
                return await self.async_begin(
                    Candidate(address=one.address, found=one)
                    for one in found
                    if str(one.address) in wanted
                )
        form = found_form(found_options(self.protocol, found), multiple=self.several)
        return self.async_show_form(
            step_id="select",
            data_schema=self.add_suggested_values_to_schema(
                form, self.suggestions | (user_input or {})
            ),
            errors=errors,
            description_placeholders=self.placeholders(),
        )

    async def async_step_manual(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Type where the chargers are."""
        errors = self.take_error()
        form = ADDRESSES[self.protocol.key]
        if form.optional and form.any is not None:
            # There is one on such a line: the form for the charger asks the rest.
            return await self.async_begin([Candidate(address=form.any)])
        if user_input is not None:
            addresses, errors = typed_addresses(self.protocol, user_input, self.taken())
            if any(self.is_elsewhere(one) for one in addresses):
                errors[form.one] = "box_already_set_up"
            if not errors:
                told = {one.address: one for one in self._report.found}
                return await self.async_begin(
                    Candidate(address=address, found=told.get(address))
                    for address in addresses
                )
        return self.async_show_form(
            step_id="manual",
            data_schema=self.add_suggested_values_to_schema(
                manual_form(self.protocol, multiple=self.several, known=self.waiting()),
                user_input,
            ),
            errors=errors,
            description_placeholders=self.placeholders(),
        )

    # -- One charger after the other ---------------------------------------------

    async def async_begin(self, candidates: Iterable[Candidate]) -> ResultT:
        """Ask for the first charger's name and limits."""
        self._pending = list(candidates)
        self.ready = []
        return await self.async_step_charger()

    async def async_step_charger(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Ask for one charger's name and limits; again for the next."""
        errors: Errors = {}
        if user_input is not None:
            errors = self._take_charger(self._pending[0], user_input)
            if not errors:
                self._pending.pop(0)
                user_input = None
                if not self._pending:
                    return self.confirm()
        candidate = self._pending[0]
        address = ADDRESSES[self.protocol.key]
        limit = self.suggestions.get(CONF_INSTALLATION_LIMIT, SUGGESTED_LIMIT)
        offered = {
            CONF_NAME: default_name(self.protocol, candidate.address),
            address.one: address.show(candidate.address),
            **self.suggestions,
            **candidate.suggestions(self.protocol, limit),
        }
        return self.async_show_form(
            step_id="charger" if self.protocol.ports == 1 else "box",
            data_schema=self.add_suggested_values_to_schema(
                charger_form(
                    self.protocol, ask_address=candidate.address == address.any
                ),
                user_input or offered,
            ),
            errors=errors,
            description_placeholders=self.placeholders()
            | candidate.placeholders(self.protocol)
            | {
                "number": str(len(self.ready) + 1),
                "total": str(len(self.ready) + len(self._pending)),
            },
        )

    async def async_step_box(self, user_input: dict[str, Any] | None = None) -> ResultT:
        """Ask the same for a box with ports of its own: it has texts of its own."""
        return await self.async_step_charger(user_input)

    def is_elsewhere(self, address: Address, but: ConfigSubentry | None = None) -> bool:
        """Return whether a box, which can be connected in two ways, is set up in one.

        ``but``: the one that is being changed.
        """
        serial = ADDRESSES[self.protocol.key].serial(address)
        return (
            self.protocol.ports > 1
            and serial is not None
            and is_set_up(self.hass, box_unique_id(serial), but)
        )

    def _take_charger(self, candidate: Candidate, typed: dict[str, Any]) -> Errors:
        others = self.others()
        # Of those that are still to come nothing is known, but they will be there.
        expected: list[Mapping[str, Any]] = [one.data for one in others]
        expected += [one["data"] for one in self.ready]
        expected += [{} for _ in self._pending[1:]]
        errors = check_charger(typed, expected)
        if ADDRESSES[self.protocol.key].one in typed:
            # Found without its serial number: here it can be given.
            addresses, wrong = typed_addresses(self.protocol, typed, self.taken())
            errors |= wrong
            if addresses:
                candidate = Candidate(address=addresses[0])
        serial = candidate.serial(self.protocol)
        identity = charger_unique_id(self.protocol.key, serial, candidate.address)
        if identity in {one.unique_id for one in others}:
            errors["base"] = "already_configured"
        if self.is_elsewhere(candidate.address):
            errors["base"] = "box_already_set_up"
        if not errors:
            self.ready.append(
                ConfigSubentryData(
                    data=charger_data(candidate.address, serial, typed),
                    subentry_type=SUBENTRY_CHARGER,
                    title=typed[CONF_NAME].strip(),
                    unique_id=identity,
                )
            )
        return errors

    # -- Confirm: each protocol explains its own fail-safe ------------------------

    def confirm(self, user_input: dict[str, Any] | None = None) -> ResultT:
        """Show what will be stored, or store it now that it is confirmed."""
        # A page that is loaded again asks for the step without having confirmed.
        if user_input is not None:
            return self.finish(self.ready)
        rows = (confirm_row(self.protocol, one) for one in self.ready)
        return self.async_show_form(
            step_id=f"confirm_{self.protocol.key}",
            description_placeholders=supply_texts(self.bus_data)
            | {"chargers": "\n".join(rows)},
            last_step=True,
        )

    async def async_step_confirm_evbox(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Store, now that the user knows an EVBox's fail-safe."""
        return self.confirm(user_input)

    async def async_step_confirm_abl(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Store, now that the user knows that an ABL box has none."""
        return self.confirm(user_input)

    async def async_step_confirm_smartevse(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Store, now that the user knows that a polled SmartEVSE has none."""
        return self.confirm(user_input)

    async def async_step_confirm_smartevse_master(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Store, now that the user knows that slaves stop without us."""
        return self.confirm(user_input)

    async def async_step_confirm_ews(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Store, now that the user knows what an EWS-Box does without its server."""
        return self.confirm(user_input)

    async def async_step_confirm_ews_network(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Store, now that the user knows what it does when it cannot dial."""
        return self.confirm(user_input)
