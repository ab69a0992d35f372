"""The result of a scan of a bus."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from .model import FailSafe
from .readings import ChargerInfo
from .round_trip import RoundTrip

type Address = int | str
"""Address of a charger on its bus; of a box that is alone there, its serial number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundCharger:
    """A charger that answered a scan."""

    address: Address
    info: ChargerInfo
    serial: str | None = None
    maximum_current: float | None = None
    """Maximum that it reports, A."""
    connectors: int = 1
    maximum_currents: tuple[float | None, ...] = ()
    """Of each port, where a box has ports of its own, A."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """What was read of it beside its serial number and is kept, as `Charger.facts`."""
    fail_safe: FailSafe | None = None
    """What it does when no message comes; ``None``: that of its protocol."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanResult:
    """The result of a scan of a bus."""

    found: tuple[FoundCharger, ...] = ()
    duplicates: tuple[int, ...] = ()
    """Addresses at which more than one charger answers."""
    unreadable: bool = False
    """Bytes came, but no good frame: wrong protocol or parity."""
    other_master: bool = False
    """Another master is active on this line; nothing was sent."""
    foreign_requests: bool = False
    """Requests of another station were received: it does not expect company."""
    gateway: bool = False
    """The adapter speaks Modbus TCP, and passes nothing on."""
    round_trip: RoundTrip | None = None
    """What the search has learnt of the line; ``None``: there was none."""
