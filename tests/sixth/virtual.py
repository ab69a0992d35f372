"""A virtual Sextant S6. It shares no code with the library."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from tests.virtual.device import Device

if TYPE_CHECKING:
    from tests.virtual.wire import Segment


class VirtualSextant(Device):
    """One box, with a car that draws what it may."""

    baud: ClassVar[int] = 57600
    protocol: ClassVar[str] = "sextant"

    def __init__(self, dial: int, serial: str, owner: str = "Miller") -> None:
        super().__init__(f"sextant-{dial}")
        self.dial = dial
        self.serial = serial
        self.owner = owner
        self.limit = 160
        self.lamp = 100
        self.charging = False
        self.key_switch = True
        self.limits: list[int] = []
        self._buffer = ""

    def receive(self, segment: Segment) -> None:
        self._buffer += segment.data.decode("latin-1")
        while "\r" in self._buffer:
            line, self._buffer = self._buffer.split("\r", 1)
            body, _, checksum = line.removeprefix("$").partition("*")
            if body[:1] == str(self.dial) and checksum == _checksum(body):
                self.requests += 1
                self._answer(body[1], body[2:])

    def _answer(self, letter: str, payload: str) -> None:
        if letter == "I":
            payload = f"{self.serial},1.4,160,{self.owner}"
        elif letter == "R":
            current = self.limit if self.charging else 0
            state = "C" if current else "A"
            payload = f"{state},{current},1234,{self.limit},{self.lamp}"
        elif letter == "L" and not self.key_switch:
            letter, payload = "E", "7"
        elif letter == "L":
            self.limit = int(payload)
            self.limits.append(self.limit)
        elif letter == "B":
            self.lamp = int(payload)
        body = f"{self.dial}{letter.lower()}{payload}"
        self.send(f"${body}*{_checksum(body)}\r".encode(), 0.002)


def _checksum(body: str) -> str:
    return f"{sum(body.encode()) % 256:02X}"
