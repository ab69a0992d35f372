"""What the user sets up for a SmartEVSE."""

from dataclasses import dataclass
from typing import ClassVar

from ..model import ChargerConfig
from .balancing import SLAVES
from .dialects import UNITS, Dialect


@dataclass(frozen=True, slots=True, kw_only=True)
class SmartEvseConfig(ChargerConfig):
    """A SmartEVSE; its address is its load-balancing setting, mostly.

    Raises ValueError for an address that cannot be.
    """

    poll_interval: float = 2.0
    """s; a later one that is polled is left alone for longer, see `timing.QUIET`."""
    dialect: Dialect | None = None
    """``None``: found by probing, on each connect."""

    def __post_init__(self) -> None:
        """Check the address."""
        if self.address not in UNITS:
            message = f"{self.address} is no address of a SmartEVSE (0 to 8)"
            raise ValueError(message)


@dataclass(frozen=True, slots=True, kw_only=True)
class PolledConfig(SmartEvseConfig):
    """A SmartEVSE without load balancing, or one that is its own master."""

    live: ClassVar = ChargerConfig.live | {"stop_on_shutdown"}

    stop_on_shutdown: bool = False
    """Turn its access off when everything stops: it has no fail-safe of its own."""

    def __post_init__(self) -> None:
        """Check the address: slaves stop when no master broadcasts."""
        if self.address not in (0, 1):
            message = f"{self.address} is the address of a slave; polled are 0 and 1"
            raise ValueError(message)


@dataclass(frozen=True, slots=True, kw_only=True)
class SlaveConfig(SmartEvseConfig):
    """A SmartEVSE set up as slave 1, 2 or 3: unit 2, 3 or 4."""

    def __post_init__(self) -> None:
        """Raise ValueError for an address that no slave has."""
        if self.address not in SLAVES:
            message = f"{self.address} is no address of a slave (2 to 4)"
            raise ValueError(message)
