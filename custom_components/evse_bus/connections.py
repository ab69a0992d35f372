"""The connections of one config entry: a port, or a listener that boxes dial.

A port has one bus for all its chargers. Behind a listener each box has a connection,
and so a bus and a scheduler, of its own: a slow or dead box delays no other.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Callable, Iterable, Mapping
from ipaddress import ip_network
from typing import Any, Final, override

from homeassistant.config_entries import ConfigEntry, ConfigEntryState
from homeassistant.const import CONF_DEVICE, CONF_HOST, CONF_PORT
from homeassistant.core import HomeAssistant, callback
from homeassistant.util.hass_dict import HassKey

from .configuration import line_settings, protocol_of, supply_of
from .const import CONF_ALLOWED, DOMAIN
from .evse.bus import Bus
from .evse.dialling import Network, UnknownBox
from .evse.errors import LineError
from .evse.line import Line, canonical_url
from .evse.master import BusMaster
from .evse.memory import LineMemory
from .evse.model import ChargerConfig
from .evse.recovery import PAUSES
from .stores.addresses import ADDRESSES

_LINES: Final[HassKey[dict[str, LineMemory]]] = HassKey(f"{DOMAIN}.lines")

SETUP_PAUSE: Final = PAUSES[-1]
"""Pause before each attempt to open the port of a config entry that waits for it, s."""


class Connections(ABC):
    """All connections of one config entry."""

    name: str
    """Port or address, for messages."""

    @property
    @abstractmethod
    def shared_bus(self) -> Bus | None:
        """Return the bus of all chargers; ``None``: each box has its own."""

    @property
    def master(self) -> BusMaster | None:
        """Return the master of the shared bus, if the protocol has one."""
        return None if self.shared_bus is None else self.shared_bus.master

    @abstractmethod
    async def start(self) -> None:
        """Open the port or listener and start polling; raises LineError."""

    @abstractmethod
    async def stop(self) -> None:
        """Stop all buses and close the port or listener."""

    @abstractmethod
    async def probe(self) -> None:
        """Open the port or listener and close it again; raises LineError.

        Only while it is not started. Nothing is sent.
        """

    @abstractmethod
    async def acquire_bus(self, config: ChargerConfig, name: str) -> Bus:
        """Return the bus that a charger is to be added to.

        ``name``: of its box, for messages.
        """

    async def release_bus(self, bus: Bus) -> None:  # noqa: B027 - a port keeps its bus
        """Stop a bus that has no charger left, unless the connection keeps it."""

    def rename(self, name: str) -> None:  # noqa: B027 - boxes have names of their own
        """Apply a new title of the config entry."""

    def update_options(self, options: Mapping[str, Any]) -> None:  # noqa: B027
        """Apply changed options of the config entry."""


class PortConnection(Connections):
    """One port, and one bus on it."""

    def __init__(self, hass: HomeAssistant, entry: ConfigEntry) -> None:
        """Create the bus; the port is not opened."""
        self.name = connection_name(entry.data)
        self._bus = protocol_of(entry.data).bus(
            self.name,
            settings=line_settings(entry.data),
            name=entry.title,
            circuit=supply_of(entry.data),
            memory=line_memory(hass, self.name),
        )

    @property
    @override
    def shared_bus(self) -> Bus:
        return self._bus

    @override
    async def start(self) -> None:
        await self._bus.start()

    @override
    async def stop(self) -> None:
        await self._bus.stop()

    @override
    async def probe(self) -> None:
        line = Line(self._bus.line.url, self._bus.line.settings)
        await line.open()
        await line.close()

    @override
    async def acquire_bus(self, config: ChargerConfig, name: str) -> Bus:
        return self._bus

    @override
    def rename(self, name: str) -> None:
        self._bus.name = name


class ListenerConnections(Connections):
    """A listener, and one bus for each configured box."""

    def __init__(
        self,
        hass: HomeAssistant,
        entry: ConfigEntry,
        on_unknown_box: Callable[[UnknownBox], None],
    ) -> None:
        """Create the listener; it does not accept connections yet.

        ``on_unknown_box`` is called with each box that dials and is not configured.
        """
        self.name = connection_name(entry.data)
        self._hass = hass
        self.listener = protocol_of(entry.data).listen_at(
            entry.data[CONF_HOST],
            entry.data[CONF_PORT],
            allowed=allowed_networks(entry.options),
            on_unknown_box=on_unknown_box,
        )
        self._addresses = hass.data[ADDRESSES]
        self.listener.on_new_address = self._addresses.put
        self._buses: dict[str, Bus] = {}
        self._started = False

    @property
    @override
    def shared_bus(self) -> None:
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
        # Concurrently: a box in the middle of an exchange must not delay the others.
        await asyncio.gather(*(self._remove(serial) for serial in tuple(self._buses)))

    @override
    async def probe(self) -> None:
        await self.listener.start()
        await self.listener.stop()

    @override
    async def acquire_bus(self, config: ChargerConfig, name: str) -> Bus:
        serial = config.serial or ""
        addresses = await self._addresses.async_get(serial)
        bus = self.listener.register(
            serial, name, addresses, line_memory(self._hass, f"{DOMAIN}:{serial}")
        )
        self._buses[serial] = bus
        if self._started:
            await bus.start()
        return bus

    @override
    async def release_bus(self, bus: Bus) -> None:
        if bus.chargers:
            return
        for serial, candidate in tuple(self._buses.items()):
            if candidate is bus:
                await self._remove(serial)

    async def _remove(self, serial: str) -> None:
        del self._buses[serial]
        await self.listener.unregister(serial)

    @override
    def update_options(self, options: Mapping[str, Any]) -> None:
        self.listener.allow(allowed_networks(options))


def line_memory(hass: HomeAssistant, device: str) -> LineMemory:
    """Return what is known of the line at a port, until Home Assistant stops.

    From searches and from all buses that were on it.
    """
    lines = hass.data.setdefault(_LINES, {})
    return lines.setdefault(canonical_url(device), LineMemory())


def make_connections(
    hass: HomeAssistant,
    entry: ConfigEntry,
    on_unknown_box: Callable[[UnknownBox], None],
) -> Connections:
    """Return the connections of a config entry; nothing is opened."""
    if protocol_of(entry.data).dials_in:
        return ListenerConnections(hass, entry, on_unknown_box)
    return PortConnection(hass, entry)


def allowed_networks(options: Mapping[str, Any]) -> list[Network]:
    """Return the networks whose boxes may dial in; empty: all."""
    stored: Iterable[str] = options.get(CONF_ALLOWED, ())
    return [ip_network(one) for one in stored]


def connection_name(data: Mapping[str, Any]) -> str:
    """Return the port or address of a config entry, for messages."""
    if protocol_of(data).dials_in:
        return address_name(data[CONF_HOST], data[CONF_PORT])
    device: str = data[CONF_DEVICE]
    return device


def address_name(host: str, port: int) -> str:
    """Return ``host:port``, with brackets around an IPv6 address."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@callback
def async_set_up_when_open(
    hass: HomeAssistant, entry: ConfigEntry, connections: Connections
) -> None:
    """Set up a config entry again as soon as its port can be opened.

    To be called before ConfigEntryNotReady is raised. Home Assistant repeats the setup
    by itself, but its pauses grow to 10 min, and a bus must be back within 10 s of its
    adapter.
    """

    async def wait() -> None:
        try:
            while True:
                await asyncio.sleep(SETUP_PAUSE)
                try:
                    await connections.probe()
                except LineError:
                    continue
                hass.config_entries.async_schedule_reload(entry.entry_id)
                return
        finally:
            forget()

    @callback
    def on_state_change() -> None:
        # Unloaded, removed, or set up again by Home Assistant.
        if entry.state is not ConfigEntryState.SETUP_RETRY:
            task.cancel()

    task = hass.async_create_background_task(wait(), f"evse_bus port of {entry.title}")
    forget = entry.async_on_state_change(on_state_change)
