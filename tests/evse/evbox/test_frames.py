"""Byte vectors of the manual, of PROTOCOLS.md and of a real box."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import GarbledReplyError
from custom_components.evse_bus.evse.evbox.frames import (
    LONGEST_FRAME,
    LONGEST_REQUEST,
    EvboxFrame,
    EvboxFramer,
    ModuleReply,
    Reply,
    checksums,
    decode_reply,
    encode_68,
    encode_69,
    frame,
)
from custom_components.evse_bus.evse.model import CurrentLimit, Limits, Orders
from custom_components.evse_bus.evse.safety import Setpoint, clamp
from tests.virtual import evbox_frames as oracle

ORDER = "00E6008C0154003C002800500046"
REQUEST_69 = b"\x0280A069" + ORDER.encode() + b"F703\x03"
INFORMATION = bytes.fromhex("00112233445566778899AABBCCDDEEFF")
MODULE_1 = "0078008C008C008C021C0140038400014C1D"
MODULE_2 = "00500000000000A00085FFBFFF32000B823C"
REPLY_69 = "A080690014015E02" + MODULE_1 + MODULE_2
REPLY_68 = (
    "A08068019230540014015E02"
    f"{MODULE_1}00E600E500E7{MODULE_2.replace('FF32', 'FF52')}00E300E400E2"
)
FIELD_69 = (
    "A080690001015E02007800000000000003E803E803E800000028"
    "007800000000000003E803E803E80000001EC47A"
)


def manual_setpoint(third: float = 34.0) -> Setpoint:
    """Return the manual's example: 23, 14 and 34 A, 60 s, then 4, 8 and 7 A."""
    orders = Orders(
        limit=CurrentLimit(current=40.0, phases=(23.0, 14.0, third)),
        fail_safe=CurrentLimit(current=40.0, phases=(4.0, 8.0, 7.0)),
        fail_safe_timeout=60,
    )
    return clamp(orders, Limits(installation=40.0))


def received(text: str) -> EvboxFrame:
    return EvboxFrame(frame(text), text)


def feed(*chunks: bytes) -> tuple[list[EvboxFrame], EvboxFramer]:
    framer = EvboxFramer()
    return [one for chunk in chunks for one in framer.feed(chunk)], framer


def decode(wire: bytes) -> Reply:
    frames, framer = feed(wire)
    assert (framer.bad, framer.noise, framer.pending) == (0, 0, 0)
    (one,) = frames
    assert one.raw == wire
    reply = decode_reply(one)
    assert reply is not None
    return reply


# -- Requests ------------------------------------------------------------------------


def test_command_69_as_the_manual_prints_it() -> None:
    assert encode_69(manual_setpoint()) == REQUEST_69
    assert len(REQUEST_69) == LONGEST_REQUEST[69] == 40


@pytest.mark.parametrize(
    ("third", "word", "sums"), [(34.0, "0154", "D20A"), (32.0, "0140", "CD0F")]
)
def test_command_68_with_computed_checksums(third: float, word: str, sums: str) -> None:
    request = encode_68(manual_setpoint(third), serial=1923054, information=INFORMATION)
    order = ORDER.replace("0154", word)
    text = f"80A06801923054{INFORMATION.hex().upper()}{order}{sums}"
    assert request == b"\x02" + text.encode() + b"\x03"
    assert len(request) == LONGEST_REQUEST[68] == 80


@pytest.mark.parametrize("serial", [-1, 100_000_000])
def test_a_serial_number_that_does_not_fit_eight_digits(serial: int) -> None:
    with pytest.raises(ValueError, match="8 digits"):
        encode_68(manual_setpoint(), serial=serial, information=INFORMATION)


@pytest.mark.parametrize("length", [0, 15, 17])
def test_an_information_module_of_another_length(length: int) -> None:
    with pytest.raises(ValueError, match="16"):
        encode_68(manual_setpoint(), information=bytes(length))


