"""The dialect of a box, found by reading only. Pure.

================== ============ ============ ========= ========== ========= =========
read               2.17         2.20         2.30      2.30+      3.x, 26   3.x
================== ============ ============ ========= ========== ========= =========
0xA0 x 9 (0x04)    state letter state number refused   refused    refused   refused
... its exception                            malformed malformed  standard  standard
0xA9 x 3 (0x03)    (no reply)   three words
0x021A (0x04)                                refused   answered
0x0216 (0x04)                                                     answered  refused
0x0000 x 12 (0x04)                           12 words  12 words   12 words  12 words
0x0100 x 5 (0x04)                            5 words   5 words    5 words   5 words
================== ============ ============ ========= ========== ========= =========

Cells in brackets are never asked for. Malformed: without the 0x80 in its function.
PROTOCOLS.md, 3.
"""

from collections.abc import Awaitable, Callable

from ..errors import ExchangeRefusedError, ImplausibleReplyError
from ..model import MAXIMUM_CURRENT
from ..registers import Block, words_of
from .dialects import (
    MAPS,
    MODEM_STATES,
    PROBE_A0,
    PROBE_A9,
    PROBE_HEAD,
    PROBE_V3_OLD,
    Dialect,
    Status,
)
from .registers import (
    ILLEGAL_ADDRESS,
    MalformedRefusalError,
    decode_status,
    has_known_box,
)

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
        return await _later(read, is_malformed=isinstance(error, MalformedRefusalError))
    dialect = dialect_of_a0(data)
    if dialect is None:
        raise _unknown(PROBE_A0)
    if dialect is Dialect.V2_20:
        await _read(read, PROBE_A9)
    return dialect


async def _later(read: Read, *, is_malformed: bool) -> Dialect:
    """Return the dialect of a box that refuses 0xA0, with this kind of exception."""
    if is_malformed:
        answered = await _is_answered(read, PROBE_HEAD)
        dialect = Dialect.V2_HEAD if answered else Dialect.V2_30
    else:
        answered = await _is_answered(read, PROBE_V3_OLD)
        dialect = Dialect.V3_OLD if answered else Dialect.V3
    row = MAPS[dialect]
    status = decode_status(dialect, await _read(read, row.status.block))
    block = row.configuration[0]
    words = words_of(block, await _read(read, block))
    if not _is_usual(status) or not has_known_box(dialect, words):
        raise _unknown(row.status.block)
    return dialect


def _is_usual(status: Status) -> bool:
    """Return whether each word has a value of today's firmwares.

    A later status may have others; but here another Modbus device may answer.
    """
    return (
        (not status.raw_state.isdecimal() or int(status.raw_state) in MODEM_STATES)
        and status.error in range(0x100)
        and status.current <= MAXIMUM_CURRENT
        and None not in (status.access, status.mode)
    )


async def _is_answered(read: Read, block: Block) -> bool:
    """Return whether a box has a register; raises for any other exception."""
    try:
        await read(block)
    except ExchangeRefusedError as error:
        if error.code != ILLEGAL_ADDRESS:
            raise _unknown(block) from error
        return False
    return True


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
