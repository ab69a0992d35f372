"""Frames of load balancing, as on the wire."""

from tests.virtual.smartevse_frames import crc16

from .scene import MasterScene, Sent


def frame(head: str) -> bytes:
    """Return a frame from its hex digits without the checksum."""
    data = bytes.fromhex(head)
    return data + crc16(data)


OTHER_BROADCAST = frame("001000010004080064003c00000000")
"""The broadcast of another master."""
REQUEST_C = frame("020600030082")
"""Unit 2 requests current, 13 A at most."""
REQUEST_A = frame("020600010000")
"""The car has left unit 2."""


def answers(scene: MasterScene, since: float = 0.0) -> list[Sent]:
    """Return the answers to requests of all units."""
    return [
        sent
        for sent in scene.line.sent
        if sent.data[1] == 6 and sent.data[2:3] == b"\x00" and sent.when >= since
    ]
