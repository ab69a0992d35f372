"""Load balancing by dialect, against the recorded frames of the makers' masters."""

from collections.abc import Iterator
import json
from pathlib import Path
from typing import Any

import pytest

from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.modbus import RtuFramer, rtu_frame
from custom_components.evse_bus.evse.model import CurrentLimit, Limits, Orders
from custom_components.evse_bus.evse.safety import Setpoint, clamp
from custom_components.evse_bus.evse.smartevse.balancing import (
    answer_to_state,
    asks,
    broadcast,
    clear_refusal,
    grant_current,
    is_refused,
    refuse_current,
)
from custom_components.evse_bus.evse.smartevse.dialects import (
    MAPS,
    Dialect,
    Family,
    Handshake,
    Status,
)
from custom_components.evse_bus.evse.smartevse.registers import (
    decode_status,
    read_request,
)

TRACES = Path(__file__).parents[2] / "traces"
RECORDED = {
    Dialect.V2_20: "smartevse_v2_20.json",
    Dialect.V2_30: "smartevse_v2_30.json",
    Dialect.V2_HEAD: "smartevse_v2_head.json",
}


def trace(dialect: Dialect) -> dict[str, list[dict[str, Any]]]:
    recorded: dict[str, list[dict[str, Any]]] = json.loads(
        (TRACES / RECORDED[dialect]).read_text()
    )
    return recorded


def sent(dialect: Dialect) -> set[str]:
    """Return all recorded frames of masters."""
    sections = trace(dialect)
    return {
        entry["hex"]
        for name, section in sections.items()
        if name.startswith(("node_", "two_nodes"))
        for entry in section
        if entry.get("dir") == "master"
    }


@pytest.mark.parametrize("dialect", RECORDED)
def test_the_polled_block_is_that_of_the_makers_master(dialect: Dialect) -> None:
    block = MAPS[dialect].balancing.status.block
    assert read_request(2, block).hex() in sent(dialect)


@pytest.mark.parametrize("dialect", RECORDED)
def test_the_broadcast_is_that_of_the_makers_master(dialect: Dialect) -> None:
    row = MAPS[dialect].balancing
    words = bytes((0, row.currents, 2 * row.currents))
    head = bytes((row.broadcast_unit, 16)) + row.broadcast_register.to_bytes(2, "big")
    start = (head + words).hex()
    others = ("02", "03", "0906")
    frames = [one for one in sent(dialect) if not one.startswith(others)]
    assert frames
    assert all(frame.startswith(start) for frame in frames)


def test_families_and_handshakes() -> None:
    """A letter or a number as the state decides who asks; 2.20 is a family alone."""
    families = {dialect: row.balancing.family for dialect, row in MAPS.items()}
    assert families == {
        Dialect.V2_17: Family.V2_17,
        Dialect.V2_20: Family.V2_20,
        Dialect.V2_30: Family.LATER,
        Dialect.V2_HEAD: Family.LATER,
        Dialect.V3_OLD: Family.LATER,
        Dialect.V3: Family.LATER,
    }
    polled = {
        dialect
        for dialect, row in MAPS.items()
        if row.balancing.handshake is Handshake.POLLED
    }
    assert polled == set(Dialect) - {Dialect.V2_17}


def test_only_3x_keeps_its_access_in_flash_memory_and_may_go_on_for_ever() -> None:
    flash = {one for one, row in MAPS.items() if not row.balancing.access_is_volatile}
    assert flash == {Dialect.V3_OLD, Dialect.V3}
    endless = {one for one, row in MAPS.items() if not row.balancing.fail_safe_proven}
    assert endless == {Dialect.V3_OLD}


# -- Frames ------------------------------------------------------------------------


def rounds(dialect: Dialect) -> Iterator[tuple[str, str, str, str]]:
    """Return what each recorded master wrote to a state, and the poll before it."""
    last: dict[str, str] = {}
    for name, section in trace(dialect).items():
        if not name.startswith(("node_", "two_nodes", "makers_master")):
            continue
        for entry in section:
            frame = entry.get("hex", "")
            if frame[2:4] == "04" and len(frame) > 16:
                last[frame[:2]] = frame
            elif frame[2:4] == "10" and frame[8:12] == "0002" and len(frame) > 16:
                yield name, entry.get("what", ""), last[frame[:2]], frame


