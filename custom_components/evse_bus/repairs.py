"""Repair flows: a problem that the user solves with a confirmation."""

from math import floor
from typing import TYPE_CHECKING

from homeassistant.components.repairs import RepairsFlow
from homeassistant.config_entries import ConfigEntryState
from homeassistant.const import CONF_ADDRESS
from homeassistant.helpers import issue_registry as ir
import probatio as vol

from .configuration import protocol_of
from .const import CONF_ENTRY, CONF_SERIAL, CONF_SUBENTRY
from .evse.model import Setting
from .flows.progress import async_show_long_enough
from .identity import another_box, holder
from .issues import BEGINS_ABOVE_LIMIT

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Mapping

    from homeassistant.components.repairs import RepairsFlowResult
    from homeassistant.core import HomeAssistant

    from .chargers.managed import ManagedCharger
    from .coordinator import EvseBusConfigEntry
    from .issues import Fix


async def async_create_fix_flow(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    issue_id: str,
    data: Fix | None,  # noqa: ARG001
) -> RepairsFlow:
    """Return the flow for an issue that can be fixed here."""
    if issue_id.startswith(BEGINS_ABOVE_LIMIT):
        return LowerMaximumFlow()
    return AnotherBoxFlow()


class FixFlow(RepairsFlow):
    """A flow that begins with a confirmation."""

    async def async_step_init(
        self,
        user_input: dict[str, str] | None = None,  # noqa: ARG002 - a step's signature
    ) -> RepairsFlowResult:
        """Begin with the confirmation."""
        return await self.async_step_confirm()

    async def async_step_confirm(
        self, user_input: dict[str, str] | None = None
    ) -> RepairsFlowResult:
        """Say what is done; on submission it is."""
        raise NotImplementedError

    @property
    def shown(self) -> Mapping[str, str] | None:
        """Return the placeholders of the issue."""
        issue = ir.async_get(self.hass).async_get_issue(self.handler, self.issue_id)
        return None if issue is None else issue.translation_placeholders

    def ask(self) -> RepairsFlowResult:
        """Show the confirmation."""
        return self.async_show_form(
            step_id="confirm",
            data_schema=vol.Schema({}),
            description_placeholders=self.shown,
        )


class AnotherBoxFlow(FixFlow):
    """Let the box that answers in the place of a charger take that place."""

    async def async_step_confirm(
        self, user_input: dict[str, str] | None = None
    ) -> RepairsFlowResult:
        """Say what the new box takes over; on submission it does."""
        found = self.data or {}
        entries = self.hass.config_entries
        entry = entries.async_get_entry(str(found[CONF_ENTRY]))
        subentry_id = str(found[CONF_SUBENTRY])
        if entry is None or (subentry := entry.subentries.get(subentry_id)) is None:
            return self.async_abort(reason="charger_gone")
        protocol = protocol_of(entry.data)
        serial = str(found[CONF_SERIAL])
        if (other := holder(self.hass, protocol.identity(serial))) is not None:
            return self.async_abort(
                reason="box_already_set_up",
                description_placeholders={"holder": other.name},
            )
        if user_input is not None:
            form = protocol.address
            address = subentry.data[CONF_ADDRESS]
            if form.is_serial and address != form.any:
                address = form.parse(serial)
            change = another_box(protocol, subentry, address, serial)
            entries.async_update_subentry(entry, subentry, **change)
            return self.async_create_entry(data={})
        return self.ask()


class LowerMaximumFlow(FixFlow):
    """Lower the maximum in the memory of a box to what its wiring carries."""

    def __init__(self) -> None:
        """Begin before anything was written."""
        super().__init__()
        self._writing: asyncio.Task[None] | None = None
        self._texts: dict[str, str] = {}
        """Placeholders of the issue, which ends with the read-back."""

    async def async_step_confirm(
        self, user_input: dict[str, str] | None = None
    ) -> RepairsFlowResult:
        """Say what is written, and what for; on submission it is."""
        self._texts = dict(self.shown or {})
        if user_input is not None:
            return await self.async_step_write()
        return self.ask() if self._managed() is not None else self._gone()

    async def async_step_write(
        self,
        user_input: dict[str, str] | None = None,  # noqa: ARG002 - a step's signature
    ) -> RepairsFlowResult:
        """Write once, and show the progress until it was read back."""
        if self._writing is None:
            managed = self._managed()
            if managed is None:
                return self._gone()
            charger = managed.charger
            limit = floor(charger.config.installation_limit)
            lowering = charger.configure(
                Setting.MAXIMUM_CURRENT, limit, only_lower=True
            )
            # Closing the dialogue ends the wait, not what was begun on the line.
            self._writing = self.hass.async_create_background_task(
                async_show_long_enough(lowering), "evse_bus lower maximum"
            )
        if not self._writing.done():
            return self.async_show_progress(
                step_id="write",
                progress_action="write",
                description_placeholders=self._texts,
                progress_task=self._writing,
            )
        error = self._writing.exception()
        next_step = "done" if error is None else "failed"
        return self.async_show_progress_done(next_step_id=next_step)

    async def async_step_done(
        self,
        user_input: dict[str, str] | None = None,  # noqa: ARG002 - a step's signature
    ) -> RepairsFlowResult:
        """End: it was read back."""
        return self.async_create_entry(data={})

    async def async_step_failed(
        self,
        user_input: dict[str, str] | None = None,  # noqa: ARG002 - a step's signature
    ) -> RepairsFlowResult:
        """Say why it is not certain."""
        error = self._writing.exception() if self._writing is not None else None
        return self.async_abort(
            reason="not_lowered",
            description_placeholders=self._texts | {"error": str(error)},
        )

    def _managed(self) -> ManagedCharger | None:
        """Return the charger; ``None``: it is not set up now."""
        data = self.data or {}
        entry: EvseBusConfigEntry | None = self.hass.config_entries.async_get_entry(
            str(data[CONF_ENTRY])
        )
        if entry is None or entry.state is not ConfigEntryState.LOADED:
            return None
        chargers = entry.runtime_data.chargers.values()
        wanted = data[CONF_SUBENTRY]
        return next((one for one in chargers if one.subentry_id == wanted), None)

    def _gone(self) -> RepairsFlowResult:
        return self.async_abort(reason="charger_gone")
