"""P-CHARGE EWS-Box: MCS binary over RS-232 or TCP, two charge ports a box."""

from dataclasses import replace
from typing import Final

from ..address import TextAddress
from ..protocol import Make, Protocol
from ..redaction import SerialNumbers
from .charger import EwsPort
from .config import EwsPortConfig
from .network.listener import Listener
from .port import BoxPorts
from .scan import scan
from .timing import SETTINGS, TCP_TIMING, TIMING
from .wire.frames import EwsFramer

_SERIAL: Final = TextAddress(key="box_serial", longest=12, is_serial=True)

PROTOCOL: Final = Protocol(
    key="ews",
    name="P-CHARGE EWS-Box",
    make=Make(key="ews", name="EWS-Box", plural="EWS-Boxes", menu="connection"),
    choice="ews_serial",
    settings=SETTINGS,
    timing=TIMING,
    framer=EwsFramer,
    config=EwsPortConfig,
    charger=EwsPort,
    scan=scan,
    ports=2,
    group=BoxPorts,
    interface="RS-232",
    address=replace(_SERIAL, any="", optional=True, single=True),
    asks_voltage=False,
    sets_clock=True,
    # The frames that contain it (``rs``) are not kept: they contain cards, too.
    serials=SerialNumbers(),
    serial_family="ews",
)
"""On RS-232."""

NETWORK: Final = replace(
    PROTOCOL,
    key="ews_network",
    name="P-CHARGE EWS-Box, network",
    choice="ews_network",
    address=_SERIAL,
    timing=TCP_TIMING,
    listener=Listener,
)
"""Over the network: boxes dial a `Listener`, which has a bus for each."""

__all__ = [
    "NETWORK",
    "PROTOCOL",
    "EwsPort",
    "EwsPortConfig",
    "Listener",
]
