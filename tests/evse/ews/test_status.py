"""Records of a box, byte by byte."""

from datetime import datetime
from ipaddress import IPv4Address

import pytest

from custom_components.evse_bus.evse.errors import ImplausibleReplyError
from custom_components.evse_bus.evse.ews.wire.box_status import (
    BoxFlags,
    BoxStatus,
    Dhcp,
    PresentedCard,
    decode_box,
    decode_dhcp,
)
from custom_components.evse_bus.evse.ews.wire.status import (
    Card,
    ChargeResult,
    Details,
    KeysAndLeds,
    PortFlags,
    PortStatus,
    StartRelease,
    decode_details,
    decode_ports,
)

from .wire import BOX, DETAILS, DHCP, PORT_CHARGING, PORT_IDLE, PORTS

MAX = Card(group=7, number=42, user="Max M")
CHARGING = PortStatus(
    state=0x41,
    cable_current=32,
    offered_current=16,
    flags=PortFlags.VENTILATION,
    start_code=2,
    optimised=True,
    result_code=3,
    session_time=3600,
    session_energy=3000,
    last_time=7200,
    last_energy=10000,
    total_energy=12345678,
    meter_cycles=42,
    locked=True,
    contactor=True,
    rcd_tripped=False,
    pwm_minimum=-12.0,
    pwm_maximum=6.0,
    cable_voltage=2.5,
    keys_and_leds=KeysAndLeds.LED_GREEN | KeysAndLeds.KEY_1,
    card=MAX,
)


def local(text: str) -> datetime:
    return datetime.fromisoformat(text)


def changed(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + bytes((value,)) + data[at + 1 :]


# -- rc ------------------------------------------------------------------------------


def test_rc() -> None:
    first, second = decode_ports(PORTS)
    assert first == CHARGING
    assert first.start is StartRelease.RELEASED
    assert first.result is ChargeResult.PILOT_LOST
    assert second.state == 0
    assert second.total_energy == 100
    assert (second.session_time, second.last_energy, second.meter_cycles) == (0, 0, 0)
    assert (second.locked, second.contactor, second.rcd_tripped) == (False,) * 3
    assert second.card is None
    assert second.start is StartRelease.NONE
    assert second.result is None
    assert decode_ports(PORT_IDLE + PORT_CHARGING) == (second, first)


@pytest.mark.parametrize("length", [0, 53, 54, 107, 109, 162])
def test_rc_of_another_length(length: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_ports((2 * PORTS)[:length])


def test_codes_that_the_manual_does_not_know_stay_raw() -> None:
    for code in range(256):
        data = changed(changed(changed(PORTS, 0, code), 4, code), 6, code)
        port = decode_ports(data)[0]
        assert (port.state, port.start_code, port.result_code) == (code, code, code)
        assert (port.start is None) == (code > 2)
        assert (port.result is None) == (code not in {1, 3, 4, 5, 6, 7, 8, 9})


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (1, 81),  # A of the cable
        (2, 255),  # A offered
        (5, 2),  # optimised
        (31, 2),  # locked
        (32, 0xFF),  # contactor
        (33, 3),  # RCD
        (41, 2),  # card
    ],
)
@pytest.mark.parametrize("port", [0, 1])
def test_rc_that_cannot_be(at: int, value: int, port: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_ports(changed(PORTS, 54 * port + at, value))


def test_a_port_in_mode_1_does_not_know_all_of_it() -> None:
    wild = PORT_CHARGING
    for at in (1, 2, 31, 34, 35, 36, 37, 38, 39):
        wild = changed(wild, at, 0xFF)
    port, other = decode_ports(wild + PORT_CHARGING, (True, False))
    assert other == CHARGING
    assert (port.cable_current, port.offered_current, port.locked) == (None,) * 3
    assert (port.pwm_minimum, port.pwm_maximum, port.cable_voltage) == (None,) * 3
    assert (port.state, port.total_energy, port.contactor, port.card) == (
        0x41,
        12345678,
        True,
        MAX,
    )
    with pytest.raises(ImplausibleReplyError):
        decode_ports(wild + PORT_CHARGING, (False, True))


def test_bytes_of_a_missing_port_are_ignored() -> None:
    for second in (54 * b"\xff", PORT_IDLE):
        assert decode_ports(PORT_CHARGING + second, count=1) == (CHARGING,)
    with pytest.raises(ImplausibleReplyError):
        decode_ports(PORT_CHARGING + 54 * b"\xff")
    with pytest.raises(ImplausibleReplyError):
        decode_ports(PORT_CHARGING, count=1)


# -- rd ------------------------------------------------------------------------------

READ = Details(
    power=(11100, 0),
    pwm_duty=(53, 100),
    pilot_code=(0x42, 0x41),
    cable_code=(0x20, 0),
    limit=(16, 0),
    last_card=(MAX, None),
    last_end=(local("2014-06-30T23:59:58"), None),
)


def test_rd() -> None:
    assert decode_details(DETAILS) == READ


@pytest.mark.parametrize("more", [b"\0", b"\xff" * 8, bytes(984)])
def test_rd_of_a_later_firmware(more: bytes) -> None:
    assert decode_details(DETAILS + more) == READ


@pytest.mark.parametrize("length", [0, 1, 55])
def test_rd_too_short(length: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_details(DETAILS[:length])


@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 1), (4, 1), (8, 101), (9, 255), (16, 2), (29, 255), (44, 13), (51, 13)],
)
def test_rd_that_cannot_be(at: int, value: int) -> None:
    data = DETAILS
    if at == 51:
        data = data[:51] + bytes((13, 1)) + data[53:]
    with pytest.raises(ImplausibleReplyError):
        decode_details(changed(data, at, value))


