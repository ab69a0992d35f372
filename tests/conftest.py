"""What every test needs.

Network: the test plugin blocks IP sockets. A test (or fixture) that serves or
dials 127.0.0.1 asks for the fixture ``socket_enabled``; ptys are not blocked.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import sys
from unittest.mock import PropertyMock, patch

from hypothesis import settings
import pytest
from pytest_homeassistant_custom_component.syrupy import HomeAssistantSnapshotExtension
from syrupy.assertion import SnapshotAssertion

# Home Assistant finds custom integrations by importing the package
# custom_components. The test plugin has one of its own: ours must be first.
import custom_components
from custom_components.evse_bus.evse.protocols import PROTOCOLS

assert Path(custom_components.__file__).parents[1] == Path(__file__).parents[1]

# How long one example takes says more about the machine than about the code.
settings.register_profile("evse_bus", deadline=None)
settings.load_profile("evse_bus")


@pytest.fixture(autouse=True)
def integration_can_load(request: pytest.FixtureRequest) -> None:
    """Let Home Assistant find the integration, in the tests that run it."""
    if "hass" not in request.fixturenames:
        return
    request.getfixturevalue("enable_custom_integrations")
    # Our dependency `usb` would look at this machine's real ports. The other one,
    # `network`, is set up as it is: the test plugin shows it one adapter, 10.10.10.10.
    request.getfixturevalue("hass").config.components.add("usb")


@pytest.fixture
def quick_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait less for chargers that are not there; searches are the same otherwise."""
    abl = PROTOCOLS["abl"]
    timing = replace(abl.timing, reply_timeout=0.1)
    monkeypatch.setitem(PROTOCOLS, "abl", replace(abl, timing=timing))
    evbox_scan = "custom_components.evse_bus.evse.evbox.scan"
    monkeypatch.setattr(sys.modules[evbox_scan], "RETRY_PAUSE", 0.2)
    for key in ("smartevse", "smartevse_master"):
        smartevse = PROTOCOLS[key]
        timing = replace(smartevse.timing, reply_timeout=0.12)
        monkeypatch.setitem(PROTOCOLS, key, replace(smartevse, timing=timing))
    ews = PROTOCOLS["ews"]
    timing = replace(ews.timing, reply_timeout=0.25)
    monkeypatch.setitem(PROTOCOLS, "ews", replace(ews, timing=timing))
    master = "custom_components.evse_bus.evse.smartevse.master"
    monkeypatch.setattr(sys.modules[master], "LISTENING", 0.3)


@pytest.fixture
def not_set_up() -> Iterator[None]:
    """Let flows create entries that are then not set up."""
    init = "custom_components.evse_bus"
    with (
        patch(f"{init}.async_setup_entry", return_value=True),
        patch(f"{init}.async_unload_entry", return_value=True),
    ):
        yield


@pytest.fixture
def snapshot(snapshot: SnapshotAssertion) -> SnapshotAssertion:
    """Return snapshots as Home Assistant writes them, without changing ids."""
    return snapshot.use_extension(HomeAssistantSnapshotExtension)


@pytest.fixture
def all_entities_enabled() -> Iterator[None]:
    """Enable also the entities that are disabled unless somebody wants them."""
    with patch(
        "homeassistant.helpers.entity.Entity.entity_registry_enabled_default",
        new_callable=PropertyMock(return_value=True),
    ):
        yield
