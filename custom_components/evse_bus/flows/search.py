"""Ports tried and buses searched for the config flow, with progress."""

from collections.abc import Mapping, Sequence
from functools import partial
from os.path import realpath
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from ..const import (
    CONF_COMMAND,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    LOGGER,
)
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
from ..evse.line import Line
from ..evse.model import ChargerConfig, CurrentLimit, Orders
from ..evse.scan import Address, ScanResult
from .address import ADDRESSES
from .schema import CONF_SEARCH_CURRENT

if TYPE_CHECKING:
    from ..evse.bus import Bus
    from ..evse.framing import LineSettings
    from ..evse.protocol import Progress, Protocol

type Imposed = tuple[ChargerConfig, Orders]
"""What a search sets on a charger, where every message sets limits."""

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
"""What is said of an error; the first that fits."""


def error_key(error: Exception) -> str:
    """Return what a form says of an error; logs one that nobody expected."""
    for kind, key in _ERRORS.items():
        if isinstance(error, kind):
            if kind is LineError:
                LOGGER.warning("A port cannot be used: %s", error)
            return key
    LOGGER.error("Unexpected error on a bus being set up", exc_info=error)
    return "unknown"


async def async_try_port(url: str, settings: LineSettings) -> str | None:
    """Open and close a port without sending anything; return what is wrong."""
    line = Line(url, settings)
    try:
        await line.open()
    except Exception as error:  # noqa: BLE001 - a URL may lead into any library
        return error_key(error)
    await line.close()
    return None


def is_same_port(one: str, other: str) -> bool:
    """Return whether two names mean one port; blocks on the file system."""
    if "://" in one or "://" in other:
        return one == other
    return realpath(one) == realpath(other)


def port_name(url: str) -> str:
    """Return a short name for a port, for titles."""
    if "://" in url:
        return urlsplit(url).netloc or url
    return url.rstrip("/").rsplit("/", 1)[-1]


def imposed(
    protocol: Protocol, addresses: Sequence[Address], typed: Mapping[str, Any]
) -> list[Imposed]:
    """Return what a search sets, of the values that the user has confirmed."""
    fail_safe = CurrentLimit(current=typed[CONF_FAIL_SAFE_CURRENT])
    orders = Orders(
        limit=CurrentLimit(current=float(typed[CONF_SEARCH_CURRENT])),
        fail_safe=fail_safe,
        fail_safe_timeout=int(typed[CONF_FAIL_SAFE_TIMEOUT]),
    )
    more = {CONF_INSTALLATION_LIMIT: typed[CONF_INSTALLATION_LIMIT]}
    if CONF_COMMAND in typed:
        more[CONF_COMMAND] = int(typed[CONF_COMMAND])
    return [(_config(protocol, int(address), more), orders) for address in addresses]


def nothing_imposed(protocol: Protocol) -> list[Imposed]:
    """Return what the search of a protocol that only reads is called with."""
    config = _config(protocol, ADDRESSES[protocol.key].lowest, {})
    return [(config, Orders(limit=CurrentLimit(current=0.0)))]


def _config(protocol: Protocol, address: int, more: Mapping[str, Any]) -> ChargerConfig:
    config: ChargerConfig = protocol.config(
        key="search", name="search", address=address, **more
    )
    return config


async def async_search(
    protocol: Protocol, bus: Bus, searches: Sequence[Imposed], progress: Progress
) -> ScanResult:
    """Search a started bus, once for each set of values; return all that was found.

    Raises LineError and what else the bus raises.
    """
    reports: list[ScanResult] = []
    for config, orders in searches:
        share = partial(_share, progress, len(reports), len(searches))
        reports.append(await protocol.scan(bus, config, orders, share))
    return ScanResult(
        found=tuple(one for report in reports for one in report.found),
        duplicates=tuple(one for report in reports for one in report.duplicates),
        unreadable=any(report.unreadable for report in reports),
        unsupported=tuple(one for report in reports for one in report.unsupported),
        other_master=any(report.other_master for report in reports),
    )


def _share(progress: Progress, done: int, total: int, share: float) -> None:
    progress((done + share) / total)
