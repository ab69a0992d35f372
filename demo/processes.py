"""Programs that the demo starts, and ends with itself."""

import asyncio
from asyncio.subprocess import DEVNULL, Process
from contextlib import suppress
import os
from pathlib import Path
import signal
from typing import Final

PATIENCE: Final = 30.0
"""Longest wait for the end of a program, s."""
TAIL: Final = 15


class Program:
    """One program in a process group of its own, so that Ctrl-C reaches only the demo."""

    def __init__(self, name: str, process: Process, log: Path) -> None:
        """Take over a process that was started."""
        self.name = name
        self._process = process
        self._log = log

    @classmethod
    async def start(
        cls, name: str, *command: str | Path, log: Path, cwd: Path
    ) -> Program:
        """Start it; its output goes to the log."""
        environment = dict(os.environ)
        for variable in ("PYTHONDONTWRITEBYTECODE", "PYTHONPATH", "PYTHONHOME"):
            # Without stored byte code Home Assistant takes a minute at each start.
            environment.pop(variable, None)
        # One log is enough: this one also has the output before any logging.
        environment["HA_DISABLE_LOG_FILE"] = "1"
        with log.open("wb") as output:
            process = await asyncio.create_subprocess_exec(
                *command,
                cwd=cwd,
                env=environment,
                stdin=DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        return cls(name, process, log)

    @property
    def running(self) -> bool:
        """Return whether it has not ended."""
        return self._process.returncode is None

    async def wait(self) -> int:
        """Wait for its end; return its exit code."""
        return await self._process.wait()

    def log_tail(self) -> str:
        """Return the end of its log."""
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join([*lines[-TAIL:], f"(from {self._log})"])

    def printed(self, text: str) -> bool:
        """Return whether it has printed this text."""
        return text in self._log.read_text(encoding="utf-8", errors="replace")

    async def stop(self) -> None:
        """End it, and all processes that it started."""
        if self.running:
            with suppress(ProcessLookupError):
                self._process.terminate()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), PATIENCE)
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        await self._process.wait()
