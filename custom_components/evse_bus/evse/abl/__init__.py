"""ABL EVCC2/3 (eMH1, eMH2, eMH3 wallboxes): Modbus ASCII on RS-485."""

from typing import Final

from ..framing import LineSettings
from ..modbus import AsciiFramer
from ..protocol import Protocol
from .charger import AblCharger
from .config import TIMING, AblConfig
from .scan import scan

PROTOCOL: Final = Protocol(
    key="abl",
    name="ABL EVCC2/3",
    settings=LineSettings(baudrate=38400, parity="E"),
    timing=TIMING,
    framer=AsciiFramer,
    config=AblConfig,
    charger=AblCharger,
    scan=scan,
)

__all__ = ["PROTOCOL", "AblCharger", "AblConfig"]
