"""Start virtual buses and Home Assistant; stop them together."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import fcntl
import signal
import sys
from typing import Final

from .buses import BUSES, DemoBus
from .client import Client
from .home import furnish
from .ports import check_port, with_listen_port
from .processes import Program
from .settings import PASSWORD, ROOT, USER, DemoError, Settings, from_environment
from .storage import prepare
from .terminal import Progress, report

GLANCE: Final = 0.2
BUS_PATIENCE: Final = 15.0
START_PATIENCE: Final = 600.0
"""Seconds; a first start on a slow machine compiles much."""
RESTART: Final = 100
"""Home Assistant's exit code for a restart."""


def main() -> int:
    """Run until a signal, or until a program ends that should not."""
    try:
        settings = from_environment()
        with alone(settings):
            check_port(settings)
            settings = with_listen_port(settings)
            prepare(settings)
            asyncio.run(_until_signal(settings))
    except DemoError as error:
        report(f"FAILED: {error}")
        return 1
    except KeyboardInterrupt:
        # Before anything was started.
        return 130
    return 0


@contextmanager
def alone(settings: Settings) -> Iterator[None]:
    """Hold the lock of the folder: one demo at a time. Raises DemoError."""
    settings.folder.mkdir(parents=True, exist_ok=True)
    with (settings.folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise DemoError(f"a demo runs already in {settings.folder}") from None
        place = settings.folder / "place"
        here = str(settings.folder)
        if place.exists() and place.read_text(encoding="utf-8") != here:
            raise DemoError(
                f"{here} was created in another place, and its ports are there;"
                " remove it to start again"
            )
        place.write_text(here, encoding="utf-8")
        yield


async def _until_signal(settings: Settings) -> None:
    loop = asyncio.get_running_loop()
    programs: list[Program] = []
    demo = asyncio.create_task(_run(settings, programs))

    def stop() -> None:
        # Once: a second Ctrl-C must not interrupt the cleanup.
        if not demo.done() and not demo.cancelling():
            demo.cancel()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stop)
    try:
        with suppress(asyncio.CancelledError):
            await demo
    finally:
        if any(program.running for program in programs):
            report("stopping ...")
        # Home Assistant first: its chargers must not disappear before it.
        for program in reversed(programs):
            await program.stop()
        report("stopped")


async def _run(settings: Settings, programs: list[Program]) -> None:
    for bus in BUSES:
        program = await _start_bus(settings, bus)
        programs.append(program)
    await asyncio.gather(
        *(
            _bus_ready(program, bus)
            for program, bus in zip(programs, BUSES, strict=True)
        )
    )
    lines = [str(settings.link(bus.name)) for bus in BUSES if not bus.dials]
    report(f"virtual buses: {', '.join(lines)}")
    while True:
        home = await _start_home(settings)
        programs.append(home)
        token = settings.token.read_text(encoding="utf-8").strip()
        async with Client(settings.url, token) as client:
            await _wait_until_running(client, home)
            await furnish(client, settings)
        _welcome(settings)
        waits = {asyncio.create_task(program.wait()): program for program in programs}
        ended, others = await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for other in others:
            other.cancel()
        if [waits[one] for one in ended] != [home] or await home.wait() != RESTART:
            program = waits[ended.pop()]
            raise DemoError(f"{program.name} has ended:\n{program.log_tail()}")
        programs.remove(home)
        report("Home Assistant restarts")


async def _start_bus(settings: Settings, bus: DemoBus) -> Program:
    return await Program.start(
        bus.title,
        sys.executable,
        ROOT / "scripts" / "virtual-chargers",
        *bus.arguments(settings),
        "--verbose",
        log=settings.folder / f"bus-{bus.name}.log",
        cwd=ROOT,
    )


async def _bus_ready(program: Program, bus: DemoBus) -> None:
    try:
        async with asyncio.timeout(BUS_PATIENCE):
            while not program.printed(bus.ready):
                if not program.running:
                    break
                await asyncio.sleep(GLANCE / 4)
            else:
                return
    except TimeoutError:
        pass
    raise DemoError(f"{bus.title} does not start:\n{program.log_tail()}")


async def _start_home(settings: Settings) -> Program:
    return await Program.start(
        "Home Assistant",
        sys.executable,
        *("-m", "homeassistant", "--config", settings.config, "--log-no-color"),
        log=settings.log,
        cwd=settings.folder,
    )


async def _wait_until_running(client: Client, home: Program) -> None:
    with Progress("Home Assistant: starting") as progress:
        while True:
            running, components = await client.running()
            if running:
                return
            if not home.running:
                raise DemoError(f"Home Assistant has ended:\n{home.log_tail()}")
            if progress.seconds > START_PATIENCE:
                raise DemoError(f"Home Assistant hangs:\n{home.log_tail()}")
            progress.show(f"{components} components" if components else "")
            await asyncio.sleep(GLANCE)


def _welcome(settings: Settings) -> None:
    report()
    report(f"Home Assistant is ready:  {settings.url}")
    report(f"  user {USER}, password {PASSWORD}; the dashboard is called Chargers")
    report(f"  a long-lived token is in {settings.token}")
    report(f"  its log is {settings.log}")
    report("Ctrl-C stops everything.")


if __name__ == "__main__":
    sys.exit(main())
