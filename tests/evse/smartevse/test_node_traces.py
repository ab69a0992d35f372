"""Our master against the recorded masters of 2.20, 2.30 and HEAD: the same frames.

Our master chooses other moments and currents; but each frame it sends to nodes must have
a form that a recorded master has sent, and the stories of the recordings run through.
"""

import asyncio

import pytest

from custom_components.evse_bus.evse.model import Circuit, OrderChange
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from tests.evse.smartevse.scene import MasterScene
from tests.evse.smartevse.test_balancing import RECORDED, trace
from tests.simulated_time import simulate

type Form = tuple[int | str, ...]

SECTIONS = ("node", "node_with_master", "node_refused", "two_nodes", "node_power_cycle")
READ, WRITE_ONE, WRITE_SEVERAL = 4, 6, 16
SETTINGS = (0x00C0, 0x00E0, 0x0100, 0x0200, 0x021A, 0x0216)
"""Registers of settings and of probes, which no recorded master reads."""


def form(data: bytes) -> Form:
    """Return what distinguishes a request, whatever its unit and its currents."""
    unit, function = data[:2]
    register, count = (int.from_bytes(data[at : at + 2]) for at in (2, 4))
    to = "all" if unit == 9 else "node"
    if function == WRITE_SEVERAL and to == "node":
        # States and errors, and access: each value counts.
        return (to, function, register, *data[4:-2])
    return (to, function, register, count)


def recorded(dialect: Dialect) -> set[Form]:
    sections = trace(dialect)
    frames = [
        entry.get("request") if "request" in entry else entry["hex"]
        for name in SECTIONS
        for entry in sections[name]
        if "request" in entry or entry.get("dir") == "master"
    ]
    return {form(bytes.fromhex(one)) for one in frames if one}


async def story(scene: MasterScene) -> None:
    """B, C, charge, lower, 0, refuse, 60 s, resume, access, silence, power failure."""
    one, two = (scene.slave(unit) for unit in (2, 3))
    await asyncio.sleep(8)
    await scene.charge(2)
    await asyncio.sleep(5)
    assert scene.offers == 16
    await one.change_orders(OrderChange(current=10.0))
    await scene.charge(3)
    await asyncio.sleep(5)
    await scene.master.change_circuit(Circuit(limit=8.0))
    await asyncio.sleep(25)
    # The second one: 0, then its next request is refused.
    assert scene.box(3).offers == 0
    await scene.master.change_circuit(Circuit(limit=20.0))
    await scene.until(lambda: scene.box(3).offers == 10)
    # The car ends and asks again; then there is no current for it.
    scene.box(3).car.finish()
    await asyncio.sleep(12)
    await one.change_orders(OrderChange(current=16.0))
    scene.box(3).car.request()
    await scene.until(lambda: scene.box(3).state == "C")
    await two.change_orders(OrderChange(allowed=False))
    await asyncio.sleep(5)
    await two.change_orders(OrderChange(allowed=True))
    await scene.until(lambda: scene.box(3).state == "C")
    # Silence of ours, and NO_COMM.
    for box in scene.line.boxes.values():
        box.deaf = True
    await asyncio.sleep(15)
    assert scene.offers == 0
    for box in scene.line.boxes.values():
        box.deaf = False
    await scene.until(lambda: scene.offers == 20)
    # A power failure, also while it is paused.
    scene.box(2).controller.power_cycle()
    await asyncio.sleep(30)
    await one.change_orders(OrderChange(allowed=False))
    scene.box(2).controller.power_cycle()
    await asyncio.sleep(30)
    assert scene.box(2).offers == 0
    # Refused in state 6: no current when the car asks for it.
    scene.box(3).car.leave()
    await one.change_orders(OrderChange(allowed=True))
    await scene.until(lambda: scene.box(2).state == "C")


@pytest.mark.parametrize("dialect", RECORDED)
def test_each_frame_has_a_form_that_a_recorded_master_has_sent(
    dialect: Dialect,
) -> None:
    async def scene() -> None:
        scene = MasterScene(
            units=(2, 3), dialect=dialect.value, limit=20.0, watch=False
        )
        async with scene:
            await story(scene)
            ours = {
                form(sent.data)
                for sent in scene.line.sent
                if int.from_bytes(sent.data[2:4]) not in SETTINGS
                # The probe of the dialect.
                and sent.data[2:6] != bytes((0, 0xA0, 0, 9))
                and sent.data[2:6] != bytes((0, 0xA9, 0, 3))
            }
        assert ours <= recorded(dialect)
        states = {one[-4:] for one in ours if one[:2] == ("node", WRITE_SEVERAL)}
        # Granted B and C, refused, cleared.
        assert {(0, 5, 0, 0), (0, 7, 0, 0), (0, 4, 0, 1)} <= states
        assert states & {(0, 0, 0, 0), (0, 9, 0, 0)}

    simulate(scene())
