"""The dialect of a box, found by reading only. Pure.

=========================  ============  ============  =====================
read                       2.17          2.20          later
=========================  ============  ============  =====================
0xA0 x 9 (0x04)            state letter  state number  exception 2
0xA9 x 3 (0x03)            (no reply)    three words   (exception 2)
0x0000 x 12 (0x04)         (exception)   (exception)   twelve words
=========================  ============  ============  =====================

Cells in brackets are never asked for. PROTOCOLS.md, 3.
"""

from collections.abc import Awaitable, Callable

from ..errors import ExchangeRefusedError, ImplausibleReplyError
from ..registers import Block
from .dialects import MAPS, PROBE_A0, PROBE_A9, Dialect
from .registers import ILLEGAL_ADDRESS, decode_status

type Read = Callable[[Block], Awaitable[bytes]]
"""Reads a block of one box; raises ExchangeRefusedError for an exception."""


async def find_dialect(read: Read) -> Dialect:
    """Return the dialect of a box.

    Raises ImplausibleReplyError for a device that is no known SmartEVSE, and what
    ``read`` raises.
    """
    try:
        data = await read(PROBE_A0)
    except ExchangeRefusedError as error:
        if error.code != ILLEGAL_ADDRESS:
            raise _unknown(PROBE_A0) from error
        status = MAPS[Dialect.LATER].status.block
        decode_status(Dialect.LATER, await _read(read, status))
        return Dialect.LATER
    dialect = dialect_of_a0(data)
    if dialect is None:
        raise _unknown(PROBE_A0)
    if dialect is Dialect.V2_20:
        await _read(read, PROBE_A9)
    return dialect


def dialect_of_a0(data: bytes) -> Dialect | None:
    """Return the dialect of a reply to `PROBE_A0`; ``None``: neither of the two.

    A letter is 2.17; a number may be 2.20, which `PROBE_A9` must confirm.
    """
    for dialect in (Dialect.V2_17, Dialect.V2_20):
        try:
            decode_status(dialect, data)
        except ImplausibleReplyError:
            continue
        return dialect
    return None


async def _read(read: Read, block: Block) -> bytes:
    try:
        return await read(block)
    except ExchangeRefusedError as error:
        raise _unknown(block) from error


def _unknown(block: Block) -> ImplausibleReplyError:
    message = f"no known SmartEVSE replies like this to {block.register:#06x}"
    return ImplausibleReplyError(message)
