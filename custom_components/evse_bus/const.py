"""Names that several modules of the integration share."""

from logging import Logger, getLogger
from typing import Final

DOMAIN: Final = "evse_bus"
LOGGER: Final[Logger] = getLogger(__package__)
MANUFACTURER: Final = "EVSE Bus"

# -- A config entry is one bus ---------------------------------------------------
# Its port stands under homeassistant.const.CONF_DEVICE, as `usb` expects.

CONF_PROTOCOL: Final = "protocol"
"""Key in `evse.protocols.PROTOCOLS`."""
CONF_BAUDRATE: Final = "baudrate"
"""Only where an expert has overridden the protocol's own; so with the next two."""
CONF_PARITY: Final = "parity"
CONF_STOP_BITS: Final = "stop_bits"
CONF_SUPPLY_LIMIT: Final = "supply_limit"
"""What all chargers of a bus may draw together, A a phase (where we are its master)."""
CONF_SUPPLY_MINIMUM: Final = "supply_minimum"
"""Least current that a charger of such a bus charges with, A."""

CONF_ALLOWED: Final = "allowed"
"""Option of a listener: networks whose boxes may dial in; empty: all may.

Where it listens stands under homeassistant.const.CONF_HOST and CONF_PORT.
"""

# -- A config subentry is one charger --------------------------------------------
# Its address stands under homeassistant.const.CONF_ADDRESS; of a box that is alone on
# its bus it is the serial number, as far as known.

SUBENTRY_CHARGER: Final = "charger"

CONF_SERIAL: Final = "serial"
"""Serial number as text, or None: then the first one found there is kept."""
CONF_INSTALLATION_LIMIT: Final = "installation_limit"
"""A; where a box has several ports, of the first."""
CONF_PORTS: Final = "ports"
"""How many ports of a box are used (EWS-Box)."""
CONF_INSTALLATION_LIMIT_2: Final = "installation_limit_2"
"""Of a box's second port, A."""
CONF_VOLTAGE: Final = "voltage"
"""Phase to neutral, V."""
CONF_POLL_INTERVAL: Final = "poll_interval"
"""s"""
CONF_ORDER_LIFETIME: Final = "order_lifetime"
"""Minutes, or None: orders stand until they are changed."""
CONF_FAIL_SAFE_CURRENT: Final = "fail_safe_current"
"""A; with the time-out the first orders ever, as the user confirmed them."""
CONF_FAIL_SAFE_TIMEOUT: Final = "fail_safe_timeout"
"""s (EVBox)."""
CONF_COMMAND: Final = "command"
"""68 or 69 (EVBox)."""
CONF_INFORMATION: Final = "information"
"""The information module as 32 hex digits (EVBox)."""
CONF_PHASE_ORDER: Final = "phase_order"
"""Which phase the first, second and third current belong to (ABL)."""
CONF_STOP_ON_SHUTDOWN: Final = "stop_on_shutdown"
"""Charging is stopped when Home Assistant stops (SmartEVSE, polled)."""
