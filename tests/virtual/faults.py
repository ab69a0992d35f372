"""Faults of a wire, by rate or once."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Container
    from random import Random

Kind = Literal[
    "lose", "late", "duplicate", "truncate", "corrupt", "twin", "replace", "noise"
]
Damage = Literal["flip", "replace", "drop", "insert"]
DAMAGES: tuple[Damage, ...] = ("flip", "replace", "drop", "insert")


def twin_flips(data: bytes, rng: Random) -> bytes:
    """Flip the same bit in two bytes: an XOR of all bytes does not show it.

    Neither in the first byte nor in the last one: they delimit a frame.
    """
    damaged, bit = bytearray(data), 1 << rng.randrange(8)
    for index in rng.sample(range(1, len(data) - 1), 2):
        damaged[index] ^= bit
    return bytes(damaged)


def opposite_flips(
    data: bytes, rng: Random, possible: Container[int] = range(256)
) -> bytes:
    """Set a bit in one byte and clear it in another: a sum does not show it either.

    Both become one of the `possible` bytes. Without such a pair nothing changes.
    """
    pairs = [
        (one, other, bit)
        for bit in (1 << place for place in range(8))
        for one, up in enumerate(data)
        if not up & bit and up ^ bit in possible
        for other, down in enumerate(data)
        if down & bit and down ^ bit in possible
    ]
    damaged = bytearray(data)
    if pairs:
        one, other, bit = rng.choice(pairs)
        damaged[one] ^= bit
        damaged[other] ^= bit
    return bytes(damaged)


@dataclass(slots=True)
class Faults:
    """Faults of one device, or of the whole bus (`bus.faults`).

    Rates are probabilities per reply, `byte_error_rate` per byte. All can be set at
    any time from any thread. `damage`: what a byte error does, one at random: one bit
    flips, another byte is in its place, it is lost, a byte comes before it. `echo` and
    `noise_rate` (bytes per second) count on the bus only; `dead` on the bus is a cut
    cable: no byte reaches any device. `twin` damages a reply in a way that the checksum
    of its protocol does not show.
    """

    byte_error_rate: float = 0.0
    damage: tuple[Damage, ...] = ("flip",)
    lose_rate: float = 0.0
    late_rate: float = 0.0
    late_by: float = 0.5
    duplicate_rate: float = 0.0
    truncate_rate: float = 0.0
    dead: bool = False
    echo: bool = False
    noise_rate: float = 0.0
    twin: Callable[[bytes, Random], bytes] = twin_flips
    happened: dict[str, int] = field(default_factory=dict)
    _once: deque[tuple[Kind, object]] = field(default_factory=deque)

    def once(self, kind: Kind, value: float | bytes | None = None) -> None:
        """Apply a fault to the next reply; several calls: several replies in turn.

        - `lose`: it is never sent
        - `late`: sent `value` seconds later (default `late_by`)
        - `duplicate`: sent twice
        - `truncate`: cut to its first `value` bytes (default half)
        - `corrupt`: one bit of byte `value` flips (default the middle one)
        - `twin`: two bits flip so that the checksum still fits (EWS, EVBox, ABL)
        - `replace`: the bytes `value` are sent in its place
        - `noise`: the bytes `value` are sent just before it
        """
        self._once.append((kind, value))

    def clear(self) -> None:
        """Remove all faults, pending ones included; the counters stay."""
        self.byte_error_rate = self.lose_rate = self.late_rate = 0.0
        self.duplicate_rate = self.truncate_rate = self.noise_rate = 0.0
        self.dead = self.echo = False
        self._once.clear()

    def apply(
        self, replies: list[tuple[float, bytes]], rng: Random
    ) -> list[tuple[float, bytes]]:
        """Return the replies with faults applied, as pairs of delay (s) and bytes."""
        if self.dead:
            self._count("dead")
            return []
        if self._once and replies:
            kind, value = self._once.popleft()
            replies = self._do(kind, value, replies, rng)
        for kind, rate in (
            ("lose", self.lose_rate),
            ("late", self.late_rate),
            ("duplicate", self.duplicate_rate),
            ("truncate", self.truncate_rate),
        ):
            if rate and replies and rng.random() < rate:
                replies = self._do(kind, None, replies, rng)
        return replies

    def disturb(self, data: bytes, rng: Random) -> bytes:
        """Damage bytes at the byte error rate; fewer or more may come out."""
        rate = self.byte_error_rate
        if not rate or rng.random() >= 1 - (1 - rate) ** len(data):
            return data
        # At least one byte is hit; the others keep their own chance.
        hit = rng.randrange(len(data))
        damaged = bytearray()
        for index, byte in enumerate(data):
            if index == hit or rng.random() < rate:
                damaged += self._damaged(byte, rng)
                self._count("byte_error")
            else:
                damaged.append(byte)
        return bytes(damaged)

    def _damaged(self, byte: int, rng: Random) -> bytes:
        """Return what is received in place of a byte."""
        damage = self.damage[0] if len(self.damage) == 1 else rng.choice(self.damage)
        if damage == "flip":
            return bytes((byte ^ 1 << rng.randrange(8),))
        if damage == "replace":
            return bytes((byte ^ rng.randrange(1, 256),))
        if damage == "drop":
            return b""
        return bytes((rng.randrange(256), byte))

    def _do(
        self,
        kind: Kind,
        value: object,
        replies: list[tuple[float, bytes]],
        rng: Random,
    ) -> list[tuple[float, bytes]]:
        self._count(kind)
        delay, data = replies[0]
        rest = replies[1:]
        number = value if isinstance(value, (int, float)) else None
        first: list[tuple[float, bytes]] = []
        if kind == "late":
            first = [(delay + (self.late_by if number is None else number), data)]
        elif kind == "duplicate":
            first = [(delay, data), (delay, data)]
        elif kind == "truncate":
            first = [(delay, data[: len(data) // 2 if number is None else int(number)])]
        elif kind == "corrupt":
            index = len(data) // 2 if number is None else int(number)
            damaged = bytearray(data)
            damaged[index] ^= 1 << rng.randrange(7)
            first = [(delay, bytes(damaged))]
        elif kind == "twin":
            first = [(delay, self.twin(data, rng))]
        elif kind != "lose":
            other = value if isinstance(value, bytes) else b"\x00\xff"
            first = [(delay, other if kind == "replace" else other + data)]
        return first + rest

    def _count(self, what: str) -> None:
        self.happened[what] = self.happened.get(what, 0) + 1
