"""Reading, capabilities and limits from the records of a box."""

import asyncio
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.ews import NETWORK, PROTOCOL
from custom_components.evse_bus.evse.ews.box import Installation, Snapshot
from custom_components.evse_bus.evse.ews.readings import (
    capabilities_of,
    charger_reading,
)
from custom_components.evse_bus.evse.ews.wire.box_status import decode_box
from custom_components.evse_bus.evse.ews.wire.parameters import SystemMode
from custom_components.evse_bus.evse.ews.wire.status import (
    Card,
    ChargeResult,
    decode_details,
    decode_ports,
)
from custom_components.evse_bus.evse.meter import MeterReading, SessionReading
from custom_components.evse_bus.evse.model import Capability, SessionResult
from custom_components.evse_bus.evse.readings import ConnectorReading
from tests.virtual.ews_rfid import Card as VirtualCard

from .scene import EwsScene, play
from .wire import BOX, DETAILS, PORTS

MODE_3 = {
    Capability.OFFERED_CURRENT,
    Capability.CABLE_CURRENT,
    Capability.LOCK,
    Capability.PILOT_VOLTAGE,
}
ALWAYS = {
    Capability.RCD,
    Capability.VENTILATION,
    Capability.CONTACTOR,
    Capability.SERVER,
}


def connector(port: int = 1, **changes: object) -> ConnectorReading:
    """Return the reading of one port, with fields of its status changed."""
    ports = list(decode_ports(PORTS))
    ports[port - 1] = replace(ports[port - 1], **changes)  # type: ignore[arg-type]
    snapshot = Snapshot(
        ports=tuple(ports),
        meters=tuple(MeterReading(one.total_energy, 3) for one in ports),
        sessions=tuple(
            SessionReading(one.session_energy, one.session_time) for one in ports
        ),
        details=decode_details(DETAILS),
        status=decode_box(BOX),
        installation=Installation(),
    )
    reading = charger_reading(port, snapshot, paused=False)
    assert list(reading.connectors) == [port]
    return reading.connectors[port]


@pytest.mark.parametrize("result", ChargeResult)
def test_how_a_charge_has_ended(result: ChargeResult) -> None:
    reading = connector(result_code=result).last_result
    assert reading is not None
    assert reading.name == result.name


def test_every_result_has_a_neutral_one() -> None:
    assert {one.name for one in ChargeResult} == {one.name for one in SessionResult}


@pytest.mark.parametrize("code", [0, 2, 10, 255])
def test_an_unknown_result_is_none(code: int) -> None:
    assert connector(result_code=code).last_result is None


def test_the_card_is_read_and_not_shown() -> None:
    known = connector(card=Card(group=1, number=2, user="MAXMUSTR"))
    assert known.user == "MAXMUSTR"
    assert "MAXMUSTR" not in repr(known)
    assert connector(card=Card(group=1, number=2, user="")).user is None
    assert connector(card=None).user is None


def test_the_bits_and_voltages_are_of_the_right_port() -> None:
    details = decode_details(DETAILS)
    for port in (1, 2):
        status = decode_ports(PORTS)[port - 1]
        reading = connector(port)
        assert reading.rcd_tripped is status.rcd_tripped
        assert reading.pilot_low == status.pwm_minimum
        assert reading.pilot_high == status.pwm_maximum
        assert reading.proximity_voltage == status.cable_voltage
        assert reading.last_end == details.last_end[port - 1]
        assert reading.energy == status.total_energy
        assert reading.meter_generation == 3


# -- Capabilities -------------------------------------------------------------------


def test_a_port_in_mode_3_has_a_pilot() -> None:
    assert capabilities_of(1, Installation()) >= MODE_3 | ALWAYS
    fixed = capabilities_of(1, Installation(fixed_cable=True))
    assert fixed >= (MODE_3 | ALWAYS) - {Capability.LOCK}
    assert Capability.LOCK not in fixed


def test_a_household_socket_has_none() -> None:
    installation = Installation(mode_1=(False, True))
    assert capabilities_of(1, installation) >= MODE_3
    assert not capabilities_of(2, installation) & MODE_3
    assert capabilities_of(2, installation) >= ALWAYS


@pytest.mark.parametrize(
    ("mode", "cards", "keys"),
    [
        (None, True, False),
        (SystemMode.SERVER, False, False),
        (SystemMode.SERVER | SystemMode.CARDS, True, False),
        (SystemMode.SERVER | SystemMode.MANUAL_IO, False, True),
        (SystemMode(0xFF), True, True),
    ],
)
def test_cards_and_keys_depend_on_the_parameters(
    mode: SystemMode | None, *, cards: bool, keys: bool
) -> None:
    known = capabilities_of(1, Installation(mode=mode))
    assert (Capability.CARDS in known) is cards
    assert (Capability.KEYS in known) is keys


def test_before_the_parameters_are_known() -> None:
    """Capabilities that the parameters may take away are left out before."""
    known = capabilities_of(2, None)
    assert known >= ALWAYS
    assert not known & (MODE_3 | {Capability.CARDS, Capability.KEYS})


# -- On the virtual box --------------------------------------------------------------


def test_reading_of_a_charge_with_a_card() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.set_clock(scene.box.clock().replace(year=2026))
        assert scene.connector(2).last_result is None
        assert scene.connector(2).last_end is None
        scene.box.present_card(VirtualCard(7, 42, "MAX"))
        await scene.plug(2)
        scene.box.press_key(2, 1)
        await scene.until(lambda: scene.connector(2).user == "MAX")
        assert scene.connector(1).user is None
        scene.box.ports[1].release_start("test")
        await scene.until(lambda: scene.connector(2).charging)
        port = scene.connector(2)
        assert (port.pilot_low, port.pilot_high) == (-12.0, 6.0)
        assert port.proximity_voltage == 1.9
        assert not port.ventilation_requested
        assert scene.reading(2).server_connected
        assert not scene.reading(2).ventilating
        scene.box.ports[1].wants_fan = True
        await scene.until(lambda: scene.connector(2).ventilation_requested)
        await scene.until(lambda: scene.reading(2).ventilating, 15)
        assert not scene.connector(1).ventilation_requested
        await asyncio.sleep(10)
        scene.cars[1].leave()
        await scene.until(
            lambda: scene.connector(2).last_result is SessionResult.PILOT_LOST
        )
        end = scene.connector(2).last_end
        assert end is not None
        assert abs((scene.box.clock() - end).total_seconds()) < 10
        assert scene.connector(1).last_end is None
        scene.box.trip_rcd(1)
        await scene.until(lambda: scene.connector(1).rcd_tripped)
        assert not scene.connector(2).rcd_tripped

    play(EwsScene(options={"rfid": True, "fan": True}), acts)


def test_a_bus_over_the_network_is_the_listeners() -> None:
    assert (PROTOCOL.ports, PROTOCOL.dials_in) == (2, False)
    assert (NETWORK.ports, NETWORK.dials_in) == (2, True)
    assert NETWORK.timing.reply_timeout > PROTOCOL.timing.reply_timeout
    with pytest.raises(TypeError, match="listener"):
        NETWORK.bus("socket://192.0.2.1:4711")
