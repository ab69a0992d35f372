"""EV chargers on a serial bus: EVBox, ABL, SmartEVSE and P-CHARGE EWS-Box.

A library of its own: it imports nothing of Home Assistant. The names below are what a
script needs; docs/library.md has examples.
"""

from .address_change import (
    AddressChange,
    AddressChanged,
    AddressChangeError,
    Problem,
)
from .bus import Bus
from .charger import Charger
from .conversation import rest
from .errors import (
    DuplicateAddressError,
    EvseError,
    ExchangeError,
    ExchangeRefusedError,
    GarbledReplyError,
    ImplausibleReplyError,
    LineBusyError,
    LineError,
    LineLostError,
    NotAvailableError,
    NotConfirmedError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
    PortSettingsError,
    RefusedOrderError,
    ReplyTimeoutError,
    SharedAddressError,
    SupersededError,
    WrongChargerError,
)
from .exchange import Turn
from .framing import LineSettings
from .memory import LineMemory
from .model import (
    Capability,
    ChargerConfig,
    Command,
    CurrentLimit,
    FailSafe,
    Fault,
    Limits,
    Mode,
    OrderChange,
    Orders,
    SessionResult,
    Setting,
    Status,
)
from .protocol import Protocol
from .protocols import PROTOCOLS
from .readings import ChargerInfo, ChargerReading, ConnectorReading
from .scan import FoundCharger, ScanResult

__all__ = [
    "PROTOCOLS",
    "AddressChange",
    "AddressChangeError",
    "AddressChanged",
    "Bus",
    "Capability",
    "Charger",
    "ChargerConfig",
    "ChargerInfo",
    "ChargerReading",
    "Command",
    "ConnectorReading",
    "CurrentLimit",
    "DuplicateAddressError",
    "EvseError",
    "ExchangeError",
    "ExchangeRefusedError",
    "FailSafe",
    "Fault",
    "FoundCharger",
    "GarbledReplyError",
    "ImplausibleReplyError",
    "Limits",
    "LineBusyError",
    "LineError",
    "LineLostError",
    "LineMemory",
    "LineSettings",
    "Mode",
    "NotAvailableError",
    "NotConfirmedError",
    "OrderChange",
    "Orders",
    "PortBusyError",
    "PortMissingError",
    "PortPermissionError",
    "PortSettingsError",
    "Problem",
    "Protocol",
    "RefusedOrderError",
    "ReplyTimeoutError",
    "ScanResult",
    "SessionResult",
    "Setting",
    "SharedAddressError",
    "Status",
    "SupersededError",
    "Turn",
    "WrongChargerError",
    "rest",
]
