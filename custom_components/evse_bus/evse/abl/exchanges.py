"""Exchanges with a box in which the first reply is not all that counts."""

from collections.abc import Callable

from ..errors import ExchangeRefusedError, GarbledReplyError, ReplyTimeoutError
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


async def write_once(
    turn: Turn, request: bytes, accept: Callable[[ModbusFrame], bool | None]
) -> bool:
    """Send a write; return whether it was confirmed. A lost reply decides nothing.

    Nor does a late one: a box that confirms a reset after it is no slow line, whose
    reply time-out would have to grow. Raises ExchangeRefusedError.
    """
    is_over = False

    def accept_in_time(frame: ModbusFrame) -> bool | None:
        return None if is_over else accept(frame)

    try:
        await turn.exchange(request, accept_in_time)
    except ReplyTimeoutError:
        return False
    finally:
        is_over = True
    return True


async def collect_confirmations(
    turn: Turn, request: bytes, accept: Callable[[ModbusFrame], bool | None]
) -> list[ExchangeRefusedError | None]:
    """Send a write; return all replies in time: ``None`` confirms it.

    Two replies mean that it has reached two boxes. Raises ReplyTimeoutError where
    there is no reply, and GarbledReplyError for unreadable bytes, which may be two.
    """
    replies: list[ExchangeRefusedError | None] = []
    is_over = False

    def accept_all(frame: ModbusFrame) -> bool | None:
        if is_over:
            return None
        try:
            if accept(frame) is None:
                return None
            replies.append(None)
        except ExchangeRefusedError as error:
            replies.append(error)
        return True

    try:
        await turn.collect(request, accept_all)
    finally:
        is_over = True
    return replies
