"""A line with any mix of boxes that our master may have, and what it must keep to.

The witness looks at the virtual boxes alone: what their pilots offer while the
contactors are closed, when a contactor closes, and which registers were written.
"""

import asyncio
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from random import Random
from typing import Literal, override

from custom_components.evse_bus.evse.errors import EvseError, LineLostError
from custom_components.evse_bus.evse.model import (
    MINIMUM_CURRENT,
    Circuit,
    CurrentLimit,
    OrderChange,
    Orders,
)
from custom_components.evse_bus.evse.smartevse.config import SlaveConfig
from custom_components.evse_bus.evse.smartevse.dialects import Dialect as KeptDialect
from custom_components.evse_bus.evse.smartevse.master import PERIOD
from custom_components.evse_bus.evse.smartevse.slave import SlaveSmartEvse
from tests.evse.smartevse.scene import Box, MasterScene, Sent
from tests.simulated_time import now
from tests.virtual import Car, SmartEvseController
from tests.virtual.smartevse_outlet3 import SmartEvseOutlet3
from tests.virtual.smartevse_registers import DIALECTS, LINES_3, Dialect

FAMILIES: Mapping[str, tuple[str, ...]] = {
    "2.17": ("2.17",),
    "2.20": ("2.20",),
    "2.30": ("2.30", "2.30+", *(line.name for line in LINES_3)),
}
UNITS: Mapping[str, range] = {
    "2.17": range(2, 5),
    "2.20": range(2, 9),
    "2.30": range(2, 9),
}
INSTALLATION = 32.0
KEPT: Mapping[str, KeptDialect] = {
    "2.17": KeptDialect.V2_17,
    "2.20": KeptDialect.V2_20,
    "2.30": KeptDialect.V2_30,
    "2.30+": KeptDialect.V2_HEAD,
    **{line.name: KeptDialect.V3_OLD for line in LINES_3},
    "3": KeptDialect.V3,
}
"""The names of the library."""

CROSSED = 1.0
"""A grant may have been on its way when a start was forbidden, s."""
SETTLES = 4.0
"""A lower supply counts once each box has received two broadcasts, s."""
LETS_GO = 8.0
"""C1: PWM off, contactor closed for up to 7 s, until the car lets go, s."""
RETURNS = 90.0
"""After another master: 60 s of silence, and what its boxes go on with, s."""
SETTLED = 12.0
"""After that long with broadcasts, and all well, each order is obeyed, s."""
PATIENCE = 60.0
"""Longest wait for that: a bus begins anew, and reads its boxes first, s."""
STANDING = 20.0
"""A command may be carried out so long after it was given, s."""
EPSILON = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxSpec:
    """A box with its unknowns."""

    dialect: str
    cable: int = 32
    maximum: int = 32
    fixed: bool = False
    smart: bool = False
    """Its mode is not normal."""
    delay: float = 0.008
    late: Literal["no", "before", "after"] = "no"
    """Its answers while it measures a cable."""
    second: float = 1.0
    reaction: float = 0.5
    ramp: float = 3.0
    insists: bool = False
    """Its car goes on requesting without PWM."""
    pilot_cut: int = 5
    mode_opens_access: bool = True
    highest_access: int | None = None
    access_stored: bool | None = None
    """3.5 and 3.6 only: not settled."""
    modem: int = 0
    kept: bool = False
    """Its dialect is known from earlier."""
    allowed: bool = True
    limit: float = 32.0
    """Its orders at the beginning: whether it may charge, and with how much, A."""
    access: bool = True
    """At the beginning, as its switch has it."""

    @property
    def row(self) -> Dialect:
        """Return its dialect, with the unknowns of 3.x."""
        dialect = DIALECTS[self.dialect]
        version = dialect.version3
        if version is None:
            return dialect
        if self.dialect == "3.6" and self.access_stored is not None:
            version = replace(version, access_stored=self.access_stored)
        # Where access is volatile, other values are ignored.
        highest = self.highest_access if version.access_stored else 1
        version = replace(
            version,
            pilot_cut=self.pilot_cut,
            mode_opens_access=self.mode_opens_access,
            highest_access=highest,
            modem=self.modem,
        )
        return replace(dialect, version3=version)

    def plug(self, unit: int) -> Box:
        """Return the box."""
        car = Car(
            max_current=32.0,
            reaction=self.reaction,
            ramp=self.ramp,
            requests_without_pwm=self.insists,
        )
        controller = SmartEvseController(
            self.row,
            car,
            cable=self.cable,
            settings={
                "load_balance": unit,
                "max_current": self.maximum,
                "config": int(self.fixed),
                "mode": int(self.smart),
            },
        )
        controller.holds_requests = self.late != "no"
        controller.answers_as_before = self.late == "before"
        if not isinstance(controller.outlet, SmartEvseOutlet3):
            controller.outlet.second *= self.second
        if not self.access:
            controller.outlet.set_access(allowed=False)
        return Box(controller, car, delay=self.delay)


