"""Imports run one way: entities -> coordinator -> evse -> model.

Read from the sources, so that a wall holds also where no test walks.
"""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

INTEGRATION = Path(__file__).parents[1] / "custom_components/evse_bus"
EVSE = INTEGRATION / "evse"
HOUSE = INTEGRATION / "house"
VIRTUAL = Path(__file__).parent / "virtual"
PROTOCOLS = sorted(path.parent.name for path in EVSE.glob("*/charger.py"))

PURE = (
    "frames",
    "registers",
    "dialects",
    "balancing",
    "probing",
    "duty",
    "states",
    "decisions",
    "plausibility",
)
"""Files of a protocol folder that know no line and no conversation, beside `wire/`."""

KNOW_A_PROTOCOL = {
    # The cards, LEDs and parameter blocks of an EWS-Box: behaviour, which no protocol
    # could declare as data.
    "actions",
}
"""Parts of Home Assistant's side that import the folder of a protocol."""

LIBRARY_MAY = {"pymodbus", "serialx"}
"""Third-party packages the library may import, all told in the README."""


def imports(path: Path, root: Path) -> set[str]:
    """Return what a file imports: relative imports as paths below ``root``."""
    found = set()
    package = path.relative_to(root).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                found.add(node.module or "")
                continue
            up = len(package) - node.level + 1
            assert up >= 0, f"{path} reaches out of {root}"
            base = (*package[:up], *((node.module or "").split(".")))
            names = [part for part in base if part]
            if node.module is None:
                found.update(".".join((".", *names, one.name)) for one in node.names)
            else:
                found.add(".".join((".", *names)))
    return {
        name.replace("..", "~") if name.startswith("..") else name for name in found
    }


def local(path: Path, root: Path) -> set[str]:
    return {name[1:] for name in imports(path, root) if name.startswith("~")}


def files(root: Path) -> dict[str, Path]:
    """Return all files below ``root`` by their module name; a package by its own."""
    found = {}
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(part for part in parts if part != "__init__")] = path
    return found


def graph(root: Path) -> dict[str, set[str]]:
    """Return which files import which; imports for type checking count too.

    ``from .a import b`` imports the file ``a.b`` where there is one, else ``a``.
    """
    modules = files(root)
    found: dict[str, set[str]] = {}
    for name, path in modules.items():
        package = path.relative_to(root).parent.parts
        used = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ImportFrom) or not node.level:
                continue
            base = package[: len(package) - node.level + 1]
            stem = ".".join((*base, *(node.module or "").split("."))).strip(".")
            for one in node.names:
                inner = f"{stem}.{one.name}".strip(".")
                used.add(inner if inner in modules else stem)
        found[name] = used & modules.keys() - {name}
    return found


