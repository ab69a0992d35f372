"""Configuration and timing of an ABL wallbox."""

from dataclasses import dataclass
from typing import ClassVar, Final

from ..framing import Timing
from ..model import ChargerConfig, Phases
from .registers import LONGEST_REPLY

TIMING: Final = Timing(
    # A box replies within some milliseconds; network adapters take longer.
    reply_timeout=0.3,
    longest_reply=LONGEST_REPLY,
    # The first request after an idle time is lost; the repeat comes 0.7 s after it.
    retry_pauses=(0.4, 1.0),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pauses:
    """Pauses between the turns of a command, s."""

    wake: float = 3.0
    """Without a pilot signal: wakes a car (PROTOCOLS.md, 2)."""
    settings: float = 0.5
    """Between the writes that change the settings (PROTOCOLS.md, 2)."""
    boot: float = 0.6
    """Between two attempts to reach a box after a reset."""
    retry: float = 0.4
    """After a first request, which a sleeping box loses."""
    verify: float = 0.3
    """Between two reads of a state that is to be reached."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AblConfig(ChargerConfig):
    """An ABL wallbox; its address is its device-ID, 1 to 16."""

    poll_interval: float = 2.0
    """s; keeps the box awake, and shows soon that a power cycle has reset the limit."""
    phase_order: Phases[int] = (3, 2, 1)
    """The phase that each of Ict1, Ict2, Ict3 measures; most boxes begin with L3."""

    enable_again: bool = False
    """The user's permission also enables an outlet that went to E0 by itself, out of a
    pause of ours."""

    live: ClassVar = ChargerConfig.live | {"enable_again"}

    def __post_init__(self) -> None:
        """Raise ValueError unless the phase order has each phase once."""
        if sorted(self.phase_order) != [1, 2, 3]:
            message = f"{self.phase_order} is no order of the phases 1, 2, 3"
            raise ValueError(message)
