"""What the user sets up for a ChargePoint."""

from dataclasses import dataclass

from ..model import ChargerConfig
from .frames import ANY_SERIAL, INFORMATION_LENGTH, LARGEST_SERIAL, CommandNumber


@dataclass(frozen=True, slots=True, kw_only=True)
class EvboxConfig(ChargerConfig):
    """A ChargePoint; its address is its serial number, 0: whoever is there.

    Raises ValueError for what cannot be sent.
    """

    command: CommandNumber = 68
    """69 for boxes that do not know 68: no serial number, no voltages."""
    information: bytes = bytes(INFORMATION_LENGTH)
    """Information module (68), passed on by the box: byte 1 vendor code, bytes 8-9
    the maximum current of the connection in A, the rest free."""

    def __post_init__(self) -> None:
        """Check what the encoder could not say."""
        if self.command not in (68, 69):
            message = f"command {self.command} is neither 68 nor 69"
            raise ValueError(message)
        if not ANY_SERIAL <= self.address <= LARGEST_SERIAL:
            message = f"serial number {self.address} has no 8 digits"
            raise ValueError(message)
        if len(self.information) != INFORMATION_LENGTH:
            message = f"information module of {len(self.information)} bytes, not 16"
            raise ValueError(message)

    @property
    def addressed(self) -> int:
        """Return the serial number that is addressed; 0: whoever is there."""
        return self.address if self.command == 68 else ANY_SERIAL  # noqa: PLR2004
