"""The orders of `sl`, and their answer codes (manual)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .ews_states import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from .ews_port import EwsPort


class Code:
    """Answers to `sl`."""

    OK, NO_SUCH_CAR, NO_SUCH_ORDER, CONFIG = 0, 1, 2, 3
    ENDED, CABLE, LOCK, CONTACTOR = 4, 5, 6, 7
    INITIALISING, NO_READER, RCD, BLOCKED = 9, 10, 11, 12


STOP, PRESS_START, START = 1, 2, 3
OPTIMISED_ON, OPTIMISED_OFF, STOP_OR_UNLOCK, LOCK = 4, 5, 6, 7

REFUSES_START = {
    Status.INIT: Code.INITIALISING,
    Status.CABLE_ERROR: Code.CABLE,
    Status.LOCK_ERROR: Code.LOCK,
    Status.UNLOCK_ERROR: Code.LOCK,
    Status.CONTACTOR_ON_ERROR: Code.CONTACTOR,
    Status.CONTACTOR_OFF_ERROR: Code.CONTACTOR,
    Status.CONFIG_ERROR: Code.CONFIG,
    Status.NO_READER: Code.NO_READER,
    Status.RCD: Code.RCD,
    Status.BLOCKED: Code.BLOCKED,
    Status.ENDED: Code.ENDED,
    Status.ABORTED: Code.ENDED,
}


def start_refusal(port: EwsPort) -> int:
    """Return the code for a start that is not possible now, or 0."""
    if port.server_paused:
        return Code.OK
    return REFUSES_START.get(port.status, Code.OK)


def execute(port: EwsPort, order: int, press_start: Callable[[EwsPort], None]) -> int:
    """Execute one order of `sl` and return the answer code."""
    if not STOP <= order <= LOCK:
        return Code.NO_SUCH_ORDER
    if not port.installation.enabled:
        return Code.CONFIG
    if port.status == Status.INIT:
        return Code.INITIALISING
    if order in (PRESS_START, START):
        refusal = start_refusal(port)
        if not refusal:
            press_start(port) if order == PRESS_START else port.release_start("sl 3")
        return refusal
    if order == LOCK:
        return _lock(port)
    if order == STOP:
        port.stop("sl 1")
    elif order == STOP_OR_UNLOCK:
        if port.active:
            port.pause()
        else:
            port.unlock("sl 6")
    else:
        port.optimised = order == OPTIMISED_ON
    return Code.OK


def _lock(port: EwsPort) -> int:
    if not port.has_lock:
        return Code.CONFIG
    if port.status == Status.RCD:
        return Code.RCD
    if not port.cable_in or port.status in (Status.LOCK_ERROR, Status.UNLOCK_ERROR):
        return Code.LOCK
    port.lock_manually()
    return Code.OK
