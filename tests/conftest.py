"""What every test needs.

Time: async tests run in simulated time (`tests.simulated_time`), in which virtual
buses and boxes live on the loop of the test. A test of ptys, sockets or programs at
their real pace is marked ``real_time``, and ``slow`` if that takes long.

Network: the test plugin blocks IP sockets. A test (or fixture) that serves or
dials 127.0.0.1 asks for the fixture ``socket_enabled``; ptys are not blocked.
"""

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import sys
from unittest.mock import PropertyMock, patch

from homeassistant import runner
from hypothesis import settings
import pytest
from pytest_homeassistant_custom_component.syrupy import HomeAssistantSnapshotExtension
from syrupy.assertion import SnapshotAssertion

# Home Assistant finds custom integrations by importing the package
# custom_components. The test plugin has one of its own: ours must be first.
import custom_components
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests import simulated_ports
from tests.simulated_time import SimulatedLoop

assert Path(custom_components.__file__).parents[1] == Path(__file__).parents[1]

# How long one example takes says more about the machine than about the code.
settings.register_profile("evse_bus", deadline=None)
settings.load_profile("evse_bus")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give slow tests, and no others, more time before they count as hung."""
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(240))


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
def _function_scoped_runner(request: pytest.FixtureRequest) -> Iterator[asyncio.Runner]:
    """Run tests in simulated time; in place of pytest-asyncio's fixture.

    Its own hook for other loops would make the loop of the session anew for each test.
    """
    real = request.node.get_closest_marker("real_time")
    factory = asyncio.new_event_loop if real else SimulatedLoop
    with asyncio.Runner(loop_factory=factory) as made:
        asyncio.set_event_loop(made.get_loop())
        yield made
    asyncio.set_event_loop(None)


@pytest.fixture(autouse=True)
async def configure_event_loop() -> None:
    """Configure a loop as Home Assistant does, but leave it its own clock."""
    loop = asyncio.get_running_loop()
    runner.configure_event_loop(loop)
    if isinstance(loop, SimulatedLoop):
        del loop.time


@pytest.fixture(autouse=True)
def direct_ports() -> Iterator[None]:
    """Let the library open the ports of virtual buses that live on its loop."""
    with simulated_ports.direct_ports():
        yield


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
