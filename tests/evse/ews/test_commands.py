"""Commands, byte by byte, and those that are refused."""

from datetime import UTC, datetime

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews.wire.commands import (
    LED_OFF,
    LED_ON,
    LED_UNCHANGED,
    READS,
    Led,
    PortLeds,
    ReaderTarget,
    activate_firmware,
    blinking,
    card_reader,
    erase_rom,
    read,
    reset,
    set_clock,
    set_leds,
    set_limit,
    set_meter,
    start_stop,
    write_rom,
)
from custom_components.evse_bus.evse.ews.wire.frames import (
    LONGEST_FRAME,
    Bcc,
    CommandId,
    Request,
)
from custom_components.evse_bus.evse.ews.wire.states import StartStop
from custom_components.evse_bus.evse.ews.wire.status import decode_ports
from custom_components.evse_bus.evse.model import CurrentLimit, Limits, Orders
from custom_components.evse_bus.evse.safety import Setpoint, clamp

from .wire import PORTS, message

CHARGING, IDLE = decode_ports(PORTS)
WAITING = decode_ports(b"\x30" + PORTS[1:])[0]


def on_wire(request: Request) -> bytes:
    """Return the parameters, both readings checked."""
    wire = request.encode(Bcc.ALL)
    params = wire[4:-1]
    assert wire == message("C", params)
    assert request.encode(Bcc.WITHOUT_MESSAGE_ID) == message(
        "C", params, counts_id=False
    )
    return params


def setpoint(current: float) -> Setpoint:
    return Setpoint(
        currents=(current, current, current),
        fail_safe=(0.0, 0.0, 0.0),
        fail_safe_timeout=1,
    )


# -- Reading -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["id", "rc", "rd", "rf", "rg", "ri", "rp", "rs", "ru", "rz"]
)
def test_reads_have_no_parameters(name: str) -> None:
    assert on_wire(read(CommandId(name))) == name.encode()


@pytest.mark.parametrize("command", sorted(set(CommandId) - READS))
def test_a_command_that_writes_is_no_read(command: CommandId) -> None:
    with pytest.raises(RefusedOrderError):
        read(command)


def test_zz() -> None:
    # 00^02^43^7a^7a = 41.
    assert reset().encode(Bcc.ALL) == bytes.fromhex("02 0002 43 7a7a 41")


# -- sl ------------------------------------------------------------------------------


def test_sl() -> None:
    # 00^04^43^73^6c^01^06 = 5f.
    request = start_stop(1, StartStop.PAUSE, CHARGING)
    assert request.encode(Bcc.ALL) == bytes.fromhex("02 0004 43 736c 01 06 5f")
    assert on_wire(start_stop(2, StartStop.START, WAITING)) == b"sl\x02\x03"
    assert on_wire(start_stop(1, StartStop.STOP, IDLE)) == b"sl\x01\x01"


def test_sl_only_in_its_states() -> None:
    with pytest.raises(NotAvailableError):
        start_stop(1, StartStop.PAUSE, WAITING)
    with pytest.raises(NotAvailableError):
        start_stop(1, StartStop.START, CHARGING)
    ended = decode_ports(b"\x50" + PORTS[1:])[0]
    with pytest.raises(NotAvailableError):
        start_stop(1, StartStop.START, ended)
    resumed = start_stop(1, StartStop.START, ended, paused=True)
    assert on_wire(resumed) == b"sl\x01\x03"


# -- st ------------------------------------------------------------------------------


def test_st_in_whole_amperes() -> None:
    for current in range(6, 81):
        for port in (1, 2):
            wire = on_wire(set_limit(port, setpoint(float(current))))
            assert wire == b"st" + bytes((port, current))


@pytest.mark.parametrize(
    "current", [0.0, -1.0, 1.0, 5.0, 5.9, 6.5, 15.999, 81.0, 255.0, 256.0, 262.0]
)
def test_st_that_is_no_limit(current: float) -> None:
    with pytest.raises(RefusedOrderError):
        set_limit(1, setpoint(current))


def test_a_pause_is_no_limit() -> None:
    with pytest.raises(RefusedOrderError, match="switch the limit off"):
        set_limit(1, setpoint(0.0))


@pytest.mark.parametrize("current", [float("nan"), float("inf"), float("-inf")])
def test_st_that_is_no_number(current: float) -> None:
    with pytest.raises(RefusedOrderError):
        set_limit(1, setpoint(current))


def test_a_phase_without_current_is_no_limit_of_the_others() -> None:
    one = Setpoint(
        currents=(16.0, 16.0, 0.0), fail_safe=(0.0, 0.0, 0.0), fail_safe_timeout=1
    )
    with pytest.raises(RefusedOrderError):
        set_limit(1, one)


amperes = st.floats(0, 300, allow_nan=False)


