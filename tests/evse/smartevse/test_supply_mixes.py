"""Property: any mix of boxes that one master may have keeps to the supply.

{2.17}, {2.20} or {2.30, HEAD, 3.x}, with what no source settles drawn at random, and any
cars, commands and mishaps. More than the supply is excused only where no master can
help it (`sharing`): a lowered supply is on its way, or another master is there.
"""

import asyncio
from collections.abc import Awaitable
from contextlib import suppress
import os
from random import Random
from typing import Any

from hypothesis import (
    HealthCheck,
    Phase,
    event,
    example,
    given,
    settings,
    strategies as st,
)
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange
from tests.evse.smartevse.mixes import (
    FAMILIES,
    UNITS,
    BoxSpec,
    MixScene,
    lossy,
    silent_once_granted,
)
from tests.simulated_time import now, simulate
from tests.virtual import Car

EXAMPLES = int(os.environ.get("SUPPLY_EXAMPLES", "6"))
pytestmark = pytest.mark.timeout(60 + 2 * EXAMPLES)
PHASES = tuple(set(Phase) - {Phase.explain})
"""To explain a failure would take minutes."""
SEATS = 7
"""Most boxes of one master; a story names them by their place."""
ALL_COME, FIRST_COMES, NONE_COMES = 3, 1, 0
"""Seeds with which all cars are there at the beginning, or the first of two, or none."""
FALLS_SILENT = 3
"""One with which the only car is there, and the library ends."""
SHARE, BEGINNING = 0.7, 9.0
"""Cars that are there before the story, and time for them to begin, s."""
SLOWEST = 3.0
"""Longest wait for a command, s."""


def boxes_of(family: str) -> st.SearchStrategy[list[BoxSpec]]:
    """Return any boxes that one master may have, with their unknowns."""
    spec = st.builds(BoxSpec, dialect=st.sampled_from(FAMILIES[family]), **UNKNOWNS)
    return st.lists(spec, min_size=1, max_size=len(UNITS[family]))


UNKNOWNS: dict[str, st.SearchStrategy[Any]] = {
    "cable": st.sampled_from((32, 32, 16, 13)),
    "maximum": st.sampled_from((32, 32, 25, 16, 10)),
    "fixed": st.booleans(),
    "smart": st.booleans(),
    "delay": st.sampled_from((0.008, 0.02, 0.06)),
    "late": st.sampled_from(("no", "before", "after")),
    "second": st.sampled_from((1.0, 0.99, 1.0063)),
    "reaction": st.sampled_from((0.2, 0.5, 1.0, 3.0)),
    "ramp": st.sampled_from((0.0, 1.0, 3.0)),
    "insists": st.booleans(),
    "pilot_cut": st.sampled_from((5, 0)),
    "mode_opens_access": st.booleans(),
    "highest_access": st.sampled_from((None, 1, 2)),
    "access_stored": st.booleans(),
    "modem": st.sampled_from((0, 0, 2)),
    "kept": st.booleans(),
    "allowed": st.sampled_from((True, True, True, False)),
    "limit": st.sampled_from((32.0, 32.0, 32.0, 9.3, 5.0)),
    "access": st.sampled_from((True, True, True, False)),
}

type Act = tuple[str, int, float]

acts = st.lists(
    st.tuples(
        st.sampled_from(
            (
                *("come", "come", "come", "leave", "rest", "ask", "press", "press"),
                *("deaf", "mute", "lossy", "damaged", "reset", "well", "well"),
                *("silent once granted", "gone once granted"),
                *("away", "back", "again", "reload", "other", "alone"),
                *("off", "on", "none", "less", "more", "low supply", "high supply"),
            )
        ),
        st.integers(0, SEATS - 1),
        st.sampled_from((0.0, 0.05, 0.3, 1.0, 2.5, 7.0, 15.0)),
    ),
    max_size=16,
)

silences = st.lists(
    st.tuples(
        st.sampled_from(
            (
                *("come", "come", "leave", "rest", "ask", "ask"),
                *("deaf", "no broadcasts", "no broadcasts", "well", "off", "none"),
                *("silent once granted", "gone once granted", "press", "more"),
            )
        ),
        st.integers(0, 2),
        st.sampled_from((0.3, 1.0, 2.0, 4.0, 8.0, 15.0)),
    ),
    min_size=4,
    max_size=14,
)
"""Only cars, and boxes that do not receive what they should."""

CHANGES = {
    "off": OrderChange(allowed=False),
    "on": OrderChange(allowed=True),
    "none": OrderChange(current=0.0),
    "less": OrderChange(current=9.3),
    "more": OrderChange(current=32.0),
}
SUPPLIES = {"low supply": 0.6, "high supply": 1.2}
"""By the supply at the beginning."""


def do_to_car(car: Car, what: str) -> None:
    match what:
        case "come":
            car.plug_in()
        case "leave":
            car.leave()
        case "rest":
            car.finish()
        case "ask":
            car.request()


