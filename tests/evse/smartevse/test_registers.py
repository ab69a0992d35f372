"""Registers of a SmartEVSE: bytes of the recorded firmware, and random ones."""

import asyncio
from dataclasses import replace

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import (
    ExchangeRefusedError,
    ImplausibleReplyError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.modbus import (
    READ_INPUT_REGISTERS,
    ModbusFrame,
    RtuFramer,
    rtu_frame,
)
from custom_components.evse_bus.evse.model import (
    CurrentLimit,
    Fault,
    Limits,
    Mode,
    Orders,
    Setting,
    Status as OcppStatus,
)
from custom_components.evse_bus.evse.registers import Block
from custom_components.evse_bus.evse.safety import clamp
from custom_components.evse_bus.evse.smartevse.dialects import (
    MAPS,
    PROBE_A0,
    PROBE_A9,
    PROBE_HEAD,
    PROBE_V3_OLD,
    Dialect,
    Status,
)
from custom_components.evse_bus.evse.smartevse.probing import find_dialect
from custom_components.evse_bus.evse.smartevse.registers import (
    MalformedRefusalError,
    decode_configuration,
    decode_status,
    read_answer,
    read_request,
    write_access,
    write_answer,
    write_current,
    write_mode,
    write_setting,
)
from custom_components.evse_bus.evse.smartevse.states import (
    faults_of,
    is_stopped,
    ocpp_status,
    offered,
    shows_plug,
    state_of,
)

from .polled_scene import ALL, HEAD, LATER, V2_17, V2_20, V2_30

each = pytest.mark.parametrize("dialect", ALL)
LIMITS = Limits(installation=80.0)


def setpoint(current: float):  # type: ignore[no-untyped-def] # noqa: ANN201
    return clamp(Orders(limit=CurrentLimit(current=current)), LIMITS)


def frame(text: str) -> ModbusFrame:
    (found,) = RtuFramer().feed(bytes.fromhex(text))
    return found


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "big") for value in values)


def later(state: int = 2, *, serial: int = 4711, kelvin: int = 293) -> bytes:
    return words(state, 0, 100, 1, 0, 1, 0, 16, 0, 0, kelvin, serial)


def test_requests_as_recorded() -> None:
    assert read_request(0, PROBE_A0).hex() == "000400a0000931ff"
    assert read_request(1, PROBE_A0).hex() == "010400a00009302e"
    assert (
        read_request(0, Block(0xC0, 9, READ_INPUT_REGISTERS)).hex()
        == "000400c0000931e1"
    )
    written = write_current(0, V2_17, setpoint(14.0))
    assert written.hex() == "001000a6000102008cb2a3"
    assert write_access(0, V2_17, allowed=False).hex() == "001000a70001020000b2d7"
    assert write_access(0, V2_17, allowed=True).hex() == "001000a700010200017317"
    assert write_access(2, V2_17, allowed=False).hex() == "021000a70001020000abb7"


def test_status_as_recorded() -> None:
    data = read_answer(0, PROBE_A0)(
        frame("0004120043000000100006000000000082000100009f06")
    )
    assert data is not None
    assert decode_status(V2_17, data) == Status(
        raw_state="C",
        error=0,
        current=13.0,
        access=True,
        mode=Mode.NORMAL,
        maximum=16,
        minimum=6,
    )


def test_no_communication_as_recorded() -> None:
    data = read_answer(2, PROBE_A0)(
        frame("0204120041000200100006000000000050000100002797")
    )
    assert data is not None
    status = decode_status(V2_17, data)
    assert faults_of(V2_17, status) == {Fault.NO_COMM}
    assert ocpp_status(V2_17, status) is OcppStatus.FAULTED
    assert not shows_plug(status)


def test_configuration_as_recorded() -> None:
    """The defaults: minimum 6 A, circuit 16 A, maximum 13 A, mains 25 A."""
    blocks = MAPS[V2_17].configuration
    first = bytes.fromhex("000000000006001000000004000000000000")
    second = bytes.fromhex("000d00000019")
    configuration = decode_configuration(
        V2_17, dict(zip(blocks, (first, second), strict=True))
    )
    assert configuration.settings == {
        Setting.MINIMUM_CURRENT: 6,
        Setting.MAXIMUM_CURRENT: 13,
        Setting.MAINS_CURRENT: 25,
    }
    assert configuration.load_balancing == 0


