"""SmartEVSE: Modbus RTU on RS-485, polled or with us as load-balancing master."""

from collections.abc import Mapping
from dataclasses import replace
import re
from typing import Final

from ..address import NumberAddress
from ..framing import LineSettings
from ..modbus import RtuFramer
from ..model import MAXIMUM_CURRENT
from ..options import Toggle
from ..protocol import CircuitRange, Kinds, Make, Protocol
from ..readings import ChargerInfo
from ..redaction import SerialNumbers
from .config import PolledConfig, SlaveConfig, kept_dialect
from .dialects import MAPS, Dialect
from .master import Master
from .polled import PolledSmartEvse
from .reader import TIMING
from .readings import charger_info
from .scan import scan_polled, scan_slaves
from .slave import SlaveSmartEvse

SETTINGS: Final = LineSettings(baudrate=9600)

_MAKE: Final = Make(key="smartevse", name="SmartEVSE", menu="mode")

_WORD: Final = 0xFFFF
"""Only later firmware has a serial number, of 16 bits: two boxes may have the same."""


def _word(serial: str) -> bytes:
    """Return a serial number as a register; empty for one that is no register."""
    number = int(serial) if serial.isdecimal() else 0
    return number.to_bytes(2, "big") if 0 < number <= _WORD else b""


_SERIALS: Final = SerialNumbers(
    encode=_word,
    # Later dialects: the last of twelve registers, and the checksum, which reveals it.
    in_frame=re.compile(rb"(?s)(?<=\A.\x04\x18.{22}).{1,4}"),
    distinct=False,
)


def _family(facts: Mapping[str, str]) -> str | None:
    """Return the family of a box: one broadcast is for one of them."""
    dialect = kept_dialect(facts.get("dialect", ""))
    return None if dialect is None else MAPS[dialect].balancing.family


def _info(facts: Mapping[str, str]) -> ChargerInfo:
    return charger_info(Dialect(facts["dialect"]), facts.get("serial"))


POLLED: Final = Protocol(
    key="smartevse",
    name="SmartEVSE v2",
    make=_MAKE,
    choice="polled",
    settings=SETTINGS,
    timing=TIMING,
    framer=RtuFramer,
    config=PolledConfig,
    charger=PolledSmartEvse,
    scan=scan_polled,
    # Its setting LOAD BAL, as an address: 0 is Disabled, 1 is Master.
    address=NumberAddress(key="unit", lowest=0, highest=1, labelled=True, single=True),
    options=(Toggle(name="stop_on_shutdown", prominent=True),),
    lifetime_is_fail_safe=True,
    serials=_SERIALS,
    serial_identifies=False,
)

MASTER: Final = Protocol(
    key="smartevse_master",
    name="SmartEVSE, load balancing",
    make=_MAKE,
    choice="master",
    settings=SETTINGS,
    # A reply must leave room for the broadcast every 2 s. A box that requests something
    # begins after 6 to 10 ms of silence, and is received 1 ms later: it goes first.
    timing=replace(TIMING, silence=0.012, reply_timeout_limit=0.6),
    framer=RtuFramer,
    config=SlaveConfig,
    charger=SlaveSmartEvse,
    scan=scan_slaves,
    master=Master,
    address=NumberAddress(
        key="slave",
        lowest=2,
        highest=8,
        labelled=True,
        # Setting LOAD BAL; 2.17 has no more than three slaves.
        menu={
            2: ("Slave 1", "Node 1"),
            3: ("Slave 2", "Node 2"),
            4: ("Slave 3", "Node 3"),
            5: ("Node 4",),
            6: ("Node 5",),
            7: ("Node 6",),
            8: ("Node 7",),
        },
        has_serial=False,
    ),
    # Seven boxes at most; the minimum as in the menu of a box (MIN).
    circuit=CircuitRange(highest=7 * MAXIMUM_CURRENT, highest_minimum=16),
    kinds=Kinds(kind=_family, info=_info),
    serials=_SERIALS,
    serial_identifies=False,
)

__all__ = [
    "MASTER",
    "POLLED",
    "SETTINGS",
    "Master",
    "PolledConfig",
    "PolledSmartEvse",
    "SlaveConfig",
    "SlaveSmartEvse",
]