@given(
    st.sampled_from([None, True, False]),
    amperes,
    st.tuples(*3 * [st.none() | amperes]),
    st.floats(0, 90),
)
def test_no_order_switches_the_limit_off_or_exceeds_it(
    allowed: bool | None,  # noqa: FBT001
    current: float,
    phases: tuple[float | None, float | None, float | None],
    ceiling: float,
) -> None:
    orders = Orders(limit=CurrentLimit(current=current, phases=phases), allowed=allowed)
    wish = clamp(orders, Limits(installation=ceiling, step=1.0))
    try:
        wire = on_wire(set_limit(1, wish))
    except RefusedOrderError:
        assert wish.current == 0 or wish.current > 80
        return
    assert allowed is not False
    assert 6 <= wire[3] <= min(80, ceiling, *orders.limit.effective())


# -- Ports ---------------------------------------------------------------------------


@pytest.mark.parametrize("port", [-1, 0, 3, 255, 256, True, 1.0])
def test_a_port_that_there_is_not(port: int) -> None:
    with pytest.raises(RefusedOrderError):
        set_meter(port, 1)
    with pytest.raises(RefusedOrderError):
        set_limit(port, setpoint(16.0))
    with pytest.raises(RefusedOrderError):
        start_stop(port, StartStop.STOP, CHARGING)


# -- cr, sc --------------------------------------------------------------------------


def test_cr() -> None:
    assert on_wire(set_meter(2, 12345678)) == b"cr\x02\x00\xbc\x61\x4e"
    assert on_wire(set_meter(1, 0)) == b"cr\x01\0\0\0\0"
    for total in (-1, 1 << 32):
        with pytest.raises(RefusedOrderError):
            set_meter(1, total)


def test_sc() -> None:
    clock = datetime.fromisoformat("2026-11-22T05:06:07.9")
    assert on_wire(set_clock(clock)) == b"sc\x07\xea\x0b\x16\x05\x06\x07"
    for wrong in (clock.replace(tzinfo=UTC), clock.replace(year=1999)):
        with pytest.raises(RefusedOrderError):
            set_clock(wrong)


# -- se ------------------------------------------------------------------------------


def test_se() -> None:
    request = set_leds(
        PortLeds(red=LED_OFF, green=LED_ON, orange=blinking(500, 250, 100)),
        PortLeds(spare=Led(on=1, off=2, offset=3)),
    )
    unchanged = "ffff ffff 0000"
    assert on_wire(request) == b"se" + bytes.fromhex(
        f"0000 0000 0000  ffff 0000 0000  01f4 00fa 0064  {unchanged}"
        f"{unchanged} {unchanged} {unchanged} 0001 0002 0003"
    )
    assert Led(on=0xFFFF, off=0xFFFF) == LED_UNCHANGED


@pytest.mark.parametrize(
    ("on", "off"), [(0, 1), (1, 0), (0xFFFF, 1), (-1, 1), (1, 0x10000)]
)
def test_times_that_do_not_blink(on: int, off: int) -> None:
    with pytest.raises(RefusedOrderError):
        blinking(on, off)


def test_times_of_leds_that_do_not_fit() -> None:
    for led in (Led(on=-1, off=0), Led(on=1, off=0x10000), Led(on=1, off=1, offset=-1)):
        with pytest.raises(RefusedOrderError):
            set_leds(PortLeds(red=led), PortLeds())


# -- mc ------------------------------------------------------------------------------


def test_mc_as_the_manual_has_it() -> None:
    """Mc, 1, 1, id: ask the reader for its id."""
    request = card_reader(ReaderTarget.READER, 1, b"id")
    assert on_wire(request) == b"mc\x01\x01id"
    assert on_wire(card_reader(ReaderTarget.CARD, 255, b"")) == b"mc\x02\xff"


def test_mc_that_does_not_fit() -> None:
    longest = card_reader(ReaderTarget.CARD, 0, bytes(1036))
    assert len(longest.encode(Bcc.ALL)) == LONGEST_FRAME
    with pytest.raises(RefusedOrderError):
        card_reader(ReaderTarget.CARD, 0, bytes(1037))
    for timeout in (-1, 256):
        with pytest.raises(RefusedOrderError):
            card_reader(ReaderTarget.CARD, timeout, b"")
    for target in (0, 3, 256):
        with pytest.raises(RefusedOrderError):
            card_reader(target, 1, b"")  # type: ignore[arg-type]


# -- oe, ow, fw ----------------------------------------------------------------------


def test_oe() -> None:
    assert on_wire(erase_rom(0x10000, 0x8000)) == b"oe\0\1\0\0\0\0\x80\0"
    for start, count in ((-1, 1), (1 << 32, 1), (0, 1 << 32), (0, -1)):
        with pytest.raises(RefusedOrderError):
            erase_rom(start, count)


@given(st.integers(0, 0xFFFFFFFF), st.binary(min_size=1, max_size=1024))
def test_ow(start: int, data: bytes) -> None:
    params = on_wire(write_rom(start, data))
    assert params == b"ow" + start.to_bytes(4) + len(data).to_bytes(4) + data


def test_ow_that_does_not_fit() -> None:
    for start, size in ((0, 0), (0, 1025), (-1, 1), (1 << 32, 1)):
        with pytest.raises(RefusedOrderError):
            write_rom(start, bytes(size))


def test_fw() -> None:
    assert on_wire(activate_firmware()) == b"fw"