@dataclass
class Watch:
    """What one box was seen to do, and may do."""

    closed: bool = False
    offered: float = 0.0
    """Its last PWM while the contactor was closed, A."""
    allowed: bool = True
    """The newest order: a pause forbids a start at once, confirmed or not."""
    limits: tuple[float, ...] = (16.0,)
    """The limit that was confirmed, or all that may count, the newest last, A."""
    forbidden_since: float = float("-inf")
    """Neither of these has let it begin since then."""
    off_since: float | None = None
    """Access was turned off at the box."""
    on_at: float = float("-inf")
    """The last order that it may charge."""
    writes: int = 0
    """Number of those that were looked at."""

    @property
    def limit(self) -> float:
        return max(self.limits)

    @property
    def may_begin(self) -> bool:
        return self.allowed and self.limits[-1] >= MINIMUM_CURRENT


@dataclass
class MixScene(MasterScene):
    """Our master, a mix of boxes, and the witness."""

    specs: Mapping[int, BoxSpec] = field(default_factory=dict)
    watch: bool = False
    damaged: bool = False
    """Replies are damaged on their way."""
    watched: dict[int, Watch] = field(init=False, default_factory=dict)
    found: dict[int, KeptDialect] = field(init=False, default_factory=dict)
    excused: Counter[str] = field(init=False, default_factory=Counter)
    """Reasons why more than the supply was no fault, and for how many steps."""
    wrong: list[str] = field(init=False, default_factory=list)
    _old_supply: float = field(init=False, default=0.0)
    _lowered_at: float = field(init=False, default=float("-inf"))
    _broadcast_at: float = field(init=False, default=float("-inf"))
    _broadcasts_since: float = field(init=False, default=float("inf"))
    _other_since: float | None = field(init=False, default=None)
    _other_until: float = field(init=False, default=float("-inf"))

    @override
    def plug_box(self, unit: int, dialect: str | None = None) -> Box:
        box = self.line.boxes[unit] = self.specs[unit].plug(unit)
        spec = self.specs[unit]
        self.watched[unit] = Watch(
            allowed=spec.allowed,
            limits=(spec.limit,),
            off_since=None if spec.access else now(),
        )
        return box

    @override
    def make(self, unit: int, **orders: object) -> SlaveSmartEvse:
        spec = self.specs[unit]
        config = SlaveConfig(
            key=str(unit),
            name=f"slave {unit}",
            address=unit,
            installation_limit=INSTALLATION,
            dialect=self.found.get(unit, KEPT[spec.dialect] if spec.kept else None),
        )
        usual = {"limit": CurrentLimit(current=spec.limit), "allowed": spec.allowed}
        return SlaveSmartEvse(config, Orders(**(usual | orders)))  # type: ignore[arg-type]

    async def restart(self, *, reload: bool) -> None:
        """Restart the library, which has stored its orders; the boxes go on."""
        slaves = [self.slave(unit) for unit in self.units]
        orders = {slave.unit: slave.orders for slave in slaves}
        for slave in slaves:
            if slave.dialect is not None:
                # It is kept with the charger.
                self.found[slave.unit] = slave.dialect
        await self.bus.stop()
        self.new_bus(reload=reload)
        for unit, one in orders.items():
            self.add(unit, limit=one.limit, allowed=one.allowed)
        await self.bus.start()

    # -- What is done to it --------------------------------------------------------

    async def order(self, unit: int, change: OrderChange) -> None:
        """Change orders: a limit counts once it was confirmed, a pause at once."""
        watch = self.watched[unit]
        could_begin = watch.may_begin
        if change.allowed is not None:
            watch.allowed = change.allowed
        if change.allowed:
            watch.on_at = now()
        if change.current is not None:
            watch.limits = (*watch.limits, change.current)
        if could_begin and not watch.may_begin:
            watch.forbidden_since = now()
        await self.slave(unit).change_orders(change)
        if change.current is not None:
            watch.limits = (change.current,)

    async def change_supply(self, limit: float) -> None:
        """Change the limit of the supply."""
        before = max(self._supply(), self.master.circuit.limit)
        if limit < before:
            self._old_supply, self._lowered_at = before, now()
        self.limit = limit
        await self.master.change_circuit(Circuit(limit=limit, minimum=self.minimum))

    def press(self, unit: int) -> None:
        """Turn access on or off at the box."""
        outlet = self.box(unit).controller.outlet
        outlet.set_access(not outlet.access)
        self.watched[unit].off_since = None if outlet.access else now()

    def power_cycle(self, unit: int) -> None:
        """Take power from a box for a moment."""
        self.box(unit).controller.power_cycle()
        self.watched[unit].off_since = None

    def unplug_adapter(self, *, away: bool) -> None:
        """Take the adapter away, or put it back."""
        if away:
            self.line.refuse_open = LineLostError("unplugged")
            self.line.unplug()
        else:
            self.line.refuse_open = None

    def other_master(self, dialect: str, *, present: bool) -> None:
        """Let another master speak, for the same supply."""
        if not present:
            if self.line.boxes.pop(1, None) is not None:
                self._other_until = now() + RETURNS
                self._other_since = None
            return
        controller = SmartEvseController(
            DIALECTS[dialect],
            Car(),
            settings={"load_balance": 1, "circuit": max(10, int(self.limit))},
        )
        controller.step(now())
        self.line.boxes[1] = Box(controller, Car())
        self._other_since = now()

    # -- The witness ---------------------------------------------------------------

    @override
    def step(self) -> None:
        self.line.live()
        total = 0.0
        for unit, watch in self.watched.items():
            self._check_access(unit, watch)
            total += self._look(unit, watch)
        self.most = max(self.most, total)
        over = total - self.master.circuit.limit
        if over <= EPSILON:
            return
        reason = self._excuse(total)
        if reason:
            self.excused[reason] += 1
        else:
            offers = {u: w.offered for u, w in self.watched.items() if w.closed}
            self._note(f"{total:g} A of {self.master.circuit.limit:g} A: {offers}")

    def _note(self, what: str) -> None:
        self.wrong.append(f"{now():.2f} {what}")

    def _look(self, unit: int, watch: Watch) -> float:
        """Return the most that the car at a box may be drawing, A."""
        box = self.box(unit)
        outlet = box.controller.outlet
        if not outlet.contactor:
            watch.closed, watch.offered = False, 0.0
            return 0.0
        if not watch.closed:
            self._begins(unit, watch)
        watch.closed = True
        if outlet.pilot_current:
            watch.offered = outlet.pilot_current
            self._check_limit(unit, watch)
        # Without PWM (C1) the car still has what it was offered last.
        return watch.offered

    @property
    def beside_another(self) -> bool:
        """Return whether another master is there, or was a while ago."""
        return self._other_since is not None or now() < self._other_until

    def _begins(self, unit: int, watch: Watch) -> None:
        """Look at the moment in which a contactor closes."""
        if self.beside_another:
            self.excused["another master lets a box begin"] += 1
            return
        if not watch.may_begin:
            if now() - watch.forbidden_since > CROSSED:
                self._note(f"{unit} begins, and is not allowed")
            else:
                self.excused["a pause was ordered after the grant"] += 1
        off = watch.off_since
        if off is not None and not self.box(unit).controller.outlet.access:
            if now() - off > CROSSED:
                self._note(f"{unit} begins without access")
            else:
                self.excused["access was turned off after the grant"] += 1

    def _check_access(self, unit: int, watch: Watch) -> None:
        """Look whether we turn access on that was turned off at the box."""
        controller = self.box(unit).controller
        register = self.specs[unit].row.register_of("access")
        for write in controller.writes[watch.writes :]:
            if (write.register, write.values) != (register, (1,)):
                continue
            off, watch.off_since = watch.off_since, None
            if off is None or self.beside_another:
                continue
            if off > watch.on_at + STANDING:
                self._note(f"{unit}: access was turned on, which the box had off")
        watch.writes = len(controller.writes)

    def _check_limit(self, unit: int, watch: Watch) -> None:
        spec = self.specs[unit]
        cable = spec.maximum if spec.fixed else spec.cable
        most = min(cable, spec.maximum, INSTALLATION, watch.limit)
        if watch.offered <= most + EPSILON or self.beside_another:
            return
        self._note(f"{unit} offers {watch.offered:g} A, of {most:g} A")

    def _supply(self) -> float:
        """Return the supply that counts now, A."""
        if now() < self._lowered_at + SETTLES:
            return self._old_supply
        return self.master.circuit.limit

    def _excuse(self, total: float) -> str:
        """Return why more than the supply is no fault of any master; else nothing."""
        if self.beside_another:
            return "another master"
        since = now() - self._lowered_at
        if total > self._old_supply + EPSILON or since > SETTLES + LETS_GO:
            return ""
        if since > SETTLES:
            # Those that were stopped hold the contactor until their cars let go.
            stopped = sum(
                watch.offered
                for unit, watch in self.watched.items()
                if watch.closed and not self.box(unit).controller.outlet.pilot_current
            )
            kept = total - stopped <= self.master.circuit.limit + EPSILON
            return "a lowered supply: cars let go (C1)" if kept else ""
        if not self._is_broadcasting or any(
            watch.closed and self._cannot_be_reached(unit)
            for unit, watch in self.watched.items()
        ):
            # It counts from when they have received it.
            self._lowered_at = now()
        return "a lowered supply is on its way"

    @property
    def _is_broadcasting(self) -> bool:
        """Return whether our broadcasts go out: not while we begin, or have no port."""
        return now() - self._broadcast_at <= PERIOD + 0.5

    @override
    def _add_up(self, sent: Sent) -> None:
        super()._add_up(sent)
        if sent.is_broadcast:
            if not self._is_broadcasting:
                self._broadcasts_since = sent.when
            self._broadcast_at = sent.when

    def _cannot_be_reached(self, unit: int) -> bool:
        box = self.box(unit)
        lossy = box.misses(b"") or box.loses(b"")
        return box.deaf or bool(lossy) or self.damaged or not self.line.is_open

    # -- The end -------------------------------------------------------------------

    async def settle(self) -> bool:
        """Wait until each order is obeyed; return whether it may be expected at all."""
        begin = now()
        while now() < begin + PATIENCE:
            if self.beside_another:
                return False
            if self._is_broadcasting and all(
                self.slave(unit).available for unit in self.units
            ):
                since = max(begin, self._broadcasts_since)
                if now() >= since + SETTLED:
                    return True
            await asyncio.sleep(0.5)
        return False

    def check_orders(self) -> None:
        """Look at boxes that must not charge by their orders."""
        for unit, watch in self.watched.items():
            orders = self.slave(unit).orders
            limit = orders.limit.current or 0.0
            if watch.closed and (not orders.allowed or limit < MINIMUM_CURRENT):
                self._note(f"{unit} goes on, and is not allowed")

    async def pause_all(self) -> None:
        """Order a pause of each box: it confirms that, and has stopped then."""
        for unit in self.units:
            try:
                async with asyncio.timeout(STANDING):
                    await self.order(unit, OrderChange(allowed=False))
            except (EvseError, TimeoutError) as err:
                self._note(f"{unit} is not paused: {err!r}")
            # In C1 it has taken the pause; its contactor opens once the car lets go.
            if self.box(unit).offers:
                self._note(f"{unit} goes on, and its pause was confirmed")

    async def fall_silent(self) -> None:
        """Stop the library: each box stops, by itself or stopped by us."""
        slaves = [self.slave(unit) for unit in self.units]
        try:
            await asyncio.gather(*(slave.on_shutdown() for slave in slaves))
        except EvseError as err:
            self._note(f"one is not stopped: {err!r}")
        await self.bus.stop()
        await asyncio.sleep(STANDING)
        for unit, watch in self.watched.items():
            if watch.closed:
                self._note(f"{unit} goes on without a master")

    # -- What was written ----------------------------------------------------------

    def check_writes(self) -> None:
        """Look at all that the boxes were written, but by another master."""
        if self.excused["another master"] or self.beside_another:
            return
        for unit in self.watched:
            for write in self.box(unit).controller.writes:
                what = self._forbidden(unit, write.register, write.values)
                if what:
                    self._note(f"{unit}: {what} was written: {write}")

    def is_pause(self, sent: Sent) -> bool:
        """Return whether it turns off the access of one box, which was read."""
        unit, register = sent.data[0], int.from_bytes(sent.data[2:4], "big")
        if unit not in self.specs or self.slave(unit).dialect is None:
            return False
        row = self.specs[unit].row
        is_access = register == row.register_of("access") and row.version3 is None
        return is_access and sent.values == (0,)

    def _forbidden(self, unit: int, register: int, values: tuple[int, ...]) -> str:
        """Return why a register must not be written."""
        dialect = self.specs[unit].row
        if dialect.name == "2.17" and register in range(0x81, 0x85):
            return ""
        if register == dialect.register_of("access"):
            if dialect.version3:
                return "access in flash"
            return "" if values in ((0,), (1,)) else "a value of access"
        if register == dialect.register_of("state") and dialect.status_writable:
            return "" if len(values) == 2 else "more than state and error"
        return "another register"


def silent_once_granted(box: Box, *, deaf: bool) -> None:
    """Let nothing of a box arrive from its grant on, or to it either."""

    def is_lost(data: bytes) -> bool:
        return not data or box.controller.outlet.contactor

    box.loses = is_lost
    if deaf:
        box.misses = is_lost


def lossy(box: Box, share: float, dice: Random) -> None:
    """Let a share of the frames to and from a box get lost."""

    def lose(data: bytes) -> bool:
        # The witness asks without a frame whether there are losses at all.
        return not data or dice.random() < share

    box.misses = box.loses = lose
