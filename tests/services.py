"""Helpers of the tests that call the actions for an EWS-Box."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from unittest.mock import patch

from homeassistant.core import Context, HomeAssistant
from homeassistant.exceptions import HomeAssistantError, ServiceValidationError
from homeassistant.helpers import device_registry as dr
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.ews import services as library
from tests.common import call, get_entity, identity, running, wait_until
from tests.flow import english
from tests.virtual import VirtualBus
from tests.virtual.ews_box import EwsBox

ADMIN_PASSWORD = "verysecret"  # noqa: S105 - the virtual box's
CARD_PIN = "Px7q"
USER_PASSWORD = "alsosecret"  # noqa: S105 - the virtual box's


WRITERS = {
    "system": "write_system_parameters",
    "network": "write_network_parameters",
    "installation": "write_installation_info",
    "extra": "write_extra_parameters",
}
"""The action that writes each block of parameters."""
WRITES = ("cr", "ma", "se", "sf", "sp", "su", "si", "sz")
"""Commands by which actions change something at the box."""


class Scene:
    """A virtual EWS-Box that is set up in Home Assistant."""

    def __init__(
        self, hass: HomeAssistant, entry: MockConfigEntry, bus: VirtualBus, box: EwsBox
    ) -> None:
        self.hass = hass
        self.entry = entry
        self.bus = bus
        self.box = box

    def device(self, port: int | None = None) -> str:
        """Return the id of the device of the box, or of one of its ports."""
        registry = dr.async_get(self.hass)
        key = identity(self.entry)
        device: dr.AnyDeviceEntry | None
        if port is None:
            device = registry.async_get_device_by_identifier(
                (DOMAIN, key), self.entry.entry_id
            )
        else:
            device = registry.async_get_child_device_by_identifier(
                (DOMAIN, f"{key}_{port}"), self.entry.entry_id
            )
        assert device is not None
        return device.id

    async def act(
        self,
        action: str,
        port: int | None = None,
        *,
        device: str | None = None,
        context: Context | None = None,
        **data: object,
    ) -> None:
        """Carry out an action that returns nothing."""
        await self.hass.services.async_call(
            DOMAIN,
            action,
            {"device_id": device or self.device(port), **data},
            blocking=True,
            context=context,
        )

    async def ask(
        self, action: str, port: int | None = None, **data: object
    ) -> dict[str, Any]:
        """Return the response of an action."""
        response = await self.hass.services.async_call(
            DOMAIN,
            action,
            {"device_id": self.device(port), **data},
            blocking=True,
            return_response=True,
        )
        assert isinstance(response, dict)
        return response

    async def refuses(
        self,
        action: str,
        key: str,
        port: int | None = None,
        *,
        kind: type[HomeAssistantError] = ServiceValidationError,
        **data: object,
    ) -> str:
        """Carry out an action that fails; return the text that people see."""
        with pytest.raises(kind) as caught:
            await self.act(action, port, **data)
        error = caught.value
        assert type(error) is kind
        assert error.translation_key == key
        return said(error)

    async def fails_to_ask(self, action: str, key: str, **data: object) -> str:
        """Ask for what is not answered; return the text that people see."""
        with pytest.raises(HomeAssistantError) as caught:
            await self.ask(action, **data)
        assert caught.value.translation_key == key
        return said(caught.value)

    async def switch_on(self, key: str, port: int = 1) -> None:
        """Switch something of a port on."""
        entity = await get_entity(self.hass, "switch", self.entry, f"{port}_{key}")
        await call(self.hass, "switch.turn_on", entity)

    def written(self, *names: str) -> list[bytes]:
        """Return what the box was told by these commands, or by any action."""
        names = names or WRITES
        return [command.parameters for command in self.box.commands_named(*names)]


def said(error: HomeAssistantError) -> str:
    """Return the English text of an error, all of its placeholders filled in."""
    text = english()["exceptions"][error.translation_key]["message"]
    shown = text.format(**error.translation_placeholders or {})
    assert isinstance(shown, str)
    return shown


@asynccontextmanager
async def scene(
    hass: HomeAssistant, box: EwsBox | None = None, **data: object
) -> AsyncIterator[Scene]:
    """Set up a virtual EWS-Box; all of its ports answer."""
    box = box or EwsBox()
    box.system.admin_password = ADMIN_PASSWORD.encode().ljust(12, b"\0")
    box.system.card_pin = CARD_PIN.encode()
    box.user.user_password = USER_PASSWORD.encode().ljust(12, b"\0")
    # What was written is read back sooner than a real box may need.
    quick = patch.object(library, "LOOK_AGAIN", 0.05)
    with quick:
        async with running(hass, box, poll_interval=0.5, **data) as (entry, bus):
            chargers = entry.runtime_data.chargers.values()
            await wait_until(
                hass, lambda: all(one.charger.available for one in chargers)
            )
            yield Scene(hass, entry, bus, box)
