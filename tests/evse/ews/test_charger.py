"""A port's readings and its times: who is asked what, when, and what is believed."""

import asyncio
from datetime import UTC, datetime, timedelta
from itertools import pairwise
import logging
from zoneinfo import ZoneInfo

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews import PROTOCOL, session
from custom_components.evse_bus.evse.ews.answers import EwsRefusedError
from custom_components.evse_bus.evse.ews.config import EwsPortConfig, ews_config
from custom_components.evse_bus.evse.ews.events import CardPresented
from custom_components.evse_bus.evse.ews.frames import Bcc
from custom_components.evse_bus.evse.ews.info import KeyEvent
from custom_components.evse_bus.evse.ews.status import StartRelease
from custom_components.evse_bus.evse.ews.timing import TCP_TIMING
from custom_components.evse_bus.evse.model import (
    Capability,
    ChargerConfig,
    Command,
    Fault,
    OrderChange,
    Status,
)
from tests.virtual.ews_box import EwsBox as VirtualBox
from tests.virtual.ews_commands import COMMANDS
from tests.virtual.ews_records import InfoMix
from tests.virtual.ews_rfid import Card

from .ether import SERIAL, EwsScene, now, play, simulate

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


# -- Readings -----------------------------------------------------------------------


def test_what_a_port_tells() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await asyncio.sleep(60)
        connector, reading = scene.connector(), scene.reading()
        assert connector.status is Status.CHARGING
        assert connector.raw_state == "0x40"
        assert connector.plugged
        assert connector.charging
        assert connector.locked
        assert connector.contactor
        assert connector.cable_current == 32
        assert connector.power == pytest.approx(3 * 16 * 230 * 0.98, rel=0.01)
        assert connector.session_energy == pytest.approx(180, rel=0.15)
        assert connector.session_time == pytest.approx(62, abs=3)
        assert connector.energy == connector.session_energy
        assert reading.offered_current == 16
        assert reading.maximum_current == 32
        assert not reading.faults
        idle = scene.connector(2)
        assert idle.status is Status.AVAILABLE
        assert idle.energy == 0
        assert scene.charger().info.serial == SERIAL  # type: ignore[union-attr]
        assert scene.charger().info.firmware == "M165300103"  # type: ignore[union-attr]
        assert Capability.LOCK in scene.charger().capabilities

    play(EwsScene(), acts)


def test_one_rc_tells_of_both_ports() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(60)
        asked = [len(scene.line.named(name, since=begin)) for name in ("rc", "rd")]
        assert 29 <= asked[0] == asked[1] <= 31
        assert 5 <= len(scene.line.named("rs", since=begin)) <= 7
        # Passwords pass on the wire no more often than need be.
        assert len(scene.line.named("rp")) == 1

    play(EwsScene(), acts)


def test_a_box_with_one_port() -> None:
    async def acts(scene: EwsScene) -> None:
        await asyncio.sleep(30)
        assert scene.charger().available
        assert not scene.charger(2).available
        await scene.charger().change_orders(amperes(10.0))
        with pytest.raises(EvseError):
            await scene.charger(2).change_orders(amperes(10.0))
        assert not scene.line.limits(2)

    async def run() -> None:
        scene = EwsScene(options={"ports": 1})
        async with scene:
            await scene.until(lambda: scene.charger().reading is not None)
            await acts(scene)

    simulate(run())


def test_a_household_socket_gives_16_amperes_or_none() -> None:
    async def acts(scene: EwsScene) -> None:
        assert Capability.OFFERED_CURRENT not in scene.charger().capabilities
        with pytest.raises(RefusedOrderError):
            await scene.charger().change_orders(amperes(10.0))
        await scene.charge()
        assert not scene.line.limits(1)
        assert scene.line.limits(2)
        await scene.charger().change_orders(amperes(0.0))
        assert scene.status() == 0x50

    play(EwsScene(options={"mode1": (True, False)}), acts)


@pytest.mark.parametrize("bcc", ["all", "without_msgid"])
def test_the_reading_of_the_checksum_is_found(bcc: str) -> None:
    async def acts(scene: EwsScene) -> None:
        found = scene.charger().box.bcc
        assert found is (Bcc.ALL if bcc == "all" else Bcc.WITHOUT_MESSAGE_ID)
        assert [one.name for one in scene.line.sent].count("id") <= 2
        await scene.charger().change_orders(amperes(10.0))

    play(EwsScene(options={"bcc": bcc}), acts)


