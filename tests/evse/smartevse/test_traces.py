"""The decoders of the library against the makers' firmwares 2.20 to HEAD, as recorded.

What the firmware did inside stands between brackets in the recordings: the current of
the pilot, and the contactor. A reading must agree with it.
"""

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass
import json
from pathlib import Path
import re
from typing import Any, Final

import pytest

from custom_components.evse_bus.evse.errors import (
    ExchangeRefusedError,
    ReplyTimeoutError,
)
from custom_components.evse_bus.evse.modbus import ModbusFrame, RtuFramer
from custom_components.evse_bus.evse.model import Setting
from custom_components.evse_bus.evse.registers import Block
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect, Status
from custom_components.evse_bus.evse.smartevse.probing import find_dialect
from custom_components.evse_bus.evse.smartevse.registers import (
    decode_configuration,
    decode_status,
    read_answer,
)
from custom_components.evse_bus.evse.smartevse.states import (
    CHARGING,
    STOPPING,
    UNPLUGGED,
    offered,
    shows_plug,
    state_of,
)

FILES: Final = {
    Dialect.V2_20: "smartevse_v2_20",
    Dialect.V2_30: "smartevse_v2_30",
    Dialect.V2_HEAD: "smartevse_v2_head",
}
TRACES: Final[dict[Dialect, dict[str, list[dict[str, Any]]]]] = {
    dialect: json.loads(
        (Path(__file__).parents[2] / "traces" / f"{name}.json").read_text()
    )
    for dialect, name in FILES.items()
}
INSIDE: Final = re.compile(
    r"\[pilot (?P<pilot>steady|[\d.]+ A), contactor (?P<contactor>open|closed)\]"
)
UNIT: Final = {Dialect.V2_20: 0, Dialect.V2_30: 1, Dialect.V2_HEAD: 1}

each = pytest.mark.parametrize("dialect", TRACES)


def frame(data: str) -> ModbusFrame:
    (found,) = RtuFramer().feed(bytes.fromhex(data))
    return found


@dataclass(frozen=True)
class Recorded:
    """A status that was read, and what the firmware did inside."""

    section: str
    what: str
    status: Status
    pilot: float | None = None
    """A; 0: no PWM; ``None``: not recorded."""
    contactor: bool | None = None


def statuses(dialect: Dialect) -> Iterator[Recorded]:
    """Yield each reading of a whole status block."""
    block = MAPS[dialect].status.block
    for section, entries in TRACES[dialect].items():
        for entry in entries:
            request, reply = entry.get("request"), entry.get("reply")
            if not request or not reply or len(reply) < 2 * (5 + 2 * block.words):
                continue
            asked = bytes.fromhex(request)
            if int.from_bytes(asked[2:4]) != block.register:
                continue
            words = int.from_bytes(asked[4:6])
            read = Block(block.register, words, asked[1])
            data = read_answer(asked[0], read)(frame(reply))
            assert data is not None
            status = decode_status(dialect, data[: 2 * block.words])
            inside = INSIDE.search(entry["what"])
            if inside is None:
                yield Recorded(section, entry["what"], status)
                continue
            pilot = inside["pilot"].removesuffix(" A")
            yield Recorded(
                section,
                entry["what"],
                status,
                0.0 if pilot == "steady" else float(pilot),
                inside["contactor"] == "closed",
            )


@each
def test_every_byte_belongs_to_a_frame(dialect: Dialect) -> None:
    framer = RtuFramer()
    for section, entries in TRACES[dialect].items():
        for entry in entries:
            for key in ("request", "reply", "hex"):
                what = str(entry.get("what"))
                if not entry.get(key) or "wrong CRC" in what or " 0 words" in what:
                    continue
                data = bytes.fromhex(entry[key])
                if data[1] not in (3, 4, 6, 16):
                    # The recorder also tried functions that no box knows.
                    continue
                frames = framer.feed(data)
                assert b"".join(one.raw for one in frames) == data, (section, entry)
    assert (framer.noise, framer.bad, framer.pending) == (0, 0, 0)


