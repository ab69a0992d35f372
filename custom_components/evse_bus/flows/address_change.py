"""Flow steps that give a charger another address over the wire.

From two places: a search has found several chargers at one address, and one charger is
being reconfigured.
"""

from abc import abstractmethod
import asyncio
from collections.abc import Sequence
from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING, Any, Final

from homeassistant.data_entry_flow import (
    AbortFlow,
    FlowContext,
    FlowHandler,
    FlowResult,
)
from homeassistant.helpers.selector import BooleanSelector
import probatio as vol

from ..const import LOGGER
from ..evse.address_change import (
    AddressChange,
    AddressChanged,
    AddressChangeError,
    Problem,
)
from ..evse.errors import LineBusyError, LineLostError, NotAvailableError
from .address import Errors, address_field, numbers
from .progress import async_show_long_enough
from .search import error_key

if TYPE_CHECKING:
    from ..evse.bus import Bus
    from ..evse.protocol import Protocol
    from ..evse.scan import Address

CONF_OLD: Final = "old_address"
CONF_NEW: Final = "new_address"
CONF_UNPLUGGED: Final = "unplugged"

NOT_BEGUN: Final = "address_not_begun"
"""Key of the text where the bus could not be used, and nothing was written."""

UNKNOWN: Final = "?"
"""In texts, a value that is not known."""

_HALFWAY: Final = frozenset(
    {
        Problem.IN_SET_UP,
        Problem.SECOND_CHARGER,
        Problem.BOTH,
        Problem.SEVERAL_AT_NEW,
        Problem.LOST,
        Problem.INTERRUPTED,
    }
)
"""After these the same charger must be meant when it is tried again."""