def test_a_value_that_does_not_fit_is_refused_not_wrapped() -> None:
    for setpoint in (
        Setpoint(currents=(6553.6, 0, 0), fail_safe=(0, 0, 0), fail_safe_timeout=1),
        Setpoint(currents=(-0.1, 0, 0), fail_safe=(0, 0, 0), fail_safe_timeout=1),
        Setpoint(currents=(0, 0, 0), fail_safe=(0, 0, 0), fail_safe_timeout=0x10000),
        Setpoint(currents=(0, 0, 0), fail_safe=(0, 0, 0), fail_safe_timeout=0),
    ):
        with pytest.raises(ValueError, match=r"fit|not allowed"):
            encode_69(setpoint)


amperes = st.floats(0, 700, allow_nan=False)


@given(
    ordered=st.tuples(amperes, amperes, amperes),
    fail_safe=st.tuples(amperes, amperes, amperes),
    ceiling=st.floats(6, 700),
    timeout=st.integers(1, 0xFFFF),
    serial=st.integers(0, 99_999_999),
    information=st.binary(min_size=16, max_size=16),
)
def test_a_chargepoint_decodes_the_encoded_values(
    *,
    ordered: tuple[float, float, float],
    fail_safe: tuple[float, float, float],
    ceiling: float,
    timeout: int,
    serial: int,
    information: bytes,
) -> None:
    orders = Orders(
        limit=CurrentLimit(current=1000.0, phases=ordered),
        fail_safe=CurrentLimit(current=1000.0, phases=fail_safe),
        fail_safe_timeout=timeout,
    )
    setpoint = clamp(orders, Limits(installation=ceiling))
    for request in (
        encode_69(setpoint),
        encode_68(setpoint, serial=serial, information=information),
    ):
        body = oracle.checked(request[1:-1].decode())
        assert body is not None
        order = oracle.order(body, 0.0)
        assert order is not None
        assert order.limits == pytest.approx(setpoint.currents)
        assert order.fallback == pytest.approx(setpoint.fail_safe)
        assert order.timeout == timeout
        # For the fuse: not a tenth more than ordered or allowed.
        for sent, most in zip(order.limits, ordered, strict=True):
            assert sent <= min(most, ceiling)
        for sent, most in zip(order.fallback, fail_safe, strict=True):
            assert sent <= min(most, ceiling)
        if order.command == 68:
            assert order.serial == f"{serial:08d}"
            assert order.information == information


# -- Replies -------------------------------------------------------------------------


def test_the_reply_69_of_a_real_box() -> None:
    module = ModuleReply(
        minimum_current=12.0,
        currents=(0.0, 0.0, 0.0),
        cos_phi=(1.0, 1.0, 1.0),
        energy=40,
    )
    other = ModuleReply(
        minimum_current=12.0,
        currents=(0.0, 0.0, 0.0),
        cos_phi=(1.0, 1.0, 1.0),
        energy=30,
    )
    assert decode(b"\x02" + FIELD_69.encode() + b"\x03") == Reply(
        command=69,
        minimum_interval=1,
        maximum_current=35.0,
        modules=(module, other),
    )


def test_the_reply_69_of_the_manual_with_right_checksums() -> None:
    reply = decode(frame(REPLY_69))
    assert (reply.serial, reply.minimum_interval, reply.maximum_current) == (
        None,
        20,
        35.0,
    )
    assert reply.modules == (
        ModuleReply(
            minimum_current=12.0,
            currents=(14.0, 14.0, 14.0),
            cos_phi=(0.540, 0.320, 0.900),
            energy=85021,
        ),
        ModuleReply(
            minimum_current=8.0,
            currents=(0.0, 0.0, 16.0),
            cos_phi=(0.133, -0.065, -0.206),
            energy=754236,
        ),
    )


