"""What the documentation shows does what it says, and what it names is there."""

import asyncio
from collections.abc import Iterator
import json
from pathlib import Path
import re
import sys

import pytest

from custom_components.evse_bus import (
    binary_sensor,
    button,
    event,
    sensor_tables,
    switch,
)
from custom_components.evse_bus.actions.table import ACTIONS
from custom_components.evse_bus.evse.ews.box import Installation
from custom_components.evse_bus.evse.ews.network.admission import PLACES
from custom_components.evse_bus.evse.ews.network.listener import IDENTIFY_TIME
from custom_components.evse_bus.evse.ews.readings import capabilities_of
from custom_components.evse_bus.evse.ews.timing import (
    COMMAND_MARGIN,
    COMMAND_TIMEOUT,
)
from custom_components.evse_bus.evse.ews.wire.parameters import SystemMode
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from custom_components.evse_bus.flows.listener import FIRST_PORT
from custom_components.evse_bus.flows.schema import default_of
from tests.virtual import AblBox, Car, EwsBox, EwsDialler, VirtualBus

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT / "custom_components/evse_bus"
PAGES = {
    str(page.relative_to(ROOT)): page.read_text()
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
NAMES = json.loads((LIBRARY / "translations/en.json").read_text())["entity"]
CLASS_NAMES = frozenset(
    {"Charging", "Connectivity", "Energy", "Power", "Problem", "Restart"}
)
"""Of entities that Home Assistant itself names, after their device class."""


def words(page: str) -> str:
    """Return a page's text, however its lines are broken."""
    return " ".join(PAGES[page].split())


def scripts(page: str) -> list[str]:
    """Return the Python blocks of a page."""
    return re.findall(r"```python\n(.*?)```", PAGES[page], re.DOTALL)


# -- Links -----------------------------------------------------------------------


def anchors(page: str) -> set[str]:
    """Return what the headings of a page can be linked by, as GitHub makes it."""
    headings = re.findall(r"^#+ (.+)$", PAGES[page], re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}


def links() -> Iterator[tuple[str, str]]:
    for page, text in PAGES.items():
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            if not link.startswith("http"):
                yield page, link


@pytest.mark.parametrize(("page", "link"), [*links()])
def test_a_link_leads_somewhere(page: str, link: str) -> None:
    path, _, anchor = link.partition("#")
    target = ((ROOT / page).parent / path).resolve() if path else ROOT / page
    assert target.is_file()
    if anchor:
        assert anchor in anchors(str(target.relative_to(ROOT)))


# -- Numbers and names -----------------------------------------------------------


def test_the_readme_knows_how_often_is_asked() -> None:
    keys = ("evbox", "abl", "smartevse", "smartevse_master", "ews", "ews_network")
    every = {key: f"{default_of(PROTOCOLS[key], 'poll_interval'):g} s" for key in keys}
    others = {every[key] for key in keys[1:]}
    assert others == {every["abl"]}
    readme = words("README.md")
    assert f"EVBox {every['evbox']}, ABL, SmartEVSE and EWS-Box {every['abl']}" in (
        readme
    )
    assert f"an EVBox every {every['evbox']}" in readme
    assert f"an ABL box, a SmartEVSE or an EWS-Box every {every['abl']}" in readme
    patience = COMMAND_TIMEOUT - COMMAND_MARGIN
    assert f"hears a command every {patience:g} s at least" in readme


def test_the_numbers_of_the_listener() -> None:
    assert f"a port ({FIRST_PORT} is offered)" in words("README.md")
    page = words("docs/ews.md")
    assert f"{FIRST_PORT} is offered if it is free" in page
    assert (
        f"within {IDENTIFY_TIME:g} s end, at most {PLACES} (and one for "
        "each box that is set up) wait at once"
    ) in page
    assert f"drops the connection after {COMMAND_TIMEOUT:g} s" in page


def test_every_action_is_told_with_who_may() -> None:
    told = re.findall(
        r"^\| `evse_bus\.(\w+)` \| .+ \| (\w+) \|$", PAGES["README.md"], re.MULTILINE
    )
    who = {True: "administrators", False: "everybody"}
    assert dict(told) == {name: who[one.admin] for name, one in ACTIONS.items()}


def ews_entities() -> set[str]:
    """Return the names of all entities that an EWS-Box or its listener can have."""
    everything = Installation(mode=SystemMode.CARDS | SystemMode.MANUAL_IO)
    has = {*capabilities_of(1, everything), None}
    tables = {
        "binary_sensor": (*binary_sensor.CONNECTOR_SENSORS, *binary_sensor.BOX_SENSORS),
        "button": button.BUTTONS,
        "event": event.EVENTS,
        "sensor": (
            *sensor_tables.CONNECTOR_SENSORS,
            *sensor_tables.CHARGER_SENSORS,
            *sensor_tables.LISTENER_SENSORS,
            sensor_tables.CONNECTED_BOXES,
            sensor_tables.FAULT,
        ),
        "switch": (*switch.COMMANDS, *switch.CONNECTOR_COMMANDS, switch.ALLOWED),
    }
    return {
        NAMES[platform][one.translation_key]["name"].format(
            **(one.translation_placeholders or {})
        )
        for platform, table in tables.items()
        for one in table
        if getattr(one, "capability", None) in has and one.translation_key is not None
    }


def test_the_page_of_the_ews_box_names_all_its_entities() -> None:
    page = words("docs/ews.md")
    assert len(names := ews_entities()) > 40
    assert not [name for name in names | CLASS_NAMES if name not in page]


def test_where_the_commands_of_an_ews_box_are() -> None:
    """In the table of the protocol's page: entities and actions that exist."""
    cells = [
        line.rstrip(" |").rsplit(" | ", 1)[1]
        for line in PAGES["docs/ews-protocol.md"].splitlines()
        if line.startswith("| `") and line.count("|") == 9
    ]
    named = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    assert set(named) == set(ACTIONS)
    entities = {name for cell in cells for name in re.findall(r"\*([^*]+)\*", cell)}
    known = ews_entities() | CLASS_NAMES | {"Charging current"}
    assert entities
    assert not entities - known


# -- Scripts ---------------------------------------------------------------------


async def run(code: str, *arguments: str) -> str:
    """Run a script as on a machine that has never heard of Home Assistant."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        "import sys; sys.modules['homeassistant'] = None\n" + code,
        *arguments,
        cwd=LIBRARY,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    async with asyncio.timeout(30):
        out, err = await process.communicate()
    assert process.returncode == 0, err.decode()
    return out.decode()


@pytest.mark.slow
@pytest.mark.real_time
async def test_the_script_of_the_library_reads_and_sets_a_charger() -> None:
    code = scripts("docs/library.md")[0]
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) == 11
    car = Car(max_current=16)
    box = AblBox(1, car=car)
    async with VirtualBus.pty(box) as bus:
        car.plug_in()
        await bus.wait_for_async(lambda: box.state == "C2", timeout=30)
        assert "raw_state='C2'" in await run(code, bus.url)
        assert box.limits_written == [166]
        assert box.ic_amps <= 10.0


@pytest.mark.slow
@pytest.mark.real_time
async def test_the_same_script_for_an_ews_box() -> None:
    code = scripts("docs/library.md")[0].replace('"abl"', '"ews"')
    car = Car(max_current=16)
    box = EwsBox(cars=(car,))
    async with VirtualBus.pty(box) as bus:
        car.plug_in()
        await bus.wait_for_async(lambda: box.ports[0].status == 0x30, timeout=30)
        assert "raw_state='0x30'" in await run(code, bus.url)
        assert box.ports[0].limit == 10
        assert not box.ports[0].contactor


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.usefixtures("socket_enabled")
async def test_the_script_that_an_ews_box_dials(unused_tcp_port: int) -> None:
    code = scripts("docs/library.md")[1]
    car = Car(max_current=16)
    box = EwsBox(serial="012345678901", cars=(car,))
    host = "127.0.0.1"
    async with EwsDialler(box, host, unused_tcp_port, retry=0.05) as bus:
        car.plug_in()
        await bus.wait_for_async(lambda: box.ports[0].status == 0x30, timeout=30)
        out = await run(code, host, str(unused_tcp_port), box.serial)
        assert "raw_state='0x30'" in out
        assert "ChargeStarted(port=1)" in out
        assert box.ports[0].contactor
        assert box.ports[0].offered == 6
