"""The two ends of a virtual wire: in simulated time, and a pty at its real pace."""

from collections.abc import Callable

import pytest

from tests.virtual import VirtualBus

type MakeBus = Callable[..., VirtualBus]

each_wire = pytest.mark.parametrize(
    "make_bus",
    [
        pytest.param(VirtualBus.in_loop, id="simulated"),
        pytest.param(
            VirtualBus.pty, id="pty", marks=(pytest.mark.real_time, pytest.mark.slow)
        ),
    ],
)
