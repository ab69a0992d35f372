"""Flow steps common to adding a bus and adding a charger: search, name, confirm."""

from abc import abstractmethod
import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, override

from homeassistant.config_entries import ConfigSubentry, ConfigSubentryData
from homeassistant.const import CONF_ADDRESS, CONF_NAME
from homeassistant.data_entry_flow import FlowContext, FlowResult

from ..chargers.kinds import Member, find_mix
from ..configuration import line_settings
from ..connections import connection_name, line_memory
from ..const import CONF_INSTALLATION_LIMIT, SUBENTRY_CHARGER
from ..evse.model import FailSafe
from ..evse.scan import Address, ScanResult
from ..identity import Holder, holder, identity_data
from ..issues import load_texts, speed_texts
from .address import Errors, manual_form, typed_addresses
from .address_change import AddressSteps
from .charger import (
    NO,
    Candidate,
    charger_data,
    charger_form,
    check_charger,
    confirm_row,
    default_name,
)
from .progress import async_show_long_enough
from .schema import (
    CONF_CHARGERS,
    SUGGESTED_LIMIT,
    check_currents,
    found_form,
    found_options,
)
from .search import error_key, overload_of
from .supply import supply_texts

if TYPE_CHECKING:
    from ..evse.protocol import Progress
    from ..evse.scan import FoundCharger


type Step[ResultT] = Callable[[dict[str, Any] | None], Awaitable[ResultT]]
"""A step of a flow: takes the filled-in form, if any."""


