"""A small Modbus ASCII device for comparing two clients on one pty.

``python -m benchmarks.responder``: prints its path and replies until stdin ends.
Replies are those of an ABL box that charges, with a different current each time.
Device-ID 1 replies with ``>`` as ABL does, device-ID 2 with ``:`` as in Modbus; 3 and 4
do the same in pieces, as they come from a line at 38400 Bd (2 ms each). The replies are
prepared in advance, so that the device takes hardly any processor time.
"""

import asyncio
import itertools
import json
import os
import sys
import time
import tty
from typing import Self

from .machine import ROOT

ABL, MODBUS, ABL_PIECES, MODBUS_PIECES = 1, 2, 3, 4

_STARTS = {ABL: b">", MODBUS: b":", ABL_PIECES: b">", MODBUS_PIECES: b":"}
_IN_PIECES = (ABL_PIECES, MODBUS_PIECES)
_PIECE = 7
"""Bytes that pass in 2 ms."""
_PIECE_TIME = 2e-3
_FIXED = {
    b"00010002": "0141122D",
    b"00060002": "06C28000",
    b"00500008": "5000" + b"2W22xy00000001".hex(),
}
"""Register and count, and the contents of these registers."""
_CURRENTS = range(60, 160)


class Responder:
    """The device in another process."""

    def __init__(self) -> None:
        """Prepare; nothing is started."""
        self._process: asyncio.subprocess.Process | None = None
        self.url = ""

    async def __aenter__(self) -> Self:
        """Start the process; the port can be opened then."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "benchmarks.responder",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            cwd=ROOT,
        )
        if self._process.stdout is not None:
            self.url = json.loads(await self._process.stdout.readline())
        return self

    async def __aexit__(self, *_error: object) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            await self._process.wait()


def _answer(unit: int, content: str) -> bytes:
    body = bytes((unit, 0x03, len(content) // 2)) + bytes.fromhex(content)
    checksum = -sum(body) & 0xFF
    return _STARTS[unit] + body.hex().upper().encode() + b"%02X\r\n" % checksum


def _main() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    print(json.dumps(os.ttyname(slave)), flush=True)
    fixed = {
        (unit, question): _answer(unit, content)
        for unit in _STARTS
        for question, content in _FIXED.items()
    }
    readings = {
        unit: itertools.cycle(
            # C2, Ic 26.6 %, Ict1 to Ict3.
            [_answer(unit, f"2EC2110A{one:04X}{one:04X}{one:04X}") for one in _CURRENTS]
        )
        for unit in _STARTS
    }
    frame = b""
    while True:
        frame += os.read(master, 256)
        if not frame.endswith(b"\r\n"):
            continue
        unit, question = int(frame[1:3], 16), frame[5:13]
        frame = b""
        if question == b"002E0005":
            _say(master, next(readings[unit]), unit)
        elif (unit, question) in fixed:
            _say(master, fixed[unit, question], unit)


def _say(master: int, answer: bytes, unit: int) -> None:
    if unit not in _IN_PIECES:
        os.write(master, answer)
        return
    for piece in itertools.batched(answer, _PIECE, strict=False):
        time.sleep(_PIECE_TIME)
        os.write(master, bytes(piece))


if __name__ == "__main__":
    _main()
