"""Lowering MAX in the box: one EEPROM write, and access as it was before.

It is the only bound of the current with which a charge begins (PROTOCOLS.md, 3).
"""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
)
from custom_components.evse_bus.evse.model import OrderChange, Setting
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from tests.simulated_time import now, simulate
from tests.virtual.smartevse_outlet import SmartEvseOutlet
from tests.virtual.smartevse_outlet3 import SmartEvseOutlet3

from .polled_scene import ALL, LATER, PolledScene, as_write, play
from .scene import MasterScene

LIMIT = 10
"""Of the installation, A; the box has 16 A."""

each = pytest.mark.parametrize("dialect", ALL)


class Before(StrEnum):
    """What the box was doing before the write."""

    FREE = "no car"
    CHARGING = "charging"
    OFF = "access off, no car"
    OFF_WITH_CAR = "access off, car in"


class Trouble(StrEnum):
    """What happens at the write."""

    NONE = "none"
    REPLY_LOST = "reply lost"
    REQUEST_LOST = "request lost"
    ACCESS_REPLY_LOST = "reply to the write of access lost"
    ACCESS_REQUEST_LOST = "write of access lost"
    BACK_LOST = "read-back lost"
    LINE_LOST = "line lost right after the write"
    POWER_FAILURE = "power failure of the box right after the write"
    STOP = "Home Assistant stops right after the write, and starts again"


@dataclass
class MaximumScene(PolledScene):
    """A box whose MAX is above the installation limit."""

    installation: float = LIMIT

    @property
    def register(self) -> int:
        return MAPS[self.dialect].settings[Setting.MAXIMUM_CURRENT].register

    @property
    def eeprom_writes(self) -> int:
        return sum(self.box.controller.eeprom_writes.values())

    async def lower(self) -> None:
        await self.charger.configure(Setting.MAXIMUM_CURRENT, LIMIT, only_lower=True)

    async def begin(self, before: Before) -> None:
        if before in (Before.OFF, Before.OFF_WITH_CAR):
            # At the box: Home Assistant has no order that would close it again.
            self.outlet.set_access(False)
        if before is Before.OFF_WITH_CAR:
            self.car.plug_in()
        if before is Before.CHARGING:
            await self.charge()
        await self.polled(3)

    def meet(self, trouble: Trouble) -> asyncio.Task[None] | None:
        """Let it happen at the write of MAX, once."""
        if trouble is Trouble.LINE_LOST:
            return asyncio.create_task(self._after_the_write(self.line.unplug))
        if trouble is Trouble.POWER_FAILURE:
            cut = self.box.controller.power_cycle
            return asyncio.create_task(self._after_the_write(cut))
        if trouble is Trouble.STOP:
            return asyncio.create_task(self._stop_after_the_write())
        registers = {
            Trouble.REPLY_LOST: self.register,
            Trouble.REQUEST_LOST: self.register,
            Trouble.ACCESS_REPLY_LOST: self.layout.access_register,
            Trouble.ACCESS_REQUEST_LOST: self.layout.access_register,
        }
        if trouble in registers:
            request_lost = trouble in (
                Trouble.REQUEST_LOST,
                Trouble.ACCESS_REQUEST_LOST,
            )
            self._lose(registers[trouble], is_request=request_lost)
        if trouble is Trouble.BACK_LOST:
            self._lose_read_back()
        return None

    def _lose(self, register: int, *, is_request: bool) -> None:
        """Lose the first request that writes a register, or the reply to it."""
        lost: list[bytes] = []

        def is_it(data: bytes) -> bool:
            if data[1] != 0x10 or lost or int.from_bytes(data[2:4]) != register:
                return False
            lost.append(data)
            return True

        if is_request:
            self.box.misses = is_it
        else:
            self.box.loses = is_it

    def _lose_read_back(self) -> None:
        """Lose the first reply to a read of the settings after the write."""
        first = MAPS[self.dialect].configuration[0]
        length = 3 + 2 * first.words + 2
        lost: list[bytes] = []

        def is_it(data: bytes) -> bool:
            written = self.writes(self.register)
            if lost or not written or data[1] != 4 or len(data) != length:
                return False
            lost.append(data)
            return True

        self.box.loses = is_it

    async def _after_the_write(self, happens) -> None:  # type: ignore[no-untyped-def] # noqa: ANN001
        await self.until(lambda: bool(self.eeprom_writes))
        happens()

    async def _stop_after_the_write(self) -> None:
        await self.until(lambda: bool(self.eeprom_writes))
        await self.restart(away=5.0)