def circles(used: dict[str, set[str]]) -> list[set[str]]:
    """Return the sets of files that import each other, by whatever way."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        waiting = list(used[start])
        while waiting:
            name = waiting.pop()
            if name not in seen:
                seen.add(name)
                waiting.extend(used[name])
        return seen

    all_reached = {name: reached(name) for name in used}
    found: list[set[str]] = []
    for name, seen in all_reached.items():
        if name in seen and not any(name in circle for circle in found):
            found.append({other for other in seen if name in all_reached[other]})
    return found


def test_no_file_imports_itself_by_any_way() -> None:
    assert circles(graph(INTEGRATION)) == []


def test_a_circle_is_found() -> None:
    used = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}
    assert circles(used) == [{"b", "c"}]


def outside(path: Path, root: Path) -> set[str]:
    found = (name for name in imports(path, root) if not name.startswith("~"))
    return {name.split(".")[0] for name in found}


@pytest.mark.parametrize("path", sorted(EVSE.rglob("*.py")), ids=lambda p: p.name)
def test_the_library_stands_alone(path: Path) -> None:
    allowed = LIBRARY_MAY | set(sys.stdlib_module_names)
    assert outside(path, EVSE) <= allowed


@pytest.mark.parametrize("path", sorted(HOUSE.rglob("*.py")), ids=lambda p: p.name)
def test_sun_and_fuse_are_arithmetic(path: Path) -> None:
    """No library, no clock, no loop, no chance; nothing of `evse/` or beside it."""
    used = outside(path, INTEGRATION)
    assert used <= set(sys.stdlib_module_names)
    assert not used & {"asyncio", "time", "datetime", "random", "threading"}
    ours = {name for name in graph(INTEGRATION) if name.split(".")[0] == "house"}
    name = ".".join(path.relative_to(INTEGRATION).with_suffix("").parts)
    assert graph(INTEGRATION)[name.removesuffix(".__init__")] <= ours


@pytest.mark.parametrize("name", ["model", "errors"])
def test_the_words_import_nothing(name: str) -> None:
    assert local(EVSE / f"{name}.py", EVSE) == set()
    assert outside(EVSE / f"{name}.py", EVSE) <= set(sys.stdlib_module_names)


def test_clamp_schedule_and_ceiling_are_pure() -> None:
    assert local(EVSE / "safety.py", EVSE) == {"errors", "model"}
    assert local(EVSE / "schedule.py", EVSE) == set()
    assert local(EVSE / "ceiling.py", EVSE) == {"errors", "model", "safety"}
    for name in ("safety", "schedule", "ceiling"):
        assert "asyncio" not in outside(EVSE / f"{name}.py", EVSE)


def test_standing_orders_do_not_know_the_ceiling() -> None:
    used = local(EVSE / "standing_orders.py", EVSE)
    assert not used & {"ceiling", "governance", "charger", "bus"}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_protocols_do_not_know_each_other(protocol: str) -> None:
    others = set(PROTOCOLS) - {protocol}
    for path in (EVSE / protocol).rglob("*.py"):
        used = {name.split(".")[0] for name in local(path, EVSE)}
        assert not used & others, path
        assert "protocols" not in used, path


def test_only_the_registry_knows_the_protocols() -> None:
    for path in EVSE.glob("*.py"):
        used = {name.split(".")[0] for name in local(path, EVSE)}
        if path.name != "protocols.py":
            assert not used & set(PROTOCOLS), path


def test_home_assistants_side_knows_a_protocol_by_its_description() -> None:
    """No import of a protocol's folder, and no key of a protocol as a text."""
    words = set(PROTOCOLS) | {"ews_network", "smartevse_master"}
    knowing = set()
    for path in INTEGRATION.rglob("*.py"):
        if path.is_relative_to(EVSE):
            continue
        used = {tuple(name.split(".")[:2]) for name in local(path, INTEGRATION)}
        if used & {("evse", protocol) for protocol in PROTOCOLS}:
            knowing.add(path.relative_to(INTEGRATION).parts[0])
        nodes = ast.walk(ast.parse(path.read_text()))
        texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
        assert not texts & words, path
    assert knowing == set(KNOW_A_PROTOCOL)


def test_only_the_line_knows_serialx_and_only_modbus_knows_pymodbus() -> None:
    for path in EVSE.rglob("*.py"):
        name = path.relative_to(EVSE).as_posix()
        assert ("serialx" in outside(path, EVSE)) == (name == "line.py"), path
        if name != "modbus.py":
            assert "pymodbus" not in outside(path, EVSE), path


def test_pure_parts_of_a_protocol_do_not_talk() -> None:
    talking = {"bus", "line", "exchange", "jobs", "charger", "turns"}
    for protocol in PROTOCOLS:
        folder = EVSE / protocol
        named = (folder / f"{name}.py" for name in PURE)
        for path in (*named, *(folder / "wire").glob("*.py")):
            if path.exists():
                used = {one.split(".")[-1] for one in local(path, EVSE)}
                assert not used & talking, path


def test_the_coordinator_does_not_know_what_stands_on_it() -> None:
    above = {
        *("binary_sensor", "button", "event", "number", "select", "sensor", "switch"),
        *("entity", "diagnostics", "services", "repairs", "actions", "config_flow"),
        "flows",
    }
    for name in (
        *("coordinator", "connections", "discovery", "issues"),
        *("supply", "configuration", "errors", "const", "identity"),
        *("chargers/devices", "chargers/managed", "chargers/subentries"),
        *("stores/file", "stores/orders"),
    ):
        used = local(INTEGRATION / f"{name}.py", INTEGRATION)
        assert not {one.split(".")[0] for one in used} & above, name


def test_the_folder_of_the_integration_can_be_taken_in_at_a_glance() -> None:
    assert sum(path.is_file() for path in INTEGRATION.iterdir()) <= 30


def test_virtual_chargers_share_nothing_with_the_library() -> None:
    for path in VIRTUAL.rglob("*.py"):
        assert "custom_components" not in path.read_text() or (
            path.name.startswith("test_")
        ), path


def test_the_library_can_be_imported_without_home_assistant() -> None:
    """As a script would: with the folder of the integration on its path."""
    code = (
        "import sys; sys.modules['homeassistant'] = None; import evse.protocols;"
        "print(*sorted(evse.protocols.PROTOCOLS))"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter and our own code
        [sys.executable, "-c", code],
        cwd=INTEGRATION,
        capture_output=True,
        text=True,
        check=True,
    )
    # A folder may speak in more than one role: ``smartevse``, ``smartevse_master``.
    folders = {key.split("_")[0] for key in done.stdout.split()}
    assert sorted(folders) == PROTOCOLS
