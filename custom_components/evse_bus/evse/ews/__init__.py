"""P-CHARGE EWS-Box: MCS binary over RS-232 or TCP, two charge ports a box."""

from dataclasses import replace
from typing import Final

from ..protocol import Protocol
from .box import Ports
from .charger import EwsPort
from .config import EwsPortConfig
from .network.listener import Listener, Stranger
from .scan import scan
from .timing import SETTINGS, TCP_TIMING, TIMING
from .wire.frames import EwsFramer

PROTOCOL: Final = Protocol(
    key="ews",
    name="P-CHARGE EWS-Box",
    settings=SETTINGS,
    timing=TIMING,
    framer=EwsFramer,
    config=EwsPortConfig,
    charger=EwsPort,
    scan=scan,
    ports=2,
    group=Ports,
)
"""On RS-232."""

NETWORK: Final = replace(
    PROTOCOL,
    key="ews_network",
    name="P-CHARGE EWS-Box, network",
    timing=TCP_TIMING,
    dials_in=True,
)
"""Over the network: boxes dial a `Listener`, which has a bus for each."""

__all__ = [
    "NETWORK",
    "PROTOCOL",
    "EwsPort",
    "EwsPortConfig",
    "Listener",
    "Stranger",
]