def test_a_scan_finds_both_ports_and_writes_nothing() -> None:
    async def run() -> None:
        scene = EwsScene(ports=(), options={"bcc": "without_msgid", "max_current": 20})
        life = asyncio.create_task(scene._live())
        await scene.bus.start()
        done: list[float] = []
        config = scene.make_charger(1).config
        orders = scene.make_charger(1).orders
        report = await PROTOCOL.scan(scene.bus, config, orders, done.append)
        assert [one.address for one in report.found] == [1, 2]
        assert {one.serial for one in report.found} == {SERIAL}
        assert {one.maximum_current for one in report.found} == {20.0}
        assert done[-1] == 1.0
        scene.line.cut = True
        report = await PROTOCOL.scan(scene.bus, config, orders, done.append)
        assert not report.found
        assert not report.unreadable
        assert not scene.box.writes
        await scene.bus.stop()
        life.cancel()

    simulate(run())


def test_another_box_gets_no_order() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(60)
        for change in (amperes(10.0), ON, OFF):
            with pytest.raises(EvseError):
                await scene.charger().change_orders(change)
        assert Fault.WRONG_CHARGER in scene.charger().faults
        assert not scene.box.writes
        assert scene.charger().reading is None
        assert begin < now()

    async def run() -> None:
        scene = EwsScene(expected="000000000001")
        async with scene:
            await acts(scene)

    simulate(run())


def test_a_box_in_the_place_of_another_is_noticed_before_a_word() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.line.cut = True
        await asyncio.sleep(1.5)
        scene.box = scene.make_box("000000000007")
        scene.line.cut = False
        with pytest.raises(EvseError):
            await scene.charger().change_orders(OFF)
        await asyncio.sleep(60)
        assert not scene.box.writes
        assert Fault.WRONG_CHARGER in scene.charger().faults

    play(EwsScene(), acts)


def test_the_set_up() -> None:
    with pytest.raises(ValueError, match="no port"):
        EwsPortConfig(key="a", name="a", address=3)
    with pytest.raises(TypeError):
        ews_config(ChargerConfig(key="a", name="a", address=1))
    assert EwsPortConfig(key="a", name="a", address=2).port == 2


# -- Limits -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "installation", "highest"),
    [
        ({"jumper": 32}, 63.0, 32),
        ({"jumper": 32, "max_current": 20}, 63.0, 20),
        ({"jumper": 13}, 63.0, 13),
        ({"jumper": 32}, 25.0, 25),
        ({"jumper": 63}, 40.5, 40),
    ],
)
def test_no_limit_is_above_the_least_of_all(
    options: dict[str, object], installation: float, highest: int
) -> None:
    async def acts(scene: EwsScene) -> None:
        assert scene.line.limits()[-1] == highest
        assert max(scene.line.limits()) <= highest

    play(
        EwsScene(current=installation, installation=installation, options=options), acts
    )


def test_a_cable_weaker_than_the_limit() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].cable = 13
        assert scene.box.ports[0].limit == 32
        await scene.charge()
        await scene.until(lambda: scene.box.ports[0].limit == 13)
        with pytest.raises(RefusedOrderError):
            await scene.charger().change_orders(amperes(40.0))
        await scene.charger().change_orders(amperes(20.0))
        assert scene.box.ports[0].limit == 13
        assert all(one.accepted for one in scene.box.currents_set)
        # The next cable is a better one.
        await scene.charger().command(Command.STOP_AND_UNLOCK)
        scene.cars[0].leave()
        await scene.until(lambda: scene.box.ports[0].limit == 20)

    play(EwsScene(current=32.0), acts)


def test_a_limit_of_port_2_of_its_own() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.extra.max_current_2 = 10
        scene.box.take_parameters()
        scene.charger().box.parameters_due = 0.0
        await scene.until(lambda: scene.box.ports[1].limit == 10)
        assert scene.box.ports[0].limit == 16

    play(EwsScene(), acts)


def test_a_limit_is_believed_when_it_is_read_back() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ignores_limits = True
        with pytest.raises(NotConfirmedError):
            await scene.charger().change_orders(amperes(10.0))
        assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
        scene.box.ignores_limits = False
        await scene.until(lambda: scene.box.ports[0].limit == 10)
        await asyncio.sleep(5)
        assert not scene.charger().faults

    play(EwsScene(), acts)


def test_a_box_that_never_takes_a_limit_is_not_told_all_the_time() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(100)
        assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
        assert len(scene.line.limits(1, since=begin)) <= 30

    async def run() -> None:
        scene = EwsScene(ports=(1,))
        scene.box.ignores_limits = True
        async with scene:
            await scene.until(lambda: scene.charger().reading is not None)
            await acts(scene)

    simulate(run())


def test_a_box_that_takes_less_is_left_in_peace() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(60)
        assert not scene.line.limits(1, since=begin)
        assert scene.box.ports[0].limit == 20
        assert not scene.charger().faults

    async def run() -> None:
        scene = EwsScene(current=32.0, ports=(1,))
        scene.box.clamps_limits = True
        # Something that the box does not tell of keeps it at 20 A.
        scene.box.ports[0].installation.limit = 20
        async with scene:
            await scene.until(lambda: scene.box.ports[0].limit)
            await asyncio.sleep(5)
            await acts(scene)

    simulate(run())