def test_the_reply_68_of_the_manual_with_right_checksums() -> None:
    reply = decode(frame(REPLY_68))
    assert (reply.command, reply.serial) == (68, "01923054")
    assert reply.modules[0].voltages == (230, 229, 231)
    assert reply.modules[1].voltages == (227, 228, 226)
    # FF52 as printed is -0.174; the text's -0.206 would be FF32.
    assert reply.modules[1].cos_phi == (0.133, -0.065, -0.174)
    # The printed 0C70 belongs to the same reply with one '4' less (PROTOCOLS.md).
    assert checksums(REPLY_68.replace("00E300E400E2", "00E300E300E2")) == "0C70"


@pytest.mark.parametrize(
    "printed",
    [
        # The request 68 lacks a digit and carries 69's checksum.
        "80A06801923054"
        + INFORMATION.hex().upper()
        + "00E6008C014003C002800500046F703",
        REPLY_68 + "0C70",
        REPLY_69.replace("FF32", "FF52") + "FB05",
        REPLY_69 + "FB05",
        # As in the text: digits are missing in the second module.
        REPLY_69.replace("0000000000A00085FFBFFF32", "000000000A00085FFBFF52") + "FB05",
    ],
)
def test_damaged_examples_of_the_manual_are_refused(printed: str) -> None:
    frames, framer = feed(b"\x02" + printed.encode() + b"\x03")
    assert frames == []
    assert framer.bad == 1


def test_no_modules_and_twenty_modules() -> None:
    none = decode(frame("A080690001015E00"))
    assert none.modules == ()
    wire = frame(f"A08068{1923054:08d}0014015E14" + 20 * (MODULE_1 + "00E600E500E7"))
    assert len(wire) == LONGEST_FRAME == 990
    assert len(decode(wire).modules) == 20
    assert len(frame("A080690014015E14" + 20 * MODULE_1)) == 742


@pytest.mark.parametrize(
    "text",
    [
        "A080690001015E01",
        "A080690001015E00" + MODULE_1,
        "A080690001015E15" + 21 * MODULE_1,
        "A080680001015E00",
        "A08069",
        "A080690001015E0G",
        "A080690001015e00",
    ],
)
def test_a_reply_of_another_length_is_bad_despite_good_checksums(text: str) -> None:
    frames, framer = feed(frame(text))
    assert frames == []
    assert framer.bad == 1
    with pytest.raises(GarbledReplyError):
        decode_reply(received(text))


@pytest.mark.parametrize("text", ["80A069" + ORDER, "BCA001", "A0806A", "80B1420K1"])
def test_other_frames_are_good_but_no_replies(text: str) -> None:
    frames, framer = feed(frame(text))
    assert [one.text for one in frames] == [text]
    assert framer.bad == framer.noise == 0
    assert decode_reply(frames[0]) is None


words = st.integers(0, 0xFFFF)
modules = st.lists(
    st.tuples(
        words, words, words, words, words, words, words, st.integers(0, 0xFFFFFFFF)
    ),
    max_size=20,
)


def signed(word: int) -> float:
    return (word - 0x10000 if word >= 0x8000 else word) / 1000


@given(interval=words, maximum=words, content=modules, volts=words, long=st.booleans())
def test_a_reply_decodes_to_the_values_of_the_chargepoint(
    *,
    interval: int,
    maximum: int,
    content: list[tuple[int, ...]],
    volts: int,
    long: bool,
) -> None:
    head = "A0806800001234" if long else "A08069"
    parts = [head, f"{interval:04X}{maximum:04X}{len(content):02X}"]
    for values in content:
        parts += [*(f"{word:04X}" for word in values[:7]), f"{values[7]:08X}"]
        parts += 3 * [f"{volts:04X}"] if long else []
    reply = decode(oracle.frame("".join(parts)))
    assert reply.serial == ("00001234" if long else None)
    assert reply.minimum_interval == interval
    assert reply.maximum_current == maximum / 10
    assert [
        (
            module.minimum_current,
            module.currents,
            module.cos_phi,
            module.energy,
            module.voltages,
        )
        for module in reply.modules
    ] == [
        (
            one[0] / 10,
            tuple(word / 10 for word in one[1:4]),
            tuple(map(signed, one[4:7])),
            one[7],
            (volts, volts, volts) if long else None,
        )
        for one in content
    ]
