"""What is begun is finished, also when whoever asked for it gives up."""

import asyncio
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant


async def async_finish[T](
    hass: HomeAssistant, what: Coroutine[Any, Any, T], name: str
) -> T:
    """Return what a coroutine returns; raises what it raises.

    An automation that begins anew cancels the action that it waits for. That ends
    the waiting, not the action. (A shield would report its failure, which then
    interests nobody.)
    """
    task = hass.async_create_task(what, name)
    task.add_done_callback(_look_at)
    await asyncio.wait({task})
    return task.result()


def _look_at(task: asyncio.Task[Any]) -> None:
    """Take note of a failure, so that nobody is warned of one nobody waits for."""
    if not task.cancelled():
        task.exception()
