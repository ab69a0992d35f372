"""What every test needs.

Network: the test plugin blocks IP sockets. A test (or fixture) that serves or
dials 127.0.0.1 asks for the fixture ``socket_enabled``; ptys are not blocked.
"""

from pathlib import Path

from hypothesis import settings
import pytest

# Home Assistant finds custom integrations by importing the package
# custom_components. The test plugin has one of its own: ours must be first.
import custom_components

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
    # Our dependency `usb` would look at this machine's real ports.
    request.getfixturevalue("hass").config.components.add("usb")