def do_to_box(scene: MixScene, what: str, unit: int, dice: Random) -> None:
    box = scene.box(unit)
    match what:
        case "press":
            scene.press(unit)
        case "deaf":
            box.deaf = True
        case "mute":
            box.mute = True
        case "lossy":
            lossy(box, 0.4, dice)
        case "no broadcasts":
            # It is read, and does not receive what it may offer.
            box.misses = lambda data: data[:1] in (b"\0", b"\x09", b"")
        case "silent once granted" | "gone once granted":
            silent_once_granted(box, deaf=what[0] == "g")
        case "reset":
            scene.power_cycle(unit)
        case "well":
            box.deaf = box.mute = False
            box.misses = box.loses = lambda _data: False


async def do_to_line(scene: MixScene, what: str, family: str, dice: Random) -> None:
    match what:
        case "damaged":
            scene.damaged = True
            scene.line.damage = lambda data: flipped(data, dice)
        case "away" | "back":
            scene.unplug_adapter(away=what == "away")
        case "again" | "reload":
            # Without its port it would not start.
            scene.unplug_adapter(away=False)
            await scene.restart(reload=what == "reload")
        case "other" | "alone":
            scene.other_master(dice.choice(FAMILIES[family]), present=what == "other")


def flipped(data: bytes, dice: Random) -> bytes:
    """Return a frame of which one bit in ten times has changed."""
    if not data or dice.random() > 0.1:
        return data
    bit = dice.randrange(8 * len(data))
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


async def attempt(command: Awaitable[None]) -> None:
    """Give a command some seconds; it may fail."""
    with suppress(EvseError, TimeoutError):
        async with asyncio.timeout(SLOWEST):
            await command


async def live(scene: MixScene, family: str, story: list[Act], dice: Random) -> None:
    supply = scene.limit
    async with scene:
        await asyncio.sleep(5)
        for unit in scene.units:
            if dice.random() < SHARE:
                scene.box(unit).car.plug_in()
        await asyncio.sleep(BEGINNING)
        for what, seat, pause in story:
            unit = scene.units[seat % len(scene.units)]
            do_to_car(scene.box(unit).car, what)
            do_to_box(scene, what, unit, dice)
            await do_to_line(scene, what, family, dice)
            if what in CHANGES:
                await attempt(scene.order(unit, CHANGES[what]))
            elif what in SUPPLIES:
                limit = max(6.0, round(supply * SUPPLIES[what], 1))
                await attempt(scene.change_supply(limit))
            await asyncio.sleep(pause)
        for unit in scene.units:
            do_to_box(scene, "well", unit, dice)
        scene.damaged = False
        scene.line.damage = lambda data: data
        scene.unplug_adapter(away=False)
        is_settled = await scene.settle()
        scene.check_writes()
        if is_settled:
            scene.check_orders()
            await (scene.pause_all() if dice.randrange(2) else scene.fall_silent())


def check(
    family: str, boxes: list[BoxSpec], limit: float, story: list[Act], seed: int
) -> None:
    dice = Random(seed)  # noqa: S311 - the same each time
    units = tuple(UNITS[family])[: len(boxes)]
    scene: MixScene | None = None

    async def run() -> None:
        nonlocal scene
        scene = MixScene(
            units=units,
            limit=limit,
            current=32.0,
            specs=dict(zip(units, boxes, strict=True)),
        )
        await live(scene, family, story, dice)

    simulate(run())
    assert scene is not None
    for reason in scene.excused:
        event(f"excused: {reason}")
    assert not scene.wrong, scene.wrong[:3]


@settings(
    max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow], phases=PHASES
)
@given(
    mix=st.sampled_from(tuple(FAMILIES)).flatmap(
        lambda family: st.tuples(st.just(family), boxes_of(family))
    ),
    limit=st.sampled_from((12.0, 18.0, 20.0, 25.0, 40.0)),
    story=acts,
    seed=st.integers(0, 1000),
)
# A pause of 2.17 is its access; a 0 in the broadcast would leave it at 6 A.
@example(
    mix=("2.17", [BoxSpec(dialect="2.17")]),
    limit=20.0,
    story=[("off", 0, 5.0)],
    seed=ALL_COME,
)
# Access is turned off while it asks: after a grant it would go on all the same.
@example(
    mix=("2.20", [BoxSpec(dialect="2.20", reaction=3.0)]),
    limit=20.0,
    story=[("leave", 0, 3.0), ("come", 0, 0.15), ("press", 0, 10.0)],
    seed=ALL_COME,
)
# It would charge for ever after our end.
@example(
    mix=("2.30", [BoxSpec(dialect="3.6", kept=True)]),
    limit=20.0,
    story=[("come", 0, 5.0)],
    seed=FALLS_SILENT,
)
def test_any_mix_keeps_to_the_supply(
    mix: tuple[str, list[BoxSpec]], limit: float, story: list[Act], seed: int
) -> None:
    """Set `SUPPLY_EXAMPLES` for more of them."""
    family, boxes = mix
    check(family, boxes, limit, story, seed)


