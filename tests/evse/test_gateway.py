"""An adapter that speaks Modbus TCP is recognised, and no other is taken for one."""

import asyncio
from itertools import combinations
from typing import Any

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.gateway import (
    NOT_MBAP,
    PROBE,
    is_reply,
    speaks_modbus_tcp,
)
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests.simulated_time import now
from tests.virtual import (
    CLIENT,
    AblBox,
    Car,
    EvboxChargePoint,
    SmartEvse,
    VirtualBus,
)
from tests.virtual.adapter import GatewayKind, ModbusTcpGateway
from tests.virtual.device import Device
from tests.virtual.ews_box import EwsBox

BEGINS: dict[str, int] = {"evbox": 0x02, "ews": 0x02, "abl": 0x3A}
"""First byte of each message, where a protocol has one."""

each_protocol = pytest.mark.parametrize(
    "protocol", ["abl", "evbox", "smartevse", "smartevse_master", "ews"]
)


def crc(data: bytes) -> bytes:
    """Return the CRC of Modbus RTU (MODBUS over Serial Line, 6.2.2)."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


@pytest.mark.parametrize("sent", [PROBE, NOT_MBAP])
def test_no_charger_takes_a_probe_for_a_request(sent: bytes) -> None:
    assert not set(BEGINS.values()) & set(sent)
    for begin, end in combinations(range(len(sent) + 1), 2):
        part = sent[begin:end]
        assert len(part) < 4 or crc(part[:-2]) != part[-2:]


def test_what_a_gateway_makes_of_the_probe_is_no_request_either() -> None:
    frame = PROBE[6:] + crc(PROBE[6:])
    assert not set(BEGINS.values()) & set(frame)
    # No address of a SmartEVSE (0 to 9), and a read.
    assert frame[0] == 247
    assert frame[1] == 4


@given(st.binary(min_size=8, max_size=40), st.binary(max_size=40))
def test_only_its_own_transaction_is_a_reply(request: bytes, received: bytes) -> None:
    if is_reply(request, received):
        assert received[:4] == request[:2] + b"\0\0"
        assert len(received) == 6 + int.from_bytes(received[4:6])


def box_of(protocol: str) -> Device:
    if protocol == "abl":
        return AblBox(1)
    if protocol == "evbox":
        return EvboxChargePoint("01923054", min_interval=1)
    if protocol == "ews":
        return EwsBox()
    return SmartEvse(load_balance=2 if protocol == "smartevse_master" else 0, car=Car())


ADDRESSES = {"abl": 1, "evbox": 1923054, "smartevse": 0, "smartevse_master": 2}


def bus_of(protocol: str, url: str) -> tuple[Bus, Charger[Any]]:
    described = PROTOCOLS[protocol]
    bus = described.bus(url)
    config = described.config(
        key="1",
        name="box",
        address=ADDRESSES.get(protocol, 1),
        installation_limit=16.0,
    )
    charger = described.charger(config, Orders(limit=CurrentLimit(current=10.0)))
    bus.add(charger)
    return bus, charger


@each_protocol
@pytest.mark.parametrize("kind", ["silent", "closes", "answers"])
async def test_a_running_bus_recognises_it(protocol: str, kind: GatewayKind) -> None:
    with VirtualBus.in_loop(box_of(protocol), network=True) as virtual:
        virtual.adapter.gateway = ModbusTcpGateway(kind)
        bus, charger = bus_of(protocol, virtual.url)
        changes: list[bool] = []
        async with bus:
            bus.subscribe(lambda: changes.append(bus.wire.gateway.detected))
            begin = now()
            while not bus.wire.gateway.detected:
                # An EVBox is asked once in 20 s only.
                assert now() - begin < 120
                await asyncio.sleep(0.1)
            assert changes[-1]
            # Nothing has reached the wire.
            assert not virtual.log.of(CLIENT)
            # Set to transparent mode, it is one no more.
            virtual.adapter.gateway = None
            await charger.wait_available(90.0)
            assert not bus.wire.gateway.detected
            assert not changes[-1]


@each_protocol
async def test_one_that_never_answers_cannot_be_told_from_dead_boxes(
    protocol: str,
) -> None:
    with VirtualBus.in_loop(box_of(protocol), network=True) as virtual:
        virtual.adapter.gateway = ModbusTcpGateway("mute")
        bus, _ = bus_of(protocol, virtual.url)
        async with bus:
            await asyncio.sleep(600)
            assert not bus.wire.gateway.detected


@each_protocol
@pytest.mark.parametrize("network", [False, True])
async def test_an_adapter_in_front_of_dead_boxes_is_none(
    protocol: str,
    network: bool,  # noqa: FBT001
) -> None:
    """The probe is passed on, and harms no box that listens but is not heard."""
    box = box_of(protocol)
    with VirtualBus.in_loop(box, network=network) as virtual:
        box.faults.lose_rate = 1.0
        bus, charger = bus_of(protocol, virtual.url)
        async with bus:
            await asyncio.sleep(400)
            sent = b"".join(entry.data for entry in virtual.log.of(CLIENT))
            assert (PROBE in sent) == network
            assert not bus.wire.gateway.detected
            box.faults.clear()
            await charger.wait_available(90.0)
            # Silent once more, it is not asked again: it has passed frames on.
            asked = sent.count(PROBE)
            box.faults.lose_rate = 1.0
            await asyncio.sleep(400)
            sent = b"".join(entry.data for entry in virtual.log.of(CLIENT))
            assert sent.count(PROBE) == asked
            assert not bus.wire.gateway.detected


@each_protocol
async def test_an_adapter_that_closes_connections_anyhow_is_none(protocol: str) -> None:
    """Idle ones soon; or each one as soon as it is open."""
    with VirtualBus.in_loop(box_of(protocol), network=True) as virtual:
        virtual.adapter.idle_timeout = 0.5
        bus, charger = bus_of(protocol, virtual.url)
        async with bus:
            await charger.wait_available(90.0)
            await asyncio.sleep(60)
            virtual.adapter.idle_timeout = None
            loop = asyncio.get_running_loop()
            opened = virtual.opened
            virtual.adapter.hung = True
            for _ in range(1200):
                await asyncio.sleep(0.1)
                if virtual.opened != opened:
                    opened = virtual.opened
                    loop.call_later(0.05, virtual._port.drop_client)  # type: ignore[union-attr]
            assert not bus.wire.gateway.detected


@each_protocol
@pytest.mark.parametrize("idle_timeout", [0.5, 1.0, 2.0, 5.0])
async def test_an_idle_adapter_in_front_of_dead_boxes_is_none(
    protocol: str, idle_timeout: float
) -> None:
    with VirtualBus.in_loop(box_of(protocol), network=True) as virtual:
        virtual.faults.dead = True
        virtual.adapter.idle_timeout = idle_timeout
        bus, _ = bus_of(protocol, virtual.url)
        async with bus:
            await asyncio.sleep(600)
            assert not bus.wire.gateway.detected


@pytest.mark.parametrize("kind", ["silent", "closes", "answers", "mute", None])
@pytest.mark.parametrize("network", [False, True])
async def test_asking_a_port_that_is_not_open(
    kind: GatewayKind | None,
    network: bool,  # noqa: FBT001
) -> None:
    with VirtualBus.in_loop(SmartEvse(), network=network) as virtual:
        if kind is not None:
            virtual.adapter.gateway = ModbusTcpGateway(kind)
        expected = network and kind in ("silent", "closes", "answers")
        settings = PROTOCOLS["smartevse"].settings
        for closes in (False, True):
            found = await speaks_modbus_tcp(virtual.url, settings, closes=closes)
            assert found == expected
        assert not virtual.connected
        virtual.unplug()
        assert not await speaks_modbus_tcp(virtual.url, settings, closes=True)
