"""The registry of protocols: one line a protocol."""

from typing import Final

from .abl import PROTOCOL as ABL
from .evbox import PROTOCOL as EVBOX
from .ews import NETWORK as EWS_NETWORK, PROTOCOL as EWS
from .protocol import Protocol
from .smartevse import MASTER as SMARTEVSE_MASTER, POLLED as SMARTEVSE

PROTOCOLS: Final[dict[str, Protocol]] = {
    protocol.key: protocol
    for protocol in (EVBOX, ABL, SMARTEVSE, SMARTEVSE_MASTER, EWS, EWS_NETWORK)
}


def protocols_by_make() -> dict[str, list[Protocol]]:
    """Return the protocols of each make, by its key; in the order of the registry."""
    makes: dict[str, list[Protocol]] = {}
    for protocol in PROTOCOLS.values():
        makes.setdefault(protocol.make.key, []).append(protocol)
    return makes