def as_polled(dialect: Dialect, reply: str) -> Status:
    registers = MAPS[dialect].balancing.status
    return decode_status(dialect, bytes.fromhex(reply)[3:-2], registers)


@pytest.mark.parametrize("dialect", RECORDED)
def test_what_is_written_to_a_state_is_what_a_master_wrote(dialect: Dialect) -> None:
    made = []
    for name, what, reply, frame in rounds(dialect):
        status = as_polled(dialect, reply)
        unit = int(frame[:2], 16)
        if not asks(status):
            make = clear_refusal
        elif "refused" in what or frame[14:18] in {"0004", "0006"}:
            make = refuse_current
        else:
            make = grant_current
        assert make(unit, dialect, status).hex() == frame, (name, what, reply)
        made.append(make)
    assert {one.__name__ for one in made} == {
        "clear_refusal",
        "refuse_current",
        "grant_current",
    }
    assert len(made) > 30


@pytest.mark.parametrize("dialect", RECORDED)
def test_the_reply_to_a_written_state_is_understood(dialect: Dialect) -> None:
    replies = {
        entry["hex"]
        for name, section in trace(dialect).items()
        if name.startswith("node_")
        for entry in section
        if entry.get("dir") == "slave" and entry["hex"].startswith("0210")
    }
    register = MAPS[dialect].balancing.status.block.register
    own = {one for one in replies if one[4:8] == f"{register:04x}"}
    assert own
    accept = answer_to_state(2, dialect)
    for reply in own:
        (frame,) = RtuFramer().feed(bytes.fromhex(reply))
        assert accept(frame) is True
    # One of two values was taken: only the next status shows which.
    (part,) = RtuFramer().feed(
        rtu_frame(2, bytes((16, *register.to_bytes(2, "big"), 0, 1)))
    )
    assert accept(part) is False


@pytest.mark.parametrize("dialect", RECORDED)
def test_a_broadcast_is_that_of_a_recorded_master(dialect: Dialect) -> None:
    family = MAPS[dialect].balancing.family
    for currents in ({}, {2: 10.0, 3: 8.0}, {2: 16.0, 3: 16.0}, {3: 6.0}):
        frame = broadcast(family, {unit: at(amps) for unit, amps in currents.items()})
        assert frame.hex() in sent(dialect)


def at(current: float) -> Setpoint:
    orders = Orders(limit=CurrentLimit(current=current), allowed=True)
    return clamp(orders, Limits(installation=80.0))


@pytest.mark.parametrize("dialect", RECORDED)
@pytest.mark.parametrize("state", ["A", "B", "C", "F", "H", "B1", "C1", "T", "14"])
def test_a_box_that_does_not_ask_is_neither_granted_nor_refused(
    dialect: Dialect, state: str
) -> None:
    status = Status(raw_state=state, error=1, current=6.0, access=True)
    for make in (grant_current, refuse_current):
        with pytest.raises(RefusedOrderError):
            make(2, dialect, status)


@pytest.mark.parametrize("state", ["E", "G", "B", "C", "C1", "T", "14"])
def test_a_refusal_is_not_cleared_in_a_state_that_asks_or_charges(state: str) -> None:
    """It would repeat a state that the box may have left meanwhile."""
    status = Status(raw_state=state, error=1, current=6.0, access=True)
    assert not is_refused(status)
    with pytest.raises(RefusedOrderError):
        clear_refusal(2, Dialect.V2_30, status)


def test_other_error_bits_are_kept() -> None:
    status = Status(raw_state="G", error=0x41, current=6.0, access=True)
    assert grant_current(2, Dialect.V3, status)[7:11] == bytes((0, 7, 0, 0x40))
    assert refuse_current(2, Dialect.V3, status)[7:11] == bytes((0, 6, 0, 0x41))


@pytest.mark.parametrize(("unit", "dialect"), [(2, Dialect.V2_17), (1, Dialect.V2_30)])
def test_no_state_is_written_to_another_box(unit: int, dialect: Dialect) -> None:
    """0x83 closes the contactor of a 2.17, and a box at unit 1 has no master."""
    status = Status(raw_state="E", error=0, current=6.0, access=True)
    with pytest.raises(RefusedOrderError):
        grant_current(unit, dialect, status)


def test_a_broadcast_of_2_17_has_no_value_for_unit_5() -> None:
    with pytest.raises(RefusedOrderError):
        broadcast(Family.V2_17, {5: at(6.0)})
