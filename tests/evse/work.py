"""The work of a function, counted: the same on any machine, however busy."""

from collections.abc import Callable
import sys
from types import CodeType

_NAME = "work of a test"
_FREE = (3, 4)
"""Tool ids that Python names for no kind of tool."""


class TooMuchWorkError(Exception):
    """More instructions than allowed were executed."""


def instructions(function: Callable[[], object], most: int) -> int:
    """Call a function and return how many instructions of Python it executed.

    Raises TooMuchWorkError as soon as there are more than ``most``. What is done inside
    one call of C (a search in bytes, a comparison) counts as one.
    """
    count = 0

    def counted(_code: CodeType, _offset: int) -> None:
        nonlocal count
        count += 1
        if count > most:
            # What follows, the end of the count included, is not counted.
            monitoring.set_events(tool, 0)
            raise TooMuchWorkError(count)

    monitoring = sys.monitoring
    tool = next(one for one in _FREE if monitoring.get_tool(one) is None)
    monitoring.use_tool_id(tool, _NAME)
    monitoring.register_callback(tool, monitoring.events.INSTRUCTION, counted)
    monitoring.set_events(tool, monitoring.events.INSTRUCTION)
    try:
        function()
    finally:
        monitoring.set_events(tool, 0)
        monitoring.register_callback(tool, monitoring.events.INSTRUCTION, None)
        monitoring.free_tool_id(tool)
    return count
