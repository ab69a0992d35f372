"""The table of `PauseTracker`: each event, and the pause after it."""

from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.ews.permission import Pause, PauseTracker
from custom_components.evse_bus.evse.ews.timing import SETTLING
from custom_components.evse_bus.evse.ews.wire.status import PortStatus, decode_ports

from .wire import PORTS

CHARGING = replace(decode_ports(PORTS)[0], state=0x40, locked=True)
PAUSED = replace(CHARGING, state=0x42)
ENDED = replace(CHARGING, state=0x50)
SENT_AT = 100.0
SETTLED = SENT_AT + SETTLING


def paused(status: PortStatus = PAUSED) -> PauseTracker:
    """Return a tracker of a pause of ours that was confirmed and followed."""
    tracker = PauseTracker()
    tracker.on_sent(CHARGING, SENT_AT)
    tracker.pause = Pause.OURS
    tracker.for_current = True
    tracker.on_status(status, SETTLED, has_lock=True)
    assert tracker.pause is Pause.OURS
    assert tracker.for_current
    return tracker


def test_pause_of_an_earlier_run_is_possible() -> None:
    tracker = PauseTracker()
    assert tracker.pause is Pause.POSSIBLE
    assert not tracker.was_sent
    tracker.on_status(PAUSED, 0.0, has_lock=True)
    assert tracker.pause is Pause.POSSIBLE
    tracker.on_status(CHARGING, 0.0, has_lock=True)
    assert tracker.pause is Pause.NONE


def test_sent_order_is_a_possible_pause() -> None:
    tracker = PauseTracker()
    tracker.end()
    tracker.on_sent(CHARGING, SENT_AT)
    assert tracker.pause is Pause.POSSIBLE
    assert tracker.was_sent


@pytest.mark.parametrize("state", [0x40, 0x41])
def test_port_has_time_to_follow(state: int) -> None:
    status = replace(CHARGING, state=state)
    tracker = PauseTracker()
    tracker.on_sent(CHARGING, SENT_AT)
    tracker.on_status(status, SETTLED - 0.1, has_lock=True)
    assert tracker.pause is Pause.POSSIBLE
    tracker.on_status(status, SETTLED, has_lock=True)
    assert tracker.pause is Pause.NONE


@pytest.mark.parametrize("state", range(0x100))
def test_pause_stands_in_three_states(state: int) -> None:
    tracker = paused()
    tracker.on_status(replace(PAUSED, state=state), SETTLED, has_lock=True)
    stands = state in {0x42, 0x43, 0x50}
    assert tracker.pause is (Pause.OURS if stands else Pause.NONE)
    assert tracker.for_current is stands


@pytest.mark.parametrize("status", [PAUSED, ENDED])
def test_unlocked_plug_ends_it(status: PortStatus) -> None:
    tracker = paused(status)
    tracker.on_status(replace(status, locked=None), SETTLED, has_lock=True)
    assert tracker.pause is Pause.OURS
    tracker = paused(status)
    tracker.on_status(replace(status, locked=False), SETTLED, has_lock=False)
    assert tracker.pause is Pause.NONE


@pytest.mark.parametrize("has_lock", [True, False])
def test_ended_charge_with_a_free_plug_is_no_pause(*, has_lock: bool) -> None:
    tracker = PauseTracker()
    tracker.on_status(replace(ENDED, locked=False), 0.0, has_lock=has_lock)
    assert tracker.pause is (Pause.NONE if has_lock else Pause.POSSIBLE)


@pytest.mark.parametrize("counter", ["session_time", "session_energy"])
def test_counters_that_go_back_make_it_possible(counter: str) -> None:
    tracker = paused()
    lower = replace(PAUSED, **{counter: getattr(PAUSED, counter) - 1})  # type: ignore[arg-type]
    tracker.on_status(lower, SETTLED, has_lock=True)
    assert tracker.pause is Pause.POSSIBLE
    assert not tracker.for_current


def test_restart_makes_it_possible() -> None:
    tracker = paused()
    tracker.doubt()
    assert tracker.pause is Pause.POSSIBLE
    assert not tracker.for_current
    tracker.end()
    tracker.doubt()
    assert tracker.pause is Pause.NONE


def test_start_ends_it() -> None:
    tracker = paused()
    tracker.on_started()
    assert tracker.pause is Pause.NONE
    assert not tracker.was_sent
    assert not tracker.is_settling(SENT_AT)
    # The limit that started it has nothing left to end, by the next status.
    tracker.on_status(CHARGING, SETTLED, has_lock=True)
    assert not tracker.for_current
