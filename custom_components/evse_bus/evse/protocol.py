"""What a protocol folder offers to the bus and to whoever sets one up."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .bus import Bus
from .line import Line
from .model import Supply

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from .charger import Charger
    from .duty import Duty
    from .found import ScanReport
    from .framing import Frame, Framer, LineSettings, Timing
    from .model import ChargerConfig, Orders

type Progress = Callable[[float], None]
"""Called with the share of a scan that is done, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """One protocol: how its line looks, and how to make and find its chargers."""

    key: str
    name: str
    settings: LineSettings
    timing: Timing
    framer: Callable[[], Framer[Frame]]
    config: type[ChargerConfig]
    """What a charger of this protocol is set up with."""
    charger: Callable[[ChargerConfig, Orders], Charger]
    scan: Callable[[Bus, ChargerConfig, Orders, Progress], Awaitable[ScanReport]]
    """Look for chargers on a started bus: ``scan(bus, config, orders, progress)``.

    ``config`` and ``orders`` are what is imposed where `probe_imposes` is true.
    """
    probe_imposes: bool = False
    """Every message sets limits, so a scan does too: ask for the values first."""
    ports: int = 1
    """Most ports that one box has, each a charger of its own (`ChargerConfig.address`
    is its number); 1: a box is one charger."""
    dials_in: bool = False
    """The boxes dial us: there is a listener and no port, and a bus for each box."""
    duty: Callable[[Supply], Duty] | None = None
    """Home Assistant is the master of the bus: what that takes."""

    def bus(
        self,
        url: str,
        *,
        settings: LineSettings | None = None,
        name: str = "",
        supply: Supply | None = None,
    ) -> Bus:
        """Return a bus of this protocol on a port; `Bus.start` opens it.

        ``supply`` is what its chargers share, where the bus has a master. Raises
        TypeError where boxes dial us: then the listener makes the buses.
        """
        if self.dials_in:
            message = f"{self.name}: there is no port to open, a listener has its buses"
            raise TypeError(message)
        line = Line(url, settings or self.settings)
        duty = self.duty(supply or Supply()) if self.duty is not None else None
        return Bus(line, self.framer(), self.timing, name, duty=duty)
