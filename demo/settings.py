"""Where the demo keeps what, and how to get in."""

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
"""The checkout."""

HOST: Final = "127.0.0.1"
"""Not for others: everybody knows the password."""
DEFAULT_PORT: Final = 8123
HIGHEST_PORT: Final = 65535

USER: Final = "demo"
PASSWORD: Final = "demo"  # noqa: S105 - printed for everybody to use


class DemoError(Exception):
    """Something a person should read; the demo ends."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The choices a person has, and what follows from them."""

    folder: Path
    port: int = DEFAULT_PORT
    listen_port: int = 0
    """Where an EWS-Box dials; chosen at the first start."""

    @property
    def url(self) -> str:
        """Return where Home Assistant is."""
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
        """Return what Home Assistant has to say."""
        return self.folder / "home-assistant.log"

    def link(self, protocol: str) -> Path:
        """Return the path of a virtual bus: the same at each start."""
        return self.folder / f"tty{protocol.upper()}"


def from_environment() -> Settings:
    """Return what was asked for; raises DemoError for a port that is none."""
    typed = os.environ.get("EVSE_BUS_DEMO_PORT") or str(DEFAULT_PORT)
    if not typed.isdecimal() or not 0 < int(typed) <= HIGHEST_PORT:
        raise DemoError(f"EVSE_BUS_DEMO_PORT is no TCP port: {typed}")
    folder = Path(os.environ.get("EVSE_BUS_DEMO_DIR") or ROOT / ".demo")
    return Settings(folder=folder.resolve(), port=int(typed))