@each
@pytest.mark.parametrize("before", Before)
@pytest.mark.parametrize("trouble", Trouble)
def test_one_write_and_access_as_before(
    dialect: Dialect, before: Before, trouble: Trouble
) -> None:
    async def acts(scene: MaximumScene) -> None:
        await scene.begin(before)
        access = scene.outlet.access
        assert access is (before in (Before.FREE, Before.CHARGING))
        most: list[float] = [0.0]
        scene.on_step.append(lambda: most.append(scene.box.offers))
        happens = scene.meet(trouble)
        with suppress(EvseError):
            await scene.lower()
        if happens is not None:
            await happens
        await asyncio.sleep(60)
        await scene.settled()
        taken = trouble is not Trouble.REQUEST_LOST
        assert scene.eeprom_writes == taken
        assert scene.outlet.settings["max_current"] == (LIMIT if taken else 16)
        assert scene.reading.settings[Setting.MAXIMUM_CURRENT] == (
            LIMIT if taken else 16
        )
        # A car that is in may begin where access could not be closed in time.
        late = trouble in (Trouble.LINE_LOST, Trouble.POWER_FAILURE)
        if not access:
            assert not scene.outlet.access
            assert scene.box.offers == 0
            assert late or max(most) == 0
        if before is Before.CHARGING:
            assert scene.box.offers == LIMIT
        if trouble is not Trouble.POWER_FAILURE:
            assert max(most) <= LIMIT

        # Asked for again, it already stands.
        await scene.lower()
        assert scene.eeprom_writes == 1

    play(MaximumScene(dialect), acts)


@each
@pytest.mark.parametrize("trouble", Trouble)
def test_the_caller_learns_whether_it_is_certain(
    dialect: Dialect, trouble: Trouble
) -> None:
    async def acts(scene: MaximumScene) -> None:
        await scene.begin(Before.OFF_WITH_CAR)
        happens = scene.meet(trouble)
        uncertain = trouble in (
            Trouble.REQUEST_LOST,
            Trouble.LINE_LOST,
        )
        if uncertain:
            with pytest.raises(EvseError):
                await scene.lower()
        else:
            await scene.lower()
            assert not scene.outlet.access
            assert scene.outlet.settings["max_current"] == LIMIT
        if happens is not None:
            await happens

    play(MaximumScene(dialect), acts)


@each
@pytest.mark.parametrize("deaf_for", [0.3, 0.8, 1.2])
def test_access_is_closed_at_once_although_requests_are_lost(
    dialect: Dialect, deaf_for: float
) -> None:
    """A later box that is left alone works its cycle, and a car would begin."""

    async def acts(scene: MaximumScene) -> None:
        await scene.begin(Before.OFF_WITH_CAR)
        opened: list[float] = []
        scene.on_step.append(
            lambda: opened.append(now()) if scene.outlet.access else None
        )
        scene.box.misses = lambda _data: bool(opened) and now() < opened[0] + deaf_for
        with suppress(EvseError):
            await scene.lower()
        await scene.polled(2)
        assert not scene.outlet.access
        assert opened[-1] - opened[0] < 3

    play(MaximumScene(dialect), acts)


@each
def test_nothing_is_written_before_the_settings_were_read(dialect: Dialect) -> None:
    """The value may stand already: set in its menu, a minute ago."""

    async def acts(scene: MaximumScene) -> None:
        await scene.polled(2)
        scene.outlet.settings["max_current"] = LIMIT
        blocks = [block.register for block in MAPS[dialect].configuration]
        scene.box.misses = lambda data: int.from_bytes(data[2:4]) in blocks
        with pytest.raises(NotAvailableError, match="nothing was written"):
            await scene.lower()
        assert not scene.writes(scene.register)

    play(MaximumScene(dialect), acts)


@each
def test_a_lower_maximum_is_not_raised(dialect: Dialect) -> None:
    """Set in its menu a moment ago, and not read yet."""

    async def acts(scene: MaximumScene) -> None:
        await scene.polled(2)
        scene.outlet.settings["max_current"] = 8
        await scene.lower()
        assert not scene.writes(scene.register)
        assert scene.reading.settings[Setting.MAXIMUM_CURRENT] == 8

    play(MaximumScene(dialect), acts)


@each
def test_nothing_is_written_while_access_has_no_known_value(dialect: Dialect) -> None:
    async def acts(scene: MaximumScene) -> None:
        scene.outlet.access = 5
        with pytest.raises(NotAvailableError, match="nothing was written"):
            await scene.lower()
        assert not scene.writes(scene.register)

    play(MaximumScene(dialect), acts)


