"""What the ABL tests share."""

import pytest

from custom_components.evse_bus.evse import bus
from custom_components.evse_bus.evse.abl.dialogue import Dialogue, Pauses


@pytest.fixture(autouse=True)
def short_reopening(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a lost port be looked for sooner."""
    monkeypatch.setattr(bus, "REOPEN_FIRST", 0.1)


@pytest.fixture
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the virtual car wake, and the virtual box start, sooner than real ones."""
    short = Pauses(wake=0.3, setup=0.03, boot=0.08, retry=0.2, verify=0.05)
    monkeypatch.setattr(Dialogue, "pauses", short)
