"""TCP ports: Home Assistant's own, and the one that an EWS-Box dials."""

from dataclasses import replace
import errno
from pathlib import Path
import socket
from typing import Final

from .settings import HOST, DemoError, Settings

LISTEN_PORTS: Final = range(4712, 4812)
"""The first free one is taken; the integration offers the same."""


def check_port(settings: Settings) -> None:
    """Raise DemoError when Home Assistant could not listen there."""
    if why := _in_the_way(settings.port):
        raise DemoError(
            f"port {settings.port} {why}; set EVSE_BUS_DEMO_PORT to another one"
        )


def with_listen_port(settings: Settings) -> Settings:
    """Return the settings with the port that boxes dial, chosen at the first start.

    It is kept: Home Assistant has stored it. Raises DemoError when it is taken.
    """
    kept = settings.folder / "listen-port"
    port = _read(kept)
    if port is None:
        port = next(
            (p for p in LISTEN_PORTS if p != settings.port and not _in_the_way(p)), None
        )
        if port is None:
            raise DemoError("no port is free that an EWS-Box could dial")
        kept.write_text(str(port), encoding="utf-8")
    elif why := _in_the_way(port):
        raise DemoError(
            f"port {port}, which this demo's EWS-Box dials, {why}; end that one, or"
            f" remove {settings.folder} to begin anew"
        )
    return replace(settings, listen_port=port)


def _read(kept: Path) -> int | None:
    """Return what was written; nothing, or half of it, counts as nothing."""
    try:
        return int(kept.read_text(encoding="utf-8"))
    except OSError, ValueError:
        return None


def _in_the_way(port: int) -> str:
    """Return why nobody could listen on a port; empty: it is free."""
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
