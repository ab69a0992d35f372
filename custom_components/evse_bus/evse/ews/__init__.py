"""P-CHARGE EWS-Box: MCS binary over RS-232 or TCP, two charge ports a box."""

from typing import Final

from ..protocol import Protocol
from .charger import EwsPort
from .config import EwsPortConfig
from .frames import EwsFramer
from .scan import scan
from .timing import SETTINGS, TIMING

PROTOCOL: Final = Protocol(
    key="ews",
    name="P-CHARGE EWS-Box",
    settings=SETTINGS,
    timing=TIMING,
    framer=EwsFramer,
    config=EwsPortConfig,
    charger=EwsPort,
    scan=scan,
)
"""On RS-232; a box on the network dials a `listener.Listener`."""

__all__ = ["PROTOCOL", "EwsPort", "EwsPortConfig"]
