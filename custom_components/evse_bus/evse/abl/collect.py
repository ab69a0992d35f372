"""A read of one device-ID in which every reply counts, not only the first."""

from ..errors import GarbledReplyError
from ..exchange import Turn
from ..modbus import ModbusFrame
from ..registers import Registers
from .registers import read_answer, read_request


async def collect[T](
    turn: Turn, address: int, registers: Registers[T], *, disturbed: bool = True
) -> list[T]:
    """Return all replies to one read (see `Turn.collect`).

    ``disturbed``: unreadable bytes beside a reply are allowed (a box that wakes up).
    Raises ReplyTimeoutError where there is no reply, and GarbledReplyError.
    """
    replies: list[T] = []
    answer = read_answer(address, registers.block)

    def accept(frame: ModbusFrame) -> T | None:
        if (data := answer(frame)) is None:
            return None
        replies.append(registers.decode(data))
        return replies[-1]

    try:
        await turn.collect(read_request(address, registers.block), accept)
    except GarbledReplyError:
        if not (replies and disturbed):
            raise
    return replies
