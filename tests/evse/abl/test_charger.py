"""One box on a wire: its identity, its readings, and missing replies."""

import asyncio
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.abl import reader
from custom_components.evse_bus.evse.errors import GarbledReplyError, WrongChargerError
from custom_components.evse_bus.evse.model import Capability, Fault, OrderChange, Status
from tests.simulated_time import now
from tests.virtual import AblBox, Car, Request
from tests.virtual.abl_outlet import Outlet

from .scene import LIMIT, SERIAL, Scene, answers, config, orders, until


def plugged(**settings: float) -> Car:
    car = Car(**settings)  # type: ignore[arg-type] # floats only
    car.plug_in()
    return car


@pytest.mark.usefixtures("socket_enabled")
@pytest.mark.parametrize("tcp", [False, True], ids=["in loop", "tcp"])
async def test_a_car_charges(tcp: bool) -> None:  # noqa: FBT001
    box = AblBox(1, car=plugged(max_current=12, phases=2, ramp=0.1, reaction=0.0))
    async with Scene(box, tcp=tcp) as scene:
        charger = await scene.settled(config(), orders(10))
        await until(
            lambda: (
                charger.reading
                and charger.reading.connectors[1].estimated_power == 2 * 10.0 * 230
            )
        )
        assert charger.reading is not None
        connector = charger.reading.connectors[1]
        assert connector.status is Status.CHARGING
        assert connector.raw_state == "C2"
        assert (connector.plugged, connector.charging) == (True, True)
        # L1 is the third word.
        assert connector.current == (10.0, 10.0, 0.0)
        assert connector.estimated_energy is not None
        assert charger.reading.offered_current == 9.96
        assert charger.reading.allowed is True
        assert not charger.faults
        assert charger.info is not None
        assert charger.info.serial == "2W22xy01234567"
        assert charger.info.firmware == "1.2"
        assert charger.info.options["enable_after_power_cycle"] is True
        assert Capability.CURRENT in charger.capabilities
        # The box started with 16 A; the limit was written once.
        assert scene.writes() == [166]
        assert scene.bus.wire.statistics.bad_frames == 0


async def test_a_box_without_a_meter_has_no_currents() -> None:
    box = AblBox(1, car=plugged(), meter=False)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        assert charger.reading is not None
        connector = charger.reading.connectors[1]
        assert connector.current == (None, None, None)
        assert connector.estimated_power is None
        assert connector.estimated_energy is None
        assert Capability.CURRENT not in charger.capabilities
        assert Capability.ESTIMATED_ENERGY not in charger.capabilities


async def test_currents_in_b2_are_zero_without_measurements() -> None:
    car = Car()
    box = AblBox(1, car=car)
    box.unreadable_in_b2 = True
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        car.plug_in(request=False)
        await until(
            lambda: charger.reading and charger.reading.connectors[1].raw_state == "B2"
        )
        assert charger.reading is not None
        assert charger.reading.connectors[1].status is Status.SUSPENDED_EV
        assert charger.reading.connectors[1].current == (0, 0, 0)


async def test_nothing_is_written_to_a_box_within_its_orders() -> None:
    async with Scene(AblBox(1, default_current=10)) as scene:
        await scene.settled(config(), orders(16))
        assert scene.writes() == []


async def test_a_request_to_a_sleeping_box_is_repeated_in_time() -> None:
    async with Scene(AblBox(1, sleep_after=5)) as scene:
        charger = scene.add(config(), orders())
        await until(lambda: charger.available)
        first, second = [one.t for one in scene.requests()[:2]]
        assert 0.5 <= second - first <= 1.0
        assert charger.misses == 0
        assert charger.statistics.timeouts == 1


async def test_a_command_wakes_a_sleeping_box() -> None:
    async with Scene(AblBox(1, sleep_after=1.5)) as scene:
        charger = scene.add(config(poll_interval=60), orders())
        await until(lambda: charger.available and scene.boxes[0].asleep)
        await charger.change_orders(OrderChange(current=8))
        assert scene.writes() == [133]
        assert scene.boxes[0].lost_asleep == 2


async def test_a_missing_optional_register_is_no_missed_reply() -> None:
    without, having = AblBox(1, tells_icmax=False), AblBox(2)
    async with Scene(without, having) as scene:
        one = scene.add(config(1), orders(10))
        two = scene.add(config(2), orders(10))
        await until(lambda: scene.reads(1, 0x0F) and scene.reads(2, 0x0F))
        for charger in (one, two):
            await scene.polled(charger, 3)
            assert charger.available
            assert charger.misses == 0
        assert one.reading is not None
        assert one.reading.details["icmax_duty"] is None
        assert two.reading is not None
        assert two.reading.details["icmax_duty"] == 16.6
        # Probed three times, not with every poll.
        assert len(scene.reads(1, 0x0F)) == 3


