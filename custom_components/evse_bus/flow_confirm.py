"""The last step: what happens when we fall silent, for each protocol its own words."""

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

from homeassistant.config_entries import ConfigSubentryData
from homeassistant.data_entry_flow import FlowContext, FlowHandler, FlowResult

from .flow_charger import confirm_row
from .flow_supply import supply_texts

if TYPE_CHECKING:
    from .evse.protocol import Protocol


class ConfirmSteps[
    ContextT: FlowContext,
    ResultT: FlowResult[Any, Any],
    HandlerT,
](FlowHandler[ContextT, ResultT, HandlerT]):
    """From chargers that are ready to be stored to a user who knows what that means."""

    def __init__(self) -> None:
        """Start with nothing to store."""
        super().__init__()
        self.protocol: Protocol
        self.bus_data: dict[str, Any]
        """Data of the bus's entry."""
        self.ready: list[ConfigSubentryData] = []

    @abstractmethod
    def finish(self, chargers: list[ConfigSubentryData]) -> ResultT:
        """Store the chargers."""

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