@settings(
    max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow], phases=PHASES
)
@given(
    mix=st.sampled_from(tuple(FAMILIES)).flatmap(
        lambda family: st.tuples(
            st.just(family), boxes_of(family).map(lambda boxes: boxes[:3])
        )
    ),
    limit=st.sampled_from((12.0, 20.0, 25.0)),
    story=silences,
    seed=st.integers(0, 1000),
)
# Stopped while it is deaf: HEAD holds its contactor for 18 s, an old 3.x for ever.
@example(
    mix=("2.30", [BoxSpec(dialect="2.30+", insists=True), BoxSpec(dialect="2.30")]),
    limit=12.0,
    story=[("deaf", 0, 0.0), ("off", 0, 30.0)],
    seed=ALL_COME,
)
@example(
    mix=("2.30", [BoxSpec(dialect="3.6"), BoxSpec(dialect="2.30")]),
    limit=12.0,
    story=[("deaf", 0, 0.0), ("off", 0, 30.0)],
    seed=ALL_COME,
)
# Its pilot is as before its car's pause, since no broadcast has lowered it; in state 6
# it receives one, and its pilot does not follow.
@example(
    mix=("2.20", [BoxSpec(dialect="2.20"), BoxSpec(dialect="2.20")]),
    limit=25.0,
    story=[
        *(("no broadcasts", 0, 0.3), ("rest", 0, 0.3), ("come", 1, 5.0)),
        ("ask", 0, 8.0),
    ],
    seed=FIRST_COMES,
)
@example(
    mix=("2.30", [BoxSpec(dialect="2.30"), BoxSpec(dialect="2.30")]),
    limit=25.0,
    story=[
        *(("no broadcasts", 0, 0.3), ("rest", 0, 0.3), ("come", 1, 5.5)),
        *(("ask", 0, 0.05), ("well", 0, 8.0)),
    ],
    seed=FIRST_COMES,
)
# It was granted current, and no status shows that.
@example(
    mix=("2.17", [BoxSpec(dialect="2.17"), BoxSpec(dialect="2.17")]),
    limit=12.0,
    story=[("silent once granted", 1, 0.05), ("come", 1, 25.0)],
    seed=FIRST_COMES,
)
@example(
    mix=("2.30", [BoxSpec(dialect="2.30+"), BoxSpec(dialect="2.30")]),
    limit=12.0,
    story=[
        *(("leave", 0, 3.0), ("gone once granted", 1, 0.05)),
        *(("come", 1, 5.0), ("come", 0, 25.0)),
    ],
    seed=FIRST_COMES,
)
@example(
    mix=("2.20", [BoxSpec(dialect="2.20"), BoxSpec(dialect="2.20")]),
    limit=12.0,
    story=[("gone once granted", 1, 0.05), ("come", 1, 25.0)],
    seed=FIRST_COMES,
)
# It was granted more than the broadcast that it missed after that.
@example(
    mix=("2.17", [BoxSpec(dialect="2.17"), BoxSpec(dialect="2.17", limit=9.3)]),
    limit=25.0,
    story=[
        *(("come", 1, 9.0), ("gone once granted", 0, 0.05)),
        *(("come", 0, 0.6), ("more", 1, 20.0)),
    ],
    seed=NONE_COMES,
)
def test_what_a_silent_box_may_be_offering_counts(
    mix: tuple[str, list[BoxSpec]], limit: float, story: list[Act], seed: int
) -> None:
    """Two or three boxes; one does not receive the broadcasts for a while."""
    family, boxes = mix
    check(family, boxes, limit, story, seed)


@settings(
    max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow], phases=PHASES
)
@given(
    families=st.permutations(tuple(FAMILIES)).map(lambda some: some[:2]),
    data=st.data(),
    story=st.lists(
        st.sampled_from(("come", "press", "reset", "off", "on", "less", "reload")),
        max_size=6,
    ),
)
def test_boxes_of_two_families_are_written_nothing(
    families: list[str], data: st.DataObject, story: list[str]
) -> None:
    """A broadcast for one would change the settings of the other."""
    one, other = (data.draw(boxes_of(family))[:3] for family in families)
    # Boxes of 2.17 have addresses up to 4.
    units = {"2.17": (2, 3, 4)}.get(families[0], (5, 6, 7))
    others = (5, 6, 7) if units == (2, 3, 4) else (2, 3, 4)
    places = (*units[: len(one)], *others[: len(other)])
    specs = dict(zip(places, (*one, *other), strict=True))
    dice = Random(0)  # noqa: S311 - the same each time

    async def run() -> None:
        scene = MixScene(units=tuple(specs), specs=specs)
        async with scene:
            # Until all were read: only then the mix is known.
            await asyncio.sleep(12)
            begin = now()
            for what in story:
                unit = dice.choice(scene.units)
                do_to_car(scene.box(unit).car, what)
                do_to_box(scene, what, unit, dice)
                await do_to_line(scene, what, families[0], dice)
                if what in CHANGES:
                    await attempt(scene.order(unit, CHANGES[what]))
                await asyncio.sleep(2)
            written = [s for s in scene.line.sent if s.data[1] not in (3, 4)]
            assert [s for s in written if s.when > begin] == []
            # Neither before that, but for the pause of a box that was read.
            assert [s for s in written if not scene.is_pause(s)] == []

    simulate(run())
