"""`Command.UNLOCK`: order 6 where it unlocks, and order 1 everywhere else."""

import asyncio
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any

import pytest

from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    NotConfirmedError,
)
from custom_components.evse_bus.evse.ews.permission import Pause
from custom_components.evse_bus.evse.ews.wire.answers import (
    START_STOP_CODES,
    EwsRefusedError,
    Refusal,
)
from custom_components.evse_bus.evse.ews.wire.commands import unlock
from custom_components.evse_bus.evse.ews.wire.info import Change, Info
from custom_components.evse_bus.evse.ews.wire.states import STATES
from custom_components.evse_bus.evse.ews.wire.status import decode_ports
from custom_components.evse_bus.evse.model import (
    Command,
    Fault,
    OrderChange,
    Status,
)
from tests.virtual import ews_commands
from tests.virtual.ews_records import InfoMix

from .scene import EwsScene, now, play
from .wire import PORTS

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)
STOP, LOCK_ORDER, SIX = 1, 7, 6
NOT_READY = (0xF0, 0xFF)


async def lock(scene: EwsScene) -> None:
    """Let a car wait behind a locked plug."""
    await scene.plug()
    await scene.charger().command(Command.LOCK)
    assert scene.box.ports[0].locked


async def pause(scene: EwsScene) -> None:
    """Let a car charge, and be paused by us."""
    await scene.charge()
    await scene.charger().change_orders(OFF)
    assert scene.box.ports[0].locked


def freeze(scene: EwsScene, status: int) -> None:
    """Keep a port in a status, with a locked plug; only its lock still moves."""
    port = scene.box.ports[0]
    port._transition = lambda: None  # type: ignore[method-assign]
    port.cable_in = port.lock.locked = True
    port.status = status


# -- The order sent ------------------------------------------------------------------


def test_order_6_unlocks_in_two_states_only() -> None:
    known = decode_ports(PORTS)[0]
    allowed = {(0x50, 0), (0x50, 1), (0x50, 2), (0x30, 0), (0x30, 1)}
    for status, start, locked in product(range(0x100), range(3), (True, False, None)):
        status_of_port = replace(known, state=status, start_code=start, locked=locked)
        if locked and (status, start) in allowed:
            assert unlock(2, status_of_port).parameters == b"\x02\x06"
        else:
            with pytest.raises(NotAvailableError, match="not in state"):
                unlock(2, status_of_port)


@pytest.mark.parametrize("status", sorted(STATES))
def test_the_order_sent_in_each_state(status: int) -> None:
    async def acts(scene: EwsScene) -> None:
        freeze(scene, status)
        await scene.until(lambda: scene.connector().raw_state == f"0x{status:02X}")
        if status in NOT_READY:
            with pytest.raises(NotAvailableError, match="not ready"):
                await scene.charger().command(Command.UNLOCK)
            assert not scene.line.orders()
            return
        await scene.charger().command(Command.UNLOCK)
        (sent,) = scene.line.orders()
        order = SIX if status in (0x30, 0x50) else STOP
        assert tuple(sent.parameters) == (1, order)
        assert scene.unlocked() == [f"sl {order}"]
        assert not scene.connector().locked

    play(EwsScene(), acts)


def test_nothing_is_sent_for_a_free_plug() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charger().command(Command.UNLOCK)
        await scene.plug()
        await scene.charger().command(Command.UNLOCK)
        await scene.charge()
        await scene.charger().command(Command.UNLOCK)
        begin = now()
        await scene.charger().command(Command.UNLOCK)
        assert len(scene.line.orders(STOP)) == 1
        assert not scene.line.orders(SIX)
        assert now() - begin < 0.5

    play(EwsScene(), acts)


def test_a_car_that_waits() -> None:
    """It still waits; nothing was started or stopped."""

    async def acts(scene: EwsScene) -> None:
        await lock(scene)
        scene.box.press_key(1, 1)
        await scene.until(lambda: scene.connector().start_requested)
        await scene.charger().command(Command.UNLOCK)
        await asyncio.sleep(20)
        assert scene.unlocked() == ["sl 6"]
        assert scene.status() == 0x30
        assert scene.connector().start_requested
        assert not scene.starts()

    play(EwsScene(), acts)


