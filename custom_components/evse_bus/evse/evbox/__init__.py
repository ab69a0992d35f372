"""EVBox Protocol Max v4: ChargePoints with up to 20 ChargeBox modules each."""

from typing import Final

from ..protocol import Protocol
from .charger import EvboxCharger
from .config import SETTINGS, TIMING, EvboxConfig
from .frames import EvboxFramer
from .scan import scan

__all__ = ["PROTOCOL", "EvboxCharger", "EvboxConfig"]


PROTOCOL: Final = Protocol(
    key="evbox",
    name="EVBox Protocol Max v4",
    settings=SETTINGS,
    timing=TIMING,
    framer=EvboxFramer,
    config=EvboxConfig,
    charger=EvboxCharger,
    scan=scan,
    probe_sets_limits=True,
)
