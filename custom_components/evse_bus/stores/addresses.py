"""The addresses from which boxes have dialled.

A listener keeps places for them, also right after a restart: only the address of a
connection is known before it has been identified. Losing the file costs no more than
these places.
"""

from collections.abc import Iterable
from ipaddress import ip_address
from typing import Final

from homeassistant.core import HomeAssistant, callback
from homeassistant.helpers.storage import Store
from homeassistant.util.hass_dict import HassKey

from ..const import CONF_SERIAL, DOMAIN, LOGGER
from ..evse.dialling import Address
from .file import STORAGE_VERSION, UNREADABLE

ADDRESSES_KEY: Final = f"{DOMAIN}.addresses"
"""File name in the storage folder of Home Assistant."""
ADDRESSES_DELAY: Final = 60.0
"""Delay before a new address is written, s."""


class AddressStore:
    """The last addresses of all boxes, by serial number."""

    def __init__(self, hass: HomeAssistant) -> None:
        """Read nothing yet."""
        self._hass = hass
        self._file = Store[dict[str, list[str]]](hass, STORAGE_VERSION, ADDRESSES_KEY)
        self._addresses: dict[str, tuple[Address, ...]] = {}
        self._loaded = False

    async def async_get(self, serial: str) -> tuple[Address, ...]:
        """Return the addresses of a box, the last one first."""
        if not self._loaded:
            try:
                stored = await self._file.async_load() or {}
                read = {key: _addresses(one) for key, one in stored.items()}
            except UNREADABLE as error:
                LOGGER.warning("The stored addresses cannot be read: %s", error)
                read = {}
            # A box may have dialled meanwhile.
            self._addresses = {**read, **self._addresses}
            self._loaded = True
        return self._addresses.get(serial, ())

    @callback
    def put(self, serial: str, addresses: tuple[Address, ...]) -> None:
        """Take the addresses of a box, and write them soon."""
        self._addresses[serial] = addresses
        self._file.async_delay_save(self._content, ADDRESSES_DELAY)

    def _content(self) -> dict[str, list[str]]:
        """Return what is stored: of boxes that are set up."""
        set_up = {
            subentry.data.get(CONF_SERIAL)
            for entry in self._hass.config_entries.async_entries(DOMAIN)
            for subentry in entry.subentries.values()
        }
        return {
            serial: list(map(str, addresses))
            for serial, addresses in self._addresses.items()
            if serial in set_up
        }


ADDRESSES: Final[HassKey[AddressStore]] = HassKey(ADDRESSES_KEY)


def _addresses(stored: Iterable[str]) -> tuple[Address, ...]:
    return tuple(map(ip_address, stored))