@pytest.mark.parametrize(("pause_status", "order"), [(0x50, SIX), (0x42, STOP)])
def test_our_pause_is_over(pause_status: int, order: int) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].pause_status = pause_status  # type: ignore[assignment]
        await pause(scene)
        begin = now()
        await scene.charger().command(Command.UNLOCK)
        assert [one.parameters[1] for one in scene.line.orders(since=begin)] == [order]
        assert scene.unlocked() == [f"sl {order}"]
        assert scene.charger().permission.pause_state is Pause.NONE
        await asyncio.sleep(20)
        assert scene.connector().status is Status.FINISHING
        begin = now()
        await scene.charger().change_orders(ON)
        await scene.charger().change_orders(OrderChange(current=20.0))
        assert not scene.line.orders(since=begin)

    play(EwsScene(), acts)


def test_a_pause_for_want_of_current_is_over_too() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(OrderChange(current=0.0))
        assert scene.charger().waits_for_current
        await scene.charger().command(Command.UNLOCK)
        assert not scene.charger().waits_for_current
        begin = now()
        await scene.charger().change_orders(OrderChange(current=20.0))
        assert not scene.line.orders(since=begin)

    play(EwsScene(), acts)


def test_a_start_that_is_released_is_ended() -> None:
    async def acts(scene: EwsScene) -> None:
        freeze(scene, 0x30)
        scene.box.ports[0].start_mode = 2
        await scene.charger().command(Command.UNLOCK)
        assert [one.parameters[1] for one in scene.line.orders()] == [STOP]
        assert scene.box.ports[0].start_mode == 0

    play(EwsScene(), acts)


@pytest.mark.parametrize("options", [{"fixed_cable": True}, {"mode1": (True, False)}])
def test_without_a_lock_there_is_nothing_to_unlock(options: dict[str, Any]) -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        begin = now()
        with pytest.raises(NotAvailableError, match="no lock"):
            await scene.charger().command(Command.UNLOCK)
        assert not scene.line.orders(since=begin)
        assert scene.status() == 0x40

    play(EwsScene(options=options), acts)


# -- What goes wrong -----------------------------------------------------------------


@pytest.mark.parametrize("received", [True, False])
@pytest.mark.parametrize("begin", [lock, pause])
def test_a_lost_answer(begin: Any, *, received: bool) -> None:  # noqa: ANN401
    async def acts(scene: EwsScene) -> None:
        await begin(scene)
        since = now()
        lost = ["sl"]

        def lose(name: str) -> bool:
            return name == "sl" and bool(lost) and bool(lost.pop())

        if received:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        await scene.charger().command(Command.UNLOCK)
        sent = scene.line.orders(since=since)
        assert [one.parameters[1] for one in sent] == [SIX] * (1 if received else 2)
        assert scene.unlocked() == ["sl 6"]
        names = [one.name for one in scene.line.sent if one.when >= since]
        for at, name in enumerate(names):
            assert name != "sl" or names[at - 1] == "rc"

    play(EwsScene(), acts)


@pytest.mark.parametrize("name", ["id", "rs", "rc"])
@pytest.mark.parametrize("count", [1, 2])
def test_other_lost_answers(name: str, count: int) -> None:
    async def acts(scene: EwsScene) -> None:
        await pause(scene)
        since = now()
        lost = ["sl"] + [name] * count

        def lose(one: str) -> bool:
            if one not in lost:
                return False
            lost.remove(one)
            return True

        scene.line.mute = lose
        with suppress(NotConfirmedError):
            await scene.charger().command(Command.UNLOCK)
        await asyncio.sleep(20)
        assert len(scene.line.orders(since=since)) == 1
        assert scene.unlocked() == ["sl 6"]

    play(EwsScene(), acts)


@pytest.mark.parametrize("at", range(9))
@pytest.mark.parametrize("name", ["sl", "rc"])
def test_a_record_inside_the_conversation(name: str, at: int) -> None:
    async def acts(scene: EwsScene) -> None:
        await pause(scene)
        inside = InfoMix("inside", at=at, bits=0b100)
        scene.box.mix_info(*([InfoMix("none")] if name == "sl" else []), inside)
        since = now()
        await scene.charger().command(Command.UNLOCK)
        assert len(scene.line.orders(since=since)) == 1
        assert scene.unlocked() == ["sl 6"]

    play(EwsScene(ports=(1,)), acts)