class ChargerSteps[
    ContextT: FlowContext,
    ResultT: FlowResult[Any, Any],
    HandlerT,
](AddressSteps[ContextT, ResultT, HandlerT]):
    """Steps from a bus to the data of its new chargers."""

    adds_several: ClassVar[bool]
    """Several chargers can be added in one flow."""
    step_after_error: ClassVar[str]
    """Step after a failed search; it shows `take_error`."""

    def __init__(self) -> None:
        """Start without chargers."""
        super().__init__()
        self.bus_data: dict[str, Any]
        """Data of the config entry of the bus."""
        self.ready: list[ConfigSubentryData] = []
        self.suggestions: dict[str, Any] = {}
        """Values typed so far that the next forms suggest."""
        self._scan_task: asyncio.Task[ScanResult] | None = None
        self._result = ScanResult()
        self._error: str | None = None
        self._pending: list[Candidate] = []
        self._unproven: list[str] = []
        """Names of new chargers that may not stop by themselves."""
        self.held_by = NO
        """Where a box is set up already that was typed in, for texts."""

    def add_step(self, step_id: str, step: Step[ResultT]) -> str:
        """Add a step whose texts are those of one protocol; return its id.

        The flow manager finds a step by the name of its method.
        """
        setattr(self, f"async_step_{step_id}", step)
        return step_id

    # -- Differences between the two flows ---------------------------------------

    @abstractmethod
    async def async_scan(self, progress: Progress) -> ScanResult:
        """Search the bus; leave a port closed that was closed before."""

    @abstractmethod
    def finish(self, chargers: list[ConfigSubentryData]) -> ResultT:
        """Store the chargers and end the flow."""

    def choices(self) -> tuple[str, ...]:
        """Return the steps to offer when a search has found nothing to add."""
        return ("scan", "manual")

    def others(self) -> list[ConfigSubentry]:
        """Return the other chargers of the bus."""
        return []

    def taken(self) -> set[Address]:
        """Return their addresses."""
        return {one.data[CONF_ADDRESS] for one in self.others()}

    def waiting(self) -> list[str]:
        """Return the addresses of unknown boxes that are connected."""
        return []

    @property
    def several(self) -> bool:
        """Return whether several chargers can be added now."""
        return self.adds_several and not self.protocol.address.single

    # -- Search ------------------------------------------------------------------

    async def async_step_scan(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ResultT:
        """Search, and show the progress."""
        if self._scan_task is None:
            # The flow manager cancels it when the flow is closed.
            self._scan_task = self.hass.async_create_background_task(
                async_show_long_enough(self.async_scan(self.async_update_progress)),
                "evse_bus search",
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
        self._result = task.result()
        return self.async_show_progress_done(next_step_id=self._step_after_scan())

    def _step_after_scan(self) -> str:
        result, trip = self._result, self._result.round_trip
        steps = {
            "other_master": result.other_master,
            "modbus_tcp": result.gateway,
            "mixed_firmware": self._mix_found(),
            "duplicates": result.duplicates,
            "select": self._new(),
            "nothing_new": result.found,
            "replies_too_late": trip is not None and trip.too_slow,
            "foreign_requests": result.foreign_requests,
            "unreadable": result.unreadable,
        }
        return next(
            (step for step, applies in steps.items() if applies), "nothing_found"
        )

    def _new(self) -> list[FoundCharger]:
        return [one for one in self._result.found if self._holder_of(one) is None]

    def _holder_of(self, found: FoundCharger) -> str | None:
        """Return where a charger is set up already, or another at its address."""
        if (other := self.holder(found.serial)) is not None:
            return other.name
        titles = {one.data[CONF_ADDRESS]: one.title for one in self.others()}
        return titles.get(found.address)

    def _held(self) -> str:
        """Return where the chargers found are set up already, for texts."""
        names = map(self._holder_of, self._result.found)
        return ", ".join(name for name in names if name is not None) or NO

    def take_error(self) -> Errors:
        """Return the error of the step before this form, once."""
        error, self._error = self._error, None
        return {"base": error} if error else {}

    async def async_step_nothing_found(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report that no charger answered, and offer what to try."""
        return self._menu("nothing_found")

    async def async_step_foreign_requests(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report that nothing answered, but that another station sends requests."""
        return self._menu("foreign_requests")

    async def async_step_modbus_tcp(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report an adapter that speaks Modbus TCP and passes nothing on."""
        return self._menu("modbus_tcp")

    async def async_step_nothing_new(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report that only chargers answered that are set up already."""
        return self._menu("nothing_new", held=self._held())

    async def async_step_unreadable(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report that no frame could be made of the bytes received."""
        return self._menu("unreadable")

    async def async_step_duplicates(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report that several chargers answer at one address."""
        label = self.protocol.address.label
        addresses = ", ".join(label(one) for one in self._result.duplicates)
        first = ("select",) if self._new() else ()
        if self.protocol.change_address is not None:
            first = ("sort_out", *first)
        return self._menu("duplicates", first, addresses=addresses)

    @override
    def shared_addresses(self) -> tuple[int, ...]:
        return self._result.duplicates

    @override
    def used_addresses(self) -> set[Address]:
        found = {one.address for one in self._result.found}
        return self.taken() | found | set(self._result.duplicates)

    def _mix_found(self) -> str | None:
        """Return the boxes on the line, where one bus cannot have them all."""
        return find_mix(
            self.protocol,
            [
                *map(Member.of_stored, self.others()),
                *map(Member.of_found, self._result.found),
            ],
        )

    async def async_step_mixed_firmware(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Refuse boxes that one bus cannot have together: some have to leave it."""
        return self.async_show_menu(
            step_id="mixed_firmware",
            menu_options=[one for one in self.choices() if one != "manual"],
            description_placeholders=self.placeholders()
            | {"chargers": self._mix_found() or NO},
        )

    def abort_mix(self) -> ResultT | None:
        """Abort where one bus cannot have all its boxes, perhaps since just now.

        ``None``: it can, as far as is known.
        """
        running = map(Member.of_stored, self.others())
        mix = find_mix(self.protocol, [*running, *map(Member.of_stored, self.ready)])
        if mix is None:
            return None
        return self.async_abort(
            reason="mixed_firmware", description_placeholders={"chargers": mix}
        )

    async def async_step_other_master(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report another master on the line; Home Assistant must be silent."""
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
        """Return the placeholders of the bus for texts."""
        return {
            "port": connection_name(self.bus_data),
            "protocol": self.protocol.name,
            "settings": str(line_settings(self.bus_data)),
            "holder": self.held_by,
        }

    # -- Which chargers ----------------------------------------------------------

    async def async_step_select(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Choose from the chargers found."""
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
            description_placeholders=self.placeholders() | {"held": self._held()},
        )

    async def async_step_manual(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Type the addresses of the chargers."""
        errors = self.take_error()
        form = self.protocol.address
        if form.optional and form.any is not None:
            # One box on the line: its form asks for the serial number.
            return await self.async_begin([Candidate(address=form.any)])
        if user_input is not None:
            addresses, errors = typed_addresses(form, user_input, self.taken())
            if self.find_holder(map(form.serial, addresses)):
                errors[form.key] = "box_already_set_up"
            if not errors:
                found = {one.address: one for one in self._result.found}
                return await self.async_begin(
                    Candidate(address=address, found=found.get(address))
                    for address in addresses
                )
        return self.async_show_form(
            step_id="manual",
            data_schema=self.add_suggested_values_to_schema(
                manual_form(form, multiple=self.several, known=self.waiting()),
                user_input,
            ),
            errors=errors,
            description_placeholders=self.placeholders(),
        )

    # -- One charger after the other ---------------------------------------------

    async def async_begin(self, candidates: Iterable[Candidate]) -> ResultT:
        """Begin with the form for the first charger."""
        self._pending = list(candidates)
        self.ready = []
        self._unproven = []
        return await self.async_step_charger()

    async def async_step_charger(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Ask for the name and limits of one charger after the other."""
        errors: Errors = {}
        if user_input is not None:
            errors = self._take_charger(self._pending[0], user_input)
            if not errors:
                self._pending.pop(0)
                user_input = None
                if not self._pending:
                    return await self.async_step_fail_safe_unproven()
        candidate = self._pending[0]
        if (other := self.holder(candidate.serial(self.protocol))) is not None:
            return self.abort_held(other)
        address = self.protocol.address
        limit = self.suggestions.get(CONF_INSTALLATION_LIMIT, SUGGESTED_LIMIT)
        offered = {
            CONF_NAME: default_name(self.protocol, candidate.address),
            address.key: address.show(candidate.address),
            **self.suggestions,
            **candidate.suggestions(self.protocol, limit),
        }
        return self.async_show_form(
            step_id="charger" if self.protocol.ports == 1 else "box",
            data_schema=self.add_suggested_values_to_schema(
                charger_form(
                    self.protocol, ask_serial=candidate.address == address.any
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
        """Ask the same for a box with several ports, with texts of its own."""
        return await self.async_step_charger(user_input)

    def holder(self, serial: str | None) -> Holder | None:
        """Return where a box is set up already, on this or any other bus."""
        return holder(self.hass, self.protocol.identity(serial))

    def find_holder(
        self, serials: Iterable[str | None], but: ConfigSubentry | None = None
    ) -> bool:
        """Return whether one of some boxes is set up already; name it in the texts.

        ``but`` is the subentry being reconfigured.
        """
        identities = map(self.protocol.identity, serials)
        found = (holder(self.hass, one, but) for one in identities)
        other = next(filter(None, found), None)
        self.held_by = NO if other is None else other.name
        return other is not None

    def abort_held(self, other: Holder) -> ResultT:
        """Abort: the box is set up already, perhaps by another flow just now."""
        return self.async_abort(
            reason="box_already_set_up",
            description_placeholders={"holder": other.name},
        )

    def find_held(self) -> Holder | None:
        """Return where one of the new boxes was set up while this flow was open."""
        found = (holder(self.hass, one["unique_id"]) for one in self.ready)
        return next(filter(None, found), None)

    def _take_charger(self, candidate: Candidate, typed: dict[str, Any]) -> Errors:
        others = self.others()
        # Nothing is known yet of the chargers that follow, but they count.
        expected: list[Mapping[str, Any]] = [one.data for one in others]
        expected += [one["data"] for one in self.ready]
        expected += [{} for _ in self._pending[1:]]
        errors = check_charger(self.protocol, typed, expected)
        form = self.protocol.address
        if form.key in typed:
            # Found without its serial number, which can be typed here.
            addresses, wrong = typed_addresses(form, typed, self.taken())
            errors |= wrong
            if addresses:
                candidate = Candidate(address=addresses[0])
        serial = candidate.serial(self.protocol)
        if self.find_holder([serial]):
            errors["base"] = "box_already_set_up"
        if not errors:
            data = charger_data(self.protocol, candidate.address, serial, typed)
            if (found := candidate.found) is not None:
                data |= found.facts
                if found.fail_safe is FailSafe.UNPROVEN:
                    self._unproven.append(typed[CONF_NAME].strip())
            self.ready.append(
                ConfigSubentryData(
                    data=data | identity_data(self.protocol, serial),
                    subentry_type=SUBENTRY_CHARGER,
                    title=typed[CONF_NAME].strip(),
                    unique_id=self.protocol.identity(serial),
                )
            )
        return errors

    # -- Fail-safe ---------------------------------------------------------------

    async def async_step_fail_safe_unproven(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Warn of boxes of which it is not known that they stop by themselves."""
        if user_input is not None or not self._unproven:
            return await self.async_step_line_too_slow()
        return self.async_show_form(
            step_id="fail_safe_unproven",
            description_placeholders=self.placeholders()
            | {"chargers": ", ".join(self._unproven)},
            last_step=False,
        )

    # -- Speed of the line -------------------------------------------------------

    async def async_step_replies_too_late(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Report replies that come later than the protocol can wait for them."""
        trip = self._result.round_trip
        texts = {} if trip is None else speed_texts(trip)
        return self._menu("replies_too_late", (), **texts)

    async def async_step_line_too_slow(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Warn of deadlines that cannot be kept at the speed of the line."""
        trip = self._result.round_trip
        if user_input is not None or trip is None:
            return await self._async_confirm()
        overload = overload_of(
            self.bus_data,
            [*self.others(), *self.ready],
            trip,
            line_memory(self.hass, connection_name(self.bus_data)),
        )
        if overload is None:
            return await self._async_confirm()
        return self.async_show_form(
            step_id="line_too_slow",
            description_placeholders=self.placeholders()
            | speed_texts(trip)
            | load_texts(overload),
            last_step=False,
        )

    # -- Confirm -----------------------------------------------------------------

    async def _async_confirm(self, user_input: dict[str, Any] | None = None) -> ResultT:
        """Show the summary, with the protocol's own fail-safe; then store."""
        # A reloaded page asks for the step without having confirmed it.
        if user_input is not None:
            return self.finish(self.ready)
        rows = (confirm_row(self.protocol, one) for one in self.ready)
        return self.async_show_form(
            step_id=self.add_step(f"confirm_{self.protocol.key}", self._async_confirm),
            description_placeholders=supply_texts(self.bus_data)
            | {"chargers": "\n".join(rows)},
            last_step=True,
        )
