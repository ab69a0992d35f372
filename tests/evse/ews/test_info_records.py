"""Info records at any moment, and the events that come of them."""

import asyncio

import pytest

from custom_components.evse_bus.evse.events import (
    CardPresented,
    KeyEvent,
    StartRequested,
)
from custom_components.evse_bus.evse.ews.wire.status import StartRelease
from custom_components.evse_bus.evse.model import (
    OrderChange,
)
from tests.virtual.ews_records import InfoMix
from tests.virtual.ews_rfid import Card

from .scene import EwsScene, now, play

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


@pytest.mark.parametrize("name", ["rc", "rd"])
def test_a_record_at_every_position_of_an_answer(name: str) -> None:
    """Also at the very edges; no command is lost, and none is answered by it."""
    length = {"rc": 115, "rd": 63}[name]

    async def acts(scene: EwsScene) -> None:
        for at in range(length + 1):
            infos = scene.charger().box.info_count
            if name == "rd":
                scene.box.mix_info(InfoMix("none"), InfoMix("inside", at=at))
            else:
                scene.box.mix_info(InfoMix("inside", at=at))
            scene.charger().poll_now()
            await asyncio.sleep(0.6)
            assert scene.charger().box.info_count > infos, at
        assert scene.charger().statistics.timeouts == 0
        assert scene.charger().available
        assert scene.bus.wire.statistics.bad_frames == 0

    play(EwsScene(ports=(1,)), acts)


@pytest.mark.parametrize("name", ["rc", "rd"])
def test_a_record_that_has_begun_when_the_next_command_goes(name: str) -> None:
    """A serial port delivers bytes in lumps; each record counts once."""
    length = {"rc": 115, "rd": 63}[name]

    async def acts(scene: EwsScene) -> None:
        scene.line.lumps = 0
        for come in range(1, 16):
            infos = scene.charger().box.info_count
            begun = InfoMix("after", cut=length + come, pause=0.02)
            scene.box.mix_info(*([InfoMix("none")] if name == "rd" else []), begun)
            scene.charger().poll_now()
            # After rc comes rd, then any other turn.
            scene.charger(2).poll_now()
            await asyncio.sleep(0.6)
            assert scene.charger().box.info_count == infos + 1, come
        assert scene.charger().statistics.timeouts == 0
        assert scene.charger().available
        assert scene.bus.wire.statistics.bad_frames == 0
        assert scene.bus.wire.statistics.noise_bytes == 0

    play(EwsScene(), acts)


@pytest.mark.parametrize("where", ["before", "after"])
@pytest.mark.parametrize("cut", [1, 3, 8, 15, 16, 17, 20])
def test_a_record_beside_the_answer_to_an_order(where: str, cut: int) -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        mix = InfoMix(where, cut=cut)  # type: ignore[arg-type]
        scene.box.mix_info(InfoMix("none"), mix, mix, mix)
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(5)
        assert len(scene.line.orders(6)) == 1
        assert scene.status() == 0x50
        assert not scene.unlocked()

    play(EwsScene(ports=(1,)), acts)


@pytest.mark.parametrize("at", range(9))
@pytest.mark.parametrize("name", ["sl", "rc"])
def test_a_record_inside_the_conversation_of_a_pause(name: str, at: int) -> None:
    """Inside the answer to order 6, and to the rc right before it."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        inside = InfoMix("inside", at=at, bits=0b100)
        scene.box.mix_info(*([InfoMix("none")] if name == "sl" else []), inside)
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(5)
        assert len(scene.line.orders(6)) == 1
        assert scene.status() == 0x50
        assert not scene.unlocked()
        assert scene.charger().statistics.timeouts == 0

    play(EwsScene(ports=(1,)), acts)


def test_a_record_is_followed_by_a_poll_at_once() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        await asyncio.sleep(3)
        await scene.until(lambda: scene.line.sent[-1].when < now() - 0.5)
        begin = now()
        scene.box.press_key(1, 1)
        await scene.until(lambda: scene.connector().start_requested)
        assert now() - begin < 0.1
        assert scene.charger().last_status.start is StartRelease.REQUESTED  # type: ignore[union-attr]

    play(EwsScene(), acts)


@pytest.mark.parametrize("port", [1, 2])
def test_a_record_counts_for_both_ports_while_commands_never_end(port: int) -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug(port)
        asked = scene.charger(3 - port)
        over = False

        async def ask() -> None:
            while not over:
                await asked.services.read_cards()

        async with asyncio.TaskGroup() as group:
            for _ in range(4):
                group.create_task(ask())
            await asyncio.sleep(3)
            scene.box.press_key(port, 1)
            took = await scene.until(lambda: scene.connector(port).start_requested)
            over = True
        assert took < 0.2
        assert any(isinstance(one, StartRequested) for one in scene.events)

    play(EwsScene(), acts)


def test_keys_and_cards_are_events() -> None:
    async def acts(scene: EwsScene) -> None:
        mine: list[object] = []
        scene.charger(2).subscribe_events(mine.append)
        scene.box.press_key(2, 3, 0.7)
        await asyncio.sleep(2)
        scene.box.present_card(Card(7, 42, "MAX"))
        await asyncio.sleep(1)
        assert mine[:2] == [KeyEvent(2, 3, None), KeyEvent(2, 3, 0.7)]
        (card,) = (one for one in mine if isinstance(one, CardPresented))
        assert (card.group, card.number, card.user) == (7, 42, "MAX")
        assert card.readable
        assert "MAX" not in repr(card)
        assert "42" not in repr(card)
        scene.box.press_key(1, 1, 0.2)
        await asyncio.sleep(2)
        assert KeyEvent(1, 1, None) in scene.events
        assert KeyEvent(1, 1, None) not in mine
        assert len([one for one in mine if isinstance(one, CardPresented)]) == 1

    play(EwsScene(options={"manual_io": True, "rfid": True}), acts)


def test_a_flood_of_records_does_not_block_commands() -> None:
    async def acts(scene: EwsScene) -> None:
        for _ in range(500):
            scene.box.send_raw(scene.box._record(4, {}))
            await asyncio.sleep(0.01)
        await scene.charger().change_orders(amperes(10.0))
        assert scene.bus.wire.statistics.utilisation(now()) < 0.5  # type: ignore[operator]

    play(EwsScene(), acts)
