"""The state of one port of an EWS-Box: its reading, limits, capabilities and events."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Final, override

from ..ceiling import CeilingPause
from ..events import ChargeStarted, Event, EventListener, port_of
from ..model import Capability, FailSafe, Fault, Limits, Orders, PauseReason
from .config import EwsPortConfig
from .events import charge_ended, start_requested
from .limit import Limiter
from .permission import Pause, Permission
from .port import BoxPort
from .readings import (
    asks_for_start,
    capabilities_of,
    charger_info,
    charger_reading,
    limits_of,
)
from .wire.parameters import SystemMode
from .wire.states import AFTER_OUR_PAUSE, RUNNING
from .wire.status import PortStatus

IMPLAUSIBLE_REPLIES: Final = 3
"""Implausible replies in a row after which older readings no longer count."""


def _counted(status: PortStatus) -> tuple[int, ...]:
    """Return what changes with each charge, and does not in a pause of one."""
    return (
        status.state,
        status.session_energy,
        status.total_energy,
        status.last_time,
        status.last_energy,
    )


class EwsReader(BoxPort):
    """One port, as far as it is read."""

    def __init__(self, config: EwsPortConfig, orders: Orders) -> None:
        """Take the configuration; the box is unknown before it answers."""
        super().__init__(config, orders)
        self.permission = Permission(self)
        self.limiter = Limiter(self)
        self._session = False
        """A charge is under way, pauses of ours included."""
        self._last_running: PortStatus | None = None
        """The last status in which one was under way."""
        self._implausible = 0
        self._restarts = 0

    # -- Properties --------------------------------------------------------------------

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        known = capabilities_of(self.number, self.box.installation)
        if self.config.order_lifetime is not None:
            # Not a value of the box: it counts when orders are not renewed.
            known |= {Capability.FAIL_SAFE_CURRENT}
        return known

    @property
    @override
    def limits(self) -> Limits:
        return limits_of(
            self.number,
            self.config.installation_limit,
            self.box.status,
            self.box.installation,
            self.last_status,
        )

    @property
    @override
    def waits_for_current(self) -> bool:
        return self.permission.waits_for_current

    @property
    @override
    def hindrance(self) -> PauseReason | None:
        status = self.last_status
        if status is not None and self.permission.has_ended(status):
            return PauseReason.CHARGE_ENDED
        return super().hindrance

    @property
    @override
    def fail_safe(self) -> FailSafe | None:
        installation = self.box.installation
        if installation is None or installation.mode is None:
            return None
        has_server = SystemMode.SERVER in installation.mode
        return FailSafe.ENDS if has_server else FailSafe.NOTHING

    @property
    @override
    def fingerprint(self) -> tuple[object, ...]:
        box = self.box.status
        # Its clock runs, which is no change.
        box = None if box is None else replace(box, clock=None)
        return (*super().fingerprint, self.last_status, self._details, box)

    @property
    def _details(self) -> tuple[object, ...]:
        """Return the last ``rd`` as far as it is about this port."""
        details = self.box.details
        if details is None:
            return ()
        pairs = (getattr(details, one.name) for one in fields(details))
        return tuple(pair[self.number - 1] for pair in pairs)

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self.limiter.forget()

    # -- Its visit -------------------------------------------------------------------

    @property
    @override
    def may_be_paused(self) -> bool:
        status, pause = self.last_status, self.permission.pause_state
        is_pause = status is not None and status.state in AFTER_OUR_PAUSE
        return is_pause and pause is not Pause.NONE

    @property
    @override
    def visit(self) -> str | None:
        status = self.last_status
        if status is None or not status.session_energy:
            # Another visit without energy would look the same.
            return None
        return " ".join(map(str, (status.session_time, *_counted(status))))

    @override
    def continues(self, pause: CeilingPause) -> bool:
        status, box = self.last_status, self.box.status
        if status is None or box is None or pause.visit is None:
            return False
        # Nothing flows in a pause, and each other charge would be counted.
        begun, _, counted = pause.visit.partition(" ")
        return (
            pause.serial == box.serial
            and counted == " ".join(map(str, _counted(status)))
            and begun.isdecimal()
            and status.session_time >= int(begun)
        )

    # -- Its reading -----------------------------------------------------------------

    @override
    def on_status(self, before: PortStatus | None, status: PortStatus) -> None:
        if self.box.restarts != self._restarts:
            self._restarts = self.box.restarts
            self.limiter.forget()
            # Its restart flag may stay set for long: no proof that the pause is over.
            self.permission.doubt()
        self.permission.on_status(status)
        unproved = self.governance.unproved
        if unproved is not None and self.continues(unproved):
            self.permission.adopt_pause()
        self._publish_events(before, status)
        self._implausible = 0
        self.notice(Fault.IMPLAUSIBLE, present=False)
        self._update_info()
        if (snapshot := self.box.snapshot) is not None:
            is_paused = self.permission.is_paused(status)
            self.reading = charger_reading(self.number, snapshot, paused=is_paused)
        if self.fingerprint != self.last_fingerprint:
            self.updated()

    def on_implausible(self) -> None:
        """Count an implausible reply; too many in a row make the port unavailable."""
        self._implausible += 1
        if self._implausible >= IMPLAUSIBLE_REPLIES:
            self._implausible = 0
            self.notice(Fault.IMPLAUSIBLE, present=True)
            self.set_unavailable("implausible replies only")

    def _update_info(self) -> None:
        box, info = self.box.status, self.info
        if box is None:
            return
        if info is None or (info.serial, info.firmware) != (box.serial, box.firmware):
            self.info = charger_info(box)

    # -- Events ----------------------------------------------------------------------

    def subscribe_events(self, listener: EventListener) -> Callable[[], None]:
        """Call back for each event of this port or of its box.

        Returns a function that ends it.
        """

        def filtered(event: Event) -> None:
            if port_of(event) in (None, self.number):
                listener(event)

        return self.box.events.subscribe(filtered)

    def _publish_events(self, before: PortStatus | None, status: PortStatus) -> None:
        events = self.box.events
        requested = before is not None and asks_for_start(before)
        if asks_for_start(status) and not requested:
            events.publish(start_requested(self.number, status))
        was_on = self._session
        is_on = self._session = self.permission.is_session(status, before=was_on)
        if status.state in RUNNING:
            self._last_running = status
        if was_on and not is_on:
            events.publish(charge_ended(self.number, self._last_running, status))
        elif is_on and not was_on and before is not None:
            # Without a status before it, the charge may have begun earlier.
            events.publish(ChargeStarted(port=self.number))
