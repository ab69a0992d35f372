"""Status bytes, installation and history of a charging port."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .ews_lock import Unlocking


class Status:
    """The status bytes."""

    NOT_CONNECTED, SEARCHING, WAITING = 0x00, 0x10, 0x30
    CHARGING, CHARGING_OPTIMISED, PAUSE, PAUSE_OPTIMISED = 0x40, 0x41, 0x42, 0x43
    ENDED, ABORTED = 0x50, 0x60
    CABLE_ERROR, LOCK_ERROR, UNLOCK_ERROR = 0xA0, 0xA1, 0xA2
    CONTACTOR_ON_ERROR, CONTACTOR_OFF_ERROR, CONFIG_ERROR = 0xA3, 0xA4, 0xA5
    NO_READER, RCD, BLOCKED, INIT = 0xA7, 0xA8, 0xA9, 0xF0

    ACTIVE = frozenset({0x40, 0x41, 0x42, 0x43})
    OVER = frozenset({0x50, 0x60})
    IDLE = frozenset({0x00, 0x10, 0x30, 0xA0, 0xA5, 0xA7, 0xA9})
    PLUGGED = frozenset({0x10, 0x30, 0xA0})


@dataclass
class Installation:
    """The parameters of a port; kept up to date by the box."""

    enabled: bool = True
    jumper: int = 32
    limit: int = 0
    fixed_cable: bool = False
    mode1: bool = False
    fan: bool = False
    config_error: bool = False
    reader_missing: bool = False
    blocked: bool = False


@dataclass
class PortHistory:
    """History of a port for tests, in device time."""

    statuses: list[tuple[float, int]] = field(default_factory=list)
    starts: list[tuple[float, str]] = field(default_factory=list)
    unlockings: list[Unlocking] = field(default_factory=list)
    unlocked_under_power: int = 0
    highest_offer: int = 0
    highest_draw: float = 0.0