def test_the_malformed_exceptions() -> None:
    with pytest.raises(ExchangeRefusedError) as refused:
        read_answer(0, Block(0xB0, 1, READ_INPUT_REGISTERS))(frame("000402f2c1"))
    assert refused.value.code == 2
    accept = write_answer(0, 0xA6)
    # A refusal that is obeyed all the same: unknown until it is read back.
    assert accept(frame("0010033c01")) is False
    assert accept(frame("001000a70001b1fb")) is None
    assert write_answer(0, 0xA7)(frame("001000a70001b1fb")) is True
    assert write_answer(0, 0xA7)(frame("021000a70001b019")) is None
    with pytest.raises(ExchangeRefusedError):
        accept(frame(rtu_frame(0, b"\x10\x02").hex()))
    with pytest.raises(ExchangeRefusedError):
        read_answer(1, PROBE_A9)(frame(rtu_frame(1, b"\x83\x02").hex()))


def test_0_a_is_never_written() -> None:
    paused = clamp(Orders(limit=CurrentLimit(current=0)), LIMITS)
    for dialect in ALL:
        with pytest.raises(RefusedOrderError):
            write_current(0, dialect, paused)


def test_an_impossible_address_is_refused() -> None:
    for unit in (-1, 9, 255):
        with pytest.raises(RefusedOrderError):
            write_access(unit, V2_17, allowed=True)


def test_mode_and_settings() -> None:
    assert write_mode(1, HEAD, Mode.SOLAR)[2:9] == bytes.fromhex("00030001020002")
    written = write_setting(1, HEAD, Setting.SOLAR_START_CURRENT, 4)
    assert written[2:9] == bytes.fromhex("0205000102000c")
    for value in (-17, 17):
        with pytest.raises(RefusedOrderError):
            write_setting(1, HEAD, Setting.SOLAR_START_CURRENT, value)


# -- Random bytes --------------------------------------------------------------------


@each
@given(data=st.binary(max_size=40))
def test_any_bytes_are_a_status_or_implausible(dialect: Dialect, data: bytes) -> None:
    try:
        status = decode_status(dialect, data)
    except ImplausibleReplyError:
        return
    state_of(dialect, status.raw_state)
    ocpp_status(dialect, status)
    current = offered(dialect, status)
    assert current is None or current == 0 or 6 <= current <= 80
    if is_stopped(dialect, status):
        assert status.access is False
        assert status.raw_state not in {"C", "D"}


_word = st.one_of(st.integers(0, 12), st.integers(0x41, 0x54), st.integers(0, 0xFFFF))


@each
@given(values=st.lists(_word, min_size=9, max_size=9), more=st.lists(_word, max_size=3))
def test_nearly_a_status(dialect: Dialect, values: list[int], more: list[int]) -> None:
    table = MAPS[dialect].status
    registers = (values + more + [0] * 3)[: table.block.words]

    def word(name: str) -> int:
        return registers[table.words[name].register - table.block.register]

    try:
        status = decode_status(dialect, words(*registers))
    except ImplausibleReplyError:
        return
    assert status.raw_state == table.words["raw_state"].kind.value(registers[0])
    assert status.current == word("current") / 10
    assert status.access is {0: False, 1: True}.get(word("access"))
    assert status.error == word("error")
    assert status.maximum is None or status.maximum == word("maximum") <= 160


@each
@given(data=st.data())
def test_any_settings_are_in_their_range_or_implausible(
    dialect: Dialect, data: st.DataObject
) -> None:
    layout = MAPS[dialect]
    blocks = {
        block: words(
            *data.draw(
                st.lists(
                    st.integers(0, 40) | st.integers(0, 0xFFFF),
                    min_size=block.words,
                    max_size=block.words,
                )
            )
        )
        for block in layout.configuration
    }
    try:
        configuration = decode_configuration(dialect, blocks)
    except ImplausibleReplyError:
        return
    for setting, value in configuration.settings.items():
        word = layout.settings[setting]
        lowest, highest = word.kind.span
        assert lowest <= value <= highest
        # And it is written as it was read.
        assert word.kind.value(word.kind.raw(value)) == value


