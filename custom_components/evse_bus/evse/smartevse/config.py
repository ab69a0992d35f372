"""The configuration of a SmartEVSE, as entered by the user."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from ..model import ChargerConfig, Fact
from .dialects import SLAVES, Dialect


def kept_dialect(text: str) -> Dialect | None:
    """Return a kept dialect; ``None``: a later version knew more of them."""
    return Dialect(text) if text in Dialect else None


@dataclass(frozen=True, slots=True, kw_only=True)
class SmartEvseConfig(ChargerConfig):
    """A SmartEVSE; in most cases its load-balancing setting is its address."""

    facts: ClassVar[Mapping[str, Fact]] = {
        **ChargerConfig.facts,
        "dialect": Fact(kept_dialect),
    }

    poll_interval: float = 2.0
    """s; longer for a polled box of a later dialect, see `polled.QUIET`."""
    dialect: Dialect | None = None
    """The one that was found last. It is what to expect until the box was probed, as
    it is after each connect; ``None``: it never was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PolledConfig(SmartEvseConfig):
    """A SmartEVSE without load balancing, or one that is its own master."""

    live: ClassVar = ChargerConfig.live | {"stop_on_shutdown"}

    stop_on_shutdown: bool = False
    """Turn its access off on shutdown: it has no fail-safe of its own."""

    def __post_init__(self) -> None:
        """Raise ValueError for another address: slaves stop without broadcasts."""
        if self.address not in (0, 1):
            message = f"{self.address} is the address of a slave; polled are 0 and 1"
            raise ValueError(message)


@dataclass(frozen=True, slots=True, kw_only=True)
class SlaveConfig(SmartEvseConfig):
    """A SmartEVSE whose load balancing is set to slave (node) 1 to 7: unit 2 to 8."""

    def __post_init__(self) -> None:
        """Raise ValueError for an address that no slave has."""
        if self.address not in SLAVES:
            message = f"{self.address} is no address of a slave (2 to 8)"
            raise ValueError(message)
