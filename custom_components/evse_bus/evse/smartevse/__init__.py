"""SmartEVSE v2: Modbus RTU on RS-485, polled or with us as load-balancing master."""

from typing import Final

from ..framing import LineSettings
from ..modbus import RtuFramer
from ..protocol import Protocol
from .charger import PolledSmartEvse
from .config import PolledConfig, SlaveConfig
from .master import Master
from .master_scan import scan as master_scan
from .scan import scan
from .slave import SlaveSmartEvse
from .timing import TIMING

SETTINGS: Final = LineSettings(baudrate=9600)

POLLED: Final = Protocol(
    key="smartevse",
    name="SmartEVSE v2",
    settings=SETTINGS,
    timing=TIMING,
    framer=RtuFramer,
    config=PolledConfig,
    charger=PolledSmartEvse,
    scan=scan,
)

MASTER: Final = Protocol(
    key="smartevse_master",
    name="SmartEVSE v2, load balancing",
    settings=SETTINGS,
    timing=TIMING,
    framer=RtuFramer,
    config=SlaveConfig,
    charger=SlaveSmartEvse,
    scan=master_scan,
    master=Master,
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