def test_settings_that_were_not_all_read() -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_configuration(V2_17, {})


@each
@given(current=st.floats(6, 80), unit=st.integers(0, 8), allowed=st.booleans())
def test_a_written_current_is_the_clamped_one(
    dialect: Dialect, current: float, unit: int, *, allowed: bool
) -> None:
    request = write_current(unit, dialect, setpoint(current))
    found = frame(request.hex())
    tenths = int.from_bytes(found.data[-2:], "big")
    assert 60 <= tenths <= 800
    assert tenths / 10 <= current < tenths / 10 + 0.1 + 1e-9
    assert found.unit == unit
    access = frame(write_access(unit, dialect, allowed=allowed).hex())
    assert access.data[-1] == allowed


# -- The dialect ---------------------------------------------------------------------

A0_17 = words(0x41, 0, 0, 6, 0, 0, 0, 1, 0)
A0_20 = words(0, 0, 0, 6, 0, 0, 0, 1, 0)


LATER_STATUS = MAPS[HEAD].status.block
LATER_BOX = MAPS[HEAD].configuration[0]
REFUSED = MalformedRefusalError("exception 2", 2)
STANDARD = ExchangeRefusedError("exception 2", 2)
BOX = words(0, 0, 6, 13, 0)
"""0x0100 x 5 as delivered."""

type Reply = bytes | ExchangeRefusedError


class Replies:
    """A box with these replies, one after the other, and the blocks read from it."""

    def __init__(self, *replies: Reply) -> None:
        self.replies = iter(replies)
        self.blocks: list[Block] = []

    async def read(self, block: Block) -> bytes:
        self.blocks.append(block)
        reply = next(self.replies)
        if isinstance(reply, ExchangeRefusedError):
            raise reply
        return reply


def dialect_of(box: Replies) -> Dialect:
    return asyncio.run(find_dialect(box.read))


def test_a_letter_is_2_17() -> None:
    box = Replies(A0_17)
    assert dialect_of(box) is V2_17
    assert box.blocks == [PROBE_A0]


def test_a_number_alone_is_not_2_20() -> None:
    box = Replies(A0_20, words(0, 0, 0))
    assert dialect_of(box) is V2_20
    assert box.blocks == [PROBE_A0, PROBE_A9]


@pytest.mark.parametrize(
    ("dialect", "refused", "probe", "reply"),
    [
        (V2_30, REFUSED, PROBE_HEAD, REFUSED),
        (HEAD, REFUSED, PROBE_HEAD, words(9)),
        (Dialect.V3, STANDARD, PROBE_V3_OLD, STANDARD),
        (Dialect.V3_OLD, STANDARD, PROBE_V3_OLD, words(0)),
    ],
)
def test_without_a0_it_is_a_later_one(
    dialect: Dialect, refused: Reply, probe: Block, reply: Reply
) -> None:
    box = Replies(refused, reply, later(), BOX)
    assert dialect_of(box) is dialect
    assert box.blocks == [PROBE_A0, probe, LATER_STATUS, LATER_BOX]


@pytest.mark.parametrize("code", [1, 3, 4, None])
def test_another_refusal_is_no_smartevse(code: int | None) -> None:
    with pytest.raises(ImplausibleReplyError):
        dialect_of(Replies(ExchangeRefusedError("exception", code)))


def test_a_number_without_a9_is_no_known_dialect() -> None:
    with pytest.raises(ImplausibleReplyError):
        dialect_of(Replies(A0_20, REFUSED))


def test_a_meter_is_no_smartevse() -> None:
    """Twelve words of floating point numbers at unit 1."""
    floats = words(0x4366, 0x1999, 0x4365, 0x8000, *([0x4100] * 8))
    with pytest.raises(ImplausibleReplyError):
        dialect_of(Replies(STANDARD, STANDARD, floats, BOX))
    with pytest.raises(ImplausibleReplyError):
        # Or zeros everywhere.
        dialect_of(Replies(STANDARD, words(0), bytes(24), bytes(10)))


