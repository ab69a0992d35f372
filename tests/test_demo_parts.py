"""The parts of the demo: obstacles to a start, and pure functions."""

from pathlib import Path
import socket

import pytest

from demo import ports
from demo.__main__ import alone
from demo.automation import answer_start_requests
from demo.dashboard import dashboard
from demo.flow import fill
from demo.listing import DOMAIN, ListedBus, ListedCharger, Part, list_buses
from demo.ports import check_port, with_listen_port
from demo.settings import DemoError, Settings, from_environment


def _settings(folder: Path) -> Settings:
    return Settings(folder=folder, port=8123)


# -- Obstacles to a start ------------------------------------------------------


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
    # The ports that Home Assistant has stored would not exist.
    settings.folder.rename(tmp_path / "moved")
    with (
        pytest.raises(DemoError, match="created in another place"),
        alone(_settings(tmp_path / "moved")),
    ):
        pytest.fail("a moved folder is used")


@pytest.mark.usefixtures("socket_enabled")
def test_a_taken_port_raises(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        settings = Settings(folder=tmp_path, port=server.getsockname()[1])
        with pytest.raises(DemoError, match="is taken by another program"):
            check_port(settings)
    check_port(settings)


@pytest.mark.usefixtures("socket_enabled")
def test_the_port_that_boxes_dial_is_chosen_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = _settings(tmp_path)
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        socket.create_server(("127.0.0.1", 0)) as other,
    ):
        first, second = taken.getsockname()[1], other.getsockname()[1]
        monkeypatch.setattr(ports, "LISTEN_PORTS", [first, second])
        with pytest.raises(DemoError, match="no port is free"):
            with_listen_port(settings)
        other.close()
        assert with_listen_port(settings).listen_port == second
    # It is kept, whichever is free now.
    assert with_listen_port(settings).listen_port == second
    with (
        socket.create_server(("127.0.0.1", second)),
        pytest.raises(DemoError, match=f"{second}, .* is taken by another program"),
    ):
        with_listen_port(settings)
    # A start that was interrupted while it was being kept.
    (tmp_path / "listen-port").write_text("")
    assert with_listen_port(settings).listen_port == first


# -- Pure parts ------------------------------------------------------------------


def test_a_form_is_filled_in_with_suggestions_and_defaults() -> None:
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


def test_listing_leaves_out_disabled_entities() -> None:
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


def test_each_start_request_is_allowed_at_its_own_port() -> None:
    ports = {
        number: Part(
            f"Port {number}",
            {
                "start_requested": f"binary_sensor.box_{number}_start",
                "charging_allowed": f"switch.box_{number}_allowed",
            },
        )
        for number in (1, 2)
    }
    box = ListedCharger("Box", {}, ports)
    other = ListedCharger("Other", {"charging_allowed": "switch.other"})
    automation = answer_start_requests([ListedBus("Bus", {}, [box, other])])
    assert automation is not None
    assert {one["entity_id"]: one["id"] for one in automation["triggers"]} == {
        "binary_sensor.box_1_start": "switch.box_1_allowed",
        "binary_sensor.box_2_start": "switch.box_2_allowed",
    }
    assert answer_start_requests([ListedBus("Bus", {}, [other])]) is None


def test_a_dashboard_without_buses_has_no_empty_cards() -> None:
    (view,) = dashboard([])["views"]
    assert [card["type"] for card in view["sections"][0]["cards"]] == ["heading"]


@pytest.mark.parametrize("port", ["0", "65536", "-1", "8123 ", "http", "²"])
def test_an_invalid_port_raises(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EVSE_BUS_DEMO_PORT", port)
    with pytest.raises(DemoError, match="no TCP port"):
        from_environment()


def test_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EVSE_BUS_DEMO_PORT", "")
    monkeypatch.setenv("EVSE_BUS_DEMO_DIR", str(tmp_path))
    settings = from_environment()
    assert (settings.url, settings.folder) == ("http://127.0.0.1:8123", tmp_path)