@each
def test_a_reading_agrees_with_what_the_firmware_did(dialect: Dialect) -> None:
    """The pilot offers what we show, and no closed contactor is hidden."""
    count = 0
    for one in statuses(dialect):
        if one.pilot is None or one.contactor is None:
            continue
        state = state_of(dialect, one.status.raw_state)
        closed = one.status.raw_state in CHARGING or one.status.raw_state == STOPPING
        assert closed >= one.contactor, one
        if one.contactor:
            assert state.charging is not False, one
        shown = offered(dialect, one.status) or 0.0
        if one.contactor:
            assert shown == pytest.approx(one.pilot), one
        # Before it starts, the current is in the registers already.
        assert shown >= one.pilot, one
        count += 1
    assert count > 50


@each
def test_a_car_that_may_be_in_is_never_shown_as_gone(dialect: Dialect) -> None:
    """Where access, an error or a start hides it, the state does not show the plug."""
    hidden = [
        one.status
        for one in statuses(dialect)
        if one.status.raw_state == UNPLUGGED
        and one.section in ("normal", "polled_too_often", "heat")
        and (one.status.access is False or one.status.error)
        and "unplugged" not in one.what
    ]
    assert all(not shows_plug(status) for status in hidden)
    if dialect is Dialect.V2_HEAD:
        # It reports B1 instead.
        assert not hidden
    else:
        assert hidden


@each
def test_the_dialect_is_found_by_recorded_replies(dialect: Dialect) -> None:
    """Functions 03 and 04 are answered alike (recorded for the status block)."""
    replies: dict[tuple[int, str], str | None] = {
        (bytes.fromhex(entry["request"])[0], entry["request"][4:12]): entry["reply"]
        for entry in reversed(TRACES[dialect]["reads"])
    }

    async def read(block: Block) -> bytes:
        key = f"{block.register:04x}{block.words:04x}"
        # Of a block only a longer part may be recorded.
        reply = replies.get((UNIT[dialect], key))
        if reply is None:
            longer = min(
                asked
                for unit, asked in replies
                if unit == UNIT[dialect] and asked[:4] == key[:4] and asked > key
            )
            data = bytes.fromhex(replies[UNIT[dialect], longer] or "")
            return data[3 : 3 + 2 * block.words]
        if not reply:
            raise ReplyTimeoutError
        answer = read_answer(UNIT[dialect], Block(block.register, block.words, 4))
        data = answer(frame(reply))
        assert data is not None
        return data

    assert asyncio.run(find_dialect(read)) is dialect


@each
def test_the_factory_defaults(dialect: Dialect) -> None:
    """Each in its own unit: a surplus of 4 A starts, no import is accepted."""
    words: dict[int, int] = {}
    for entry in TRACES[dialect]["reads"]:
        asked, reply = bytes.fromhex(entry["request"]), entry["reply"]
        if asked[1] != 4 or not reply or len(reply) <= 2 * 5:
            continue
        register = int.from_bytes(asked[2:4])
        data = bytes.fromhex(reply)[3:-2]
        for at in range(0, len(data), 2):
            words[register + at // 2] = int.from_bytes(data[at : at + 2])
    blocks = {
        block: b"".join(
            words[block.register + at].to_bytes(2) for at in range(block.words)
        )
        for block in MAPS[dialect].configuration
    }
    assert decode_configuration(dialect, blocks).settings == {
        Setting.MINIMUM_CURRENT: 6,
        Setting.MAXIMUM_CURRENT: 13,
        Setting.CIRCUIT_CURRENT: 16,
        Setting.MAINS_CURRENT: 25,
        Setting.MODE_AT_START: 0,
        Setting.SOLAR_START_CURRENT: 4,
        Setting.SOLAR_STOP_TIME: 10,
        Setting.SOLAR_IMPORT_CURRENT: 0,
    }


@each
def test_every_refusal_is_malformed(dialect: Dialect) -> None:
    """Without the 0x80, which tells 2.x from 3.x."""
    refusals = 0
    for entry in TRACES[dialect]["reads"]:
        asked, reply = bytes.fromhex(entry["request"]), entry["reply"]
        if (
            reply
            and len(reply) == 2 * 5
            and asked[1] in (3, 4)
            and asked[4:6] != b"\0\0"
        ):
            block = Block(*(int.from_bytes(asked[i : i + 2]) for i in (2, 4)), asked[1])
            with pytest.raises(ExchangeRefusedError) as refused:
                read_answer(asked[0], block)(frame(reply))
            assert type(refused.value) is not ExchangeRefusedError
            refusals += 1
    assert refusals > 4
