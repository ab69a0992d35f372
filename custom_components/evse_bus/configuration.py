"""From what the config flow stored to what the library is set up with. Pure."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from datetime import tzinfo
from typing import TYPE_CHECKING, Any, Final

from homeassistant.const import CONF_ADDRESS

from .const import (
    CONF_BAUDRATE,
    CONF_COMMAND,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INFORMATION,
    CONF_INSTALLATION_LIMIT,
    CONF_INSTALLATION_LIMIT_2,
    CONF_ORDER_LIFETIME,
    CONF_PARITY,
    CONF_PHASE_ORDER,
    CONF_POLL_INTERVAL,
    CONF_PORTS,
    CONF_PROTOCOL,
    CONF_SERIAL,
    CONF_STOP_BITS,
    CONF_STOP_ON_SHUTDOWN,
    CONF_SUPPLY_LIMIT,
    CONF_SUPPLY_MINIMUM,
    CONF_VOLTAGE,
)
from .evse.framing import LineSettings
from .evse.model import (
    MINIMUM_CURRENT,
    ChargerConfig,
    CurrentLimit,
    Orders,
    Supply,
)
from .evse.protocols import PROTOCOLS

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentry

    from .evse.protocol import Protocol

_OPTIONAL_FIELDS: Final[Mapping[str, Callable[[Any], object]]] = {
    CONF_SERIAL: str,
    CONF_VOLTAGE: float,
    CONF_POLL_INTERVAL: float,
    CONF_ORDER_LIFETIME: lambda minutes: float(minutes) * 60,
    # What single protocols add.
    CONF_COMMAND: int,
    CONF_INFORMATION: bytes.fromhex,
    CONF_PHASE_ORDER: tuple,
    CONF_STOP_ON_SHUTDOWN: bool,
}
"""Fields that may be missing or None, and how they are made of what is stored."""

_IN_PLACE: Final = (
    "name",
    "installation_limit",
    "voltage",
    "poll_interval",
    "order_lifetime",
    "stop_on_shutdown",
    "time_zone",
)
"""What of its set-up a charger looks up anew each time."""
_BUS_IN_PLACE: Final = (CONF_SUPPLY_LIMIT, CONF_SUPPLY_MINIMUM)
"""What can be changed while the bus runs: anew it would be silent for a while."""

_DEFAULT_TIMEOUT: Final = 60

PORT_LIMITS: Final = (CONF_INSTALLATION_LIMIT, CONF_INSTALLATION_LIMIT_2)
"""Where the installation limit of each port of a box stands."""
_FAMILIES: Final = {"ews_network": "ews"}
"""Protocols under which one box may be found by the same serial number."""


def protocol_of(data: Mapping[str, Any]) -> Protocol:
    """Return the protocol that a config entry's data names."""
    return PROTOCOLS[data[CONF_PROTOCOL]]


def charger_unique_id(
    protocol: str, serial: str | None, address: int | str | None = None
) -> str:
    """Return a charger subentry's unique id: its identity, else its address."""
    if serial is None:
        return f"{protocol}_address_{address}"
    return f"{_FAMILIES.get(protocol, protocol)}_{serial}"


def line_settings(data: Mapping[str, Any]) -> LineSettings:
    """Return how the port is opened: the protocol's way, unless overridden."""
    usual = protocol_of(data).settings
    return LineSettings(
        baudrate=int(data.get(CONF_BAUDRATE, usual.baudrate)),
        parity=data.get(CONF_PARITY, usual.parity),
        stop_bits=int(data.get(CONF_STOP_BITS, usual.stop_bits)),
    )


def made_of(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a config entry's data its bus has to be made anew for."""
    return {key: value for key, value in data.items() if key not in _BUS_IN_PLACE}


def supply_of(data: Mapping[str, Any]) -> Supply | None:
    """Return what the chargers of a bus share; ``None``: each is on its own."""
    if protocol_of(data).duty is None:
        return None
    return Supply(
        limit=float(data.get(CONF_SUPPLY_LIMIT, MINIMUM_CURRENT)),
        minimum=float(data.get(CONF_SUPPLY_MINIMUM, MINIMUM_CURRENT)),
    )


def charger_configs(
    data: Mapping[str, Any], subentry: ConfigSubentry, zone: tzinfo | None = None
) -> list[ChargerConfig]:
    """Return the set-up of a box, one for each port that is a charger of its own.

    ``data`` is the config entry's, for the protocol; ``zone`` is for the clocks of
    boxes that have one.
    """
    stored = subentry.data
    protocol = protocol_of(data)
    optional: dict[str, Any] = {
        key: convert(stored[key])
        for key, convert in _OPTIONAL_FIELDS.items()
        if stored.get(key) is not None
    }
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
    clock: dict[str, Any] = {"time_zone": zone}
    return [
        protocol.config(
            key=f"{subentry.subentry_id}_{port}",
            name=subentry.title if count == 1 else f"{subentry.title} {port}",
            address=port,
            installation_limit=float(stored[limit]),
            **optional,
            **clock,
        )
        for port, limit in enumerate(PORT_LIMITS[:count], start=1)
    ]


def port_count(stored: Mapping[str, Any]) -> int:
    """Return how many ports of a box are used."""
    return int(stored.get(CONF_PORTS, 1))


def first_orders(subentry: ConfigSubentry, config: ChargerConfig) -> Orders:
    """Return the orders of a charger that never had any.

    They are the fail-safe values that the user confirmed when adding it. Nobody
    has said yet whether it may charge, so permission is the charger's own.
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
    """Return whether a charger can be told its new set-up while it runs.

    What decides how it is spoken to is asked for once, when it is made. A serial
    number that becomes known is the one it has found itself.
    """
    names = {one.name for one in fields(old)}.intersection(_IN_PLACE)
    if old.serial is None:
        names.add("serial")
    same = {name: getattr(old, name) for name in names}
    return type(old) is type(new) and replace(new, **same) == old
