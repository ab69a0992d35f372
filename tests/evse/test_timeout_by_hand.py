"""A reply time-out that the user has typed in."""

from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.protocols import PROTOCOLS

BY_HAND = [key for key, protocol in PROTOCOLS.items() if not protocol.dials_in]


@pytest.mark.parametrize("key", BY_HAND)
@pytest.mark.parametrize("wanted", [0.1, 1.0, 10.0])
def test_a_time_out_by_hand_leaves_box_and_broadcasts_their_time(
    key: str, wanted: float
) -> None:
    protocol = PROTOCOLS[key]
    settings = replace(protocol.settings, reply_timeout=wanted)
    bus = protocol.bus("socket://127.0.0.1:1", name="a bus", settings=settings)
    own = protocol.timing
    timeout = bus.wire.round_trip.timeout
    assert timeout >= own.reply_timeout
    if protocol.master is not None:
        assert timeout <= own.reply_timeout_limit
    else:
        assert timeout == max(wanted, own.reply_timeout)
