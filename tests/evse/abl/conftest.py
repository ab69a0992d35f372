"""Fixtures of the ABL tests."""

import pytest

from custom_components.evse_bus.evse import recovery
from custom_components.evse_bus.evse.abl.config import Pauses
from custom_components.evse_bus.evse.abl.reader import AblReader


@pytest.fixture(autouse=True)
def short_reopening(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reopen a lost port sooner."""
    monkeypatch.setattr(recovery, "PAUSES", (0.1,))


@pytest.fixture
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wake the virtual car, and start the virtual box, sooner than real ones."""
    short = Pauses(wake=0.3, settings=0.03, boot=0.08, retry=0.2, verify=0.05)
    monkeypatch.setattr(AblReader, "pauses", short)
