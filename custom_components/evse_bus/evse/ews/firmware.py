"""New firmware for an EWS-Box: for programs, and at their own risk.

The manual has the three commands but not the procedure (3.2.4.1 is empty): this is the
only order in which they make sense. Nothing in this project calls it, and an image
that is not the manufacturer's makes a box unusable.
"""

from collections.abc import Callable
import itertools

from ..errors import RefusedOrderError
from .services import Services
from .timing import ERASE_PATIENCE
from .wire.commands import MAXIMUM_ROM_BYTES, activate_firmware, erase_rom, write_rom
from .wire.frames import Request

type Progress = Callable[[float], None]
"""Called with the share that is done, 0..1."""


async def upload(
    services: Services, image: bytes, progress: Progress | None = None
) -> None:
    """Erase the temporary memory (``oe``), write it (``ow``), install it (``fw``).

    A piece has up to 1024 bytes and is written once, since written memory cannot be
    written again: any refusal or lost reply ends the upload, with the old firmware
    still running. To install the new one the box ends all charges and restarts. Raises
    RefusedOrderError for an empty image, EwsRefusedError, NotConfirmedError for a lost
    reply, and what `Charger.run` raises.
    """

    async def send(request: Request) -> None:
        await services.send(request, patience=ERASE_PATIENCE)

    if not image:
        raise RefusedOrderError("an empty image")
    pieces = list(itertools.batched(image, MAXIMUM_ROM_BYTES, strict=False))
    await send(erase_rom(0, len(image)))
    for number, piece in enumerate(pieces):
        await send(write_rom(number * MAXIMUM_ROM_BYTES, bytes(piece)))
        if progress is not None:
            progress((number + 1) / len(pieces))
    await send(activate_firmware())