def test_a_refused_limit_leaves_no_open_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The box has no limit, and refuses ours: then the lowest there is."""
    takes = COMMANDS["st"]

    def picky(box: VirtualBox, parameters: bytes) -> bytes:
        return b"\1" if parameters[1] > 16 else takes(box, parameters)

    monkeypatch.setitem(COMMANDS, "st", picky)

    async def run() -> None:
        scene = EwsScene(current=20.0, ports=(1,))
        async with scene:
            await scene.until(lambda: scene.box.ports[0].limit == 6)
            assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
            with pytest.raises(EwsRefusedError):
                await scene.charger().change_orders(amperes(30.0))
            await scene.charger().change_orders(amperes(16.0))
            assert scene.box.ports[0].limit == 16
            await asyncio.sleep(3)
            assert not scene.charger().faults

    simulate(run())


def test_a_box_with_a_lower_maximum_than_it_tells() -> None:
    """It refuses, and offers less than that anyhow."""

    async def run() -> None:
        scene = EwsScene(current=32.0, ports=(1,))
        scene.box.ports[0].installation.limit = 20
        async with scene:
            await scene.until(scene.line.limits)
            await asyncio.sleep(60)
            assert len(scene.line.limits()) == 1
            assert not scene.charger().faults
            with pytest.raises(EwsRefusedError):
                await scene.charger().change_orders(amperes(30.0))
            await scene.charger().change_orders(amperes(18.0))
            assert scene.box.ports[0].limit == 18

    simulate(run())


@pytest.mark.parametrize("current", [10, 20])
@pytest.mark.parametrize("heard", [True, False])
@pytest.mark.parametrize("name", ["st", "rd", "rc"])
def test_a_limit_with_a_lost_answer(name: str, current: int, *, heard: bool) -> None:
    """A lower one that is read back then is the one before."""

    async def acts(scene: EwsScene) -> None:
        left = 1

        def lose(what: str) -> bool:
            nonlocal left
            if what != name or not left:
                return False
            left -= 1
            return True

        if heard:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        await scene.charger().change_orders(amperes(current))
        assert scene.box.ports[0].limit == current

    play(EwsScene(), acts)


def test_somebody_takes_the_limit_away() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.ports[0].limit = 0
        took = await scene.until(lambda: scene.box.ports[0].limit == 16)
        assert took < 3
        await asyncio.sleep(2)
        assert scene.charger().statistics.reasserted == 1

    play(EwsScene(), acts)


def test_a_restart_is_noticed_and_the_limit_is_back() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charger().command(Command.RESET)
        await scene.until(lambda: scene.box.restarts == 1)
        took = await scene.until(
            lambda: scene.box.ports[0].limit == scene.box.ports[1].limit == 16
        )
        assert took < 5
        await asyncio.sleep(12)
        assert scene.charger().box.restarts == 2

    play(EwsScene(), acts)


def test_orders_that_nobody_renews_fall_back_and_start_nothing() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.until(lambda: scene.box.ports[0].limit == 8, 80)
        await scene.charger().change_orders(amperes(16.0))
        assert scene.box.ports[0].limit == 16

    play(EwsScene(lifetime=60.0, fail_safe=8.0), acts)


# -- Times --------------------------------------------------------------------------


def longest_silence(scene: EwsScene, since: float) -> float:
    times = [since, *(one.when for one in scene.line.sent if one.when >= since), now()]
    return max(later - sooner for sooner, later in pairwise(times))


@pytest.mark.parametrize("interval", [0.5, 2.0, 20.0, 300.0])
def test_the_box_never_waits_for_30_seconds(interval: float) -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(400)
        assert longest_silence(scene, begin) < 25
        assert scene.bus.wire.statistics.missed_deadlines == 0
        assert scene.box.server_connected

    play(EwsScene(timing=TCP_TIMING, config={"poll_interval": interval}), acts)


def test_commands_that_never_end_keep_no_poll_from_its_deadline() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        end = begin + 60
        stop = scene.charger(2)

        async def ask() -> None:
            while now() < end:
                await stop.services.read_cards()

        await asyncio.gather(*(ask() for _ in range(4)))
        looks = [begin, *(one.when for one in scene.line.named("rc", since=begin))]
        assert max(later - sooner for sooner, later in pairwise(looks)) < 30
        assert scene.bus.wire.statistics.missed_deadlines == 0

    play(EwsScene(timing=TCP_TIMING), acts)


def test_a_lost_answer_over_the_network_costs_no_connection() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        for _ in range(20):
            scene.box.faults.once("lose")
            await asyncio.sleep(15)
        assert longest_silence(scene, begin) < 25
        assert scene.charger().available

    play(EwsScene(timing=TCP_TIMING), acts)


def test_a_silent_box_is_unavailable_and_comes_back() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.line.cut = True
        took = await scene.until(lambda: not scene.charger().available)
        assert took < 10
        assert scene.charger().reading is None
        await asyncio.sleep(100)
        scene.line.cut = False
        await scene.until(lambda: scene.charger().reading is not None, 40)
        assert scene.status() == 0x40
        assert scene.connector().status is Status.CHARGING

    play(EwsScene(), acts)


def test_ten_minutes_of_silence_are_the_boxes_own_business() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.line.cut = True
        await asyncio.sleep(640)
        assert scene.status() == 0x60
        scene.line.cut = False
        await scene.until(lambda: scene.charger().reading is not None, 40)
        assert scene.reading().faults == {Fault.UPSTREAM_TIMEOUT}
        await asyncio.sleep(30)
        assert scene.status() == 0x60

    play(EwsScene(), acts)


def test_answers_that_cannot_be_change_nothing_and_end_in_a_fault() -> None:
    async def acts(scene: EwsScene) -> None:
        before = scene.reading()
        port = scene.box.ports[0]
        port.cable = 200
        port.plug_cable()
        await asyncio.sleep(2.5)
        assert scene.reading() == before
        await scene.until(lambda: scene.charger().reading is None)
        assert Fault.IMPLAUSIBLE in scene.charger().faults
        port.cable = 32
        await scene.until(lambda: scene.charger().reading is not None)
        assert not scene.charger().faults

    play(EwsScene(), acts)


# -- What comes unasked -------------------------------------------------------------


@pytest.mark.parametrize("name", ["rc", "rd"])
def test_a_record_at_every_position_of_an_answer(name: str) -> None:
    """Also at the very edges; no command is lost, and none is answered by it."""
    length = {"rc": 115, "rd": 63}[name]

    async def acts(scene: EwsScene) -> None:
        for at in range(length + 1):
            infos = scene.charger().box.changes
            if name == "rd":
                scene.box.mix_info(InfoMix("none"), InfoMix("inside", at=at))
            else:
                scene.box.mix_info(InfoMix("inside", at=at))
            scene.charger().ask_now()
            await asyncio.sleep(0.6)
            assert scene.charger().box.changes > infos, at
        assert scene.charger().statistics.timeouts == 0
        assert scene.charger().available
        assert scene.bus.wire.statistics.bad_frames == 0

    play(EwsScene(ports=(1,)), acts)


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


def test_a_record_is_followed_by_a_poll_at_once() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        await asyncio.sleep(3)
        await scene.until(lambda: scene.line.sent[-1].when < now() - 0.5)
        begin = now()
        scene.box.press_key(1, 1)
        await scene.until(lambda: scene.connector().start_requested)
        assert now() - begin < 0.1
        assert scene.charger().seen.start is StartRelease.REQUESTED  # type: ignore[union-attr]

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


def test_a_flood_of_records_starves_nobody() -> None:
    async def acts(scene: EwsScene) -> None:
        for _ in range(500):
            scene.box.send_raw(scene.box._record(4, {}))
            await asyncio.sleep(0.01)
        await scene.charger().change_orders(amperes(10.0))
        assert scene.bus.wire.statistics.utilisation(now()) < 0.5  # type: ignore[operator]

    play(EwsScene(), acts)


# -- The clock ----------------------------------------------------------------------


def test_the_clock_is_kept_right(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "CLOCK_PAUSE", 100.0)
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


def test_without_a_zone_the_clock_is_left_alone() -> None:
    async def acts(scene: EwsScene) -> None:
        await asyncio.sleep(60)
        assert not scene.line.named("sc")

    play(EwsScene(), acts)


# -- Commands -----------------------------------------------------------------------


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


@pytest.mark.parametrize("heard", [True, False])
def test_the_other_commands(*, heard: bool) -> None:
    """A lost answer decides nothing: the next look does."""

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

        if heard:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        await charger.command(Command.LOCK)
        assert scene.box.ports[0].locked
        assert len(scene.line.orders(7)) == (1 if heard else 2)
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


def test_a_plug_that_does_not_come_free_is_told() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.ports[0].lock.jammed = "unlock"
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.STOP_AND_UNLOCK)
        assert Fault.SOCKET_UNLOCK in scene.charger().faults

    play(EwsScene(), acts)


def test_a_reset_that_nobody_answers() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.mute = lambda name: name == "zz"
        with pytest.raises(NotConfirmedError):
            await scene.charger().command(Command.RESET)
        assert len(scene.line.named("zz")) == 1

    play(EwsScene(), acts)


def test_nothing_private_is_kept_of_what_passed(
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
