"""The status blocks of a virtual EWS-Box: `rc`, `rd`, `rs` and `rg`."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from .ews_rfid import logged_in

if TYPE_CHECKING:
    from datetime import datetime

    from .ews_box import EwsBox
    from .ews_port import EwsPort

RC = struct.Struct(">BBBBBBB IIIIII BBB hhH B 13s")
RD = struct.Struct(">II BBBBBBBB 13s13s 7s7s")
RS = struct.Struct(">11sB12sIH20sB6sB4sBB7s34s")
RG = struct.Struct(">4s4s4s4s4sII")
CLOCK = struct.Struct(">HBBBBB")

NO_PWM = 100
PHASE_VOLTAGE = 230
# Volts on the proximity contact with 5 V behind 330 ohms; 2.7 kohms are in the socket.
PROXIMITY = {None: 4.46, 13: 3.73, 20: 3.11, 32: 1.9, 63: 1.13, 70: 1.13}


def pwm_percent(port: EwsPort) -> int:
    """Return the duty cycle of the pilot, % (100 = none)."""
    if not port.active or port.installation.mode1:
        return NO_PWM
    amps = port.offered
    return int(amps / 0.6) if amps <= 51 else int(amps / 2.5 + 64)


def pilot_volts(port: EwsPort) -> tuple[float, float]:
    """Return the lowest and the highest voltage on the pilot, V."""
    if port.installation.mode1:
        return 0.0, 0.0
    if not port.pilot:
        return 12.0, 12.0
    if not port.active:
        return 9.0, 9.0
    if not port.contactor:
        return -12.0, 9.0
    return -12.0, 3.0 if port.wants_fan else 6.0


def power(port: EwsPort) -> int:
    """Return the power drawn, W ("Energie in W")."""
    cos_phi = port.car.cos_phi if port.car else 1.0
    return round(sum(port.currents) * PHASE_VOLTAGE * cos_phi)


def rc(box: EwsBox) -> bytes:
    """Return both ports' status: 2 x 54 bytes."""
    return b"".join(_port_status(box, port) for port in box.ports)


def _port_status(box: EwsBox, port: EwsPort) -> bytes:
    session = port.session
    low, high = pilot_volts(port)
    mode1 = port.installation.mode1
    cable = port.cable if port.cable_in and not mode1 else 0
    if port.installation.fixed_cable and not mode1:
        cable = port.ceiling
    volts = PROXIMITY.get(cable or None, PROXIMITY[None])
    total = port.meter_reads.pop(0) if port.meter_reads else session.total_wh
    return RC.pack(
        port.status,
        cable or 0,
        0 if mode1 else port.offered,
        port.wants_fan and port.pilot,
        port.start_mode,
        port.optimised,
        session.result,
        int(session.seconds),
        int(session.wh),
        int(session.last_seconds),
        int(session.last_wh),
        int(total) & 0xFFFFFFFF,
        session.cycles,
        port.locked,
        port.contactor,
        port.rcd_tripped,
        round(low * 100),
        round(high * 100),
        round(volts * 100),
        box.user_interface.keys_pressed(port.number)
        | box.user_interface.leds(port, box.now()),
        logged_in(session.card),
    )


def rd(box: EwsBox) -> bytes:
    """Return the details of both ports: 56 bytes, and those that later versions add."""
    one, two = box.ports
    return (
        RD.pack(
            power(one),
            power(two),
            pwm_percent(one),
            pwm_percent(two),
            _pilot_level(one),
            _pilot_level(two),
            _cable_level(one),
            _cable_level(two),
            one.limit,
            two.limit,
            logged_in(one.session.last_card),
            logged_in(two.session.last_card),
            _date(one.session.last_end),
            _date(two.session.last_end),
        )
        + box.rd_extra
    )


def _pilot_level(port: EwsPort) -> int:
    """Return the IEC 61851 state: 0 = A, 1 = B, 2 = C, 3 = D."""
    return {12.0: 0, 9.0: 1, 6.0: 2, 3.0: 3}.get(pilot_volts(port)[1], 0)


def _cable_level(port: EwsPort) -> int:
    return (port.cable or 0) if port.cable_in else 0


def _date(fields: tuple[int, ...]) -> bytes:
    return CLOCK.pack(*fields)


def clock_fields(now: datetime) -> tuple[int, ...]:
    """Return year to second."""
    return now.year, now.month, now.day, now.hour, now.minute, now.second


def rs(box: EwsBox) -> bytes:
    """Return the status of the system: 105 bytes."""
    one, two = box.ports
    status = (
        box.restarted
        | (one.has_lock or two.has_lock) << 1
        | box.power_backup << 2
        | (box.power_backup and not box.initialising) << 3
    )
    fan = any(p.wants_fan and p.contactor and p.installation.fan for p in box.ports)
    return RS.pack(
        box.firmware,
        status,
        box.serial.encode("ascii"),
        123456,
        0xBEEF,
        b"Web 1.0".ljust(20, b"\x00"),
        0,
        box.mac,
        box.server_connected,
        bytes(4),
        box.jumper,
        fan,
        _date(clock_fields(box.clock())),
        box.reader.status(valid=box.card_counts_as_valid),
    )


def rg(box: EwsBox) -> bytes:
    """Return the addresses from DHCP: 28 bytes, zeros without it."""
    if box.user.own_ip != bytes(4):
        return bytes(RG.size)
    used = int(box.now() % box.lease) if box.lease else 0
    router = bytes((192, 168, 178, 1))
    return RG.pack(
        bytes((192, 168, 178, 57)),
        router,
        bytes((255, 255, 255, 0)),
        router,
        router,
        box.lease,
        used,
    )
