"""Invariants of a port under any sequence of orders, events and defects."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st

from .car import Car
from .ews_orders import execute
from .ews_port import EwsPort
from .ews_states import Status

STATUSES = {
    *(0x00, 0x10, 0x30, 0x40, 0x41, 0x42, 0x43, 0x50, 0x60),
    *(0xA0, 0xA1, 0xA2, 0xA3, 0xA4, 0xA5, 0xA7, 0xA8, 0xA9, 0xF0),
}
EVENTS = (
    *("plug", "leave", "finish", "request", "wait", "wait", "wait", "power", "reset"),
    *("rcd", "jam lock", "jam unlock", "free", "weld", "open", "whole", "pull"),
    *(1, 2, 3, 3, 4, 5, 6, 6, 7),
)


def do(port: EwsPort, car: Car, event: str | int, now: float) -> None:
    if isinstance(event, int):
        execute(port, event, lambda asked: asked.release_start("key"))
    elif event == "rcd":
        port.rcd_tripped = not port.rcd_tripped
    elif event.startswith("jam"):
        port.lock.jammed = event[4:]  # type: ignore[assignment]
    elif event in ("power", "reset"):
        port.power_off(now, restart=True, mains=event == "power")
        port.initialise(now, 1.0)
    else:
        {
            "plug": car.plug_in,
            "leave": car.leave,
            "finish": car.finish,
            "request": car.request,
            "pull": port.pull_cable,
            "free": lambda: setattr(port.lock, "jammed", ""),
            "weld": lambda: setattr(port.relay, "broken", "closed"),
            "open": lambda: setattr(port.relay, "broken", "open"),
            "whole": lambda: setattr(port.relay, "broken", ""),
            "wait": lambda: None,
        }[event]()


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.sampled_from(EVENTS), max_size=40),
    st.booleans(),
    st.sampled_from([0x50, 0x42]),
)
def test_no_sequence_breaks_the_rules(
    events: list[str | int],
    fixed: bool,  # noqa: FBT001 - hypothesis gives it
    shown: int,
) -> None:
    car = Car()
    port = EwsPort(1, car)
    port.installation.fixed_cable = fixed
    port.pause_status = shown  # type: ignore[assignment]
    now = 0.0
    port.step(now)
    for event in events:
        do(port, car, event, now)
        for _ in range(4):
            now += 0.15
            port.step(now)
            welded = port.relay.broken == "closed"
            assert port.status in STATUSES
            if port.contactor and not welded:
                assert port.status in (Status.CHARGING, Status.CHARGING_OPTIMISED)
                assert port.locked or not port.has_lock
                assert car.plugged
            if port.status in (0x40, 0x41):
                assert port.contactor
            if port.server_paused:
                assert port.locked or not port.has_lock
            assert max(port.currents) <= port.ceiling
            before, status = len(port.history.statuses), port.status
            port.step(now)
            assert (len(port.history.statuses), port.status) == (before, status)
    unlocked = port.history.unlocked_under_power
    assert not unlocked or "weld" in events
