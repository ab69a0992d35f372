"""The library opens the ports of virtual buses that live on its loop."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from custom_components.evse_bus.evse import line
from tests.virtual.ports import DirectPort

_serialx = line.create_serial_connection


async def connect[P: asyncio.Protocol](
    loop: asyncio.AbstractEventLoop,
    factory: Callable[[], P],
    url: str,
    **settings: Any,  # noqa: ANN401 - serialx' own
) -> tuple[object, P]:
    """Open a direct port; any other one as the library does."""
    if (port := DirectPort.find(url)) is None:
        return await _serialx(loop, factory, url, **settings)
    protocol = factory()
    return await port.connect(protocol), protocol


@contextmanager
def direct_ports() -> Iterator[None]:
    """Let the library open them, for as long as this context lasts."""
    with patch.object(line, "create_serial_connection", connect):
        yield
