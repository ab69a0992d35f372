"""Readable registers of a virtual ABL EVCC2/3: chapter 2 of the manual as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .abl_outlet import UNREADABLE

if TYPE_CHECKING:
    from collections.abc import Callable

    from .abl import AblBox

MODBUS_SETTINGS = 0x27  # 1 stop bit, even parity, 38400 Bd
SHORT_UNREADABLE = 0x64
METER_LIMIT = 800
SERIAL_CHARS = 14


def state_byte(state: str) -> int:
    """Return 0xC2 for C2, 0xFB for F11 (annex 3.4)."""
    return int(state[0] + f"{int(state[1:]):X}", 16)


def words(*values: int) -> bytes:
    """Return 16-bit words."""
    return b"".join(value.to_bytes(2, "big") for value in values)


def identity(box: AblBox) -> bytes:
    """0x01: hardware, device-ID, firmware, configuration."""
    out = box.outlet
    meter = out.meter if out.meter_bit is None else out.meter_bit
    flags = box.coding_resistor << 7 | out.upstream_enabled << 6 | meter << 5
    flags |= box.rdc_md << 4 | box.coding_resistor << 3
    flags |= box.welding_detection << 2 | out.enable_input
    major, minor = box.firmware
    return bytes((box.hardware << 6 | box.device_id, major << 4 | minor, flags))


def modbus_settings(_: AblBox) -> bytes:
    """0x03: 38400 Bd, 8E1."""
    return bytes((MODBUS_SETTINGS,))


def short_state(box: AblBox) -> bytes:
    """0x04: the state; not in the manual."""
    return bytes((state_byte(box.state),))


def flags(box: AblBox) -> bytes:
    """0x06: the state machine's pointer (here the state) and the flags."""
    out = box.outlet
    bits = (
        out.timeout_triggers_f4 << 15
        | out.b2_needs_enable_after_power << 14
        | out.upstream_lost << 9
        | out.imbalance << 8
        | out.hot << 7
        | out.meter_failed << 6
        | (not out.e0_a1_enabled) << 5
        | (not out.b1_b2_enabled) << 4
        | (not out.a1_b1_enabled) << 3
        | out.overcurrent
    )
    return bytes((state_byte(out.state),)) + words(bits)


def icmax(box: AblBox) -> bytes:
    """0x0F: rated, Idefault, Icmax as written, offered (abl_field.md); not in the manual.

    The byte is 3F in all five public frames, its meaning unknown.
    """
    out = box.outlet
    rated = out.default if out.rated_duty is None else out.rated_duty
    offered = 0 if out.offered_reads_zero else out.ic
    return bytes((box.icmax_byte,)) + words(
        rated, out.default, out.icmax_shown, offered
    )


def currents(box: AblBox) -> tuple[int, int, int]:
    """Return Ict1 to Ict3 in 0.1 A, 0x3E8 where not available."""
    out = box.outlet
    hidden = not out.meter or out.meter_failed or out.state == "A1"
    if hidden or (out.state == "B2" and box.unreadable_in_b2):
        return (UNREADABLE,) * 3
    one, two, three = (
        max(out.idle_floor, min(METER_LIMIT, round(current * 10)))
        for current in out.phase_currents
    )
    return (three, two, one) if box.l3_first else (one, two, three)


def full(box: AblBox) -> bytes:
    """0x2E: state, inputs, Ic, currents in 0.1 A."""
    out = box.outlet
    word = out.ev_connected << 15 | out.reduced << 14
    word |= out.en2 << 13 | out.en1 << 12 | out.ic
    return bytes((state_byte(out.state),)) + words(word, *currents(box))


def short(box: AblBox) -> bytes:
    """0x33: state, currents in A."""
    amps = [SHORT_UNREADABLE if c == UNREADABLE else c // 10 for c in currents(box)]
    return bytes((box.outlet.ev_connected << 7, state_byte(box.state), *amps))


def serial(box: AblBox) -> bytes:
    """0x50: the serial number, 14 characters after a zero."""
    text = box.serial.encode("ascii")[:SERIAL_CHARS]
    return b"\x00" + text.ljust(SERIAL_CHARS, b"\x00")


# First register -> (number of registers, content after the register number).
BLOCKS: dict[int, tuple[int, Callable[[AblBox], bytes]]] = {
    0x01: (2, identity),
    0x03: (1, modbus_settings),
    0x06: (2, flags),
    0x2E: (5, full),
    0x33: (3, short),
    0x50: (8, serial),
}
# Not in the manual; seen in the field. 0x0F: exactly five registers.
ICMAX_BLOCK: dict[int, tuple[int, Callable[[AblBox], bytes]]] = {0x0F: (5, icmax)}
EXTRA_BLOCKS: dict[int, tuple[int, Callable[[AblBox], bytes]]] = {
    0x04: (1, short_state)
}
BROADCAST_READS = frozenset({0x01})
