"""Conversations of several turns, written as one function.

Between two turns others may speak. A conversation is an async generator that
yields the pauses, in seconds; what it does between two pauses is one turn.
"""

from collections.abc import AsyncGenerator, Callable
from functools import partial

from .errors import LineBusyError, NotConfirmedError, ReplyTimeoutError
from .exchange import Talk
from .jobs import Later, Step

type Turns = AsyncGenerator[float]
"""Yields the pause before its next turn, s."""


def in_turns(conversation: Callable[[Talk], Turns]) -> Step[None]:
    """Return the first turn of a conversation; each turn brings the next one.

    The first turn may be repeated: it begins the conversation anew. A later one may
    not, so an answer that stays away there, or a line on which others keep talking,
    raises NotConfirmedError.
    """

    async def first(talk: Talk) -> Later[None] | None:
        return await _advance(conversation(talk))

    return first


async def _go_on(turns: Turns, _talk: Talk) -> Later[None] | None:
    # Every turn has a talk of its own, and all talks of one charger are alike: the
    # conversation goes on with its first.
    try:
        return await _advance(turns)
    except (ReplyTimeoutError, LineBusyError) as error:
        # Repeated, it would be at its end at once, and look as if it had gone well.
        raise NotConfirmedError(str(error)) from error


async def _advance(turns: Turns) -> Later[None] | None:
    try:
        pause = await anext(turns)
    except StopAsyncIteration:
        return None
    return Later(pause, partial(_go_on, turns))
