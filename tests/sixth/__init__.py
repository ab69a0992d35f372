"""Sextant S6: a made-up wallbox, on RS-485 with a made-up protocol.

It has what the folder of a protocol in ``evse/`` has, and a virtual box of its own
(`virtual`). Nothing in ``custom_components`` knows it; a test adds it to the registry.
"""

import re
from typing import Final

from custom_components.evse_bus.evse.address import NumberAddress
from custom_components.evse_bus.evse.framing import LineSettings
from custom_components.evse_bus.evse.options import Quantity
from custom_components.evse_bus.evse.protocol import Make, Protocol
from custom_components.evse_bus.evse.redaction import SerialNumbers

from .charger import TIMING, SextantCharger, SextantConfig
from .frames import SextantFramer
from .scan import ADDRESSES, scan

PROTOCOL: Final = Protocol(
    key="sextant",
    name="Sextant S6",
    make=Make(key="sextant", name="Sextant"),
    settings=LineSettings(baudrate=57600),
    timing=TIMING,
    framer=SextantFramer,
    config=SextantConfig,
    charger=SextantCharger,
    scan=scan,
    address=NumberAddress(key="dial", lowest=ADDRESSES[0], highest=ADDRESSES[-1]),
    options=(Quantity(name="lamp", default=40, lowest=0, highest=100, unit="%"),),
    serials=SerialNumbers(in_frame=re.compile(rb"(?<=\$[1-9]i)[^,*\r]+")),
    private=frozenset({"owner"}),
)
