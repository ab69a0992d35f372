"""Constants of the integration."""

from logging import Logger, getLogger
from typing import Final

DOMAIN: Final = "evse_bus"
LOGGER: Final[Logger] = getLogger(__package__)
MANUFACTURER: Final = "EVSE Bus"

# -- A config entry is one bus ---------------------------------------------------
# Its port is stored under homeassistant.const.CONF_DEVICE, as `usb` expects.

CONF_PROTOCOL: Final = "protocol"
"""Key in `evse.protocols.PROTOCOLS`."""
CONF_BAUDRATE: Final = "baudrate"
"""Set only where it overrides the protocol's own value; so are the next two."""
CONF_PARITY: Final = "parity"
CONF_STOP_BITS: Final = "stop_bits"
CONF_REPLY_TIMEOUT: Final = "reply_timeout"
"""s; missing: it follows what the line shows."""
CONF_SUPPLY_LIMIT: Final = "supply_limit"
"""Limit of all chargers of a bus together, A per phase (where we are its master)."""
CONF_SUPPLY_MINIMUM: Final = "supply_minimum"
"""Lowest current at which a charger of such a bus charges, A."""

CONF_ALLOWED: Final = "allowed"
"""Option of a listener: networks whose boxes may dial in; empty: all.

Its own address is stored under homeassistant.const.CONF_HOST and CONF_PORT.
"""

# -- A config subentry is one charger --------------------------------------------
# Its address is stored under homeassistant.const.CONF_ADDRESS; for a box that is alone
# on its bus that is the serial number, if known.

CONF_ENTRY: Final = "entry_id"
CONF_SUBENTRY: Final = "subentry_id"
"""Ids in the data of discovery and repair flows."""

SUBENTRY_CHARGER: Final = "charger"

CONF_IDENTITY: Final = "identity"
"""Identity by which the box is known for good (`identity.py`); missing: the subentry's
id."""
CONF_SERIAL: Final = "serial"
"""Serial number as text, or None: then the first one read is stored."""
CONF_REFUSED: Final = "refused"
"""Serial number of a box that is set up with an older subentry, and was not accepted in
the place of this one."""
CONF_INSTALLATION_LIMIT: Final = "installation_limit"
"""A; of the first port, where a box has several."""
CONF_PORTS: Final = "ports"
"""How many ports of a box are used (EWS-Box)."""
CONF_INSTALLATION_LIMIT_2: Final = "installation_limit_2"
"""Of a box's second port, A."""
CONF_VOLTAGE: Final = "voltage"
"""Phase to neutral, V."""
CONF_POLL_INTERVAL: Final = "poll_interval"
"""s"""
CONF_ORDER_LIFETIME: Final = "order_lifetime"
"""Minutes, or None: orders do not expire."""
CONF_FAIL_SAFE_CURRENT: Final = "fail_safe_current"
"""A; used in the first orders of a charger only."""
CONF_FAIL_SAFE_TIMEOUT: Final = "fail_safe_timeout"
"""s; used in the first orders of a charger only (EVBox)."""

# What else is stored of a charger are the options of its protocol (`evse/options.py`),
# and what was read of its box (`ChargerConfig.facts`), each under its name.
