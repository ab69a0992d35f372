"""Files in the storage folder of Home Assistant."""

from typing import Any, Final

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
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
        would not tell whether it succeeds.
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
