"""The encoders and decoders of the library against the maker's firmware, as recorded.

Every recorded reply is decoded, and every request that the library would make in the
recorded session is the recorded one, byte for byte.
"""

from collections.abc import Iterator
import json
from pathlib import Path
from typing import Any, Final

import pytest

from custom_components.evse_bus.evse.errors import ExchangeRefusedError
from custom_components.evse_bus.evse.modbus import (
    READ_INPUT_REGISTERS,
    RtuFramer,
    write_registers,
)
from custom_components.evse_bus.evse.model import CurrentLimit, Limits, Orders
from custom_components.evse_bus.evse.registers import Block
from custom_components.evse_bus.evse.safety import clamp
from custom_components.evse_bus.evse.smartevse.dialects import PROBE_A0, Dialect
from custom_components.evse_bus.evse.smartevse.registers import (
    decode_configuration,
    decode_status,
    read_answer,
    read_request,
    write_access,
    write_answer,
    write_current,
)

TRACE: Final[dict[str, list[dict[str, Any]]]] = json.loads(
    (Path(__file__).parents[2] / "traces" / "smartevse_v2_17.json").read_text()
)
DIALECT = Dialect.V2_17


def everything() -> Iterator[tuple[str, bytes]]:
    """Yield all recorded bytes, requests and replies, in whole frames."""
    for section, entries in TRACE.items():
        for entry in entries:
            for key in ("request", "reply", "hex", "slave_sent", "master_ack"):
                if entry.get(key):
                    yield section, bytes.fromhex(entry[key])
            lumps = "".join(text for _, text in entry.get("unsolicited", ()))
            if lumps:
                yield section, bytes.fromhex(lumps)


def answers(section: str) -> Iterator[tuple[str, bytes, bytes]]:
    for entry in TRACE[section]:
        if entry.get("request") and entry.get("reply"):
            yield (
                entry["what"],
                bytes.fromhex(entry["request"]),
                bytes.fromhex(entry["reply"]),
            )


@pytest.mark.parametrize("by_bytes", [False, True])
def test_every_byte_belongs_to_a_frame(*, by_bytes: bool) -> None:
    framer = RtuFramer()
    for section, data in everything():
        chunks = [data[i : i + 1] for i in range(len(data))] if by_bytes else [data]
        frames = [frame for chunk in chunks for frame in framer.feed(chunk)]
        assert b"".join(frame.raw for frame in frames) == data, section
    assert (framer.noise, framer.bad, framer.pending) == (0, 0, 0)


@pytest.mark.parametrize("section", TRACE)
def test_every_status_is_decoded(section: str) -> None:
    for entry in TRACE[section]:
        text = entry.get("reply") or entry.get("hex")
        if not text or len(text) != 2 * 23:
            continue
        (frame,) = RtuFramer().feed(bytes.fromhex(text))
        data = read_answer(frame.unit, PROBE_A0)(frame)
        if data is None or entry.get("what", "").startswith("FC04 read C0"):
            continue
        status = decode_status(DIALECT, data)
        assert status.raw_state == chr(data[1])
        assert status.current == int.from_bytes(data[12:14]) / 10


def rebuilt(request: bytes) -> bytes | None:
    """Build a recorded request with the library's own encoders."""
    unit, function = request[:2]
    register = int.from_bytes(request[2:4])
    if function in (3, 4):
        block = Block(register, int.from_bytes(request[4:6]), function)
        return read_request(unit, block)
    if function == 0x10 and request[4:7] == b"\x00\x01\x02":
        value = int.from_bytes(request[7:9])
        if register == 0xA7:
            return write_access(unit, DIALECT, allowed=bool(value))
        if register == 0xA6 and value:
            orders = Orders(limit=CurrentLimit(current=value / 10))
            return write_current(
                unit, DIALECT, clamp(orders, Limits(installation=80.0))
            )
    return None


def test_our_requests_are_the_recorded_ones() -> None:
    same = 0
    for section in ("normal", "master", "slave", "slave_stop_and_resume"):
        for entry in TRACE[section]:
            request = bytes.fromhex(entry.get("request") or "")
            if not request:
                continue
            ours = rebuilt(request)
            if ours is None:
                # The library never sends these: 0x06, and a current of 0 A.
                assert (
                    request[1] == 6
                    or request[-4:-2] == b"\x00\x00"
                    or (request[2:4] == b"\x00\x01")
                )
                continue
            assert ours == request, entry["what"]
            same += 1
    assert same > 25


@pytest.mark.parametrize(
    ("what", "request_", "reply"),
    list(answers("normal")),
    ids=[what for what, _, _ in answers("normal")],
)
def test_every_reply_is_accepted_for_its_request(
    what: str, request_: bytes, reply: bytes
) -> None:
    (frame,) = RtuFramer().feed(reply)
    unit, function = request_[:2]
    register = int.from_bytes(request_[2:4])
    if function == 4:
        block = Block(register, int.from_bytes(request_[4:6]), function)
        if len(reply) == 5:
            with pytest.raises(ExchangeRefusedError):
                read_answer(unit, block)(frame)
            return
        data = read_answer(unit, block)(frame)
        assert data is not None
        assert len(data) == 2 * block.words
    elif function == 0x10:
        # False for the override, which is obeyed; True for the access bit.
        assert write_answer(unit, register)(frame) is (register == 0xA7), what


def test_the_factory_defaults() -> None:
    blocks = {}
    for _, request, reply in answers("normal"):
        register, count = (int.from_bytes(request[i : i + 2]) for i in (2, 4))
        if register in (0xC0, 0xE0):
            (frame,) = RtuFramer().feed(reply)
            data = read_answer(0, Block(register, count, READ_INPUT_REGISTERS))(frame)
            assert data is not None
            words = 9 if register == 0xC0 else 3
            blocks[Block(register, words)] = data[: 2 * words]
    settings = decode_configuration(DIALECT, blocks).settings
    assert sorted(settings.values()) == [6, 13, 25]


def test_a_request_that_removes_the_override_is_never_built() -> None:
    removed = next(e for e in TRACE["normal"] if e["what"] == "FC10 A6=0")
    assert bytes.fromhex(removed["request"])[:-2].endswith(write_registers(0xA6, (0,)))
    assert rebuilt(bytes.fromhex(removed["request"])) is None
