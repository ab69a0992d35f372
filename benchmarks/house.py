"""A real Home Assistant, started for a benchmark in a process of its own.

As a program: ``python -m benchmarks.house FOLDER`` starts Home Assistant with that
configuration folder, as `homeassistant.runner` does, and executes commands from stdin
(a line of JSON each; so is its result). As a module: `House` starts such a process.
"""

import asyncio
import json
import os
from pathlib import Path
import socket
import sys
import tempfile
from typing import Any, Final, Self

from .house_boxes import COMMANDS as FOR_BOXES
from .house_commands import COMMANDS
from .machine import OUTPUT, ROOT

CONFIGURATION: Final = """\
recorder:
history:
logbook:
logger:
  default: warning
"""
LOADED: Final = (
    "Home Assistant's own default integrations with frontend, and recorder (SQLite),"
    " history and logbook"
)
_STARTS_WITHIN: Final = 180.0
_ENDS_WITHIN: Final = 60.0
_LINE_LIMIT: Final = 2**26


class House:
    """A Home Assistant in another process."""

    def __init__(self) -> None:
        """Prepare; nothing is started."""
        self._folder = tempfile.TemporaryDirectory(prefix="evse-bus-bench-")
        self._process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        """Start it with an empty configuration; return when it runs."""
        folder = Path(self._folder.name)
        (folder / "configuration.yaml").write_text(CONFIGURATION, encoding="utf-8")
        OUTPUT.mkdir(exist_ok=True)
        with (OUTPUT / "home-assistant.log").open("w", encoding="utf-8") as errors:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "benchmarks.house",
                str(folder),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=errors,
                cwd=ROOT,
                env={**os.environ, "SETUP_PORT": str(free_port())},
                limit=_LINE_LIMIT,
            )
        async with asyncio.timeout(_STARTS_WITHIN):
            await self._result()
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Stop it and delete its folder."""
        process = self._process
        if process is not None and process.stdin is not None:
            process.stdin.close()
            try:
                async with asyncio.timeout(_ENDS_WITHIN):
                    await process.wait()
            except TimeoutError:
                process.kill()
                await process.wait()
        self._folder.cleanup()

    async def do(self, command: str, **arguments: object) -> Any:  # noqa: ANN401 - JSON
        """Execute a command there (`house_commands`); return its result."""
        if self._process is None or self._process.stdin is None:
            message = "Home Assistant is not running"
            raise RuntimeError(message)
        line = json.dumps({"command": command, "arguments": arguments})
        self._process.stdin.write(line.encode() + b"\n")
        await self._process.stdin.drain()
        return await self._result()

    async def _result(self) -> Any:  # noqa: ANN401 - JSON
        if self._process is None or self._process.stdout is None:
            message = "Home Assistant is not running"
            raise RuntimeError(message)
        line = await self._process.stdout.readline()
        if not line:
            message = f"Home Assistant has ended, see {OUTPUT}/home-assistant.log"
            raise RuntimeError(message)
        return json.loads(line)


def free_port() -> int:
    """Return a free TCP port of this machine."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


# -- In the other process ----------------------------------------------------------


async def _serve(folder: str) -> None:
    # Only the process that runs Home Assistant imports it.
    from homeassistant.bootstrap import async_setup_hass  # noqa: PLC0415
    from homeassistant.runner import RuntimeConfig  # noqa: PLC0415

    hass = await async_setup_hass(RuntimeConfig(config_dir=folder, skip_pip=True))
    if hass is None:
        message = "Home Assistant did not start"
        raise SystemExit(message)
    await hass.async_start()
    print(json.dumps(None), flush=True)
    reader = asyncio.StreamReader()
    await hass.loop.connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    commands = {**COMMANDS, **FOR_BOXES}
    while line := await reader.readline():
        order = json.loads(line)
        result = await commands[order["command"]](hass, **order["arguments"])
        print(json.dumps(result), flush=True)
    await hass.async_stop()


def _main() -> None:
    from homeassistant.runner import create_event_loop  # noqa: PLC0415

    loop = create_event_loop()
    asyncio.set_event_loop(loop)
    loop.run_until_complete(_serve(sys.argv[1]))


if __name__ == "__main__":
    _main()
