"""Registers: frames of the manual, frames of real boxes, and random bytes."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.abl.registers import (
    FLAGS,
    ICMAX,
    INFO,
    LONGEST_REPLY,
    LONGEST_REQUEST,
    READING,
    SERIAL,
    Reading,
    StateCode,
    limit_duty,
    read_answer,
    read_request,
    write_answer,
    write_configuration,
    write_limit,
    write_state,
)
from custom_components.evse_bus.evse.errors import (
    ExchangeRefusedError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.modbus import AsciiFramer, ModbusFrame
from custom_components.evse_bus.evse.model import CurrentLimit, Limits, Orders
from custom_components.evse_bus.evse.registers import Block
from custom_components.evse_bus.evse.safety import Setpoint, clamp

MODBUS_SETTINGS = Block(0x0003, 1)
SHORT_READING = Block(0x0033, 3)
STATE = Block(0x0004, 1)


def setpoint(current: float) -> Setpoint:
    orders = Orders(limit=CurrentLimit(current=current))
    return clamp(orders, Limits(installation=80))


def frames(text: str) -> list[ModbusFrame]:
    return AsciiFramer().feed(text.encode() + b"\r\n")


def answer(text: str, address: int, block: Block) -> bytes:
    (frame,) = frames(text)
    data = read_answer(address, block)(frame)
    assert data is not None
    return data


# -- The manual's frames -------------------------------------------------------------


@pytest.mark.parametrize(
    ("block", "request_"),
    [
        (INFO.block, ":010300010002F9"),
        (READING.block, ":0103002E0005C9"),
        (SHORT_READING, ":010300330003C6"),
        (MODBUS_SETTINGS, ":010300030001F8"),
        (SERIAL.block, ":010300500008A4"),
        (Block(0x0014, 5), ":010300140005E3"),
    ],
)
def test_read_requests(block: Block, request_: str) -> None:
    assert read_request(1, block) == request_.encode() + b"\r\n"


def test_write_requests() -> None:
    # 1.3: 10 A is 16.6 %.
    assert write_limit(1, setpoint(10)) == b":0110001400010200A632\r\n"
    assert write_limit(1, setpoint(0)) == b":0110001400010203E8ED\r\n"
    assert write_state(16, StateCode.RESET) == b":101000050001025A5A24\r\n"


@pytest.mark.parametrize(
    ("text", "block"),
    [
        (">01030401011237AD", INFO.block),
        (">0103020327D0", MODBUS_SETTINGS),
        (">010304010F1509CA", INFO.block),
        (">0103063300A1646464F6", SHORT_READING),
        (">01030A140002490AFA020001FF8D", Block(0x0014, 5)),
        (">0103105000325732327879303132333435363722", SERIAL.block),
        # Printed with other checksums; these are the right ones (PROTOCOLS.md, 2).
        (">01030A2EC3810A006400640000AE", READING.block),
        (">0103063380C30A0A006C", SHORT_READING),
        # Real boxes (PROTOCOLS.md, 2).
        (">01030A2EA1106403E803E803E8EE", READING.block),
        (">01030A2EB2910B03E803E803E8B5", READING.block),
        (">01030A2EF4106403E803E803E89B", READING.block),
        (">01030204A155", STATE),
        (">010304014150BEA8", INFO.block),
    ],
)
def test_answers(text: str, block: Block) -> None:
    assert answer(text, 1, block)[0] == block.register
    # Not from another box, not to another request.
    (frame,) = frames(text)
    assert read_answer(2, block)(frame) is None
    assert read_answer(1, Block(block.register + 1, block.words))(frame) is None
    assert read_answer(1, Block(block.register, block.words + 1))(frame) is None


@pytest.mark.parametrize(
    ("printed", "right"),
    [
        (">01030A2EC3810A0064006400001F", "AE"),
        (">0103063380C30A0A00EC", "6C"),
        (">011000130001D8", "DB"),
    ],
)
def test_three_printed_checksums_are_wrong(printed: str, right: str) -> None:
    framer = AsciiFramer()
    assert not framer.feed(printed.encode() + b"\r\n")
    assert framer.bad == 1
    assert len(frames(printed[:-2] + right)) == 1


def test_writes_confirmed_and_refused() -> None:
    (confirmed,) = frames(">011000140001DA")
    assert write_answer(1, 0x14)(confirmed) is True
    assert write_answer(1, 0x05)(confirmed) is None
    assert write_answer(2, 0x14)(confirmed) is None
    (refused,) = frames(">0190046B")
    assert write_answer(2, 0x14)(refused) is None
    with pytest.raises(ExchangeRefusedError, match="exception 4") as caught:
        write_answer(1, 0x14)(refused)
    assert caught.value.code == 4


def test_a_request_is_never_taken_for_an_answer() -> None:
    (echo,) = frames(":011000140001DA")
    assert write_answer(1, 0x14)(echo) is None
    (read,) = frames(":01030A2EC3810A006400640000AE")
    assert read_answer(1, READING.block)(read) is None


# -- Fields --------------------------------------------------------------------------


def test_reading() -> None:
    data = answer(">01030A2EC3810A006400640000AE", 1, READING.block)
    assert READING.decode(data) == Reading(
        state=0xC3,
        plugged=True,
        reduced=False,
        en1=False,
        en2=False,
        duty=0x10A,
        currents=(10.0, 10.0, 0.0),
    )
    data = answer(">01030A2EB2910B03E803E803E8B5", 1, READING.block)
    assert READING.decode(data) == Reading(
        state=0xB2,
        plugged=True,
        reduced=False,
        en1=True,
        en2=False,
        duty=267,
        currents=(None, None, None),
    )


def test_info() -> None:
    info = INFO.decode(answer(">010304014150BEA8", 1, INFO.block))
    assert (info.hardware, info.device_id, info.firmware) == ("pcba 160307", 1, "5.0")
    assert info.coding_resistor
    assert not info.upstream_timeout
    assert info.meter
    assert info.rdc_md
    assert info.socket
    assert info.welding_detection
    assert info.enable_input == "closed_for_enabled"
    # 1.3: V1.2, board 141215, DC monitoring, welding detection, attached cable.
    info = INFO.decode(answer(">01030401011237AD", 1, INFO.block))
    assert (info.hardware, info.firmware) == ("pcba 141215", "1.2")
    assert (info.meter, info.rdc_md, info.socket) == (True, True, False)
    assert info.enable_input == "invalid"


@pytest.mark.parametrize(
    ("bit", "name", "expected"),
    [
        (15, "triggers_f4", True),
        (14, "needs_enable", True),
        (9, "upstream_lost", True),
        (8, "imbalance", True),
        (7, "hot", True),
        (6, "meter_failed", True),
        (5, "e0_a1_disabled", True),
        (4, "b1_b2_disabled", True),
        (3, "a1_b1_disabled", True),
    ],
)
def test_flags(bit: int, name: str, expected: bool) -> None:  # noqa: FBT001
    clear = FLAGS.decode(b"\x06\x42\x00\x00")
    assert (clear.pointer, clear.overcurrent, clear.china) == (0x42, 0, False)
    assert getattr(clear, name) is not expected
    flags = FLAGS.decode(b"\x06\x00" + (1 << bit).to_bytes(2))
    assert getattr(flags, name) is expected
    assert sum(getattr(flags, each) is True for each in type(flags).__slots__) == 1


def test_limits_for_china() -> None:
    assert [
        FLAGS.decode(b"\x06\x00" + (bits << 12).to_bytes(2)).china for bits in range(4)
    ] == [False, False, True, False]


def test_overcurrent() -> None:
    assert [FLAGS.decode(bytes((6, 0, 0, bits))).overcurrent for bits in range(8)] == [
        0,
        100,
        None,
        110,
        None,
        105,
        None,
        120,
    ]


def test_serial() -> None:
    data = answer(">0103105000325732327879303132333435363722", 1, SERIAL.block)
    assert SERIAL.decode(data).number == "2W22xy01234567"
    assert SERIAL.decode(b"\x50\x00SHORT".ljust(16, b"\0")).number == "SHORT"


@pytest.mark.parametrize("text", [bytes(14), b"\xff" * 14, b"2W\x01" + bytes(11)])
def test_no_serial(text: bytes) -> None:
    assert SERIAL.decode(b"\x50\x00" + text).number is None


def test_icmax() -> None:
    assert ICMAX.decode(bytes.fromhex("0FA100000000F10A0000")).duty == 0x10A


# -- Random bytes --------------------------------------------------------------------


@given(st.binary(min_size=9, max_size=9))
def test_any_reading_can_be_decoded(data: bytes) -> None:
    reading = READING.decode(b"\x2e" + data)
    assert reading.state == data[0]
    for current in reading.currents:
        assert current is None or 0 <= current <= 80


@given(st.binary(min_size=3, max_size=3), st.binary(min_size=15, max_size=15))
def test_any_block_can_be_decoded(short: bytes, long: bytes) -> None:
    assert INFO.decode(b"\x01" + short).firmware
    assert FLAGS.decode(b"\x06" + short).pointer == short[0]
    assert 0 <= ICMAX.decode(b"\x0f" + long[:9]).duty <= 0xFFF
    serial = SERIAL.decode(b"\x50" + long).number
    assert serial is None or (serial.isprintable() and len(serial) <= 14)


@given(
    st.integers(0, 255),
    st.booleans(),
    st.integers(0, 0xFFF),
    st.tuples(*[st.one_of(st.none(), st.integers(0, 800))] * 3),
)
def test_a_reading_is_decoded_as_it_was_encoded(
    state: int,
    plugged: bool,  # noqa: FBT001
    duty: int,
    currents: tuple[int | None, ...],
) -> None:
    words = [plugged << 15 | duty, *(0x3E8 if c is None else c for c in currents)]
    data = bytes((0x2E, state)) + b"".join(word.to_bytes(2) for word in words)
    reading = READING.decode(data)
    assert (reading.state, reading.plugged, reading.duty) == (state, plugged, duty)
    assert reading.currents == tuple(None if c is None else c / 10 for c in currents)


@given(st.binary(max_size=60))
def test_any_frame_can_be_offered(content: bytes) -> None:
    frame = ModbusFrame(
        raw=b"",
        is_reply=True,
        unit=1,
        function=content[0] if content else 3,
        data=content[1:],
    )
    for accept in (read_answer(1, READING.block), write_answer(1, 0x14)):
        try:
            accept(frame)
        except ExchangeRefusedError:
            assert frame.function in (0x83, 0x90)


# -- Writes --------------------------------------------------------------------------


@pytest.mark.parametrize("address", [0, 17, 255, -1])
def test_there_are_no_requests_to_invalid_addresses(address: int) -> None:
    for encode in (
        lambda: read_request(address, READING.block),
        lambda: write_limit(address, setpoint(10)),
        lambda: write_state(address, StateCode.E0),
        lambda: write_configuration(address, 1),
        lambda: write_configuration(1, address),
    ):
        with pytest.raises(RefusedOrderError):
            encode()


def test_configuration() -> None:
    def value(**settings: bool) -> str:
        (frame,) = AsciiFramer().feed(write_configuration(1, 2, **settings))
        assert frame.data[:5] == bytes.fromhex("002C000102")
        return frame.data[5:].hex().upper()

    assert value() == "F002"
    assert value(upstream_timeout=True) == "B002"
    assert value(upstream_timeout=False) == "7002"
    assert value(needs_enable=True) == "E002"
    assert value(needs_enable=False) == "D002"


@given(st.floats(0, 200), st.floats(6, 80))
def test_a_limit_is_a_pause_or_within_the_orders(
    ordered: float, ceiling: float
) -> None:
    orders = Orders(limit=CurrentLimit(current=ordered))
    point = clamp(orders, Limits(installation=ceiling))
    duty = limit_duty(point)
    if point.paused:
        assert duty == 1000
    else:
        assert duty * 0.06 <= min(ordered, ceiling) + 1e-9 or duty > 850
        assert 100 <= duty <= 960


def test_one_phase_without_current_pauses_all() -> None:
    limit = CurrentLimit(current=16, phases=(None, 0, None))
    assert limit_duty(clamp(Orders(limit=limit), Limits(installation=16))) == 1000


def test_lengths_that_the_bus_plans_with() -> None:
    assert len(write_limit(1, setpoint(10))) == LONGEST_REQUEST
    longest = ">0103105000325732327879303132333435363722\r\n"
    assert len(longest) == LONGEST_REPLY
    for registers in (INFO, FLAGS, ICMAX, READING, SERIAL):
        assert 1 + 2 * (4 + 2 * registers.block.words) + 2 <= LONGEST_REPLY
