"""Later dialects need quiet: any request on the line suspends their own cycle."""

import asyncio
from itertools import pairwise

from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.model import Fault, OrderChange
from custom_components.evse_bus.evse.smartevse.dialects import MAPS
from custom_components.evse_bus.evse.smartevse.polled import QUIET
from custom_components.evse_bus.evse.smartevse.registers import read_request
from tests.simulated_time import now

from .polled_scene import HEAD, PolledScene, play

NO_COMM = 2


def bursts(scene: PolledScene) -> list[list[float]]:
    """Return the times of requests by burst: less than a second apart."""
    found: list[list[float]] = []
    for sent in scene.line.sent:
        if found and sent.when - found[-1][-1] < 1.0:
            found[-1].append(sent.when)
        else:
            found.append([sent.when])
    return found


def quiets(scene: PolledScene) -> list[float]:
    every = bursts(scene)
    return [b[0] - a[-1] for a, b in pairwise(every)]


def test_polled_without_quiet_it_stops_with_no_comm() -> None:
    """The library must not do so: read the box every 3 s."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(2)
        await scene.bus.stop()
        request = read_request(1, MAPS[HEAD].status.block)
        errors = 0
        await scene.line.open()
        for _ in range(8):
            scene.line.write(request)
            await asyncio.sleep(3)
            errors |= scene.outlet.error
        assert errors & NO_COMM
        assert scene.box.offers == 0

    play(PolledScene(HEAD), acts)


def test_polled_by_the_library_it_does_not_stop() -> None:
    async def acts(scene: PolledScene) -> None:
        errors = []
        scene.on_step.append(lambda: errors.append(scene.outlet.error))
        await scene.charge()
        for current in (7, 12, 9, 10):
            await scene.charger.change_orders(OrderChange(current=current))
            assert scene.box.offers == current
            await asyncio.sleep(60)
        await asyncio.sleep(600)
        assert not any(errors)
        assert Fault.NO_COMM not in scene.charger.faults
        assert scene.box.offers == 10

    scene = play(PolledScene(HEAD, poll_interval=0.5), acts)
    assert min(quiets(scene)) >= QUIET - 0.1
    # Nor is it read less often than possible.
    assert max(quiets(scene)) < QUIET + 1.0


def test_commands_wait_for_the_quiet_but_pauses_do_not() -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(3)
        last = bursts(scene)[-1][-1]
        await scene.until(lambda: bursts(scene)[-1][-1] > last)
        await asyncio.sleep(1.0)
        began = now()
        await scene.charger.change_orders(OrderChange(allowed=False))
        assert now() - began < 0.5
        began = now()
        await scene.charger.change_orders(OrderChange(allowed=True))
        assert QUIET - 1.5 < now() - began < QUIET + 1.0

    play(PolledScene(HEAD), acts)


def test_requests_to_other_addresses_disturb_the_quiet_too() -> None:
    async def acts(scene: PolledScene) -> None:
        errors = []
        scene.on_step.append(lambda: errors.append(scene.outlet.error))
        await scene.charge()

        async def ask(turn: Turn) -> None:
            await turn.send(read_request(5, MAPS[HEAD].status.block))

        for _ in range(20):
            await asyncio.sleep(9.1)
            await scene.bus.run(ask)
        assert not any(errors)

    scene = play(PolledScene(HEAD), acts)
    mine = [s.when for s in scene.line.sent if s.data[0] == 1]
    foreign = [s.when for s in scene.line.sent if s.data[0] == 5]
    for when in foreign:
        following = min((one for one in mine if one > when), default=when + QUIET)
        assert following - when >= QUIET - 0.1
