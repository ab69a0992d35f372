"""Trying a port and searching a bus, for the flows."""

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from os.path import realpath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from homeassistant.config_entries import ConfigSubentry, ConfigSubentryData

from ..configuration import (
    charger_configs,
    initial_orders,
    line_settings,
    protocol_of,
    supply_of,
)
from ..const import (
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    LOGGER,
)
from ..evse.address import NumberAddress
from ..evse.errors import (
    LineBusyError,
    LineError,
    LineLostError,
    NotAvailableError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
    PortSettingsError,
)
from ..evse.line import Line, canonical_url
from ..evse.model import ChargerConfig, CurrentLimit, Orders
from ..evse.scan import ScanResult
from .schema import CONF_SEARCH_CURRENT

if TYPE_CHECKING:
    from ..evse.bus import Bus
    from ..evse.framing import LineSettings
    from ..evse.load import Overload
    from ..evse.memory import LineMemory
    from ..evse.protocol import Progress, Protocol
    from ..evse.round_trip import RoundTrip
    from ..evse.scan import Address

type Probe = tuple[ChargerConfig, Orders]
"""Configuration and orders that a search uses; sent where every message sets limits."""

_LATE_REPLIES: Final = 5.0
"""Wait for replies to a search without any, s: the line may be slow.

Long enough also to receive another station that sends every 2 s (a SmartEVSE that
reads a meter)."""

_ERRORS: Final[dict[type[Exception], str]] = {
    PortBusyError: "port_busy",
    PortMissingError: "port_missing",
    PortPermissionError: "port_permission",
    PortSettingsError: "port_settings",
    LineLostError: "port_lost",
    LineBusyError: "line_busy",
    NotAvailableError: "entry_not_loaded",
    LineError: "cannot_open",
}
"""Keys of the error texts; the first class that matches counts."""


def error_key(error: Exception) -> str:
    """Return the key of the text for an error; logs an unexpected one."""
    for kind, key in _ERRORS.items():
        if isinstance(error, kind):
            if kind is LineError:
                LOGGER.warning("A port cannot be used: %s", error)
            return key
    LOGGER.error("Unexpected error on a bus being set up", exc_info=error)
    return "unknown"


async def async_try_port(url: str, settings: LineSettings) -> str | None:
    """Open and close a port without sending anything; return the key of the error."""
    line = Line(url, settings)
    try:
        await line.open()
    except Exception as error:  # noqa: BLE001 - a URL may lead into any library
        return error_key(error)
    await line.close()
    return None


def is_same_port(one: str, other: str) -> bool:
    """Return whether two names are those of one port; blocks on the file system."""
    if "://" in one or "://" in other:
        return is_same_url(one, other)
    return realpath(one) == realpath(other)


def is_same_url(one: str, other: str) -> bool:
    """Return whether two URLs are those of one port, in whatever spelling."""
    return canonical_url(one) == canonical_url(other)


def port_name(url: str) -> str:
    """Return a short name of a port, for titles."""
    if "://" in url:
        return urlsplit(url).netloc or url
    return url.rstrip("/").rsplit("/", 1)[-1]


def probes(
    protocol: Protocol, addresses: Sequence[Address], typed: Mapping[str, Any]
) -> list[Probe]:
    """Return the probes for some addresses, with the values confirmed by the user."""
    fail_safe = CurrentLimit(current=typed[CONF_FAIL_SAFE_CURRENT])
    orders = Orders(
        limit=CurrentLimit(current=float(typed[CONF_SEARCH_CURRENT])),
        fail_safe=fail_safe,
        fail_safe_timeout=int(typed[CONF_FAIL_SAFE_TIMEOUT]),
    )
    more = {CONF_INSTALLATION_LIMIT: typed[CONF_INSTALLATION_LIMIT]} | {
        option.name: option.load(option.store(typed[option.name]))
        for option in protocol.options
        if option.name in typed
    }
    return [(_config(protocol, int(address), more), orders) for address in addresses]


def read_only_probe(protocol: Protocol) -> Probe:
    """Return the probe of a protocol whose search only reads."""
    form = protocol.address
    # Only a valid address is needed; the first port where addresses are no numbers.
    address = form.lowest if isinstance(form, NumberAddress) else 1
    return _config(protocol, address, {}), Orders(limit=CurrentLimit(current=0.0))


def _config(protocol: Protocol, address: int, more: Mapping[str, Any]) -> ChargerConfig:
    config: ChargerConfig = protocol.config(
        key="search", name="search", address=address, **more
    )
    return config


async def async_search(
    protocol: Protocol, bus: Bus, searches: Sequence[Probe], progress: Progress
) -> ScanResult:
    """Search a started bus with each probe in turn; return the results as one.

    Where replies came late, the line is slow: the search is repeated with the reply
    time-out learnt from them. Raises LineError, and what `Protocol.scan` raises.
    """
    late = bus.wire.statistics.late
    foreign = bus.wire.statistics.foreign_requests
    result = await _async_search_once(protocol, bus, searches, progress)
    if not result.found:
        await _async_wait_for_late_replies(bus, late)
    if bus.wire.statistics.late > late and not bus.wire.round_trip.too_slow:
        result = await _async_search_once(protocol, bus, searches, progress)
    is_shared = bus.wire.statistics.foreign_requests > foreign
    return replace(result, foreign_requests=is_shared)


async def _async_wait_for_late_replies(bus: Bus, late: int) -> None:
    loop = asyncio.get_running_loop()
    until = loop.time() + _LATE_REPLIES
    while bus.wire.statistics.late == late and loop.time() < until:  # noqa: ASYNC110
        # The library counts them; it has no event for one of them.
        await asyncio.sleep(0.1)


async def _async_search_once(
    protocol: Protocol, bus: Bus, searches: Sequence[Probe], progress: Progress
) -> ScanResult:
    results: list[ScanResult] = []
    for config, orders in searches:
        share = partial(_share, progress, len(results), len(searches))
        results.append(await protocol.scan(bus, config, orders, share))
    return ScanResult(
        found=tuple(one for result in results for one in result.found),
        duplicates=tuple(one for result in results for one in result.duplicates),
        unreadable=any(result.unreadable for result in results),
        other_master=any(result.other_master for result in results),
        gateway=bus.wire.gateway.detected,
        round_trip=bus.wire.round_trip,
    )


def overload_of(
    data: Mapping[str, Any],
    chargers: Iterable[ConfigSubentry | ConfigSubentryData],
    round_trip: RoundTrip,
    memory: LineMemory,
) -> Overload | None:
    """Return the deadline that these chargers together would miss on a line.

    ``data``: of the config entry of the bus; ``memory``: of the line.
    """
    protocol = protocol_of(data)
    bus = protocol.bus(
        "", settings=line_settings(data), circuit=supply_of(data), memory=memory
    )
    bus.wire.round_trip = round_trip
    for number, one in enumerate(chargers):
        subentry = _as_subentry(number, one)
        for config in charger_configs(data, subentry):
            bus.add(protocol.charger(config, initial_orders(subentry, config)))
    return bus.find_overload()


def _as_subentry(
    number: int, one: ConfigSubentry | ConfigSubentryData
) -> ConfigSubentry:
    if isinstance(one, ConfigSubentry):
        return one
    return ConfigSubentry(
        data=MappingProxyType(one["data"]),
        subentry_id=f"new_{number}",
        subentry_type=one["subentry_type"],
        title=one["title"],
        unique_id=one["unique_id"],
    )


def _share(progress: Progress, done: int, total: int, share: float) -> None:
    progress((done + share) / total)
