"""What the guard promises, whatever the meter, the boxes and the clock do."""

from dataclasses import dataclass, field
import json
from math import inf, nan
from typing import Final

from hypothesis import given, settings, strategies as st

from custom_components.evse_bus.house.fuse import (
    Fuse,
    Guarded,
    KeptPauses,
    PhaseReport,
    Reason,
)
from custom_components.evse_bus.house.guard import CONFIRM, MARGIN, Guard
from custom_components.evse_bus.house.guarded import RESTARTS
from custom_components.evse_bus.house.meter import Silence
from custom_components.evse_bus.house.phases import Rotation
from custom_components.evse_bus.house.readings import ChargerReport, ChargerSettings

BAD: Final = st.sampled_from([nan, inf, -inf, 1e6, None, 0.0, 100.0, -25.0, 25.0])
CURRENT = st.one_of(st.floats(-40, 60), BAD)
PHASES = st.tuples(CURRENT, CURRENT, CURRENT)


@dataclass(frozen=True)
class Step:
    """What happens at one look."""

    seconds: float
    meter: tuple[float | None, float | None, float | None] | None
    meter_age: float
    draws: tuple[float | None, ...]
    offered: tuple[float | None, ...]
    repeats: int


STEPS = st.lists(
    st.builds(
        Step,
        seconds=st.one_of(
            st.sampled_from([1.0, 5.0, 10.0, 10.0, 10.0, 30.0, 61.0, 300.0, -50.0]),
            st.floats(0, 120),
        ),
        meter=st.one_of(PHASES, PHASES, st.none()),
        meter_age=st.sampled_from([0.0, 0.0, 0.0, 2.0, 15.0, -1.0, -4000.0, 4000.0]),
        draws=st.tuples(*(CURRENT for _ in range(9))),
        offered=st.tuples(*(st.one_of(st.none(), st.floats(0, 40)) for _ in range(3))),
        repeats=st.sampled_from([1, 1, 2, 8]),
    ),
    max_size=20,
)

BOXES = st.lists(
    st.builds(
        Guarded,
        settings=st.builds(
            ChargerSettings,
            charger=st.just("one"),
            maximum=st.sampled_from([0.0, 5.0, 6.0, 16.0, 32.0]),
            step=st.sampled_from([0.1, 1.0]),
            wired=st.integers(1, 3),
        ),
        rotation=st.sampled_from(Rotation),
        reaction=st.sampled_from([0.0, 8.5, 15.0, 30.0]),
    ),
    min_size=1,
    max_size=3,
)
FUSES = st.builds(
    Fuse,
    rating=st.sampled_from([0.0, 16.0, 25.0, 63.0]),
    safe=st.sampled_from([0.0, 6.0]),
)


@dataclass
class World:
    """A guard, and what it was given, with a judgement of its own."""

    fuse: Fuse
    boxes: list[Guarded]
    now: float = 1e5
    grants: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.boxes = [
            Guarded(
                settings=ChargerSettings(
                    charger=str(at),
                    maximum=one.settings.maximum,
                    step=one.settings.step,
                    wired=one.settings.wired,
                ),
                rotation=one.rotation,
                reaction=one.reaction,
            )
            for at, one in enumerate(self.boxes)
        ]
        self.guard = Guard(self.fuse)
        self.guard.configure(self.boxes, {}, self.now)
        self.look()

    def look(self) -> dict[str, Reason]:
        found = self.guard.look(self.now)
        self.grants = {name: one.current for name, one in found.items()}
        return {name: one.reason for name, one in found.items()}

    def take(self, step: Step) -> None:
        self.now += step.seconds
        for at, one in enumerate(self.boxes):
            flows = step.draws[3 * at : 3 * at + 3]
            report = ChargerReport(
                at=self.now,
                currents=(flows[0], flows[1], flows[2]),
                offered=step.offered[at],
            )
            self.guard.charger(one.settings.charger, report, self.now)
        if step.meter is not None:
            report_ = PhaseReport(at=self.now - step.meter_age, currents=step.meter)
            self.guard.meter(report_, self.now)

    def left_by(self, step: Step) -> list[tuple[float, int, float]]:
        """Return what this report left at most: now, the phase, A."""
        if step.meter is None:
            return []
        own = [0.0, 0.0, 0.0]
        for name, one in self.guard._chargers.items():
            drawn = [
                max(currents)
                for when, currents in one._draws
                if abs(when - (self.now - step.meter_age)) <= 30
            ]
            for phase in self.boxes[int(name)].phases:
                own[phase] += max(drawn, default=0.0)
        return [
            (self.now, phase, self.fuse.rating - MARGIN - current + own[phase])
            for phase, current in enumerate(step.meter)
            if current is not None and abs(current) < 430
        ]

    def loads(self) -> list[float]:
        """Return the sum of the grants on each phase of the house."""
        total = [0.0, 0.0, 0.0]
        for one in self.boxes:
            for phase in one.phases:
                total[phase] += self.grants[one.settings.charger]
        return total


