"""Configuration of one port of an EWS-Box."""

from dataclasses import dataclass
from datetime import tzinfo
from typing import ClassVar

from ..model import ChargerConfig
from .wire.commands import PORTS


@dataclass(frozen=True, slots=True, kw_only=True)
class EwsPortConfig(ChargerConfig):
    """One port; its address is its number, 1 or 2. The bus has one box.

    Raises ValueError for another number.
    """

    live: ClassVar = ChargerConfig.live | {"time_zone"}

    poll_interval: float = 2.0
    """s; as the manual proposes (3.2.3). The box hangs up after 30 s of silence."""
    time_zone: tzinfo | None = None
    """Zone that the box's clock is set to; ``None``: it is left alone."""

    def __post_init__(self) -> None:
        """Raise ValueError for a port that no box has."""
        if self.address not in PORTS:
            message = f"{self.address} is no port of an EWS-Box (1, 2)"
            raise ValueError(message)

    @property
    def port(self) -> int:
        """Return the number of the port."""
        return self.address
