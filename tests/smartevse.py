"""Helpers of the tests that run virtual SmartEVSEs in Home Assistant."""

import sys

import pytest

from tests.virtual import Car, SmartEvse

LIBRARY = "custom_components.evse_bus.evse.smartevse."
ACCESS = {"2.17": 0xA7, "2.20": 0xA7, "2.30": 0x0005, "2.30+": 0x0005}
"""The register of the access bit."""


def car() -> Car:
    """Return a car that does at once what it is told."""
    return Car(reaction=0.0, ramp=0.1)


def access_writes(box: SmartEvse) -> list[int]:
    """Return what was written to the access bit."""
    register = ACCESS[box.controller.dialect.name]
    return [one.values[0] for one in box.writes if one.register == register]


def shorten(monkeypatch: pytest.MonkeyPatch, **times: float) -> None:
    """Let times of the library be other ones, wherever it uses them, s."""
    used = set()
    for path, module in tuple(sys.modules.items()):
        if path.startswith(LIBRARY):
            for name in times.keys() & vars(module).keys():
                monkeypatch.setattr(module, name, times[name])
                used.add(name)
    assert used == times.keys()


def shorten_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave a later box alone for a tenth of the time: its own must run faster, too."""
    shorten(monkeypatch, QUIET=0.65)