@given(FUSES, BOXES, STEPS)
@settings(max_examples=50, deadline=None)
def test_grants_fit_into_every_phase_at_each_decision(
    fuse: Fuse, boxes: list[Guarded], steps: list[Step]
) -> None:
    """Except the minimum of those that pause within 15 s, and the silent meter's."""
    world = World(fuse, boxes)
    for step in steps:
        for _ in range(step.repeats):
            world.take(step)
            world.look()
            headroom = world.guard.headroom
            if headroom is None or world.guard.silence(world.now) is not Silence.NONE:
                continue
            if world.guard.refused:
                continue
            for phase, load in enumerate(world.loads()):
                over = load - headroom[phase]
                on_it = [
                    world.grants[one.settings.charger]
                    for one in world.boxes
                    if phase in one.phases
                ]
                if load and over > 1e-6:
                    assert all(one in {0.0, 6.0} for one in on_it)
                    one_short = any(
                        one.short_since is not None and world.now - one.short_since < 15
                        for one in world.guard._chargers.values()
                    )
                    assert one_short


@given(FUSES, BOXES, STEPS, st.floats(31, 5000))
@settings(max_examples=50, deadline=None)
def test_silence_only_lowers(
    fuse: Fuse, boxes: list[Guarded], steps: list[Step], longer: float
) -> None:
    world = World(fuse, boxes)
    for step in steps:
        for _ in range(step.repeats):
            world.take(step)
            before = dict(world.grants)
            world.look()
            if world.guard.silence(world.now) is not Silence.NONE:
                for name, current in world.grants.items():
                    assert current <= min(before[name], fuse.safe)
    before = dict(world.grants)
    world.now += 301 + longer
    reasons = world.look()
    for name, current in world.grants.items():
        assert current <= min(before[name], fuse.safe)
        assert reasons[name] in {Reason.METER, Reason.METER_SLOW}


@given(FUSES, BOXES, STEPS)
@settings(max_examples=50, deadline=None)
def test_nothing_is_raised_that_a_reading_of_the_minute_forbade(
    fuse: Fuse, boxes: list[Guarded], steps: list[Step]
) -> None:
    """The cars may have drawn at most what was measured: that is added here."""
    world = World(fuse, boxes)
    noted: list[tuple[float, int, float]] = []
    for step in steps:
        for _ in range(step.repeats):
            if step.seconds < 0:
                noted.clear()
            world.take(step)
            noted += world.left_by(step)
            before = dict(world.grants)
            world.look()
            for one in world.boxes:
                name = one.settings.charger
                if world.grants[name] > before[name]:
                    lefts = [
                        left
                        for when, phase, left in noted
                        if world.now - CONFIRM <= when and phase in one.phases
                    ]
                    assert lefts
                    assert world.grants[name] <= min(lefts) + 1e-6
                    assert world.grants[name] <= fuse.rating - MARGIN


@given(FUSES, BOXES, STEPS, st.integers(0, 19))
@settings(max_examples=50, deadline=None)
def test_pauses_are_kept_whatever_happens_and_over_a_restart(
    fuse: Fuse, boxes: list[Guarded], steps: list[Step], restart: int
) -> None:
    world = World(fuse, boxes)
    paused: dict[str, tuple[float, int]] = {}
    for number, step in enumerate(steps):
        if number == restart:
            stored = json.loads(
                json.dumps({k: v.as_dict() for k, v in world.guard.kept.items()})
            )
            kept = {k: KeptPauses.from_dict(v) for k, v in stored.items()}
            counts = {name: one.pauses for name, one in world.guard.kept.items()}
            world.guard = Guard(fuse)
            world.guard.configure(
                world.boxes, {k: v for k, v in kept.items() if v}, world.now
            )
            before = dict(world.grants)
            world.look()
            for name, one in world.guard.kept.items():
                assert one.pauses >= counts[name]
                if name in paused:
                    paused[name] = (world.now, counts[name])
                    assert world.grants[name] == 0
                    assert before[name] == 0
        for _ in range(step.repeats):
            world.take(step)
            world.look()
            for name, one in world.guard.kept.items():
                if step.seconds < 0 and name in paused:
                    paused[name] = (world.now, one.pauses)
                if one.paused and name not in paused:
                    paused[name] = (world.now, one.pauses)
                    assert world.grants[name] == 0
                elif name in paused and world.grants[name]:
                    since, count = paused.pop(name)
                    assert world.now - since >= RESTARTS[min(count, 4) - 1]


@given(FUSES, BOXES, STEPS)
@settings(max_examples=30, deadline=None)
def test_the_same_input_gives_the_same_grants(
    fuse: Fuse, boxes: list[Guarded], steps: list[Step]
) -> None:
    def run() -> list[dict[str, float]]:
        world = World(fuse, boxes)
        found = []
        for step in steps:
            world.take(step)
            world.look()
            found.append(world.grants)
        return found

    assert run() == run()


@given(FUSES, BOXES, STEPS)
@settings(max_examples=50, deadline=None)
def test_a_grant_is_nothing_or_from_the_minimum_to_the_maximum(
    fuse: Fuse, boxes: list[Guarded], steps: list[Step]
) -> None:
    world = World(fuse, boxes)
    for step in steps:
        for _ in range(step.repeats):
            world.take(step)
            world.look()
            for one in world.boxes:
                current = world.grants[one.settings.charger]
                assert current == 0 or 6 <= current <= one.settings.maximum
                assert current == 0 or current <= max(fuse.rating, 6)
