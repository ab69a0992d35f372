"""The clock, and the commands of a person."""

import asyncio
from dataclasses import replace
from datetime import UTC, datetime, timedelta
import logging
from zoneinfo import ZoneInfo

import pytest

from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews import box
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.model import (
    ChargerConfig,
    Command,
    Fault,
    OrderChange,
    Status,
)
from tests.virtual.ews_rfid import Card

from .scene import EwsScene, now, play, simulate

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


def test_the_clock_is_kept_right(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(box, "CLOCK_PAUSE", 100.0)
    zone = ZoneInfo("Europe/Berlin")
    right = datetime(2026, 7, 1, 10, 0, tzinfo=UTC)

    async def acts(scene: EwsScene) -> None:
        begin = now()
        scene.charger().box.clock = lambda: right + timedelta(seconds=now() - begin)
        assert not scene.line.named("sc")
        await scene.until(lambda: scene.line.named("sc"))
        await asyncio.sleep(20)
        assert f"{scene.box.clock():%Y-%m-%d %H:%M}" == "2026-07-01 12:00"
        scene.box.set_clock(scene.box.clock() + timedelta(seconds=50))
        await asyncio.sleep(200)
        assert len(scene.line.named("sc")) == 1
        scene.box.set_clock(scene.box.clock() + timedelta(seconds=50))
        await asyncio.sleep(20)
        assert len(scene.line.named("sc")) == 2

    async def run() -> None:
        scene = EwsScene(config={"time_zone": zone})
        async with scene:
            scene.charger().box.clock = lambda: datetime(2000, 1, 1, tzinfo=UTC)
            scene.box.set_clock(datetime.fromisoformat("2000-01-01T01:00"))
            await scene.settled()
            await acts(scene)

    simulate(run())


def test_the_zone_may_change_while_it_runs() -> None:
    """At once, though a clock is set once an hour at most."""
    right = datetime(2026, 7, 1, 10, 0, tzinfo=UTC)

    async def acts(scene: EwsScene) -> None:
        begin = now()
        port = scene.charger()
        port.box.clock = lambda: right + timedelta(seconds=now() - begin)
        for zone, hour, sets in (
            ("Europe/Berlin", 12, 1),
            ("Europe/Paris", 12, 1),
            ("Europe/London", 11, 2),
            (None, 11, 2),
            ("Europe/Lisbon", 11, 2),
            ("Asia/Tokyo", 19, 3),
        ):
            known = None if zone is None else ZoneInfo(zone)
            config = port.config
            port.reconfigure(replace(config, time_zone=known))
            await asyncio.sleep(30)
            assert scene.box.clock().hour == hour, zone
            assert len(scene.line.named("sc")) == sets, zone
        with pytest.raises(TypeError):
            port.reconfigure(ChargerConfig(key="a", name="a", address=1))
        assert isinstance(port.config, EwsPortConfig)

    play(EwsScene(), acts)


def test_without_a_zone_the_clock_is_left_alone() -> None:
    async def acts(scene: EwsScene) -> None:
        await asyncio.sleep(60)
        assert not scene.line.named("sc")

    play(EwsScene(), acts)


def test_stop_and_unlock() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().command(Command.STOP_AND_UNLOCK)
        assert scene.status() == 0x50
        assert scene.unlocked() == ["sl 1"]
        await asyncio.sleep(20)
        assert scene.connector().status is Status.FINISHING

    play(EwsScene(), acts)


def test_stop_and_unlock_after_a_pause() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(OFF)
        await scene.charger().command(Command.STOP_AND_UNLOCK)
        assert scene.unlocked() == ["sl 1"]

    play(EwsScene(), acts)


@pytest.mark.parametrize("received", [True, False])
def test_the_other_commands(*, received: bool) -> None:
    """A lost answer decides nothing: the next status does."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        for command in (Command.LOCK, Command.REQUEST_START):
            with pytest.raises(NotAvailableError, match="not in state"):
                await charger.command(command)
        await charger.command(Command.SET_OPTIMISED, value=True)
        assert scene.box.ports[0].optimised
        await charger.command(Command.SET_OPTIMISED, value=False)
        assert not scene.box.ports[0].optimised
        with pytest.raises(RefusedOrderError):
            await charger.command(Command.SET_OPTIMISED, 1)
        with pytest.raises(NotAvailableError):
            await charger.command(Command.WAKE)
        await scene.plug()
        lost = ["sl"]

        def lose(name: str) -> bool:
            return bool(lost) and name == "sl" and bool(lost.pop())

        if received:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        await charger.command(Command.LOCK)
        assert scene.box.ports[0].locked
        assert len(scene.line.orders(7)) == (1 if received else 2)
        await charger.command(Command.REQUEST_START)
        assert scene.connector().start_requested
        assert not scene.unlocked()

    play(EwsScene(), acts)


def test_a_request_that_is_lost_is_not_made_again() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        scene.line.deaf = lambda name: name == "sl"
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.REQUEST_START)
        assert len(scene.line.orders(2)) == 1

    play(EwsScene(), acts)


def test_a_plug_that_does_not_come_free_raises() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.ports[0].lock.jammed = "unlock"
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.STOP_AND_UNLOCK)
        assert Fault.SOCKET_UNLOCK in scene.charger().faults

    play(EwsScene(), acts)


def test_an_unanswered_reset() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.mute = lambda name: name == "zz"
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.RESET)
        assert len(scene.line.named("zz")) == 1

    play(EwsScene(), acts)


def test_no_private_data_are_kept_in_the_frame_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)

    async def acts(scene: EwsScene) -> None:
        scene.box.present_card(Card(7, 42, "MAXMUSTR"))
        await asyncio.sleep(30)
        passed = b"".join(one.data for one in scene.bus.wire.frames)
        for secret in (
            b"geheim",
            b"4711",
            b"MAXMUSTR",
            bytes.fromhex("04112233445566"),
        ):
            assert secret not in passed
            assert secret.decode("latin-1") not in caplog.text
        assert b"st" in passed

    async def run() -> None:
        scene = EwsScene(options={"rfid": True})
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        async with scene:
            await scene.settled()
            await acts(scene)

    simulate(run())