def test_a_limit_that_is_too_high_is_shown_as_it_is() -> None:
    assert decode_details(changed(DETAILS, 14, 255)).limit == (255, 0)


# -- rs ------------------------------------------------------------------------------


def test_rs() -> None:
    assert decode_box(BOX) == BoxStatus(
        firmware="M165300103",
        flags=BoxFlags.RESTARTED | BoxFlags.BACKUP_PRESENT | BoxFlags.BACKUP_CHARGED,
        serial="169300001234",
        website_size=0x12345,
        website_crc=0xBEEF,
        website_version="Website 1.3",
        lan_error=0,
        mac=bytes.fromhex("0004a3010203"),
        server_connected=True,
        web_client=IPv4Address("192.168.0.23"),
        maximum_current=32,
        ventilating=False,
        clock=local("2014-12-31T01:02:03"),
        reader_error=0,
        reader_firmware="MCR 6241",
        card=PresentedCard(
            tag=bytes.fromhex("04112233445566"),
            valid=True,
            decode_error=0,
            group=7,
            number=42,
            user="Max M",
        ),
    )


def test_rs_without_a_card_and_without_a_clock() -> None:
    data = BOX[:64] + bytes(7) + BOX[71:83] + bytes(1) + b"\xff" * 21
    box = decode_box(data)
    assert (box.clock, box.card) == (None, None)


@pytest.mark.parametrize("length", [0, 104, 106])
def test_rs_of_another_length(length: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_box((2 * BOX)[:length])


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (12, 0),  # serial number
        (57, 2),  # server connected
        (62, 5),  # A
        (62, 81),
        (63, 2),  # ventilating
        (66, 13),  # month
        (83, 2),  # card
        (91, 2),  # valid
    ],
)
def test_rs_that_cannot_be(at: int, value: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_box(changed(BOX, at, value))


def test_a_maximum_that_is_not_known_yet() -> None:
    assert decode_box(changed(BOX, 62, 0)).maximum_current == 0


# -- rg ------------------------------------------------------------------------------


def test_rg() -> None:
    assert decode_dhcp(DHCP) == Dhcp(
        address=IPv4Address("192.168.1.5"),
        gateway=IPv4Address("192.168.1.1"),
        netmask=IPv4Address("255.255.255.0"),
        server=IPv4Address("192.168.1.1"),
        server_real=IPv4Address("10.0.0.1"),
        lease=86400,
        lease_left=43200,
    )


# -- Private -------------------------------------------------------------------------


def test_no_repr_has_names_cards_or_addresses() -> None:
    text = repr((decode_ports(PORTS), READ, decode_box(BOX), decode_dhcp(DHCP), MAX))
    for private in ("Max", "42,", "192.168", "255.255", "x04", "xa3"):
        assert private not in text.replace("meter_cycles=42,", "")
