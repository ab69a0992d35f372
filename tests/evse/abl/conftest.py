"""What the ABL tests share."""

import pytest

from custom_components.evse_bus.evse import bus


@pytest.fixture(autouse=True)
def short_reopening(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a lost port be looked for sooner."""
    monkeypatch.setattr(bus, "REOPEN_FIRST", 0.1)