class AddressSteps[
    ContextT: FlowContext,
    ResultT: FlowResult[Any, Any],
    HandlerT,
](FlowHandler[ContextT, ResultT, HandlerT]):
    """Steps from the request for another address to its result."""

    def __init__(self) -> None:
        """Start without a change."""
        super().__init__()
        self.protocol: Protocol
        self.moving: str | None = None
        """Serial number of the charger that is meant, if it is known."""
        self._given: set[Address] = set()
        """Addresses given in this flow."""
        self._asked_by = ""
        """Step that asks for the address; shown again after a failure."""
        self._reported_by = ""
        """Step that reports the new one."""
        self._change: AddressChange | None = None
        self._change_task: asyncio.Task[AddressChanged] | None = None
        self.changed: AddressChanged | None = None
        """The result of the last change, if it has succeeded."""
        self._failed: Exception | None = None

    # -- Differences between the flows -----------------------------------------------

    @abstractmethod
    def started_bus(self) -> AbstractAsyncContextManager[Bus]:
        """Return the bus, started; one that was not before is stopped again."""

    @abstractmethod
    def shared_addresses(self) -> tuple[int, ...]:
        """Return the addresses at which several chargers answer."""

    @abstractmethod
    def used_addresses(self) -> set[Address]:
        """Return the addresses that are not free."""

    @abstractmethod
    def placeholders(self) -> dict[str, str]:
        """Return the placeholders of the bus for texts."""

    # -- Several chargers at one address ---------------------------------------------

    async def async_step_sort_out(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Ask to switch off all chargers but one, and for an address for that one."""
        shared = self.shared_addresses()
        return await self.async_ask_address(
            ("sort_out", "sorted_out"), shared, user_input
        )

    async def async_step_sorted_out(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002 - a step's signature
    ) -> ResultT:
        """Report the new address; go on with the next charger or the search."""
        self.moving = None
        if self.changed is not None and self.changed.enabled:
            return self._sorted_out("sorted_out_enabled")
        return self._sorted_out("sorted_out")

    async def async_step_sorted_out_enabled(
        self, user_input: dict[str, Any] | None = None
    ) -> ResultT:
        """Report also that its outlet could not be disabled again."""
        return await self.async_step_sorted_out(user_input)

    def _sorted_out(self, step_id: str) -> ResultT:
        return self.async_show_menu(
            step_id=step_id,
            menu_options=["sort_out", "scan"],
            description_placeholders=self.placeholders() | self.change_texts(),
        )

    # -- Which address ---------------------------------------------------------------

    async def async_ask_address(
        self,
        steps: tuple[str, str],
        old: Sequence[int],
        user_input: dict[str, Any] | None,
        **texts: str,
    ) -> ResultT:
        """Ask for the new address of the charger at one of some old ones.

        ``steps``: the one that asks, and the one that reports the new address.
        ``texts``: more placeholders.
        """
        self._asked_by, self._reported_by = steps
        used = self.used_addresses() | self._given
        free = [one for one in numbers(self.protocol.address) if one not in used]
        if not free:
            raise AbortFlow("no_address_free")
        errors: Errors = {}
        if user_input is not None:
            self._change = AddressChange(
                old=int(user_input.get(CONF_OLD, old[0])),
                new=int(user_input[CONF_NEW]),
                serial=self.moving,
                unplugged=user_input.get(CONF_UNPLUGGED, False),
            )
            return await self.async_step_change_address()
        if self._failed is not None:
            errors["base"] = _error_key(self._failed)
        label = self.protocol.address.label
        shown = {"addresses": ", ".join(map(label, old))}
        if self._change is None:
            texts["old"] = label(old[0])
        return self.async_show_form(
            step_id=self._asked_by,
            data_schema=self._address_form(old, free),
            errors=errors,
            description_placeholders=shown | self.change_texts() | texts,
        )

    def _address_form(self, old: Sequence[int], free: Sequence[int]) -> vol.Schema:
        form, tried = self.protocol.address, self._change
        fields: dict[vol.Marker, object] = {}
        if len(old) > 1:
            chosen = tried.old if tried is not None and tried.old in old else old[0]
            fields[vol.Required(CONF_OLD, default=str(chosen))] = address_field(
                form, only=old
            )
        chosen = tried.new if tried is not None and tried.new in free else free[0]
        fields[vol.Required(CONF_NEW, default=str(chosen))] = address_field(
            form, only=free
        )
        if _problem(self._failed) is Problem.CAR_UNKNOWN:
            fields[vol.Required(CONF_UNPLUGGED, default=False)] = BooleanSelector()
        return vol.Schema(fields)

    def change_texts(self) -> dict[str, str]:
        """Return the placeholders of the last change for texts."""
        label, change = self.protocol.address.label, self._change
        texts = {
            "old": UNKNOWN if change is None else label(change.old),
            "new": UNKNOWN if change is None else label(change.new),
            "serial": self.moving or UNKNOWN,
            "state": UNKNOWN,
        }
        if isinstance(self._failed, AddressChangeError):
            texts |= self._failed.details
        if self.changed is not None:
            texts["serial"] = self.changed.serial
        return texts

    # -- The change ------------------------------------------------------------------

    async def async_step_change_address(
        self,
        user_input: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> ResultT:
        """Change the address, and show the progress."""
        if self._change_task is None:
            self._failed = self.changed = None
            # The flow manager cancels it when the flow is closed. What has been begun
            # in the charger is then brought to its end by the bus.
            self._change_task = self.hass.async_create_background_task(
                async_show_long_enough(self._async_change()),
                "evse_bus address change",
            )
        if not self._change_task.done():
            return self.async_show_progress(
                step_id="change_address",
                progress_action="change_address",
                description_placeholders=self.change_texts(),
                progress_task=self._change_task,
            )
        task, self._change_task = self._change_task, None
        if isinstance(error := task.exception(), Exception):
            self._failed = error
            if _problem(error) in _HALFWAY and isinstance(error, AddressChangeError):
                self.moving = error.details["serial"]
            return self.async_show_progress_done(next_step_id=self._asked_by)
        self.changed = task.result()
        if self._change is not None:
            self._given.add(self._change.new)
        return self.async_show_progress_done(next_step_id=self._reported_by)

    async def _async_change(self) -> AddressChanged:
        change = self.protocol.change_address
        if change is None or self._change is None:
            message = f"{self.protocol.name} has no addresses to change"
            raise NotAvailableError(message)
        async with self.started_bus() as bus:
            return await change(bus, self._change, self.async_update_progress)


def _problem(error: Exception | None) -> Problem | None:
    return error.problem if isinstance(error, AddressChangeError) else None


def _error_key(error: Exception) -> str:
    """Return the key of the text for a failed change."""
    if isinstance(error, AddressChangeError):
        LOGGER.info("No address was changed: %s", error)
        return f"address_{error.problem}"
    if isinstance(error, LineLostError | LineBusyError | NotAvailableError):
        return NOT_BEGUN
    return error_key(error)
