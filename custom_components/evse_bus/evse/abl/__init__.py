"""ABL EVCC2/3 (eMH1, eMH2, eMH3 wallboxes): Modbus ASCII on RS-485."""

from itertools import permutations
import re
from typing import Final

from ..address import NumberAddress
from ..framing import LineSettings
from ..modbus import AsciiFramer
from ..options import Choice, Toggle
from ..protocol import Make, Protocol
from ..redaction import SerialNumbers
from .charger import AblCharger
from .config import TIMING, AblConfig
from .device_id import change_device_id
from .scan import scan

_PHASE_ORDER: Final = Choice(
    name="phase_order",
    default="321",
    values={"".join(map(str, one)): [*one] for one in permutations((1, 2, 3))},
    value=tuple,
)

_SERIALS: Final = SerialNumbers(
    encode=lambda serial: serial.encode().hex().upper().encode(),
    # The answer to a read of register 0x50, whose first byte repeats the 50.
    in_frame=re.compile(rb"(?<=03[0-9A-F]{2}50)[0-9A-F]+"),
    in_rest=re.compile(rb"\A[0-9A-F]+"),
)

PROTOCOL: Final = Protocol(
    key="abl",
    name="ABL EVCC2/3",
    make=Make(key="abl", name="ABL"),
    settings=LineSettings(baudrate=38400, parity="E"),
    timing=TIMING,
    framer=AsciiFramer,
    config=AblConfig,
    charger=AblCharger,
    scan=scan,
    change_address=change_device_id,
    address=NumberAddress(key="device_id", lowest=1, highest=16),
    options=(_PHASE_ORDER, Toggle(name="enable_again")),
    serials=_SERIALS,
)

__all__ = ["PROTOCOL", "AblCharger", "AblConfig"]
