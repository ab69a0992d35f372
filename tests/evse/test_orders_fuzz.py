"""Any commands in any order on a bad line: what was said last stands."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange
from tests.simulated_time import simulate

from .telegram import Scene, SimulatedCharger
from .test_bus_mishaps import SlowCharger

CHANGES = st.one_of(
    st.booleans().map(lambda allowed: OrderChange(allowed=allowed)),
    st.integers(6, 32).map(lambda amperes: OrderChange(current=float(amperes))),
)
STEPS = st.lists(
    st.tuples(st.sampled_from((0.0, 0.05, 0.2, 0.5, 1.5)), st.none() | CHANGES),
    min_size=2,
    max_size=9,
)


@dataclass
class Witness:
    """What was said, and what of it was broken on the wire."""

    allowed: bool | None = None
    limit: float = 10.0
    broken: list[str] = field(default_factory=list)
    confirmed: dict[int, OrderChange | None] = field(default_factory=dict)

    async def say(
        self, number: int, charger: SimulatedCharger, change: OrderChange
    ) -> None:
        self.allowed = self.allowed if change.allowed is None else change.allowed
        self.limit = self.limit if change.current is None else change.current
        self.confirmed[number] = None
        try:
            await charger.change_orders(change)
        except EvseError:
            return
        self.confirmed[number] = change

    def on_wire(self, amperes: int) -> None:
        if amperes and self.allowed is False:
            self.broken.append(f"started at {amperes} A")
        if amperes > self.limit:
            self.broken.append(f"{amperes} A above {self.limit} A")


def bad_line(
    rng: Random, loss: float, witness: Witness
) -> Callable[[bytes], bytes | None]:
    """Return a device that requests do not reach, or whose answers get lost."""

    def answer(request: bytes) -> bytes | None:
        if request[2] == ord("W"):
            witness.on_wire(request[3])
        return None if rng.random() < loss else request

    return answer


@pytest.mark.parametrize("kind", [SimulatedCharger, SlowCharger])
@settings(max_examples=150)
@given(
    steps=STEPS,
    seed=st.integers(0, 1000),
    loss=st.sampled_from((0.0, 0.3, 0.6)),
    interval=st.sampled_from((0.0, 1.0)),
)
def test_what_was_said_last_stands(
    kind: type[SimulatedCharger],
    steps: list[tuple[float, OrderChange | None]],
    seed: int,
    loss: float,
    interval: float,
) -> None:
    """``None`` among the changes: the port is lost."""

    async def scene() -> None:
        scene = Scene(addresses=(1, 2), minimum_interval=interval)
        plain = scene.make(1)
        charger = kind(plain.config, plain.orders)
        scene.bus.add(charger)
        witness = Witness()
        scene.line.devices[1].answer = bad_line(Random(seed), loss, witness)  # noqa: S311
        said = []
        async with scene:
            for number, (pause, change) in enumerate(steps):
                await asyncio.sleep(pause)
                if change is None:
                    scene.line.unplug()
                else:
                    said.append(
                        asyncio.create_task(witness.say(number, charger, change))
                    )
            await asyncio.gather(*said)
            await asyncio.sleep(5)
        assert witness.broken == []
        for name, stands in (
            ("allowed", charger.orders.allowed),
            ("current", charger.orders.limit.current),
        ):
            last = [
                number
                for number, (_, change) in enumerate(steps)
                if change is not None and getattr(change, name) is not None
            ]
            change = witness.confirmed[last[-1]] if last else None
            if change is not None:
                assert stands == getattr(change, name)
        assert not list(scene.bus._jobs)

    simulate(scene())
