"""Conversations of several turns, written as one coroutine.

Between two turns others may speak: `await rest(0.4)` gives the bus away for so long.
"""

from collections.abc import Callable, Coroutine, Generator
from dataclasses import dataclass
from functools import partial
from types import coroutine
from typing import Any

from .errors import LineBusyError, NotConfirmedError, ReplyTimeoutError
from .exchange import Talk
from .jobs import Later, Step

type Conversation = Callable[[Talk], Coroutine[Any, Any, None]]


@dataclass(frozen=True, slots=True)
class _Rest:
    """What a conversation says to whoever drives it."""

    pause: float


@coroutine
def rest(pause: float) -> Generator[Any]:
    """End this turn; the next one comes after a pause, s, in which others may speak."""
    yield _Rest(pause)


def in_turns(conversation: Conversation, *, in_one_go: bool = False) -> Step[None]:
    """Return the first turn of a conversation; each turn brings the next one.

    The first turn may be repeated: it begins the conversation anew. A later one may
    not, so an answer that stays away there, or a line on which others keep talking,
    raises NotConfirmedError. ``in_one_go``: rests that only let others speak are
    left out.
    """

    async def first(talk: Talk) -> Later[None] | None:
        return await _advance(conversation(talk), in_one_go=in_one_go)

    return first


async def _go_on(
    begun: Coroutine[Any, Any, None], _talk: Talk, *, in_one_go: bool
) -> Later[None] | None:
    # Every turn has a talk of its own, and all talks of one charger are alike: the
    # conversation goes on with its first.
    try:
        return await _advance(begun, in_one_go=in_one_go)
    except (ReplyTimeoutError, LineBusyError) as error:
        # Repeated, it would be at its end at once, and look as if it had gone well.
        raise NotConfirmedError(str(error)) from error


@coroutine
def _advance(
    begun: Coroutine[Any, Any, None], *, in_one_go: bool
) -> Generator[Any, Any, Later[None] | None]:
    """Let it go on until it rests or ends; what it waits for, the event loop is told."""
    go_on = partial(begun.send, None)
    while True:
        try:
            waits_for = go_on()
        except StopIteration:
            return None
        go_on = partial(begun.send, None)
        if isinstance(waits_for, _Rest):
            if waits_for.pause > 0 or not in_one_go:
                step = partial(_go_on, begun, in_one_go=in_one_go)
                return Later(waits_for.pause, step)
            continue
        try:
            yield waits_for
        except BaseException as error:  # noqa: BLE001 - it is the conversation's
            go_on = partial(begun.throw, error)
