"""docs/timing.md: its values are those of the code, and its tests are there."""

import ast
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
import re

import pytest

from custom_components.evse_bus.evse.framing import Timing

ROOT = Path(__file__).parents[1]
PACKAGE = "custom_components.evse_bus.evse"
LIBRARY = ROOT / PACKAGE.replace(".", "/")
PAGE = (ROOT / "docs/timing.md").read_text()

MODES = 8
"""Columns of a table of modes, beside its first."""

TIMED = (
    "abl/config.py",
    "abl/decisions.py",
    "abl/device_id.py",
    "abl/evidence.py",
    "abl/reader.py",
    "abl/writer.py",
    "bus.py",
    "ceiling.py",
    "evbox/config.py",
    "ews/network/admission.py",
    "ews/network/line.py",
    "ews/network/listener.py",
    "ews/timing.py",
    "line.py",
    "recovery.py",
    "smartevse/dialects.py",
    "smartevse/handshake_polled.py",
    "smartevse/handshake_requests.py",
    "smartevse/master.py",
    "smartevse/other_masters.py",
    "smartevse/plug.py",
    "smartevse/polled.py",
    "smartevse/reader.py",
    "smartevse/scan.py",
    "smartevse/slave.py",
)
"""Files whose times must all be in the tables."""

OTHERS = {
    "abl.config.AblConfig.enable_again",
    "abl.decisions.EXCESS",
    "abl.reader.E0_OURS",
    "bus.FAILURES_WINDOW",
    "ews.network.listener.CROWD_LOGGED",
    "smartevse.dialects.Map.search_time",
    "smartevse.scan.POLLED_UNITS",
}
"""Constants of these files that are no times of a line."""


def rows() -> Iterator[list[str]]:
    """Return the cells of all rows of tables."""
    for line in PAGE.splitlines():
        if line.startswith("| ") and not line.startswith("| ---"):
            yield [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def numbers() -> Iterator[tuple[str, str]]:
    """Return the rows with a constant: its path, and the value in the table."""
    for cells in rows():
        if len(cells) == 4 and re.fullmatch(r"`[\w.]+`", cells[2]):
            yield cells[2].strip("`"), cells[1]


def named_tests() -> dict[str, str]:
    """Return the tests by the letter and number that cells name them with."""
    return dict(re.findall(r"^([A-Z]\d+) +(\S+::\w+)$", PAGE, re.MULTILINE))


def names_in(text: str) -> list[str]:
    return re.findall(r"\b([LEASMWP]\d+)\b", text)


def value_of(path: str) -> object:
    """Return the value of a constant, an attribute, or the default of a field."""
    parts = path.split(".")
    count = len(parts)
    while (
        not (LIBRARY / Path(*parts[:count]).with_suffix(".py")).is_file()
        and not (LIBRARY / Path(*parts[:count]) / "__init__.py").is_file()
    ):
        count -= 1
    value: object = import_module(".".join((PACKAGE, *parts[:count])))
    for part in parts[count:]:
        if isinstance(value, type) and is_dataclass(value):
            (field,) = (one for one in fields(value) if one.name == part)
            assert field.default is not MISSING
            value = field.default
        else:
            value = getattr(value, part)
    return value


def flat(value: object) -> list[float]:
    if isinstance(value, tuple):
        return [number for one in value for number in flat(one)]
    assert isinstance(value, int | float)
    return [float(value)]


@pytest.mark.parametrize(("path", "shown"), numbers())
def test_a_number_is_that_of_the_code(path: str, shown: str) -> None:
    assert [float(one) for one in re.findall(r"\d+(?:\.\d+)?", shown)] == flat(
        value_of(path)
    )


def test_no_time_is_left_out() -> None:
    told = {path for path, _ in numbers()}
    missing = {path for file in TIMED for path in times_in(file)} - told - OTHERS
    assert not missing


def times_in(file: str) -> Iterator[str]:
    """Return the constants of a file whose docstring ends with seconds."""
    module = file.removesuffix(".py").replace("/", ".")
    body = ast.parse((LIBRARY / file).read_text()).body
    classes = [one for one in body if isinstance(one, ast.ClassDef)]
    for prefix, statements in (
        (module, body),
        *((f"{module}.{one.name}", one.body) for one in classes),
    ):
        for statement, docstring in pairwise(statements):
            name = assigned(statement)
            text = docstring_of(docstring)
            if name and text and re.search(r"(\bs\b\.?|, s[ ;:(].*|\bs\.)", text):
                yield f"{prefix}.{name}"


def assigned(statement: ast.stmt) -> str | None:
    """Return the name of a constant or field that has a number, not a calculation."""
    if isinstance(statement, ast.AnnAssign):
        target, value = statement.target, statement.value
    elif isinstance(statement, ast.Assign):
        (target,), value = statement.targets, statement.value
    else:
        return None
    literal = isinstance(value, ast.Constant | ast.Tuple)
    return target.id if literal and isinstance(target, ast.Name) else None


def docstring_of(statement: ast.stmt) -> str | None:
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return " ".join(str(statement.value.value).split())
    return None


@pytest.mark.parametrize("protocol", ["abl", "evbox", "ews", "smartevse"])
def test_the_line_of_each_protocol_is_in_the_tables(protocol: str) -> None:
    """A time of a line that is not the default of all protocols is shown."""
    told = {path for path, _ in numbers()}
    where = {
        "abl": "abl.config.TIMING",
        "evbox": "evbox.config.TIMING",
        "ews": "ews.timing.TIMING",
        "smartevse": "smartevse.reader.TIMING",
    }[protocol]
    timing = value_of(where)
    assert isinstance(timing, Timing)
    usual = {one.name: one.default for one in fields(Timing)}
    for name in ("silence", "silence_patience", "backoff", "backoff_limit", "attempts"):
        if getattr(timing, name) != usual[name]:
            assert f"{where}.{name}" in told
    for name in ("reply_timeout", "retry_pauses", "misses"):
        assert f"{where}.{name}" in told


def functions(file: str) -> set[str]:
    tree = ast.parse((ROOT / file).read_text())
    return {
        one.name
        for one in tree.body
        if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
    }


@pytest.mark.parametrize(("name", "test"), named_tests().items())
def test_a_named_test_is_there_and_used(name: str, test: str) -> None:
    file, _, function = test.partition("::")
    assert function.startswith("test_")
    assert function in functions(file)
    assert any(name in names_in(cell) for cells in rows() for cell in cells)


def test_each_name_is_listed() -> None:
    used = {name for cells in rows() for cell in cells for name in names_in(cell)}
    assert used == named_tests().keys()


def test_each_cell_of_a_mode_says_something() -> None:
    """A value, or "-" where the number cannot occur; the first one has a test."""
    tables = [cells for cells in rows() if len(cells) == MODES + 1 and cells[0]]
    assert len(tables) > 25
    for cells in tables:
        assert all(cells)
        assert names_in(" ".join(cells[1:])), cells[0]


def promises() -> Iterator[tuple[str, str, str]]:
    table = PAGE.partition("## What is promised\n")[2]
    for line in table.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) == 3 and (ROOT / cells[1]).is_file():
            yield cells[0], cells[1], cells[2]


@pytest.mark.parametrize(("promise", "page", "tests"), promises())
def test_a_promise_is_in_its_page(promise: str, page: str, tests: str) -> None:
    text = " ".join((ROOT / page).read_text().replace("**", "").split())
    assert promise in text
    assert names_in(tests)
