"""Load balancing by dialect, against the recorded frames of the makers' masters."""

import json
from pathlib import Path
from typing import Any

import pytest

from custom_components.evse_bus.evse.smartevse.dialects import (
    MAPS,
    Dialect,
    Family,
    Handshake,
)
from custom_components.evse_bus.evse.smartevse.registers import read_request

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


@pytest.mark.parametrize("dialect", RECORDED)
def test_all_stop_is_that_of_the_makers_master(dialect: Dialect) -> None:
    row = MAPS[dialect].balancing
    assert row.all_stop_register is not None
    head = f"{row.broadcast_unit:02x}06{row.all_stop_register:04x}"
    assert {one[:8] for one in sent(dialect) if one[2:4] == "06"} == {head}


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
