"""TCP ports: Home Assistant's own, and the one that an EWS-Box dials."""

from dataclasses import replace
import errno
from pathlib import Path
import socket
from typing import Final

from .settings import HOST, DemoError, Settings

LISTEN_PORTS: Final = range(4712, 4812)
"""The first free one is used, as in the integration."""


def check_port(settings: Settings) -> None:
    """Raise DemoError if Home Assistant cannot listen on its port."""
    if problem := _problem_of(settings.port):
        raise DemoError(
            f"port {settings.port} {problem}; set EVSE_BUS_DEMO_PORT to another one"
        )


def with_listen_port(settings: Settings) -> Settings:
    """Return the settings with the port that boxes dial, chosen at the first start.

    It is kept, because Home Assistant has stored it. Raises DemoError if it is taken.
    """
    kept = settings.folder / "listen-port"
    port = _read(kept)
    if port is None:
        port = next(
            (p for p in LISTEN_PORTS if p != settings.port and not _problem_of(p)), None
        )
        if port is None:
            raise DemoError("no port is free for an EWS-Box to dial")
        kept.write_text(str(port), encoding="utf-8")
    elif problem := _problem_of(port):
        raise DemoError(
            f"port {port}, which this demo's EWS-Box dials, {problem}; end that one, or"
            f" remove {settings.folder} to start again"
        )
    return replace(settings, listen_port=port)


def _read(kept: Path) -> int | None:
    """Return the port that was stored; ``None`` for a missing or incomplete file."""
    try:
        return int(kept.read_text(encoding="utf-8"))
    except OSError, ValueError:
        return None


def _problem_of(port: int) -> str:
    """Return why a port cannot be used; empty: it is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE
            return (
                "is taken by another program" if taken else f"cannot be used: {error}"
            )
    return ""
