"""Repair flows: a problem that the user solves with a confirmation."""

from typing import TYPE_CHECKING

from homeassistant.components.repairs import RepairsFlow
from homeassistant.const import CONF_ADDRESS
from homeassistant.helpers import issue_registry as ir
import probatio as vol

from .configuration import protocol_of
from .const import CONF_ENTRY, CONF_SERIAL, CONF_SUBENTRY
from .identity import another_box, holder

if TYPE_CHECKING:
    from homeassistant.components.repairs import RepairsFlowResult
    from homeassistant.core import HomeAssistant

    from .issues import Fix


async def async_create_fix_flow(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    issue_id: str,  # noqa: ARG001
    data: Fix | None,  # noqa: ARG001
) -> RepairsFlow:
    """Return the flow for the one kind of issue that can be fixed here."""
    return AnotherBoxFlow()


class AnotherBoxFlow(RepairsFlow):
    """Let the box that answers in the place of a charger take that place."""

    async def async_step_init(
        self,
        user_input: dict[str, str] | None = None,  # noqa: ARG002 - a step's signature
    ) -> RepairsFlowResult:
        """Begin with the confirmation."""
        return await self.async_step_confirm()

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
        issue = ir.async_get(self.hass).async_get_issue(self.handler, self.issue_id)
        return self.async_show_form(
            step_id="confirm",
            data_schema=vol.Schema({}),
            description_placeholders=(
                None if issue is None else issue.translation_placeholders
            ),
        )
