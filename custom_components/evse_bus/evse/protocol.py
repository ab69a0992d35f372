"""The description of a protocol: how its line is set, its chargers made and found."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from .bus import Bus
from .charger import Charger
from .framing import Frame, Framer, LineSettings, Timing
from .line import Line
from .master import BusMaster, ChargerGroup
from .model import ChargerConfig, Orders, Supply
from .scan import ScanResult

type Progress = Callable[[float], None]
"""Called with the share of a scan that is done, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol[C: ChargerConfig = Any]:
    """One protocol: how its line is set, how to make and find its chargers."""

    key: str
    name: str
    settings: LineSettings
    timing: Timing
    framer: Callable[[], Framer[Frame]]
    config: type[C]
    """The configuration of a charger of this protocol."""
    charger: Callable[[C, Orders], Charger[C]]
    scan: Callable[[Bus, C, Orders, Progress], Awaitable[ScanResult]]
    """Search for chargers on a started bus: ``scan(bus, config, orders, progress)``.

    ``config`` and ``orders`` are sent where `probe_sets_limits` is true.
    """
    probe_sets_limits: bool = False
    """Every message sets limits, so a scan does too: ask for the values first."""
    ports: int = 1
    """Most ports of one box, each a charger of its own (`ChargerConfig.address` is its
    number); 1: a box is one charger."""
    dials_in: bool = False
    """The boxes dial us: there is a listener and no port, and a bus for each box."""
    master: Callable[[Supply], BusMaster] | None = None
    """Makes the master of the bus, where Home Assistant is that."""
    group: Callable[[], ChargerGroup] | None = None
    """Makes the owner of what the chargers of one bus share, where they are one box."""

    def bus(
        self,
        url: str,
        *,
        settings: LineSettings | None = None,
        name: str = "",
        supply: Supply | None = None,
    ) -> Bus:
        """Return a bus of this protocol on a port; `Bus.start` opens it.

        ``supply`` is shared by its chargers, where the bus has a master. Raises
        TypeError where boxes dial us: then the listener makes the buses.
        """
        if self.dials_in:
            message = f"{self.name}: there is no port to open, a listener has its buses"
            raise TypeError(message)
        line = Line(url, settings or self.settings)
        group: ChargerGroup | None = None
        if self.master is not None:
            group = self.master(supply or Supply())
        elif self.group is not None:
            group = self.group()
        return Bus(line, self.framer(), self.timing, name, group=group)
