"""The demo: its first start against the real API, and its pure parts.

Left to be tried by hand: a whole Home Assistant with its frontend.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
import json
import os
from pathlib import Path
import socket
import sys

from homeassistant.auth import auth_manager_from_config
from homeassistant.config_entries import ConfigEntries
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr, entity_registry as er
from homeassistant.setup import async_setup_component
from homeassistant.util import dt as dt_util
import pytest
from pytest_homeassistant_custom_component.typing import ClientSessionGenerator

from demo import home, processes
from demo.__main__ import alone, check_port
from demo.buses import BUSES
from demo.client import Client
from demo.dashboard import dashboard
from demo.flow import add_entry, fill
from demo.listing import DOMAIN, ListedBus, list_buses
from demo.processes import Program
from demo.settings import DemoError, Settings, from_environment
from demo.storage import prepare

from .virtual import AblBox, Car, EvboxChargePoint, Module, SmartEvse, VirtualBus

# -- The first start, without frontend -------------------------------------------


@pytest.fixture
async def client(
    hass: HomeAssistant, hass_client: ClientSessionGenerator, hass_access_token: str
) -> AsyncIterator[Client]:
    for component in ("http", "websocket_api", "api", "config"):
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
    return Settings(folder=folder, port=8123)


@pytest.mark.usefixtures("quick_search")
async def test_buses_are_added_once_and_all_is_on_the_dashboard(
    hass: HomeAssistant, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[list[ListedBus]] = []

    async def show(
        _client: Client, _settings: Settings, buses: list[ListedBus]
    ) -> None:
        saved.append(buses)

    monkeypatch.setattr(home, "_show_dashboard", show)
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
    with (
        VirtualBus.pty(*points, link=str(settings.link("evbox"))),
        VirtualBus.pty(*boxes, link=str(settings.link("abl"))),
        VirtualBus.pty(polled, link=str(settings.link("smartevse"))) as single,
        VirtualBus.pty(*slaves, link=str(settings.link("smartevse_master"))) as shared,
    ):
        await home.furnish(client, settings)
        # The chargers themselves follow what the demo begins with.
        assert [point.limits_in_force for point in points] == [(32.0,) * 3] * 2
        assert [round(box.ic_amps) for box in boxes] == [16, 10, 13]
        await single.wait_for_async(lambda: polled.pilot_current == 16, 15)
        # Two cars share what is there.
        await shared.wait_for_async(
            lambda: [slave.pilot_current for slave in slaves] == [12.5, 12.5], 15
        )

        mine = {"entity_id": "number.garage_charging_current", "value": 9}
        await client.post("services/number/set_value", mine)

        await home.furnish(client, settings)
        assert round(boxes[0].ic_amps) == 9
        entries = hass.config_entries.async_entries(DOMAIN)
        assert len(entries) == len(BUSES)
        assert not hass.config_entries.flow.async_progress()

        assert saved[0] == saved[1]
        names = [charger.name for bus in saved[0] for charger in bus.chargers]
        assert sorted(names) == sorted(
            name for bus in BUSES for name in bus.names.values()
        )
        shown = _entities(dashboard(saved[0]))
        assert {
            f"number.{name}_charging_current"
            for name in ("garage", "guests", "courtyard", "barn_left")
        } < shown
        assert "sensor.courtyard_offered_current" in shown
        assert any(entity.endswith("_shared_supply") for entity in shown)
        assert "sensor.car_park_south_module_4_power" in shown
        assert {entity for entity in shown if hass.states.get(entity) is None} == set()
        for entry in entries:
            assert await hass.config_entries.async_unload(entry.entry_id)


async def test_a_flow_that_cannot_go_on_is_closed(
    hass: HomeAssistant, client: Client, tmp_path: Path
) -> None:
    bus = BUSES[0]
    answers = bus.answers(str(tmp_path / "nothing"))
    with pytest.raises(DemoError, match="port"):
        await add_entry(client, DOMAIN, answers, lambda _step: None)
    del answers["port"]
    with pytest.raises(DemoError, match="no answer"):
        await add_entry(client, DOMAIN, answers, lambda _step: None)
    assert not hass.config_entries.flow.async_progress()


def _entities(part: object) -> set[str]:
    """Return all entities that a dashboard names, wherever."""
    if isinstance(part, dict):
        own = {part["entity"]} if "entity" in part else set()
        return own.union(*map(_entities, part.values()))
    if isinstance(part, list):
        return set().union(*map(_entities, part))
    return set()


# -- What Home Assistant finds at its start --------------------------------------


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
    """Return the logins of a token's user, if it is the one and only and the owner."""
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


