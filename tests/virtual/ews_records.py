"""Records that a virtual EWS-Box keeps for the tests, and defects of its answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .ews_frames import ANSWER, Bcc, frame


@dataclass(frozen=True, slots=True)
class EwsCommand:
    """A command received: real and device time, contents, and data of the answer.

    `answer` None: none was sent (unknown command).
    """

    t: float
    at: float
    name: str
    parameters: bytes
    answer: bytes | None


@dataclass(frozen=True, slots=True)
class EwsLimit:
    """An `st` received: real time, port, amperes."""

    t: float
    port: int
    amps: int
    accepted: bool


@dataclass(frozen=True, slots=True)
class EwsInfo:
    """An info record sent: real time, change bits, eight key bytes."""

    t: float
    bits: int
    keys: bytes


@dataclass(frozen=True, slots=True)
class InfoMix:
    """An info record in the same bytes as an answer.

    `where`: "before" or "after" the answer, or "inside", at byte `at` of it: no real box
    does that, and the answer is damaged. `cut`: number of bytes after which there is a
    pause of `pause` seconds.
    """

    where: Literal["before", "after", "inside", "none"] = "before"
    at: int = 0
    cut: int | None = None
    pause: float = 0.005
    bits: int = 0


def with_false_length(parameters: bytes, difference: int, bcc: Bcc) -> bytes:
    """Return an answer with a length wrong by `difference` and a correct BCC."""
    data = bytearray(frame(ANSWER, parameters, bcc))
    claimed = (len(parameters) + difference & 0xFFFF).to_bytes(2, "big")
    data[-1] ^= data[1] ^ data[2] ^ claimed[0] ^ claimed[1]
    data[1:3] = claimed
    return bytes(data)


def mixed(answer: bytes, record: bytes, mix: InfoMix) -> tuple[bytes, bytes]:
    """Return answer and record in two parts: before and after the pause."""
    if mix.where == "none":
        record = b""
    at = {"before": 0, "after": len(answer)}.get(mix.where, mix.at)
    data = answer[:at] + record + answer[at:]
    cut = len(data) if mix.cut is None else mix.cut
    return data[:cut], data[cut:]
