"""New firmware for an EWS-Box: for programs, and at their own risk.

The manual has the three commands and not the procedure (3.2.4.1 is empty): this is the
only order in which they make sense. Nothing in this project calls it, and an image
that is not the maker's bricks a box.
"""

from collections.abc import Callable
from functools import partial
import itertools
from typing import TYPE_CHECKING

from ..errors import RefusedOrderError
from ..exchange import Turn
from .timing import ERASE_PATIENCE
from .wire.answers import confirmed
from .wire.commands import MAXIMUM_ROM_BYTES, activate_firmware, erase_rom, write_rom
from .wire.frames import CommandId, Request

if TYPE_CHECKING:
    from .charger import EwsPort

type Progress = Callable[[float], None]
"""Called with the share that is done, 0..1."""


async def upload(port: EwsPort, image: bytes, progress: Progress | None = None) -> None:
    """Erase the temporary memory (``oe``), write it (``ow``), install it (``fw``).

    A piece has up to 1024 bytes and is written once: memory that was written does not
    take it again, so any answer that says no or stays away ends the upload, with the
    old firmware still running. Charges are ended by the box when the new one is
    installed; it restarts then. Raises RefusedOrderError for an empty image,
    EwsRefusedError, NotConfirmedError for a lost answer, and what `Charger.run` raises.
    """
    if not image:
        raise RefusedOrderError("an image without a byte")
    pieces = list(itertools.batched(image, MAXIMUM_ROM_BYTES, strict=False))
    await _say(port, CommandId.ERASE_ROM, erase_rom(0, len(image)))
    for number, piece in enumerate(pieces):
        start = number * MAXIMUM_ROM_BYTES
        await _say(port, CommandId.WRITE_ROM, write_rom(start, bytes(piece)))
        if progress is not None:
            progress((number + 1) / len(pieces))
    await _say(port, CommandId.ACTIVATE_FIRMWARE, activate_firmware())


async def _say(port: EwsPort, command: CommandId, request: Request) -> None:
    await port.services.in_a_turn(
        partial(_tell, port, command, request), patience=ERASE_PATIENCE
    )


async def _tell(
    port: EwsPort, command: CommandId, request: Request, turn: Turn
) -> None:
    await port.box.ask(
        turn, command, lambda: request, confirmed(command), patience=ERASE_PATIENCE
    )
