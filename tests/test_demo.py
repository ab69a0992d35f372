"""The demo: its first start against the real API, and the programs it starts.

Left to be tried by hand: a whole Home Assistant with its frontend.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
import json
import os
from pathlib import Path
import socket
import sys
from typing import Any

from homeassistant.auth import auth_manager_from_config
from homeassistant.config_entries import ConfigEntries
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr, entity_registry as er
from homeassistant.setup import async_setup_component
from homeassistant.util import dt as dt_util
import pytest
from pytest_homeassistant_custom_component.typing import ClientSessionGenerator

from demo import home, processes
from demo.automation import AUTOMATION_ID
from demo.buses import BUSES
from demo.client import Client
from demo.dashboard import dashboard
from demo.flow import add_entry
from demo.listing import DOMAIN, ListedBus
from demo.processes import Program
from demo.settings import DemoError, Settings
from demo.storage import prepare, write_configuration

from .virtual import (
    AblBox,
    Car,
    EvboxChargePoint,
    EwsBox,
    EwsDialler,
    Module,
    SmartEvse,
    VirtualBus,
)

pytestmark = pytest.mark.real_time

# -- The first start, without frontend -------------------------------------------


AUTOMATION = f"config/automation/config/{AUTOMATION_ID}"


@pytest.fixture
async def client(
    hass: HomeAssistant,
    hass_client: ClientSessionGenerator,
    hass_access_token: str,
    tmp_path: Path,
) -> AsyncIterator[Client]:
    config = tmp_path / "config"
    config.mkdir()
    write_configuration(config)
    hass.config.config_dir = str(config)
    for component in ("http", "websocket_api", "api", "config", "automation"):
        assert await async_setup_component(hass, component, {})
    server = (await hass_client()).server
    url = str(server.make_url("")).rstrip("/")
    async with Client(url, hass_access_token) as client:
        yield client


def _plugged() -> Car:
    car = Car(max_current=32)
    car.plug_in()
    return car


def _settings(folder: Path) -> Settings:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return Settings(folder=folder, port=8123, listen_port=free.getsockname()[1])


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[list[ListedBus]]:
    """Return the buses on the dashboard, at each start."""
    saved: list[list[ListedBus]] = []

    async def show(
        _client: Client, _settings: Settings, buses: list[ListedBus]
    ) -> None:
        saved.append(buses)

    monkeypatch.setattr(home, "_show_dashboard", show)
    return saved


@pytest.mark.slow
@pytest.mark.usefixtures("quick_search")
async def test_buses_are_added_once_and_all_is_on_the_dashboard(
    hass: HomeAssistant,
    client: Client,
    tmp_path: Path,
    shown: list[list[ListedBus]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    settings = _settings(tmp_path)
    points = [
        EvboxChargePoint(1923054, [Module(), Module()]),
        EvboxChargePoint(1923055, [Module() for _ in range(4)]),
    ]
    boxes = [
        AblBox(number, serial=f"2W22xy{number:08d}", default_current=16)
        for number in (1, 2, 3)
    ]
    polled = SmartEvse(max_current=16, car=_plugged())
    slaves = [
        SmartEvse(load_balance=unit, max_current=16, car=_plugged()) for unit in (2, 3)
    ]
    nodes = [
        SmartEvse(dialect, load_balance=unit, max_current=16)
        for dialect, unit in (("2.30", 2), ("2.30", 3), ("3", 8))
    ]
    workshop = EwsBox(serial="201609000417", cars=(_plugged(), None))
    loading_bay = EwsBox(serial="201802000093", cars=(None, _plugged()))
    with (
        VirtualBus.pty(*points, link=str(settings.link("evbox"))),
        VirtualBus.pty(*boxes, link=str(settings.link("abl"))),
        VirtualBus.pty(polled, link=str(settings.link("smartevse"))) as single,
        VirtualBus.pty(*slaves, link=str(settings.link("smartevse_master"))) as shared,
        VirtualBus.pty(*nodes, link=str(settings.link("smartevse_nodes"))) as later,
        VirtualBus.pty(workshop, link=str(settings.link("ews"))) as serial,
        EwsDialler(loading_bay, "127.0.0.1", settings.listen_port) as dialler,
    ):
        await home.furnish(client, settings)
        # The chargers themselves follow the first values of the demo.
        assert [point.limits_in_force for point in points] == [(32.0,) * 3] * 2
        assert [round(box.ic_amps) for box in boxes] == [16, 10, 13]
        assert [port.limit for port in workshop.ports] == [16, 16]
        assert [port.limit for port in loading_bay.ports] == [20, 20]
        await single.wait_for_async(lambda: polled.pilot_current == 16, 15)
        # Two cars share the supply.
        await shared.wait_for_async(
            lambda: [slave.pilot_current for slave in slaves] == [12.5, 12.5], 15
        )
        await later.wait_for_async(lambda: nodes[2].broadcasts, 15)
        # A start request is allowed, at its own port.
        for bus, box, number in ((serial, workshop, 1), (dialler, loading_bay, 2)):
            port = box.ports[number - 1]
            await bus.wait_for_async(lambda port=port: port.status == 0x30, 15)
            assert not port.history.starts
            box.press_key(number, 1)
            await bus.wait_for_async(lambda port=port: port.status == 0x40, 15)

        mine = {"entity_id": "number.garage_charging_current", "value": 9}
        await client.post("services/number/set_value", mine)
        answers: dict[str, Any] = await client.get(AUTOMATION)
        await client.post(AUTOMATION, answers | {"description": "Mine"})

        capsys.readouterr()
        await home.furnish(client, settings)
        output = capsys.readouterr().out
        assert output.count("this bus is set up already") == len(BUSES)
        assert "Loading bay: discovered: this box is set up already" in output
        assert round(boxes[0].ic_amps) == 9
        assert (await client.get(AUTOMATION))["description"] == "Mine"
        entries = hass.config_entries.async_entries(DOMAIN)
        assert len(entries) == len(BUSES)
        assert not hass.config_entries.flow.async_progress()

        assert shown[0] == shown[1]
        names = [charger.name for bus in shown[0] for charger in bus.chargers]
        assert sorted(names) == sorted(
            name for bus in BUSES for name in bus.names.values()
        )
        entities = _entities(dashboard(shown[0]))
        assert {
            f"number.{name}_charging_current"
            for name in (
                *("garage", "guests", "courtyard", "barn_left", "office_gate"),
                *("workshop_port_1", "workshop_port_2", "loading_bay_port_2"),
            )
        } < entities
        assert "sensor.courtyard_offered_current" in entities
        assert any(entity.endswith("_shared_supply") for entity in entities)
        assert "sensor.car_park_south_module_4_power" in entities
        assert "sensor.loading_bay_port_1_last_result" in entities
        assert {one for one in entities if hass.states.get(one) is None} == set()
        # It needs no cards: no data would be lost at the next start.
        assert hass.states.get("event.workshop_card") is None
        for entry in entries:
            assert await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.usefixtures("shown")
async def test_a_box_that_does_not_dial_holds_up_nothing(
    hass: HomeAssistant,
    client: Client,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(home, "BOX_PATIENCE", 0.1)
    monkeypatch.setattr(home, "PATIENCE", 0.1)
    monkeypatch.setattr(home, "BUSES", [bus for bus in BUSES if bus.dials])
    await home.furnish(client, _settings(tmp_path))
    assert "Loading bay: discovered: not offered" in capsys.readouterr().out
    # There is no port for the automation.
    with pytest.raises(DemoError, match="404"):
        await client.get(AUTOMATION)
    [listener] = hass.config_entries.async_entries(DOMAIN)
    assert not listener.subentries
    assert await hass.config_entries.async_unload(listener.entry_id)


async def test_a_flow_that_cannot_go_on_is_closed(
    hass: HomeAssistant, client: Client, tmp_path: Path
) -> None:
    bus = BUSES[0]
    answers = bus.answers(_settings(tmp_path / "nothing"))
    with pytest.raises(DemoError, match="port"):
        await add_entry(client, DOMAIN, answers, lambda _step: None)
    del answers["port"]
    with pytest.raises(DemoError, match="no values"):
        await add_entry(client, DOMAIN, answers, lambda _step: None)
    assert not hass.config_entries.flow.async_progress()


def _entities(part: object) -> set[str]:
    """Return all entities of a dashboard."""
    if isinstance(part, dict):
        own = {part["entity"]} if "entity" in part else set()
        return own.union(*map(_entities, part.values()))
    if isinstance(part, list):
        return set().union(*map(_entities, part))
    return set()


# -- Stored data -----------------------------------------------------------------


@pytest.fixture
def time_zone() -> Iterator[None]:
    before = dt_util.get_default_time_zone()
    yield
    dt_util.set_default_time_zone(before)


@pytest.mark.usefixtures("time_zone")
def test_storage(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    prepare(Settings(folder=folder, port=8200))
    token = (folder / "token").read_text()
    assert (folder / "token").stat().st_mode & 0o777 == 0o600
    assert _stored(folder, "http")["stable"]["server_port"] == 8200
    assert _stored(folder, "http")["stable"]["server_host"] == ["127.0.0.1"]
    assert _stored(folder, "core.config")["currency"] == "EUR"
    assert len(_stored(folder, "onboarding")["done"]) == 4
    assert "http:" not in (folder / "config" / "configuration.yaml").read_text()
    link = folder / "config" / "custom_components" / DOMAIN
    assert (link / "manifest.json").exists()
    assert asyncio.run(_owner(folder, token)) == ["demo"]

    # Another port, and a checkout that was moved: the same owner and token.
    link.unlink()
    link.symlink_to(tmp_path)
    prepare(Settings(folder=folder, port=8201))
    assert _stored(folder, "http")["stable"]["server_port"] == 8201
    assert (folder / "token").read_text() == token
    assert (link / "manifest.json").exists()
    assert asyncio.run(_owner(folder, token)) == ["demo"]

    # Interrupted before the token was written: no second owner.
    (folder / "token").unlink()
    prepare(Settings(folder=folder, port=8201))
    again = (folder / "token").read_text()
    assert asyncio.run(_owner(folder, again)) == ["demo"]
    assert asyncio.run(_owner(folder, token)) == []


def _stored(folder: Path, key: str) -> dict:
    return json.loads((folder / "config" / ".storage" / key).read_text())["data"]


async def _owner(folder: Path, token: str) -> list[str]:
    """Return the logins of a token's user, which must be the only one and the owner."""
    hass = HomeAssistant(str(folder / "config"))
    hass.config_entries = ConfigEntries(hass, {})
    try:
        await hass.config_entries.async_initialize()
        dr.async_setup(hass)
        await asyncio.gather(dr.async_load(hass), er.async_load(hass))
        auth = await auth_manager_from_config(hass, [{"type": "homeassistant"}], [])
        refresh = auth.async_validate_access_token(token.strip())
        if refresh is None:
            return []
        users = [user for user in await auth.async_get_users() if user.is_active]
        assert users == [refresh.user]
        assert refresh.user.is_owner
        return [login.data["username"] for login in refresh.user.credentials]
    finally:
        await hass.async_stop(force=True)


# -- Programs --------------------------------------------------------------------

STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
print("started", child.pid, flush=True)
time.sleep(60)
"""


async def test_a_program_ends_with_all_its_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "PATIENCE", 0.1)
    log = tmp_path / "log"
    program = await Program.start(
        "stubborn", sys.executable, "-c", STUBBORN, log=log, cwd=tmp_path
    )
    await _until(lambda: program.printed("started"))
    assert "started" in program.log_tail()
    child = int(log.read_text().split()[1])
    os.kill(child, 0)
    await program.stop()
    assert not program.running
    await _until(lambda: not _alive(child))


async def _until(reached: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not reached():  # noqa: ASYNC110 - of another process
            await asyncio.sleep(0.02)


def _alive(pid: int) -> bool:
    try:
        # A zombie waits for its new parent; it does not run.
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
