"""One exchange with a box: a block read, a register written."""

from ..errors import ReplyTimeoutError
from ..exchange import Turn
from ..registers import Registers
from ..safety import Setpoint
from .registers import (
    CONFIGURATION_REGISTER,
    LIMIT_REGISTER,
    STATE_REGISTER,
    StateCode,
    read_answer,
    read_request,
    write_answer,
    write_configuration,
    write_limit,
    write_state,
)


async def read[T](
    turn: Turn, address: int, registers: Registers[T], *, attempts: int = 1
) -> T:
    """Return the contents of a block; raises what `Turn.exchange` raises.

    More than one attempt is for a box known to be awake: then a lost answer was a
    disturbance, and asking again at once helps.
    """
    request = read_request(address, registers.block)
    answer = read_answer(address, registers.block)
    for _ in range(attempts - 1):
        try:
            return registers.decode(await turn.exchange(request, answer))
        except ReplyTimeoutError:
            continue
    return registers.decode(await turn.exchange(request, answer))


async def set_limit(turn: Turn, address: int, setpoint: Setpoint) -> None:
    """Write Icmax; also raises ExchangeRefusedError."""
    await turn.exchange(
        write_limit(address, setpoint), write_answer(address, LIMIT_REGISTER)
    )


async def set_state(turn: Turn, address: int, code: StateCode) -> None:
    """Make the outlet change its state; also raises ExchangeRefusedError."""
    await turn.exchange(
        write_state(address, code), write_answer(address, STATE_REGISTER)
    )


async def configure(
    turn: Turn,
    address: int,
    device_id: int,
    *,
    upstream_timeout: bool | None = None,
    needs_enable: bool | None = None,
) -> None:
    """Write device-ID and settings (in E2); also raises ExchangeRefusedError."""
    request = write_configuration(
        address,
        device_id,
        upstream_timeout=upstream_timeout,
        needs_enable=needs_enable,
    )
    await turn.exchange(request, write_answer(address, CONFIGURATION_REGISTER))
