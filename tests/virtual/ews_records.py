"""What a virtual EWS-Box keeps for the tests, and how its answers go wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .ews_frames import ANSWER, Bcc, frame


@dataclass(frozen=True, slots=True)
class EwsCommand:
    """A command that was heard: real and device time, what, and the answer's data.

    `answer` None: none was sent (unknown command).
    """

    t: float
    at: float
    name: str
    parameters: bytes
    answer: bytes | None


@dataclass(frozen=True, slots=True)
class EwsLimit:
    """An `st` that was heard: real time, port, amperes."""

    t: float
    port: int
    amps: int
    accepted: bool


@dataclass(frozen=True, slots=True)
class EwsInfo:
    """An info record that was sent: real time, change bits, eight key bytes."""

    t: float
    bits: int
    keys: bytes


@dataclass(frozen=True, slots=True)
class InfoMix:
    """How an info record meets an answer.

    `where`: "before" or "after" the answer in the same lump, or "inside", at byte `at`
    of it: a real box would not, and that answer is broken. `cut`: the lump ends after
    so many bytes, the rest comes `pause` seconds later.
    """

    where: Literal["before", "after", "inside", "none"] = "before"
    at: int = 0
    cut: int | None = None
    pause: float = 0.005
    bits: int = 0


def with_false_length(parameters: bytes, difference: int, bcc: Bcc) -> bytes:
    """Return an answer whose length is wrong by so much, its BCC right all the same."""
    data = bytearray(frame(ANSWER, parameters, bcc))
    claimed = (len(parameters) + difference & 0xFFFF).to_bytes(2, "big")
    data[-1] ^= data[1] ^ data[2] ^ claimed[0] ^ claimed[1]
    data[1:3] = claimed
    return bytes(data)


def mixed(answer: bytes, record: bytes, mix: InfoMix) -> tuple[bytes, bytes]:
    """Return the lump with the answer and the record, and what comes later."""
    if mix.where == "none":
        record = b""
    at = {"before": 0, "after": len(answer)}.get(mix.where, mix.at)
    data = answer[:at] + record + answer[at:]
    cut = len(data) if mix.cut is None else mix.cut
    return data[:cut], data[cut:]
