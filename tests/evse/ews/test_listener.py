"""Boxes that dial, and the bus of each."""

import asyncio
from typing import override

import pytest

from custom_components.evse_bus.evse.dialling import UnknownBox
from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    PortBusyError,
    PortMissingError,
)
from custom_components.evse_bus.evse.ews.charger import EwsPort
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.ews.network import line, listener as listening
from custom_components.evse_bus.evse.ews.network.listener import Listener
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from tests.virtual import Car
from tests.virtual.ews_box import EwsBox as VirtualBox
from tests.virtual.ews_cli import EwsFleet
from tests.virtual.ews_dialler import EwsDialler

from .dialling import (
    HOST,
    SERIAL,
    dialling,
    expected,
    first,
    has_reading,
    run,
    server,
    until,
)

pytestmark = pytest.mark.usefixtures("socket_enabled")


def test_a_bus_waits_for_its_box_to_dial() -> None:
    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            await asyncio.sleep(0.1)
            assert made.is_listening
            assert not bus.connected
            assert not first(bus).available
            with pytest.raises(Exception, match="not connected"):
                await first(bus).change_orders(OrderChange(current=10.0))

    run(scene)


class DamagedBox(VirtualBox):
    """Its first replies to ``rs`` have another serial number; their checksum fits."""

    damaged = 1

    @override
    def send(self, data: bytes, turn_round: float, silence: float = 0.0) -> None:
        if data[3:6] == b"Ars" and self.damaged:
            self.damaged -= 1
            changed = bytearray(data)
            # The last digit, and the size of the web page.
            changed[6 + 23] ^= 2
            changed[6 + 24] ^= 2
            data = bytes(changed)
        super().send(data, turn_round, silence)


def test_a_box_that_dials_is_found_by_two_replies_that_agree() -> None:
    async def scene() -> None:
        found: list[UnknownBox] = []
        async with server(on_unknown_box=found.append) as made:
            box = DamagedBox(serial=SERIAL)
            with dialling(made, box):
                await until(lambda: found)
                assert box.damaged == 0
                assert [one.serial for one in found] == [SERIAL]

    run(scene)


def test_a_box_dials_and_charges() -> None:
    async def scene() -> None:
        car = Car()
        box = VirtualBox(serial=SERIAL, cars=(car,))
        async with server() as made, expected(made) as bus:
            with dialling(made, box) as dialler:
                await until(lambda: has_reading(bus))
                assert bus.wire.statistics.reopened == 0
                await until(lambda: box.ports[0].limit == box.ports[1].limit == 16)
                car.plug_in()
                await until(
                    lambda: first(bus).reading.connectors[1].raw_state == "0x30"  # type: ignore[union-attr]
                )
                await first(bus).change_orders(OrderChange(allowed=True, current=10.0))
                await until(lambda: box.ports[0].contactor)
                assert box.ports[0].offered == 10
                assert not dialler.dropped

    run(scene)


def test_an_unknown_box_is_reported_and_only_identified() -> None:
    async def scene() -> None:
        found: list[UnknownBox] = []
        box = VirtualBox(serial="099999999999")
        async with server(on_unknown_box=found.append) as made:
            with dialling(made, box):
                await until(lambda: found)
                await asyncio.sleep(0.3)
                assert found[0].serial == "099999999999"
                assert str(found[0].peer) == HOST
                assert {one.name for one in box.commands} == {"id", "rs"}
                async with expected(made, "099999999999") as bus:
                    # Set up meanwhile: the connection that is there is taken.
                    await until(lambda: has_reading(bus))
                    assert made.statistics.accepted == 1

    run(scene)


def test_the_other_reading_of_the_checksum(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = listening.TCP_TIMING
    monkeypatch.setattr(
        listening,
        "TCP_TIMING",
        type(quick)(reply_timeout=0.2, gap=0.2, longest_reply=quick.longest_reply),
    )

    async def scene() -> None:
        box = VirtualBox(serial=SERIAL, bcc="without_msgid")
        async with server() as made, expected(made) as bus:
            with dialling(made, box):
                await until(lambda: has_reading(bus))

    run(scene)


def test_the_box_dials_again() -> None:
    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made) as dialler:
                await until(lambda: has_reading(bus))
                states: list[bool] = []
                bus.subscribe(lambda: states.append(bus.connected))
                dialler.hang_up()
                await until(lambda: states == [False, True])
                await until(lambda: has_reading(bus))
                assert bus.wire.statistics.reopened == 1

    run(scene)


def test_a_second_connection_with_the_same_number_is_refused() -> None:
    async def scene() -> None:
        car = Car()
        box = VirtualBox(serial=SERIAL, cars=(car,))
        false = VirtualBox(serial=SERIAL)
        async with server() as made, expected(made) as bus:
            with dialling(made, box) as dialler:
                await until(lambda: has_reading(bus))
                with dialling(made, false):
                    await until(lambda: made.statistics.duplicates >= 3)
                    assert {one.name for one in false.commands} <= {"id", "rs"}
                    assert not dialler.dropped
                    assert dialler.opened == 1
                    assert has_reading(bus)
        assert made.statistics.replaced == 0

    run(scene)


