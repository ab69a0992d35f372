"""The events that an EWS-Box does not send: derived from the status of a port.

Source: manual, 3.2.4 (``rc``).
"""

from ..events import ChargeEnded, StartRequested
from .readings import session_result
from .wire.status import PortStatus


def start_requested(port: int, status: PortStatus) -> StartRequested:
    """Return the event of a start request, with the card that is logged in."""
    card = status.card
    return StartRequested(
        port=port,
        optimised=status.optimised,
        group=None if card is None else card.group,
        number=None if card is None else card.number,
    )


def charge_ended(
    port: int, running: PortStatus | None, status: PortStatus
) -> ChargeEnded:
    """Return the event of the end of a charge.

    ``running``: the last status while it was under way, ``status``: the first one
    after it. The manual does not define when the box takes a charge over as its last
    one, nor when the counters of the session are reset (docs/ews-protocol.md).
    """
    time, energy = status.last_time, status.last_energy
    if running is not None and (time, energy) == (
        running.last_time,
        running.last_energy,
    ):
        # Not taken over (yet), or by chance equal to the charge before it.
        was_reset = (
            status.session_time < running.session_time
            or status.session_energy < running.session_energy
        )
        counted = running if was_reset else status
        time, energy = counted.session_time, counted.session_energy
    result = session_result(status.result)
    return ChargeEnded(port=port, result=result, energy=energy, duration=time)