async def test_a_program_ends_with_all_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "PATIENCE", 0.1)
    log = tmp_path / "log"
    program = await Program.start(
        "stubborn", sys.executable, "-c", STUBBORN, log=log, cwd=tmp_path
    )
    await _until(lambda: program.printed("started"))
    assert "started" in program.last_words()
    child = int(log.read_text().split()[1])
    os.kill(child, 0)
    await program.stop()
    assert not program.running
    await _until(lambda: not _alive(child))


async def _until(reached: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not reached():  # noqa: ASYNC110 - another process's doing
            await asyncio.sleep(0.02)


def _alive(pid: int) -> bool:
    try:
        # A zombie waits for whoever adopted it; it does not run.
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


# -- What can be in the way ------------------------------------------------------


def test_one_demo_in_one_folder(tmp_path: Path) -> None:
    settings = _settings(tmp_path / "state")
    with (
        alone(settings),
        pytest.raises(DemoError, match="runs already"),
        alone(settings),
    ):
        pytest.fail("two demos share a folder")
    with alone(settings):
        pass
    # The ports that Home Assistant has stored would not be there.
    settings.folder.rename(tmp_path / "moved")
    with (
        pytest.raises(DemoError, match="made in another place"),
        alone(_settings(tmp_path / "moved")),
    ):
        pytest.fail("a moved folder is used")


@pytest.mark.usefixtures("socket_enabled")
def test_a_taken_port_is_told(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        settings = Settings(folder=tmp_path, port=server.getsockname()[1])
        with pytest.raises(DemoError, match="is taken by another program"):
            check_port(settings)
    check_port(settings)


# -- Pure parts ------------------------------------------------------------------


def test_a_form_is_filled_in_as_a_person_leaves_it() -> None:
    fields = [
        {"name": "typed", "default": 1},
        {"name": "suggested", "default": 2, "description": {"suggested_value": 3}},
        {"name": "default", "default": 4},
        {"name": "empty"},
        {
            "name": "more",
            "type": "expandable",
            "schema": [{"name": "inner", "default": 5}, {"name": "other"}],
        },
    ]
    assert fill(fields, {"typed": 6, "more": {"other": 7}}) == {
        "typed": 6,
        "suggested": 3,
        "default": 4,
        "more": {"inner": 5, "other": 7},
    }


def test_listing_leaves_out_what_cannot_be_shown() -> None:
    def entity(unique_id: str, **more: object) -> dict[str, object]:
        return {
            "entity_id": f"sensor.{unique_id.lower()}",
            "unique_id": unique_id,
            "platform": DOMAIN,
            "config_entry_id": "BUS",
            "config_subentry_id": "ONE",
            "device_id": "d1",
            "disabled_by": None,
        } | more

    devices = [
        {
            "id": "d0",
            "name": "Bus",
            "name_by_user": None,
            "identifiers": [[DOMAIN, "BUS"]],
        },
        {
            "id": "d1",
            "name": "Box",
            "name_by_user": "Mine",
            "identifiers": [[DOMAIN, "ONE"]],
        },
    ]
    entities = [
        entity("BUS_connected", config_subentry_id=None),
        entity("ONE_charging_current"),
        entity("ONE_requests", disabled_by="integration"),
        entity("ONE_2_current_l1"),
        entity("ONE_1_current_l1"),
        entity("ONE_power", platform="other"),
    ]
    (bus,) = list_buses(entities, devices)
    assert (bus.name, bus.entities) == ("Bus", {"connected": "sensor.bus_connected"})
    (charger,) = bus.chargers
    assert charger.name == "Mine"
    assert charger.entities == {"charging_current": "sensor.one_charging_current"}
    assert list(charger.connectors) == [1, 2]
    assert (
        charger.connectors[2].find("power", "current_l1") == "sensor.one_2_current_l1"
    )


def test_a_dashboard_of_nothing_has_no_empty_cards() -> None:
    (view,) = dashboard([])["views"]
    assert [card["type"] for card in view["sections"][0]["cards"]] == ["heading"]


@pytest.mark.parametrize("port", ["0", "65536", "-1", "8123 ", "http", "²"])
def test_a_port_that_is_none(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EVSE_BUS_DEMO_PORT", port)
    with pytest.raises(DemoError, match="no TCP port"):
        from_environment()


def test_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EVSE_BUS_DEMO_PORT", "")
    monkeypatch.setenv("EVSE_BUS_DEMO_DIR", str(tmp_path))
    settings = from_environment()
    assert (settings.url, settings.folder) == ("http://127.0.0.1:8123", tmp_path)