def test_a_half_open_connection_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "PROOF_TIME", 1.0)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made) as dialler:
                await until(lambda: has_reading(bus))
                dialler.vanish()
                await until(lambda: made.statistics.replaced == 1)
                await until(lambda: has_reading(bus))
                assert bus.wire.statistics.reopened == 1

    run(scene)


def test_a_half_open_connection_dies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line, "ANSWER_PATIENCE", 1.0)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made) as dialler:
                await until(lambda: has_reading(bus))
                dialler.vanish(redial=False)
                await until(lambda: not bus.connected)
                assert not first(bus).available
                dialler.dial()
                await until(lambda: has_reading(bus))

    run(scene)


def test_a_box_without_power(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "PROOF_TIME", 0.5)

    async def scene() -> None:
        box = VirtualBox(serial=SERIAL)
        async with server() as made, expected(made) as bus:
            with dialling(made, box):
                await until(lambda: has_reading(bus))
                await until(lambda: box.ports[0].limit == 16)
                box.power_cycle(0.2)
                await until(lambda: made.statistics.replaced == 1)
                await until(lambda: box.ports[0].limit == 16)

    run(scene)


def test_a_box_that_begins_to_talk_nonsense_is_hung_up_on() -> None:
    async def scene() -> None:
        box = VirtualBox(serial=SERIAL)
        async with server() as made, expected(made) as bus:
            with dialling(made, box) as dialler:
                await until(lambda: has_reading(bus))
                box.send_raw(b"\x55" * 3000)
                await until(lambda: dialler.opened == 2)
                await until(lambda: has_reading(bus))

    run(scene)


def test_records_during_identification_reach_the_bus() -> None:
    """Keys that were pressed without a server come before the first question."""

    async def scene() -> None:
        box = VirtualBox(serial=SERIAL, manual_io=True)
        async with server() as made, expected(made) as bus:
            events: list[object] = []
            first(bus).subscribe_events(events.append)
            dialler = EwsDialler(
                box, HOST, made.port, retry=60, source_ports=0, own_thread=False
            )
            with dialler:
                await until(lambda: has_reading(bus))
                dialler.hang_up(redial=False)
                await until(lambda: not bus.connected)
                box.press_key(1, 3, 0.5)
                await asyncio.sleep(0.7)
                dialler.dial()
                await until(lambda: events)
                assert events[0].key == 3  # type: ignore[attr-defined]

    run(scene)


def test_fifty_boxes() -> None:
    async def scene() -> None:
        serials = [f"{n:012d}" for n in range(1, 51)]
        boxes = [VirtualBox(serial=serial) for serial in serials]
        async with server() as made:
            buses = []
            async with asyncio.TaskGroup() as group:
                for serial in serials:
                    bus = made.register(serial)
                    buses.append(bus)
                    bus.add(
                        EwsPort(
                            EwsPortConfig(
                                key=serial,
                                name=serial,
                                address=1,
                                serial=serial,
                                installation_limit=16.0,
                            ),
                            Orders(limit=CurrentLimit(current=16.0)),
                        )
                    )
                    group.create_task(bus.start())
            fleet = EwsFleet(
                boxes, HOST, made.port, retry=0.1, source_ports=0, own_thread=False
            )
            with fleet:
                await until(lambda: all(map(has_reading, buses)), 30)
                # All have dialled in the same moment, and none had to dial twice.
                assert made.statistics.accepted == len(boxes)
                assert made.statistics.crowded_out == 0
                await until(lambda: all(box.ports[0].limit == 16 for box in boxes), 30)
                await asyncio.sleep(2.5)
                assert sum(bus.wire.statistics.missed_deadlines for bus in buses) == 0
                assert all(has_reading(bus) for bus in buses)
            for serial in serials:
                await made.unregister(serial)

    run(scene)


def test_a_port_that_is_taken_and_an_address_that_is_not_ours() -> None:
    async def scene() -> None:
        async with server() as made:
            with pytest.raises(PortBusyError):
                await Listener(HOST, made.port).start()
        with pytest.raises(PortMissingError):
            await Listener("192.0.2.1", 0).start()

    run(scene)


def test_a_bus_that_is_stopped_leaves_nothing() -> None:
    async def scene() -> None:
        async with server() as made:
            bus = made.register(SERIAL)
            await bus.start()
            with dialling(made) as dialler:
                await until(lambda: bus.connected)
                await bus.stop()
                await until(lambda: dialler.opened >= 2 or not dialler.connected)
                with pytest.raises(NotAvailableError):
                    await bus.run(lambda _turn: asyncio.sleep(0))  # type: ignore[arg-type, return-value]
                await bus.start()
                await until(lambda: bus.connected)
            await made.unregister(SERIAL)

    run(scene)