@given(
    st.lists(
        st.one_of(
            st.none(),
            st.integers(0, 255),
            st.binary(max_size=30),
            st.sampled_from((A0_17, A0_20, words(0, 0, 0), later(), BOX)),
        ),
        min_size=4,
        max_size=4,
    )
)
def test_a_dialect_is_found_only_by_its_own_registers(
    replies: list[int | bytes | None],
) -> None:
    box = Replies(
        *(
            reply
            if isinstance(reply, bytes)
            else ExchangeRefusedError("exception", reply)
            for reply in replies
        )
    )
    try:
        dialect = dialect_of(box)
    except ImplausibleReplyError:
        return
    assert (PROBE_A9 in box.blocks) == (dialect is V2_20)
    assert (LATER_STATUS in box.blocks) == (dialect in LATER)


# -- States --------------------------------------------------------------------------


def test_a_without_access_is_not_unplugged() -> None:
    status = decode_status(V2_17, words(0x41, 0, 16, 6, 0, 0, 130, 0, 0))
    assert not shows_plug(status)
    assert ocpp_status(V2_17, status) is OcppStatus.OUT_OF_SERVICE
    assert is_stopped(V2_17, status)
    assert offered(V2_17, status) == 0
    assert shows_plug(replace(status, access=True))


def test_later_states() -> None:
    stopping = decode_status(HEAD, later(10))
    assert stopping.raw_state == "C1"
    assert state_of(HEAD, "C1").charging is None
    waiting = replace(stopping, raw_state="B1", access=False)
    assert is_stopped(HEAD, waiting)
    assert ocpp_status(HEAD, waiting) is OcppStatus.SUSPENDED_EVSE
    assert shows_plug(waiting)
    assert stopping.serial == "4711"
    assert stopping.temperature == 20


@pytest.mark.parametrize(
    ("dialect", "access"),
    [(V2_30, None), (HEAD, None), (Dialect.V3_OLD, False), (Dialect.V3, False)],
)
def test_access_2_is_a_pause_in_3x(dialect: Dialect, access: bool | None) -> None:  # noqa: FBT001
    """The others never report it; a 3.x waits for a new 1."""
    data = words(9, 0, 0, 0, 0, 2, 0, 16, 0, 0, 293, 1)
    assert decode_status(dialect, data).access is access
    polled = MAPS[dialect].balancing.status
    assert decode_status(dialect, data[:16], polled).access is access


def test_the_error_bit_that_means_two_things_in_3x_is_no_fault() -> None:
    """32: no sun in older ones, a test of its residual current monitor in newer ones."""
    status = decode_status(HEAD, words(0, 1 | 32, 100, 1, 0, 1, 0, 16, 0, 0, 293, 1))
    assert faults_of(HEAD, status) == {Fault.LESS_6A, Fault.NO_SUN}
    for dialect in (Dialect.V3, Dialect.V3_OLD):
        assert faults_of(dialect, status) == {Fault.LESS_6A}


@pytest.mark.parametrize("number", [11, 12, 13, 14, 15, 200])
def test_a_state_without_a_name_hides_nothing(number: int) -> None:
    """A modem's, or one of newer firmware: it may offer its current."""
    status = decode_status(Dialect.V3, later(number))
    assert status.raw_state == str(number)
    assert offered(Dialect.V3, status) == 10
    assert ocpp_status(Dialect.V3, status) is None
    state = state_of(Dialect.V3, status.raw_state)
    assert (state.plugged, state.charging) == (None, None)


def test_an_impossible_temperature_is_none() -> None:
    assert decode_status(HEAD, later(kelvin=0)).temperature is None
    assert decode_status(HEAD, later(serial=0)).serial is None


def test_a_current_out_of_range_is_6_a() -> None:
    """A broadcast of 0 to a charging slave: the contactor stays closed."""
    status = decode_status(V2_17, words(0x43, 0, 16, 6, 0, 0, 0, 1, 0))
    assert offered(V2_17, status) == 6
