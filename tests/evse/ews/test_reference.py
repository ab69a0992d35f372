"""The documentation has every command, with its code and its test."""

from importlib import import_module
from pathlib import Path
import re

import pytest

from custom_components.evse_bus.evse.ews.wire.frames import CommandId
from custom_components.evse_bus.evse.ews.wire.states import RULES, STATES

PAGE = (Path(__file__).parents[3] / "docs/ews-protocol.md").read_text()
ROWS = {
    cells[0].strip("`"): cells
    for line in PAGE.splitlines()
    if line.startswith("| `")
    and len(cells := [cell.strip() for cell in line.strip("|").split("|")]) == 8
}
LIBRARY = "custom_components.evse_bus.evse.ews.wire"


def test_every_command_has_its_row() -> None:
    assert list(ROWS) == [*CommandId, "I if"]


@pytest.mark.parametrize("name", ROWS)
def test_a_row_names_existing_code_and_tests(name: str) -> None:
    *_, code, test, where = ROWS[name]
    for one in code.split(", "):
        module, attribute = one.strip("`").split(".")
        assert hasattr(import_module(f"{LIBRARY}.{module}"), attribute)
    module, attribute = test.strip("`").split(".")
    assert hasattr(import_module(f"tests.evse.ews.{module}"), attribute)
    # Its contents are checked in tests/test_docs.py, with Home Assistant.
    assert where


def test_every_state_and_every_order_is_there() -> None:
    for code in STATES:
        assert f"0x{code:02X}" in PAGE or code in range(0x40, 0x44)
    orders = PAGE.split("## Orders and their states")[1].split("\n## ")[0]
    numbered = re.findall(r"^\| ([1-7])(?:, ([1-7]))?", orders, re.MULTILINE)
    # Order 6 has two rows: it does two things.
    numbers = dict.fromkeys(int(one) for pair in numbered for one in pair if one)
    assert [*numbers] == [*RULES]
