"""Readings of a port, its configuration, and the identity of its box."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
)
from custom_components.evse_bus.evse.ews import PROTOCOL
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.ews.wire.frames import Bcc
from custom_components.evse_bus.evse.model import (
    Capability,
    Fault,
    OrderChange,
    PauseReason,
    Status,
)

from .scene import SERIAL, EwsScene, now, play, simulate

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


def test_reading_of_a_port() -> None:
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


def test_one_rc_reads_both_ports() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(60)
        asked = [len(scene.line.named(name, since=begin)) for name in ("rc", "rd")]
        assert 29 <= asked[0] == asked[1] <= 31
        assert 5 <= len(scene.line.named("rs", since=begin)) <= 7
        # Passwords pass on the wire no more often than need be: two replies agree.
        assert len(scene.line.named("rp")) == 2

    play(EwsScene(), acts)


def test_a_household_socket_gives_16_amperes_or_none() -> None:
    async def acts(scene: EwsScene) -> None:
        assert Capability.OFFERED_CURRENT not in scene.charger().capabilities
        await scene.charge()
        await scene.charger().change_orders(amperes(15.0))
        assert scene.status() == 0x50
        assert scene.charger().pause_reason is PauseReason.LIMIT_TOO_LOW
        await scene.charger().change_orders(amperes(16.0))
        assert scene.status() in (0x40, 0x41)
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


@pytest.mark.parametrize(
    ("options", "ports", "second"),
    [({}, 2, 20.0), ({"mode1": (False, True)}, 2, 16.0), ({"ports": 1}, 1, None)],
    ids=["two-ports", "a-household-socket", "one-port"],
)
def test_a_scan_finds_the_box_and_writes_nothing(
    options: dict[str, object], ports: int, second: float | None
) -> None:
    async def run() -> None:
        known = {"bcc": "without_msgid", "max_current": 20}
        scene = EwsScene(ports=(), options=known | options)
        life = asyncio.create_task(scene.live())
        await scene.bus.start()
        done: list[float] = []
        config = scene.make_charger(1).config
        orders = scene.make_charger(1).orders
        report = await PROTOCOL.scan(scene.bus, config, orders, done.append)
        (found,) = report.found
        assert found.address == found.serial == found.info.serial == SERIAL
        assert found.connectors == ports
        assert found.maximum_currents == (20.0, second)[:ports]
        assert found.maximum_current == min(20.0, second or 20.0)
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


def test_another_box_is_noticed_before_anything_is_written() -> None:
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
    assert EwsPortConfig(key="a", name="a", address=2).port == 2


def test_one_block_of_parameters_counts_without_the_other() -> None:
    """Else a household socket would be taken for a port with a pilot."""

    async def acts(scene: EwsScene) -> None:
        await asyncio.sleep(30)
        installation = scene.charger().box.installation
        assert installation is not None
        assert installation.mode_1 == (True, False)
        assert installation.maximum == (20, 20)

    scene = EwsScene(options={"mode1": (True, False), "max_current": 20})
    scene.box.unanswered.add("rz")
    play(scene, acts)
