"""Lines that are lost, silent or closed by an idle adapter are opened again."""

import asyncio
from itertools import pairwise
from typing import override

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import LineLostError, PortMissingError
from custom_components.evse_bus.evse.model import OrderChange
from custom_components.evse_bus.evse.recovery import PAUSES, SILENCES, LineRecovery
from tests.simulated_time import now, simulate

from .simulated_line import until
from .telegram import Device, Scene, TelegramLine
from .test_master import PERIOD, BeatScene


class Adapter(TelegramLine):
    """A network adapter that may hang, close idle connections, or be away."""

    def __init__(self, *devices: Device) -> None:
        super().__init__(*devices)
        self.hung = False
        """Nothing passes until the connection is opened anew."""
        self.idle_timeout: float | None = None
        """It closes a connection without traffic after this time, s."""
        self.silent_connections = False
        """It accepts each connection, delivers nothing, and closes it."""
        self.closes_at_requests = False
        """It greets, and closes each connection at the first request."""
        self.opening_time = 0.0
        """Time that each attempt to open it takes, s."""
        self.opened: list[float] = []
        self._idle: asyncio.TimerHandle | None = None

    @override
    async def open(self) -> None:
        await asyncio.sleep(self.opening_time)
        await super().open()
        self.opened.append(now())
        self.hung = False
        if self.silent_connections:
            asyncio.get_running_loop().call_later(0.01, self.unplug)
        if self.closes_at_requests:
            asyncio.get_running_loop().call_later(0.01, super().hear, b"hello")
        self._traffic()

    @override
    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        self._traffic()
        if self.closes_at_requests:
            asyncio.get_running_loop().call_later(0.05, self.unplug)
            return now()
        return super().write(data, reply_may_equal=reply_may_equal)

    @override
    def hear(self, data: bytes) -> None:
        if not self.hung and not self.silent_connections:
            self._traffic()
            super().hear(data)

    @override
    async def close(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
        await super().close()

    def _traffic(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
        if self.idle_timeout is not None:
            loop = asyncio.get_running_loop()
            self._idle = loop.call_later(self.idle_timeout, self.unplug)


def behind_adapter(scene: Scene) -> Adapter:
    """Put an adapter between a bus that has not started and its devices."""
    adapter = Adapter(*scene.line.devices.values())
    scene.line = scene.bus.line = scene.bus.wire.line = adapter
    adapter.on_data = scene.bus.wire._on_data
    adapter.on_lost = scene.bus.port.line_lost
    return adapter


def test_a_hung_adapter_is_connected_to_anew() -> None:
    """It keeps our dead connection acknowledged: no byte comes, no error either."""

    async def scene() -> None:
        bus = Scene(addresses=(1, 2), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(5)
            adapter.hung = True
            hung = now()
            await asyncio.sleep(SILENCES[0] + 10)
            assert bus.bus.wire.statistics.renewed == 1
            assert adapter.opened[-1] - hung <= SILENCES[0] + 5
            assert bus.charger(1).available
            assert bus.charger(2).available
            assert bus.bus.connected

    simulate(scene())


def test_a_bus_of_dead_chargers_is_opened_anew_less_and_less_often() -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        changes: list[bool] = []
        async with bus:
            await asyncio.sleep(5)
            bus.bus.subscribe(lambda: changes.append(bus.bus.connected))
            adapter.devices[1].alive = False
            await asyncio.sleep(1800)
            gaps = [later - before for before, later in pairwise(adapter.opened)]
            # Each counts from the first request without a reply after the last one.
            expected = (*SILENCES[1:], SILENCES[-1])
            for gap, silence in zip(gaps[1:], expected, strict=False):
                assert silence <= gap <= silence + 31
            # The port is there: chargers that are off are no reason for a repair.
            assert changes == []

    simulate(scene())


def test_other_peoples_frames_keep_a_line_alive() -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            adapter.devices[1].alive = False
            for _ in range(200):
                await asyncio.sleep(1)
                adapter.hear(b"@\x09R\x00")
            assert bus.bus.wire.statistics.renewed == 0

    simulate(scene())


def test_a_broadcast_survives_the_reopening() -> None:
    async def scene() -> None:
        bus = BeatScene(interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(5)
            adapter.hung = True
            await asyncio.sleep(200)
            assert bus.bus.wire.statistics.renewed
            assert max(bus.gaps()) < 5.0 <= PERIOD + 5

    simulate(scene())


@pytest.mark.parametrize("interval", [2.0, 5.0])
def test_an_idle_adapter_makes_nothing_flap(interval: float) -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1, 2), interval=interval)
        adapter = behind_adapter(bus)
        adapter.idle_timeout = 1.0
        changes: list[tuple[bool, bool]] = []
        async with bus:
            await asyncio.sleep(10)
            charger = bus.charger(1)
            charger.subscribe(
                lambda: changes.append((charger.available, charger.reading is None))
            )
            bus.bus.subscribe(lambda: changes.append((bus.bus.connected, False)))
            polls = charger.polls
            await asyncio.sleep(100 * interval)
            assert charger.polls - polls >= 90
            assert (False, True) not in changes
            assert (False, False) not in changes

    simulate(scene())


@settings(max_examples=30)
@given(away=st.floats(0.05, 600.0), before=st.floats(0.5, 60.0))
def test_a_lost_port_is_back_within_ten_seconds_of_its_adapter(
    away: float, before: float
) -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(before)
            adapter.refuse_open = PortMissingError("away")
            adapter.unplug()
            await asyncio.sleep(away)
            adapter.refuse_open = None
            back = now()
            await asyncio.sleep(10)
            assert bus.charger(1).available
            assert adapter.opened[-1] - back <= PAUSES[-1] + 0.1

    simulate(scene())


def test_connections_without_a_byte_are_not_tried_all_the_time() -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(5)
            adapter.silent_connections = True
            adapter.unplug()
            start = len(adapter.opened)
            await asyncio.sleep(100)
            assert 15 <= len(adapter.opened) - start <= 25
            assert not bus.bus.connected or not bus.charger(1).available
            adapter.silent_connections = False
            await asyncio.sleep(10)
            assert bus.charger(1).available

    simulate(scene())


def test_the_pauses_begin_anew_only_after_a_received_byte() -> None:
    line = LineRecovery()
    first = [line.next_pause() for _ in range(6)]
    assert first == [*PAUSES, PAUSES[-1], PAUSES[-1]]
    line.opened(0.0)
    assert line.next_pause() == PAUSES[-1]
    line.received()
    assert line.next_pause() == PAUSES[0]


def test_a_line_lost_while_it_worked_is_opened_at_once() -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(5)
            lost = now()
            adapter._open = False
            adapter.on_lost(LineLostError("idle"))
            await asyncio.sleep(0.1)
            assert adapter.opened[-1] - lost < 0.001

    simulate(scene())


def test_an_adapter_that_greets_and_then_closes_at_each_request() -> None:
    """Its bytes are no replies: no reading gets old, and nobody dials all the time."""

    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(5)
            assert bus.charger(1).available
            adapter.closes_at_requests = True
            adapter.unplug()
            start = len(adapter.opened)
            await asyncio.sleep(100)
            assert not bus.charger(1).available
            assert bus.charger(1).reading is None
            assert len(adapter.opened) - start <= 100
            adapter.closes_at_requests = False
            await asyncio.sleep(10)
            assert bus.charger(1).available

    simulate(scene())


@pytest.mark.parametrize("renewed", [False, True])
def test_a_command_does_not_wait_for_a_port_that_is_away(renewed: bool) -> None:  # noqa: FBT001
    """A command given while the port is opened again fails with that attempt."""

    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        adapter = behind_adapter(bus)
        async with bus:
            await asyncio.sleep(5)
            adapter.opening_time = 4.0
            adapter.refuse_open = PortMissingError("away")
            if renewed:
                adapter.hung = True
                await until(lambda: not adapter.is_open)
            else:
                adapter.unplug()
            await asyncio.sleep(1)
            started = now()
            with pytest.raises(LineLostError):
                async with asyncio.timeout(60):
                    await bus.charger(1).change_orders(OrderChange(allowed=True))
            assert now() - started <= adapter.opening_time
            adapter.refuse_open = None
            sent = len(adapter.sent)
            await asyncio.sleep(20)
            assert bus.charger(1).available
            assert "W" not in [one.command for one in adapter.sent[sent:]]

    simulate(scene())
