"""The lines of one config entry: one port, or a listener that boxes dial.

A port has one bus for all chargers. With a listener each box has a line, and so a bus
and a scheduler, of its own: one that is slow or gone holds up nobody else.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Callable, Iterable, Mapping
from ipaddress import ip_network
from typing import TYPE_CHECKING, Any, override

from homeassistant.const import CONF_DEVICE, CONF_HOST, CONF_PORT

from .configuration import line_settings, protocol_of, supply_of
from .const import CONF_ALLOWED
from .evse.ews import Listener, Stranger

if TYPE_CHECKING:
    from ipaddress import IPv4Network, IPv6Network

    from homeassistant.config_entries import ConfigEntry

    from .evse.bus import Bus
    from .evse.duty import Duty
    from .evse.model import ChargerConfig


class Lines(ABC):
    """All lines of one config entry."""

    name: str
    """Of the port or address, for messages."""

    @property
    @abstractmethod
    def only(self) -> Bus | None:
        """Return the one bus of a port; ``None``: each box has its own."""

    @property
    def duty(self) -> Duty | None:
        """Return what the bus owes to all its chargers at once."""
        return None if self.only is None else self.only.duty

    @abstractmethod
    async def start(self) -> None:
        """Open them; raises LineError. Chargers that are there begin to be asked."""

    @abstractmethod
    async def stop(self) -> None:
        """Close them and leave nothing behind."""

    @abstractmethod
    async def join(self, config: ChargerConfig, name: str) -> Bus:
        """Return the bus of a charger, which is then to be put on it.

        ``name``: of its box, for messages.
        """

    async def leave(self, bus: Bus) -> None:  # noqa: B027 - a port keeps its bus
        """Take note that a charger was taken off a bus."""

    def rename(self, name: str) -> None:  # noqa: B027 - boxes have names of their own
        """Follow a new name of the config entry."""

    def follow_options(self, options: Mapping[str, Any]) -> None:  # noqa: B027
        """Follow changed options of the config entry."""


class PortLines(Lines):
    """One port, and one bus on it."""

    def __init__(self, entry: ConfigEntry) -> None:
        """Open nothing yet."""
        self.name = line_name(entry.data)
        self._bus = protocol_of(entry.data).bus(
            self.name,
            settings=line_settings(entry.data),
            name=entry.title,
            supply=supply_of(entry.data),
        )

    @property
    @override
    def only(self) -> Bus:
        return self._bus

    @override
    async def start(self) -> None:
        await self._bus.start()

    @override
    async def stop(self) -> None:
        await self._bus.stop()

    @override
    async def join(self, config: ChargerConfig, name: str) -> Bus:
        return self._bus

    @override
    def rename(self, name: str) -> None:
        self._bus.name = name


class ListenerLines(Lines):
    """A listener, and one bus for each box that is set up."""

    def __init__(
        self, entry: ConfigEntry, on_stranger: Callable[[Stranger], None]
    ) -> None:
        """Listen to nobody yet; ``on_stranger`` is told of boxes that are not set up."""
        self.name = line_name(entry.data)
        self.listener = Listener(
            entry.data[CONF_HOST],
            entry.data[CONF_PORT],
            allowed=allowed_networks(entry.options),
            on_stranger=on_stranger,
        )
        self._buses: dict[str, Bus] = {}
        self._started = False

    @property
    @override
    def only(self) -> None:
        return None

    @property
    def connected(self) -> int:
        """Return how many boxes are connected."""
        return sum(bus.connected for bus in self._buses.values())

    @override
    async def start(self) -> None:
        await self.listener.start()
        self._started = True
        for bus in self._buses.values():
            await bus.start()

    @override
    async def stop(self) -> None:
        self._started = False
        await self.listener.stop()
        # One that is in the midst of something does not hold up the others.
        await asyncio.gather(*(self._forget(serial) for serial in tuple(self._buses)))

    @override
    async def join(self, config: ChargerConfig, name: str) -> Bus:
        serial = config.serial or ""
        bus = self._buses[serial] = self.listener.expect(serial, name)
        if self._started:
            await bus.start()
        return bus

    @override
    async def leave(self, bus: Bus) -> None:
        if bus.chargers:
            return
        for serial, known in tuple(self._buses.items()):
            if known is bus:
                await self._forget(serial)

    async def _forget(self, serial: str) -> None:
        del self._buses[serial]
        await self.listener.forget(serial)

    @override
    def follow_options(self, options: Mapping[str, Any]) -> None:
        self.listener.allow(allowed_networks(options))


def lines_of(entry: ConfigEntry, on_stranger: Callable[[Stranger], None]) -> Lines:
    """Return the lines of a config entry; nothing is opened yet."""
    if protocol_of(entry.data).dials_in:
        return ListenerLines(entry, on_stranger)
    return PortLines(entry)


def allowed_networks(options: Mapping[str, Any]) -> list[IPv4Network | IPv6Network]:
    """Return which networks may dial in; none: all may."""
    stored: Iterable[str] = options.get(CONF_ALLOWED, ())
    return [ip_network(one) for one in stored]


def line_name(data: Mapping[str, Any]) -> str:
    """Return the name of the port or address of a config entry, for messages."""
    if protocol_of(data).dials_in:
        return address_name(data[CONF_HOST], data[CONF_PORT])
    device: str = data[CONF_DEVICE]
    return device


def address_name(host: str, port: int) -> str:
    """Return an address and port as people write them."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
