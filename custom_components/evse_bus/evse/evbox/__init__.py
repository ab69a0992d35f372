"""EVBox Protocol Max v4: ChargePoints with up to 20 ChargeBox modules each."""

from typing import Final

from ..charger import Charger
from ..model import ChargerConfig, Orders
from ..protocol import Protocol
from .charger import EvboxCharger
from .config import EvboxConfig, evbox_config
from .frames import EvboxFramer
from .scan import scan
from .timing import SETTINGS, TIMING

__all__ = ["PROTOCOL", "EvboxCharger", "EvboxConfig"]


def _charger(config: ChargerConfig, orders: Orders) -> Charger:
    return EvboxCharger(evbox_config(config), orders)


PROTOCOL: Final = Protocol(
    key="evbox",
    name="EVBox Protocol Max v4",
    settings=SETTINGS,
    timing=TIMING,
    framer=EvboxFramer,
    config=EvboxConfig,
    charger=_charger,
    scan=scan,
    probe_imposes=True,
)
