"""One exchange with a box: a block read, a register written."""

from ..errors import ReplyTimeoutError
from ..exchange import Request, Turn
from ..registers import Block
from .registers import read_answer, read_request, write_answer


async def read(turn: Turn, unit: int, block: Block) -> bytes:
    """Return the bytes of a block.

    Raises ExchangeRefusedError and what `Turn.exchange` raises.
    """
    return await turn.exchange(read_request(unit, block), read_answer(unit, block))


async def write(turn: Turn, unit: int, request: Request, register: int) -> bool | None:
    """Write one register; only a read-back tells whether it was taken.

    True: the box says so; False: it says no, and may have taken it all the same;
    ``None``: it says nothing. Raises ExchangeRefusedError where there is no such
    register, LineBusyError and LineLostError.
    """
    try:
        return await turn.exchange(request, write_answer(unit, register))
    except ReplyTimeoutError:
        return None
