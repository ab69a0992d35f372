"""From the data of config entries to the configuration of the library. Pure."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import tzinfo
from typing import TYPE_CHECKING, Any, Final

from homeassistant.const import CONF_ADDRESS

from .const import (
    CONF_BAUDRATE,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_INSTALLATION_LIMIT_2,
    CONF_ORDER_LIFETIME,
    CONF_PARITY,
    CONF_POLL_INTERVAL,
    CONF_PORTS,
    CONF_PROTOCOL,
    CONF_REPLY_TIMEOUT,
    CONF_STOP_BITS,
    CONF_SUPPLY_LIMIT,
    CONF_SUPPLY_MINIMUM,
    CONF_VOLTAGE,
)
from .evse.framing import LineSettings
from .evse.model import (
    MINIMUM_CURRENT,
    ChargerConfig,
    Circuit,
    CurrentLimit,
    Orders,
)
from .evse.protocols import PROTOCOLS

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentry

    from .evse.protocol import Protocol

_OPTIONAL_FIELDS: Final[Mapping[str, Callable[[Any], object]]] = {
    CONF_VOLTAGE: float,
    CONF_POLL_INTERVAL: float,
    CONF_ORDER_LIFETIME: lambda minutes: float(minutes) * 60,
}
"""Fields that may be missing or None, with the conversion of the stored value."""

_LIVE_KEYS: Final = (CONF_SUPPLY_LIMIT, CONF_SUPPLY_MINIMUM)
"""Keys that can change while the bus runs: a new bus would be silent for a while."""

_DEFAULT_TIMEOUT: Final = 60

PORT_LIMITS: Final = (CONF_INSTALLATION_LIMIT, CONF_INSTALLATION_LIMIT_2)
"""Keys of the installation limits of a box's ports."""


def protocol_of(data: Mapping[str, Any]) -> Protocol:
    """Return the protocol of a config entry's data."""
    return PROTOCOLS[data[CONF_PROTOCOL]]


def line_settings(data: Mapping[str, Any]) -> LineSettings:
    """Return the line settings: those of the protocol, unless overridden."""
    usual = protocol_of(data).settings
    timeout = data.get(CONF_REPLY_TIMEOUT)
    return LineSettings(
        reply_timeout=None if timeout is None else float(timeout),
        baudrate=int(data.get(CONF_BAUDRATE, usual.baudrate)),
        parity=data.get(CONF_PARITY, usual.parity),
        stop_bits=int(data.get(CONF_STOP_BITS, usual.stop_bits)),
    )


def rebuild_data(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry data whose change requires a new bus."""
    return {key: value for key, value in data.items() if key not in _LIVE_KEYS}


def supply_of(data: Mapping[str, Any]) -> Circuit | None:
    """Return the supply that the chargers share; ``None``: they share none."""
    if protocol_of(data).circuit is None:
        return None
    return Circuit(
        limit=float(data.get(CONF_SUPPLY_LIMIT, MINIMUM_CURRENT)),
        minimum=float(data.get(CONF_SUPPLY_MINIMUM, MINIMUM_CURRENT)),
    )


def charger_configs(
    data: Mapping[str, Any], subentry: ConfigSubentry, zone: tzinfo | None = None
) -> list[ChargerConfig]:
    """Return the configurations of a box: one for each port that is in use.

    ``data`` is that of the config entry; ``zone`` sets the clock of a box that has
    one.
    """
    stored = subentry.data
    protocol = protocol_of(data)
    conversions = dict(_OPTIONAL_FIELDS) | {
        option.name: option.load for option in protocol.options
    }
    conversions |= {name: fact.load for name, fact in protocol.config.facts.items()}
    optional: dict[str, Any] = {
        key: convert(stored[key])
        for key, convert in conversions.items()
        if stored.get(key) is not None
    }
    if protocol.sets_clock:
        optional["time_zone"] = zone
    if protocol.ports == 1:
        one = protocol.config(
            key=subentry.subentry_id,
            name=subentry.title,
            address=int(stored[CONF_ADDRESS]),
            installation_limit=float(stored[CONF_INSTALLATION_LIMIT]),
            **optional,
        )
        return [one]
    count = port_count(stored)
    return [
        protocol.config(
            key=f"{subentry.subentry_id}_{port}",
            name=subentry.title if count == 1 else f"{subentry.title} {port}",
            address=port,
            installation_limit=float(stored[limit]),
            **optional,
        )
        for port, limit in enumerate(PORT_LIMITS[:count], start=1)
    ]


def port_count(stored: Mapping[str, Any]) -> int:
    """Return how many ports of a box are used, from its subentry's data."""
    return int(stored.get(CONF_PORTS, 1))


def initial_orders(subentry: ConfigSubentry, config: ChargerConfig) -> Orders:
    """Return the first orders of a charger.

    They are the fail-safe values that the user confirmed when adding it. Permission
    is not set, so the charger keeps its own.
    """
    stored = subentry.data
    fail_safe = min(
        float(stored.get(CONF_FAIL_SAFE_CURRENT, MINIMUM_CURRENT)),
        config.installation_limit,
    )
    return Orders(
        limit=CurrentLimit(current=fail_safe),
        fail_safe=CurrentLimit(current=fail_safe),
        fail_safe_timeout=int(stored.get(CONF_FAIL_SAFE_TIMEOUT, _DEFAULT_TIMEOUT)),
    )


def changes_in_place(old: ChargerConfig, new: ChargerConfig) -> bool:
    """Return whether a running charger can take a new configuration.

    It cannot if a field has changed that is read only once, when the charger is
    created. A fact that was not kept before is the one it has read itself.
    """
    names = set(old.live) | {
        name
        for name, fact in old.facts.items()
        if not fact.identifies or getattr(old, name) is None
    }
    same = {name: getattr(old, name) for name in names}
    return type(old) is type(new) and replace(new, **same) == old
