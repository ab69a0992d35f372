"""EVBox Protocol Max v4: ChargePoints with up to 20 ChargeBox modules each."""

import re
from typing import Final

from ..address import NumberAddress
from ..options import Choice, HexBytes, Toggle
from ..protocol import Make, Protocol
from ..redaction import SerialNumbers
from .charger import EvboxCharger
from .config import SETTINGS, TIMING, EvboxConfig
from .frames import ANY_SERIAL, INFORMATION_LENGTH, LARGEST_SERIAL, EvboxFramer
from .scan import scan

_COMMAND: Final = Choice(
    name="command",
    default="68",
    values={"68": 68, "69": 69},
    # It has no serial number, so every box obeys it.
    alone=frozenset({"69"}),
    before_search=True,
)
_INFORMATION: Final = HexBytes(
    name="information",
    default=bytes(INFORMATION_LENGTH).hex(),
    length=INFORMATION_LENGTH,
)

_SERIALS: Final = SerialNumbers(
    encode=lambda serial: serial.zfill(8).encode(),
    # Eight digits behind command 68; fewer where a frame was cut off.
    in_frame=re.compile(rb"(?<=68)[0-9]{8}|(?<=A08068|80A068)[0-9]{1,8}"),
    in_rest=re.compile(rb"\A[0-9]{1,8}"),
)

PROTOCOL: Final = Protocol(
    key="evbox",
    name="EVBox Protocol Max v4",
    make=Make(key="evbox", name="EVBox"),
    settings=SETTINGS,
    timing=TIMING,
    framer=EvboxFramer,
    config=EvboxConfig,
    charger=EvboxCharger,
    scan=scan,
    probe_sets_limits=True,
    address=NumberAddress(
        key="serial_number",
        lowest=ANY_SERIAL,
        highest=LARGEST_SERIAL,
        digits=8,
        any=ANY_SERIAL,
        is_serial=True,
    ),
    options=(_COMMAND, _INFORMATION, Toggle(name="one_phase_modules")),
    serials=_SERIALS,
    private=frozenset({"information"}),
)

__all__ = ["PROTOCOL", "EvboxCharger", "EvboxConfig"]
