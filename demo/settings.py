"""Folders, port and login of the demo."""

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
"""The checkout."""

HOST: Final = "127.0.0.1"
"""This machine only: the password is no secret."""
DEFAULT_PORT: Final = 8123
HIGHEST_PORT: Final = 65535

USER: Final = "demo"
PASSWORD: Final = "demo"  # noqa: S105 - no secret


class DemoError(Exception):
    """An error to show to the user; the demo ends."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of the user, and paths that follow from them."""

    folder: Path
    port: int = DEFAULT_PORT
    listen_port: int = 0
    """The port that an EWS-Box dials; chosen at the first start."""

    @property
    def url(self) -> str:
        """Return the URL of Home Assistant."""
        return f"http://{HOST}:{self.port}"

    @property
    def config(self) -> Path:
        """Return Home Assistant's own folder."""
        return self.folder / "config"

    @property
    def token(self) -> Path:
        """Return the file with a long-lived access token of the owner."""
        return self.folder / "token"

    @property
    def log(self) -> Path:
        """Return the log of Home Assistant."""
        return self.folder / "home-assistant.log"

    def link(self, name: str) -> Path:
        """Return the path of a virtual bus: the same at each start."""
        return self.folder / f"tty{name.upper()}"


def from_environment() -> Settings:
    """Return the settings of the environment; raises DemoError for an invalid port."""
    typed = os.environ.get("EVSE_BUS_DEMO_PORT") or str(DEFAULT_PORT)
    if not typed.isdecimal() or not 0 < int(typed) <= HIGHEST_PORT:
        raise DemoError(f"EVSE_BUS_DEMO_PORT is no TCP port: {typed}")
    folder = Path(os.environ.get("EVSE_BUS_DEMO_DIR") or ROOT / ".demo")
    return Settings(folder=folder.resolve(), port=int(typed))