@each
def test_a_start_by_the_user_meanwhile_stands(dialect: Dialect) -> None:
    async def acts(scene: MaximumScene) -> None:
        await scene.begin(Before.OFF)
        start = scene.charger.change_orders(OrderChange(allowed=True))
        await asyncio.gather(scene.lower(), start)
        await scene.polled(3)
        assert scene.outlet.access
        assert scene.eeprom_writes == 1

    play(MaximumScene(dialect), acts)


@each
def test_the_write_waits_for_the_quiet(dialect: Dialect) -> None:
    async def acts(scene: MaximumScene) -> None:
        await scene.begin(Before.CHARGING)
        # The burst of the last poll is over.
        await asyncio.sleep(1.5)
        last = scene.line.sent[-1].when
        await scene.lower()
        first = next(one.when for one in scene.line.sent if one.when > last)
        if dialect in LATER:
            assert first - last >= 6.5
        assert scene.outlet.error == 0

    play(MaximumScene(dialect), acts)


@each
def test_what_is_urgent_does_not_wait_for_it(dialect: Dialect) -> None:
    """A power failure opens access that was off; the write waits for its quiet then."""

    async def acts(scene: MaximumScene) -> None:
        await scene.begin(Before.OFF_WITH_CAR)
        # The burst of the last poll is over: a later box has its quiet.
        await asyncio.sleep(1.5)
        lowered = asyncio.create_task(scene.lower())
        await asyncio.sleep(0.1)
        scene.box.controller.power_cycle()
        opened = now()
        await scene.until(lambda: not scene.outlet.access, 60)
        assert now() - opened < 8
        await asyncio.wait({lowered})
        await scene.polled(3)
        assert not scene.outlet.access

    play(MaximumScene(dialect, allowed=False), acts)


@each
def test_a_box_that_refuses_it(dialect: Dialect) -> None:
    async def acts(scene: MaximumScene) -> None:
        scene.box.misses = lambda data: (
            (write := as_write(0.0, data)) is not None
            and write.register == scene.register
        )
        with pytest.raises(NotConfirmedError, match="did not take"):
            await scene.lower()
        assert len(scene.writes(scene.register)) == 1

    play(MaximumScene(dialect), acts)


@each
def test_the_current_with_which_a_charge_begins(dialect: Dialect) -> None:
    async def acts(scene: MaximumScene) -> None:
        assert scene.charger.begins_with == 16
        await scene.lower()
        assert scene.charger.begins_with == LIMIT

    scene = MaximumScene(dialect)
    assert scene.charger.begins_with is None
    play(scene, acts)


# -- As a node of our master -------------------------------------------------------


@pytest.mark.parametrize("plugged", [False, True])
@pytest.mark.parametrize(
    ("name", "opens"),
    [
        *((name, False) for name in ("2.17", "2.20", "2.30", "2.30+", "3", "3.00")),
        *((name, True) for name in ("3", "3.00")),
    ],
)
def test_a_node_keeps_its_access(name: str, *, plugged: bool, opens: bool) -> None:
    """Turned off at the box; whether a 3.x opens it at such a write is not known."""

    async def run() -> None:
        scene = MasterScene(units=(), dialect=name)
        box = scene.plug_box(2)
        out = box.controller.outlet
        if opens:
            assert isinstance(out, SmartEvseOutlet3)
            out.version = replace(out.version, settings_open_access=True)
        scene.add(2)
        async with scene:
            slave = scene.slave(2)
            await scene.until(lambda: bool(slave.settings))
            out.set_access(False)
            if plugged:
                box.car.plug_in()
            await asyncio.sleep(5)
            written = flash_writes(out)
            await slave.configure(Setting.MAXIMUM_CURRENT, LIMIT)
            await slave.configure(Setting.MAXIMUM_CURRENT, LIMIT)
            await asyncio.sleep(5)
            assert not out.access
            assert out.settings["max_current"] == LIMIT
            assert sum(box.controller.eeprom_writes.values()) == 1
            assert box.offers == 0
            assert slave.begins_with is None
            if not opens:
                assert flash_writes(out) == written

    simulate(run())


def flash_writes(outlet: SmartEvseOutlet) -> int:
    """Return how often a 3.x has stored its access."""
    return outlet.flash_writes if isinstance(outlet, SmartEvseOutlet3) else 0