async def test_a_car_that_slows_down_is_no_overcurrent_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its flag is read again at the next poll, not after `FLAGS_INTERVAL`."""
    bits = 0b101
    monkeypatch.setattr(Outlet, "overcurrent", property(lambda _outlet: bits))
    async with Scene(AblBox(1)) as scene:
        charger = await scene.settled(config(poll_interval=2.0), orders())
        await until(lambda: Fault.OVERCURRENT in charger.faults, 40)
        bits = 0
        begin = now()
        await until(lambda: Fault.OVERCURRENT not in charger.faults, 40)
        assert now() - begin < 2.5


async def test_flags_that_stay_away_are_dropped_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reader, "FLAGS_INTERVAL", 0.0)
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        assert charger.reading is not None
        assert charger.reading.details["overcurrent"] == 0
        answer = box._answer

        def without_flags(request: Request) -> bytes | None:
            return None if request.register == 0x06 else answer(request)

        box._answer = without_flags  # type: ignore[method-assign]
        await until(
            lambda: charger.reading and "overcurrent" not in charger.reading.details
        )
        assert len(scene.reads(1, 0x06)) >= reader.FLAGS_MISSES
        assert charger.misses == 0
        assert charger.available


async def test_a_reply_to_another_request_changes_nothing() -> None:
    async with Scene(AblBox(1)) as scene:
        charger = await scene.settled(config(), orders())
        scene.boxes[0].answer_register = 0x33
        before = scene.bus.wire.statistics.foreign_frames
        await until(lambda: not charger.available)
        assert charger.reading is None
        assert scene.bus.wire.statistics.foreign_frames > before
        scene.boxes[0].answer_register = None
        await until(lambda: charger.available)


@pytest.mark.parametrize("each_way", [0.05, 0.16, 0.4])
async def test_a_box_behind_a_slow_adapter_is_available(each_way: float) -> None:
    """From 160 ms each way all replies came after the time-out of a fast line."""
    async with Scene(AblBox(1)) as scene:
        adapter = scene.virtual.adapter
        adapter.delay_out = adapter.delay_in = each_way
        charger = scene.add(config(poll_interval=2.0), orders(16))
        await until(lambda: charger.available, 30)
        gone: list[bool] = []
        charger.subscribe(lambda: gone.append(not charger.available))
        await charger.change_orders(OrderChange(current=8.0))
        assert 7.9 < scene.boxes[0].ic_amps <= 8.0
        await asyncio.sleep(300)
        assert gone
        assert not any(gone)


async def test_a_dead_box_becomes_unavailable_and_comes_back() -> None:
    async with Scene(AblBox(1)) as scene:
        charger = await scene.settled(config(), orders(10))
        scene.boxes[0].faults.dead = True
        await until(lambda: not charger.available)
        assert charger.reading is None
        scene.boxes[0].power_cycle()
        scene.boxes[0].faults.clear()
        await until(lambda: charger.available and scene.boxes[0].ic_amps < 10)
        # Serial number and information were read anew before the limit was written; at
        # first the serial number was not known, and was read twice.
        registers = [one.register for one in scene.requests()]
        assert registers.count(0x50) == 3
        last = len(registers) - 1 - registers[::-1].index(0x50)
        assert LIMIT in registers[last:]


async def test_nothing_is_written_to_the_wrong_box() -> None:
    box = AblBox(1, serial="2W22xy99999999")
    async with Scene(box) as scene:
        charger = scene.add(config(serial="2W22xy01234567"), orders(6))
        await until(lambda: Fault.WRONG_CHARGER in charger.faults)
        with pytest.raises(WrongChargerError, match="2W22xy99999999") as caught:
            await charger.change_orders(OrderChange(current=8))
        assert caught.value.expected == "2W22xy01234567"
        with pytest.raises(WrongChargerError):
            await charger.change_orders(OrderChange(allowed=False))
        assert charger.reading is None
        assert not charger.available
        assert scene.writes() == []
        # The right one is there again.
        box.serial = "2W22xy01234567"
        await until(lambda: charger.available and box.outlet.icmax == 1000)
        assert Fault.WRONG_CHARGER not in charger.faults


async def test_a_serial_number_typed_in_later_is_checked_before_the_next_write() -> (
    None
):
    async with Scene(AblBox(1)) as scene:
        charger = await scene.settled(config(), orders(16))
        await scene.stop_polls(charger)
        typed = replace(charger.config, serial="2W22xy99999999")
        charger.reconfigure(typed)
        with pytest.raises(WrongChargerError):
            await charger.change_orders(OrderChange(current=8))
        assert scene.writes() == []
        assert Fault.WRONG_CHARGER in charger.faults


@pytest.mark.parametrize("lost", [2, 1_000_000])
async def test_lost_replies_are_no_box_without_a_serial_number(lost: int) -> None:
    """It has another master, which only its serial number shows."""
    box = AblBox(1)
    read, left = box._read, lost

    def loses(request: Request) -> bytes | None:
        nonlocal left
        if request.register != SERIAL or left == 0:
            return read(request)
        left -= 1
        return None

    box._read = loses  # type: ignore[method-assign]
    async with Scene(box) as scene:
        charger = scene.add(config(), orders(6))
        charger.accepts = lambda _serial: False
        if lost == 2:
            await until(lambda: Fault.WRONG_CHARGER in charger.faults)
            assert scene.writes() == []
        else:
            await until(lambda: charger.available and charger.info is not None)
            assert charger.serial is None


async def test_a_box_replaced_while_the_adapter_was_away() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        scene.virtual.unplug()
        await until(lambda: not scene.bus.connected)
        box.serial = "2W22xy99999999"
        scene.virtual.replug()
        # No serial number is configured: the first one that was read counts.
        await until(lambda: Fault.WRONG_CHARGER in charger.faults)
        with pytest.raises(WrongChargerError):
            await charger.change_orders(OrderChange(current=6))
        assert scene.writes() == []


async def test_a_box_replaced_between_two_replies() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box.faults.dead = True
        await until(lambda: charger.misses == 1)
        box.serial = "2W22xy99999999"
        box.faults.clear()
        await until(lambda: Fault.WRONG_CHARGER in charger.faults)
        assert not charger.available


async def test_a_second_box_with_the_same_id_is_noticed() -> None:
    async with Scene(AblBox(1, jitter=0.0)) as scene:
        charger = await scene.settled(config(), orders())
        # It replies a little after the first.
        scene.virtual.add(
            AblBox(1, serial="2W22xy99999999", turn_round=0.0023, jitter=0.0)
        )
        await until(lambda: Fault.DUPLICATE_ADDRESS in charger.faults, 120)
        scene.virtual.remove(scene.virtual.devices[-1])
        await until(lambda: Fault.DUPLICATE_ADDRESS not in charger.faults, 120)


async def test_a_few_garbled_replies_are_no_second_box() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        seen: list[bool] = []
        charger.subscribe(lambda: seen.append(bool(charger.noticed)))
        answers(box, *[b">0103xx\r\n"] * 5)
        await until(lambda: charger.misses == 3)
        await until(lambda: charger.available, 30)
        assert not any(seen)


async def test_echo_noise_and_errors_are_never_misread() -> None:
    box = AblBox(1, default_current=16)
    async with Scene(box) as scene:
        scene.virtual.faults.echo = True
        charger = await scene.settled(config(poll_interval=0.0), orders(10))
        scene.virtual.faults.noise_rate = 5
        box.faults.byte_error_rate = 0.003
        offered = set()

        def note() -> None:
            if charger.reading is not None:
                offered.add(charger.reading.offered_current)

        charger.subscribe(note)
        await scene.polled(charger, 25, 60)
        async with asyncio.timeout(30):
            # Until a reply has been damaged.
            while not scene.bus.wire.statistics.bad_frames:
                await scene.polled(charger, 5, 60)
        assert offered <= {9.96}
        assert set(scene.writes(LIMIT)) == {166}


async def test_two_boxes_do_not_mix() -> None:
    async with Scene(AblBox(1), AblBox(2, serial="2W22xy00000002")) as scene:
        one = await scene.settled(config(1), orders(10))
        two = await scene.settled(config(2), orders(8))
        await asyncio.gather(
            one.change_orders(OrderChange(current=9)),
            two.change_orders(OrderChange(current=7)),
        )
        assert [box.limits_written for box in scene.boxes] == [[166, 150], [133, 116]]


@pytest.mark.parametrize("serials", [("2W22xy00000001", "2W22xy00000002"), ("", "")])
@pytest.mark.parametrize("later", [0.0, 0.003, 0.02, 0.05, 0.1, 0.2])
async def test_a_second_box_that_replies_later_gets_no_orders(
    later: float, serials: tuple[str, str]
) -> None:
    one = AblBox(1, serial=serials[0], jitter=0.0)
    two = AblBox(1, serial=serials[1], turn_round=0.002 + later, jitter=0.0)
    two.on = False
    async with Scene(one, two) as scene:
        charger = scene.add(config(poll_interval=2.0), orders(10))
        await until(lambda: charger.available and one.ic_amps < 10.1)
        two.switch_on()
        # Three of its replies have come too late by then.
        await asyncio.sleep(12)
        with pytest.raises(GarbledReplyError):
            await charger.change_orders(OrderChange(current=8))
        await until(lambda: Fault.DUPLICATE_ADDRESS in charger.faults, 60)
        assert not charger.available
        assert two.writes == []
        # The lowering stands, and is sent as soon as it is alone.
        two.switch_off()
        await until(lambda: charger.available and one.ic_amps < 8.1, 60)
        assert Fault.DUPLICATE_ADDRESS not in charger.faults
        assert two.writes == []


async def test_a_reply_too_many_is_no_second_box() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = scene.add(config(poll_interval=2.0), orders(10))
        await until(lambda: charger.available and box.ic_amps < 10.1)
        box.faults.once("duplicate")
        await asyncio.sleep(10)
        assert charger.available
        assert not charger.faults
        await charger.change_orders(OrderChange(current=8))
        assert box.ic_amps < 8.1
