"""Conversations: coroutines that take turns on the bus.

A conversation is a coroutine function of one argument, its `Turn`. It has the bus to
itself until it ends or awaits `rest`; other conversations may have their turns
meanwhile, and the next turn goes on where it rested.
"""

from collections.abc import Callable, Coroutine, Generator
from dataclasses import dataclass
from functools import partial
from types import coroutine
from typing import Any

from .errors import LineBusyError, NotConfirmedError, ReplyTimeoutError
from .exchange import Turn

type Conversation[T = None] = Callable[[Turn], Coroutine[Any, Any, T]]
"""Begins a conversation; ``T`` is its result."""


@dataclass(frozen=True, slots=True)
class Rest:
    """The end of a turn of a conversation that goes on."""

    pause: float
    """Time before the next turn, s."""
    worst_case: float | None
    """Longest time the next turn can take, s; ``None``: as long as this one."""


@coroutine
def rest(pause: float = 0.0, *, worst_case: float | None = None) -> Generator[Any, Any]:
    """End this turn; the next one comes after ``pause`` seconds or later.

    ``worst_case``: the longest time the next turn can take, s, if it is another than
    that of this one. After a rest nothing is repeated by the bus: a reply that stays
    away then raises NotConfirmedError to the caller of the conversation.
    """
    yield Rest(pause, worst_case)


@dataclass(frozen=True, slots=True)
class FollowUp:
    """A conversation that an exchange leads to; no caller waits for its result."""

    conversation: Conversation[object]
    pause: float = 0.0
    """Time before its first turn, s."""
    worst_case: float | None = None
    """Longest time its first turn can take, s; ``None``: as any of its charger."""


async def nothing(_turn: Turn) -> None:
    """Do nothing: a follow-up for a frame that needs no reply."""


class RunningConversation[T]:
    """A conversation that has begun; the bus lets it go on turn by turn."""

    def __init__(self, begun: Coroutine[Any, Any, T], *, bursts: bool = False) -> None:
        """``bursts``: rests without a pause do not end a turn."""
        self._begun = begun
        self._bursts = bursts
        self._has_rested = False
        self._result: T | None = None

    @property
    def result(self) -> T | None:
        """Return its result, once it has ended."""
        return self._result

    async def go_on(self) -> Rest | None:
        """Have the next turn; return how it rests, ``None`` when it has ended.

        Raises what the conversation raises; NotConfirmedError for a reply that stays
        away, or a line that is busy, in any turn but the first: begun anew there, it
        would do twice what it has done before its rest.
        """
        try:
            pause = await self._advance()
        except (ReplyTimeoutError, LineBusyError) as error:
            if not self._has_rested:
                raise
            raise NotConfirmedError(str(error)) from error
        self._has_rested = True
        return pause

    def close(self) -> None:
        """End a conversation that rests: its cleanup runs, nothing is sent."""
        self._begun.close()

    @coroutine
    def _advance(self) -> Generator[Any, Any, Rest | None]:
        # Drives the coroutine by hand: a rest is ours, all else it awaits goes to the
        # event loop as it is.
        go_on = partial(self._begun.send, None)
        while True:
            try:
                awaited = go_on()
            except StopIteration as end:
                self._result = end.value
                return None
            go_on = partial(self._begun.send, None)
            if isinstance(awaited, Rest):
                if awaited.pause > 0 or not self._bursts:
                    return awaited
                continue
            try:
                yield awaited
            except BaseException as error:  # noqa: BLE001 - it is the conversation's
                go_on = partial(self._begun.throw, error)
