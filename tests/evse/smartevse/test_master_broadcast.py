"""The period of the master's broadcast, whatever else the bus does."""

import asyncio
from contextlib import suppress
from random import Random

import pytest

from custom_components.evse_bus.evse.errors import EvseError, LineLostError
from custom_components.evse_bus.evse.model import Circuit, OrderChange, Setting
from custom_components.evse_bus.evse.smartevse.dialects import STOPS_ALONE
from custom_components.evse_bus.evse.smartevse.master import (
    LISTENING,
    PERIOD,
    READING,
    SLACK,
)
from custom_components.evse_bus.evse.smartevse.reader import TIMING
from tests.evse.smartevse.scene import Box, MasterScene, Sent
from tests.simulated_time import now, simulate

GARBAGE = bytes(range(1, 40))


def test_it_listens_then_reads_then_broadcasts() -> None:
    async def scene() -> None:
        scene = MasterScene()
        begin = now()
        async with scene:
            await asyncio.sleep(LISTENING - 0.01)
            assert scene.line.sent == []
            await asyncio.sleep(READING)
            first = scene.broadcasts()[0]
            before = [s for s in scene.line.sent if s.when < first.when]
            # Status and settings of both, and nothing written.
            assert len(before) == 8
            assert {sent.data[1] for sent in before} == {4}
            assert first.when - begin < LISTENING + 0.5

    simulate(scene())


def test_its_period_does_not_drift() -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            await scene.until(lambda: len(scene.broadcasts()) > 1)
            begin = scene.broadcasts()[-1].when
            await asyncio.sleep(600)
            gaps = scene.gaps(begin)
            assert len(gaps) >= 299
            assert max(gaps) <= PERIOD + SLACK
            assert min(gaps) >= PERIOD - SLACK
            last = scene.broadcasts()[-1].when
            assert last - begin == pytest.approx(PERIOD * len(gaps), abs=SLACK)
            assert scene.bus.wire.statistics.missed_deadlines == 0

    simulate(scene())


class Trouble:
    """Random events beside the broadcasts."""

    def __init__(self, scene: MasterScene) -> None:
        self.scene = scene
        self.dice = Random(1)  # noqa: S311 - the same each time
        self.commands: set[asyncio.Task[None]] = set()
        self.kinds = (
            self.order,
            self.mute,
            self.drive,
            self.make_noise,
            self.foreign,
            self.remove_or_add,
            self.change_circuit,
            self.nothing,
        )

    def box(self) -> Box:
        return self.scene.box(self.dice.choice((2, 3, 4)))

    async def order(self) -> None:
        self.commands.add(asyncio.create_task(self._order()))

    async def _order(self) -> None:
        bus = self.scene.bus
        slave = bus.chargers[self.dice.choice(list(bus.chargers))]
        current = float(self.dice.choice((0, 6, 10, 13)))
        with suppress(EvseError):
            if self.dice.random() < 0.3:
                maximum = self.dice.choice((10, 16))
                await slave.configure(Setting.MAXIMUM_CURRENT, maximum)
            else:
                await slave.change_orders(OrderChange(current=current))

    async def mute(self) -> None:
        box = self.box()
        box.mute = not box.mute

    async def drive(self) -> None:
        car = self.box().car
        (car.leave if car.plugged else car.plug_in)()

    async def make_noise(self) -> None:
        self.scene.line.noise(GARBAGE[: self.dice.randrange(40)])

    async def foreign(self) -> None:
        """Send a request of a unit that is not there."""
        self.scene.line.send(bytes.fromhex("0a0600020082a9d0"))

    async def remove_or_add(self) -> None:
        gone = self.scene.bus.chargers.get("4")
        if gone is None:
            self.scene.add(4)
        elif self.dice.random() < 0.3:
            await self.scene.bus.remove(gone)

    async def change_circuit(self) -> None:
        supply = Circuit(limit=self.dice.choice((20.0, 32.0)))
        await self.scene.master.change_circuit(supply)

    async def nothing(self) -> None:
        """Change nothing."""


