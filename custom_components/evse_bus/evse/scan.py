"""What a scan of a bus found."""

from dataclasses import dataclass

from .readings import ChargerInfo

type Address = int | str
"""Where a charger is on its bus; of a box that is alone there, its serial number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundCharger:
    """A charger that answered a scan."""

    address: Address
    info: ChargerInfo
    serial: str | None = None
    maximum_current: float | None = None
    """Maximum that it told, A."""
    connectors: int = 1
    maximum_currents: tuple[float | None, ...] = ()
    """Of each port, where a box has ports of its own, A."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanResult:
    """What a scan of a bus found."""

    found: tuple[FoundCharger, ...] = ()
    duplicates: tuple[int, ...] = ()
    """Addresses at which more than one charger answers."""
    unreadable: bool = False
    """Bytes came that no frame could be made of: wrong protocol or parity."""
    unsupported: tuple[FoundCharger, ...] = ()
    """Those that answered with a firmware that cannot be used this way."""
    other_master: bool = False
    """Another master speaks on this line; so we said nothing."""
