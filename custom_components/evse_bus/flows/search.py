"""Trying a port and searching a bus, for the flows."""

from collections.abc import Mapping, Sequence
from functools import partial
from os.path import realpath
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

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
    from ..evse.protocol import Progress, Protocol
    from ..evse.scan import Address

type Probe = tuple[ChargerConfig, Orders]
"""Configuration and orders that a search uses; sent where every message sets limits."""

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

    Raises LineError, and what `Protocol.scan` raises.
    """
    results: list[ScanResult] = []
    for config, orders in searches:
        share = partial(_share, progress, len(results), len(searches))
        results.append(await protocol.scan(bus, config, orders, share))
    return ScanResult(
        found=tuple(one for result in results for one in result.found),
        duplicates=tuple(one for result in results for one in result.duplicates),
        unreadable=any(result.unreadable for result in results),
        unsupported=tuple(one for result in results for one in result.unsupported),
        other_master=any(result.other_master for result in results),
        gateway=bus.wire.gateway.detected,
    )


def _share(progress: Progress, done: int, total: int, share: float) -> None:
    progress((done + share) / total)
