"""The description of a protocol: all that the rest of the project knows of it.

How its line is set and its chargers made and found, and, as plain data, how a user
interface asks for its chargers: names, addresses, options. A protocol's folder has one
such description for each way in which its chargers are used.
"""

from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from .address import AddressForm
from .address_change import AddressChange, AddressChanged
from .bus import Bus
from .charger import Charger
from .dialling import Listener, ListenerFactory, Network, UnknownBoxCallback
from .framing import Frame, Framer, LineSettings, Timing
from .line import Line
from .master import BusMaster, ChargerGroup
from .memory import LineMemory
from .model import ChargerConfig, Circuit, Orders
from .options import Option
from .readings import ChargerInfo
from .redaction import SerialNumbers
from .scan import ScanResult

type Progress = Callable[[float], None]
"""Called with the share of a scan that is done, 0..1."""
type ChangeAddress = Callable[[Bus, AddressChange, Progress], Awaitable[AddressChanged]]
"""Changes the address of a charger on a started bus."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Make:
    """The chargers of one folder, as people choose them."""

    key: str
    """Key of the choice and of its text."""
    name: str
    """Short name of one charger, for titles."""
    plural: str = ""
    """The same of several; only where boxes dial."""
    menu: str = ""
    """Menu in which one of its protocols is chosen; only where it has several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CircuitRange:
    """Range of the values of a `Circuit`."""

    highest: float
    """Highest limit of all chargers together, A per phase."""
    highest_minimum: float
    """Highest minimum for each charger that charges, A."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinds:
    """Kinds of boxes that cannot have one bus together."""

    kind: Callable[[Mapping[str, str]], str | None]
    """Return the kind of a box, from its facts; ``None``: not known."""
    info: Callable[[Mapping[str, str]], ChargerInfo]
    """Return what is shown of a box whose kind is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol[C: ChargerConfig = Any]:
    """One protocol: its line, its chargers, and how to ask for them."""

    # -- Names -----------------------------------------------------------------------

    key: str
    """Stored in config entries; part of the keys of texts: ``scan_<key>`` (progress of
    a search) and ``confirm_<key>`` (last step, which explains the fail-safe)."""
    name: str
    """Full name, for texts."""
    make: Make
    choice: str = ""
    """Key of this protocol in the menu of its make, where that has one."""

    # -- The line and the chargers ---------------------------------------------------

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
    change_address: ChangeAddress | None = None
    """Gives the charger at an address another one; ``None``: that is set at the charger.

    It raises AddressChangeError, and what `Bus.run` raises while nothing is written.
    """
    interface: str = "RS-485"
    """Interface that the adapter needs."""
    probe_sets_limits: bool = False
    """Every message sets limits, so a scan does too: ask for the values first. The
    chargers have a fail-safe time-out, which is one of these values."""
    ports: int = 1
    """Most ports of one box, each a charger of its own (`ChargerConfig.address` is its
    number); 1: a box is one charger."""
    listener: ListenerFactory | None = None
    """Makes a listener, where boxes dial: that has a bus for each, and no port."""
    master: Callable[[Circuit], BusMaster] | None = None
    """Makes the master of the bus, where Home Assistant is that."""
    group: Callable[[], ChargerGroup] | None = None
    """Makes the owner of what the chargers of one bus share, where they are one box."""

    # -- Input of the user -----------------------------------------------------------

    address: AddressForm
    options: tuple[Option, ...] = ()
    circuit: CircuitRange | None = None
    """Of the shared supply; ``None``: the chargers share none. Needs a `master`."""
    asks_voltage: bool = True
    """The chargers report no power; it is estimated from the configured voltage."""
    sets_clock: bool = False
    """The clock of a box is kept right: its configuration has a ``time_zone``."""
    lifetime_is_fail_safe: bool = False
    """Nothing in a charger ends a charge when no message comes: the order lifetime is
    asked for among the first fields, not folded away."""

    kinds: Kinds | None = None
    """Kinds of boxes of which a bus may have one only; ``None``: there are none."""

    # -- Identity and privacy --------------------------------------------------------

    serials: SerialNumbers
    """Serial numbers in frames."""
    serial_identifies: bool = True
    """No two boxes have the same serial number."""
    serial_family: str | None = None
    """Common to all protocols by which the same boxes can be reached: a serial number
    is set up only once among them. ``None``: no other protocol reaches them."""
    private: frozenset[str] = frozenset()
    """Fields of configurations, readings and infos that identify a person or house,
    beside serial numbers."""

    @property
    def dials_in(self) -> bool:
        """Return whether boxes dial: there is a listener and no port."""
        return self.listener is not None

    def identity(self, serial: str | None) -> str | None:
        """Return what a box is known by on any bus; ``None``: no usable serial number.

        Blanks and zeros are those of a box that was never given a number.
        """
        if not self.serial_identifies or not (serial or "").strip(" 0"):
            return None
        return f"{self.serial_family or self.key}_{serial}"

    def bus(
        self,
        url: str,
        *,
        settings: LineSettings | None = None,
        name: str = "",
        circuit: Circuit | None = None,
        memory: LineMemory | None = None,
    ) -> Bus:
        """Return a bus of this protocol on a port; `Bus.start` opens it.

        ``circuit`` is shared by its chargers, where the bus has a master. ``memory``:
        what is known of this line; ``None``: nothing. Raises TypeError where boxes
        dial us: then the listener makes the buses.
        """
        if self.dials_in:
            message = f"{self.name}: there is no port to open, a listener has its buses"
            raise TypeError(message)
        line = Line(url, settings or self.settings)
        if memory is not None:
            line.memory = memory
        group: ChargerGroup | None = None
        if self.master is not None:
            group = self.master(circuit or Circuit())
        elif self.group is not None:
            group = self.group()
        timing, wanted = self.timing, line.settings.reply_timeout
        if wanted is not None:
            # A box may take the protocol's own time; a master's broadcasts cannot wait.
            wanted = max(wanted, timing.reply_timeout)
            if self.master is not None:
                wanted = min(wanted, timing.reply_timeout_limit)
            timing = replace(timing, reply_timeout=wanted, reply_timeout_limit=wanted)
        return Bus(line, self.framer(), timing, name, group=group)

    def listen_at(
        self,
        host: str,
        port: int,
        *,
        allowed: Iterable[Network] = (),
        on_unknown_box: UnknownBoxCallback = lambda _box: None,
    ) -> Listener:
        """Return a listener of this protocol; `Listener.start` opens it.

        Raises TypeError for a protocol whose boxes do not dial.
        """
        if self.listener is None:
            message = f"{self.name}: boxes are on a port, they do not dial"
            raise TypeError(message)
        return self.listener(host, port, allowed=allowed, on_unknown_box=on_unknown_box)