def test_a_charge_that_begins_between_status_and_order_is_not_paused() -> None:
    """A record outdates the status, which is then read again."""

    async def acts(scene: EwsScene) -> None:
        await lock(scene)
        box = scene.charger().box
        original, sent_before = box.send_command, []

        async def send(turn: Any, command: Any, make: Any) -> None:  # noqa: ANN401
            if not sent_before:
                sent_before.append(command)
                scene.box.ports[0].release_start("page")
                scene.box.step()
                assert scene.status() == 0x40
                box.on_info(Info(changes=Change.PORT_1, keys=(0,) * 8))
            await original(turn, command, make)

        box.send_command = send  # type: ignore[method-assign]
        since = now()
        await scene.charger().command(Command.UNLOCK)
        assert [one.parameters[1] for one in scene.line.orders(since=since)] == [STOP]
        assert scene.unlocked() == ["sl 1"]

    play(EwsScene(), acts)


def test_records_without_end_do_not_block_an_order() -> None:
    async def acts(scene: EwsScene) -> None:
        await lock(scene)
        box = scene.charger().box
        original = box.send_command

        async def send(turn: Any, command: Any, make: Any) -> None:  # noqa: ANN401
            box.on_info(Info(changes=Change.PORT_1, keys=(0,) * 8))
            await original(turn, command, make)

        box.send_command = send  # type: ignore[method-assign]
        since = now()
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.UNLOCK)
        assert not scene.line.orders(since=since)
        assert now() - since < 10

    play(EwsScene(), acts)


def test_a_charge_that_begins_without_a_record_ends_unlocked() -> None:
    """No record came in time: order 6 has paused, which the next status shows."""

    async def acts(scene: EwsScene) -> None:
        await lock(scene)
        original = scene.line.write

        def write(data: bytes, *, reply_may_equal: bool = False) -> float:
            if data[4:6] == b"sl" and not scene.starts():
                scene.box.ports[0].release_start("page")
                scene.box.ports[0].step(now())
            return original(data, reply_may_equal=reply_may_equal)

        scene.line.write = write  # type: ignore[method-assign]
        since = now()
        await scene.charger().command(Command.UNLOCK)
        assert len(scene.line.orders(SIX, since=since)) == 2
        assert scene.unlocked() == ["sl 6"]
        assert not scene.box.ports[0].contactor
        begin = now()
        await scene.charger().change_orders(ON)
        assert not scene.line.orders(since=begin)

    play(EwsScene(), acts)


def test_a_plug_that_stays_locked_raises() -> None:
    async def acts(scene: EwsScene) -> None:
        await pause(scene)
        port = scene.box.ports[0]
        working, port.unlock = port.unlock, lambda _why: None  # type: ignore[method-assign]
        since = now()
        with pytest.raises(NotConfirmedError, match="unlock"):
            await scene.charger().command(Command.UNLOCK)
        one, two = scene.line.orders(SIX, since=since)
        assert two.when - one.when >= 5
        # It still stands in our pause, and goes on from there.
        port.unlock = working  # type: ignore[method-assign]
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)
        assert not scene.unlocked()

    play(EwsScene(), acts)


def test_a_lock_that_jams() -> None:
    async def acts(scene: EwsScene) -> None:
        await pause(scene)
        scene.box.ports[0].lock.jammed = "unlock"
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.UNLOCK)
        assert Fault.SOCKET_UNLOCK in scene.charger().faults
        scene.box.ports[0].lock.jammed = ""
        await scene.charger().command(Command.UNLOCK)
        assert scene.unlocked() == ["sl 1"]

    play(EwsScene(), acts)


@pytest.mark.parametrize("code", [*range(1, 14), 255])
def test_a_refusal_has_its_reason(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    async def acts(scene: EwsScene) -> None:
        await pause(scene)
        monkeypatch.setattr(ews_commands, "execute", lambda *_: code)
        since = now()
        with pytest.raises(EwsRefusedError) as raised:
            await scene.charger().command(Command.UNLOCK)
        assert raised.value.reason is START_STOP_CODES.get(code, Refusal.UNKNOWN)
        assert raised.value.code == code
        assert len(scene.line.orders(since=since)) == 1
        assert scene.charger().permission.pause_state is Pause.OURS

    play(EwsScene(), acts)
