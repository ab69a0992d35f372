"""Any orders in any order, with lost answers: the safety rules hold.

The virtual port is the oracle: no cable is unlocked without an order, no current is
above the ceiling once the first limit has been taken, nothing starts by itself.
"""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import Command, OrderChange

from .scene import EwsScene, now, play

WAITS = st.sampled_from((0.0, 0.05, 0.3, 1.0, 3.0, 8.0))
GONE = st.sampled_from((0.0, 1.0, 5.0))
"""Time for which the line is gone, s."""
ACTS = st.one_of(
    st.tuples(st.just("allow"), st.booleans(), WAITS),
    st.tuples(st.just("limit"), st.sampled_from((0.0, 6.0, 10.0, 16.0, 32.0)), WAITS),
    st.tuples(st.just("car"), st.sampled_from(("ask", "finish")), WAITS),
    st.tuples(st.just("lose"), st.sampled_from(("rc", "rd", "sl", "st")), WAITS),
    st.tuples(st.just("deaf"), st.sampled_from(("rc", "rd", "sl", "st")), WAITS),
    st.tuples(st.just("late"), st.sampled_from((0.3, 0.503, 0.52, 1.2)), WAITS),
    st.tuples(st.just("line"), GONE, WAITS),
    st.tuples(st.just("optimise"), st.booleans(), WAITS),
)
UNLOCKS = st.tuples(st.just("unlock"), st.just(None), WAITS)


@dataclass
class Run:
    scene: EwsScene
    lost: list[str] = field(default_factory=list)
    deaf: list[str] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)
    starts_wanted: int = 0

    def __post_init__(self) -> None:
        self.scene.line.mute = lambda name: self._take(self.lost, name)
        self.scene.line.deaf = lambda name: self._take(self.deaf, name)

    @staticmethod
    def _take(names: list[str], name: str) -> bool:
        if name not in names:
            return False
        names.remove(name)
        return True

    async def change(self, change: OrderChange) -> None:
        with suppress(EvseError):
            await self.scene.charger().change_orders(change)

    async def command(self, command: Command, value: bool | None = None) -> None:  # noqa: FBT001
        with suppress(EvseError):
            await self.scene.charger().command(command, value)

    async def act(self, act: str, value: object) -> None:
        if act == "allow":
            self.tasks.append(
                asyncio.ensure_future(self.change(OrderChange(allowed=bool(value))))
            )
        elif act == "limit":
            assert isinstance(value, float)
            self.tasks.append(
                asyncio.ensure_future(self.change(OrderChange(current=value)))
            )
        elif act == "car":
            car = self.scene.cars[0]
            (car.request if value == "ask" else car.finish)()
        elif act == "lose":
            self.lost.append(str(value))
        elif act == "deaf":
            self.deaf.append(str(value))
        elif act == "late":
            assert isinstance(value, float)
            self.scene.line.held_until = now() + value
        elif act == "optimise":
            self.tasks.append(
                asyncio.ensure_future(self.command(Command.SET_OPTIMISED, bool(value)))
            )
        elif act == "unlock":
            self.tasks.append(asyncio.ensure_future(self.command(Command.UNLOCK)))
        else:
            assert isinstance(value, float)
            self.scene.unplug(value)


@pytest.mark.slow
@settings(max_examples=50)
@given(
    acts=st.lists(ACTS, max_size=12) | st.lists(ACTS | UNLOCKS, max_size=12),
    pause_status=st.sampled_from((0x50, 0x42)),
    charging=st.booleans(),
)
def test_any_orders(
    acts: list[tuple[str, object, float]], pause_status: int, *, charging: bool
) -> None:
    async def happens(scene: EwsScene) -> None:
        port = scene.box.ports[0]
        port.pause_status = pause_status  # type: ignore[assignment]
        run = Run(scene)
        scene.cars[0].plug_in()
        await scene.until(lambda: scene.status() == 0x30)
        if charging:
            await scene.charge()
        begun = len(scene.line.sent)
        wanted = False
        for act, value, wait in acts:
            wanted |= (act, value) == ("allow", True)
            await run.act(act, value)
            await asyncio.sleep(wait)
        await asyncio.sleep(30)
        run.lost.clear()
        run.deaf.clear()
        await asyncio.sleep(60)
        if not any(act == "unlock" for act, *_ in acts):
            assert not scene.unlocked()
        assert not port.history.unlocked_under_power
        sent = scene.line.sent[begun:]
        assert all(one.parameters[1] for one in sent if one.name == "st")
        if not wanted and not charging:
            assert not scene.starts()
        ceiling = 25
        assert port.history.highest_offer <= ceiling
        orders = scene.charger().orders
        if scene.charger().setpoint.paused:
            assert port.status not in (0x40, 0x41)
        else:
            assert port.limit == min(orders.limit.current, ceiling)
        await asyncio.gather(*run.tasks)

    play(EwsScene(installation=25.0, ports=(1,)), happens)
