"""Files in the storage folder of Home Assistant."""

from collections.abc import Callable, Coroutine
from datetime import datetime
from typing import Any, Final

from homeassistant.const import EVENT_HOMEASSISTANT_FINAL_WRITE
from homeassistant.core import CALLBACK_TYPE, Event, HassJob, HomeAssistant, callback
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers.event import async_call_later
from homeassistant.helpers.storage import Store
from homeassistant.util.file import WriteError
from homeassistant.util.json import SerializationError

STORAGE_VERSION: Final = 1

UNREADABLE = (
    HomeAssistantError,  # also a version from the future
    NotImplementedError,  # no migration from that version
    OSError,
    AttributeError,
    KeyError,
    TypeError,
    ValueError,
)


class StoredFile(Store[dict[str, Any]]):
    """A file in the storage folder whose writes have ended when they return."""

    def __init__(self, hass: HomeAssistant, key: str) -> None:
        super().__init__(hass, STORAGE_VERSION, key, atomic_writes=True)

    async def async_write(self, data: dict[str, Any]) -> Exception | None:
        """Write now, also while Home Assistant stops; return the error, if any.

        `Store.async_save` would only plan a write while Home Assistant stops, and
        does not report a failure.
        """
        self._manager.async_invalidate(self.key)
        content = {
            "version": self.version,
            "minor_version": self.minor_version,
            "key": self.key,
            "data": data,
        }
        try:
            await self._async_write_data(content)
        except (WriteError, SerializationError, OSError) as error:
            return error
        return None


class PlannedWrite:
    """The next write of a store, and a last one when Home Assistant stops."""

    def __init__(
        self, hass: HomeAssistant, write: Callable[[], Coroutine[Any, Any, None]]
    ) -> None:
        """``write`` writes what has changed; it may plan another write."""
        self._hass = hass
        self._write = write
        self._cancel: CALLBACK_TYPE | None = None
        hass.bus.async_listen_once(EVENT_HOMEASSISTANT_FINAL_WRITE, self._async_last)

    def plan(self, delay: float) -> None:
        """Write after a delay, s, unless a write is planned already."""
        if self._cancel is None:
            self._cancel = async_call_later(
                self._hass, delay, HassJob(self._async_due, cancel_on_shutdown=True)
            )

    @callback
    def cancel(self) -> None:
        """Cancel a planned write."""
        if self._cancel is not None:
            self._cancel()
            self._cancel = None

    async def _async_due(self, _now: datetime) -> None:
        self._cancel = None
        await self._write()

    async def _async_last(self, _event: Event) -> None:
        await self._write()
        self.cancel()