def test_no_gap_whatever_happens_on_the_bus() -> None:
    """Dead slaves, commands, requests, noise, boxes that come and go."""

    async def scene() -> None:
        units = (2, 3, 4)
        async with MasterScene(units=units, limit=32.0, watch=False) as scene:
            await asyncio.sleep(6)
            begin = now()
            trouble = Trouble(scene)
            for _ in range(500):
                await trouble.dice.choice(trouble.kinds)()
                await asyncio.sleep(trouble.dice.random())
            assert max(scene.gaps(begin)) <= PERIOD + SLACK + TIMING.silence_patience
            assert len(scene.gaps(begin)) >= (now() - begin) / PERIOD - 2
            assert scene.bus.wire.statistics.timeouts > 10
            assert scene.bus.wire.statistics.unsolicited > 10
            for one in trouble.commands:
                one.cancel()

    simulate(scene())


def test_a_line_kept_busy_by_others() -> None:
    """A burst longer than the patience for silence: the broadcast follows at once."""

    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(6)
            planned = scene.master.slot.ready
            await asyncio.sleep(planned - now() - 0.3)
            end = now() + 1.5
            while now() < end:
                scene.line.noise(b"\x55")
                await asyncio.sleep(0.004)
            await asyncio.sleep(3)
            after = [sent for sent in scene.broadcasts() if sent.when > planned]
            assert after[0].when - end < 0.1
            # The next one comes at its planned time.
            assert after[1].when == pytest.approx(planned + PERIOD, abs=SLACK)
            assert max(scene.gaps()) < 5

    simulate(scene())


def test_a_port_lost_for_a_moment() -> None:
    """The slaves go on with the current that is read back and broadcast again."""

    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(4)
            await scene.charge(2, 3)
            await asyncio.sleep(6.7)
            scene.line.unplug()
            await asyncio.sleep(8)
            assert [box.offers for box in scene.line.boxes.values()] == [8.0, 8.0]
            values = [sent.values for sent in scene.broadcasts(now() - 14)]
            assert set(values) == {(0, 80, 80, 0)}
            assert max(scene.gaps()) < 5

    simulate(scene())


def test_a_port_lost_for_longer() -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(4)
            await scene.charge(2)
            scene.line.refuse_open = LineLostError("gone")
            scene.line.unplug()
            await asyncio.sleep(STOPS_ALONE)
            assert scene.offers == 0
            scene.line.refuse_open = None
            sent = len(scene.line.sent)
            await scene.until(lambda: len(scene.line.sent) > sent)
            back = scene.line.last_activity
            await scene.until(lambda: scene.box(2).state == "C")
            first = next(one for one in scene.broadcasts() if one.when > back)
            assert first.when - back < READING
            await asyncio.sleep(5)
            assert scene.offers == 16

    simulate(scene())


def test_nothing_is_sent_without_slaves() -> None:
    async def scene() -> None:
        async with MasterScene(units=()) as scene:
            scene.plug_box(2)
            await asyncio.sleep(10)
            assert scene.line.sent == []
            slave = scene.add(2)
            await slave.wait_available()
            await asyncio.sleep(2.5)
            assert scene.broadcasts()
            await scene.bus.remove(slave)
            await asyncio.sleep(0.1)
            silent: list[Sent] = list(scene.line.sent)
            await asyncio.sleep(20)
            assert scene.line.sent == silent

    simulate(scene())


def test_a_slave_removed_while_it_charges_still_counts() -> None:
    """It goes on with 6 A while it receives broadcasts, until a request shows its end."""

    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(4)
            await scene.charge(2, 3)
            await asyncio.sleep(4)
            await scene.bus.remove(scene.slave(3))
            await asyncio.sleep(20)
            assert scene.box(3).offers == 6
            assert scene.box(2).offers == 10
            scene.box(3).car.leave()
            await asyncio.sleep(5)
            assert scene.offers == scene.box(2).offers == 16

    simulate(scene())


def test_a_restart_does_not_disturb_charging_slaves() -> None:
    """The bus ends without a shutdown and is back before the boxes stop."""

    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(4)
            await scene.charge(2, 3)
            await asyncio.sleep(4)
            await scene.bus.stop()
            await asyncio.sleep(4)
            scene.new_bus()
            scene.add(2)
            scene.add(3)
            await scene.bus.start()
            for _ in range(1000):
                await asyncio.sleep(0.02)
                offers = [box.offers for box in scene.line.boxes.values()]
                assert offers == [8.0, 8.0]

    simulate(scene())


def test_without_a_master_all_slaves_stop() -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(4)
            await scene.charge(2, 3)
            last = scene.broadcasts()[-1].when
            await scene.bus.stop()
            await scene.until(lambda: scene.offers == 0)
            assert 9 < now() - last < 11.1
            for box in scene.line.boxes.values():
                assert box.controller.outlet.error & 2

    simulate(scene())
