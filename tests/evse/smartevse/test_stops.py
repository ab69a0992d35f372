"""How long the contactor of a node stays closed, by the virtual boxes.

The table of dialects says how long a box counts after its last broadcast, and after a
stop. Here each box has the car that lets go last: it keeps its request without PWM.
"""

from collections.abc import Iterator

import pytest

from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Balancing, Dialect
from tests.virtual import Car
from tests.virtual.smartevse_alone import SmartEvseAlone
from tests.virtual.smartevse_frames import write_several_frame

UNIT = 4
GIVE_UP = 60.0
STEP = 0.05
PHASES = tuple(phase * 0.1 for phase in range(11))
"""Moments of the last broadcast within the second of the box, s."""
LONG_SECOND = 1.0063
"""That of the recorded development version, s."""

NODES = (
    ("2.20", Dialect.V2_20, 1.0),
    ("2.30", Dialect.V2_30, 1.0),
    ("2.30+", Dialect.V2_HEAD, LONG_SECOND),
    ("3", Dialect.V3, 1.0),
)
every_node = pytest.mark.parametrize(
    ("name", "dialect", "second"), NODES, ids=[name for name, *_ in NODES]
)


class Node(SmartEvseAlone):
    """A node that charges, and its master."""

    def __init__(self, name: str, habits: Balancing, second: float) -> None:
        super().__init__(
            name,
            Car(requests_without_pwm=True),
            cable=32,
            max_current=25,
            load_balance=UNIT,
        )
        self.habits = habits
        self.outlet.second *= second

    def broadcast(self, tenths: int) -> None:
        row = self.habits
        values = [0] * row.currents
        values[UNIT - 1] = tenths
        self.receive(
            write_several_frame(row.broadcast_unit, row.broadcast_register, *values)
        )

    def charge(self) -> None:
        """Let its car charge."""
        car = self.outlet.car
        assert car is not None
        car.plug_in()
        state = self.habits.status.block.register
        for _ in range(20):
            self.broadcast(80)
            self.live(0.5)
            for asked, granted in ((4, 5), (6, 7)):
                if self.read(state) == [asked]:
                    self.write(state, granted, 0)
            if self.outlet.contactor:
                return
        pytest.fail("it does not charge")

    def until_open(self) -> Iterator[float]:
        """Let time pass until its contactor is open; yield the time since now."""
        begin = self.now
        while self.outlet.contactor and self.now < begin + GIVE_UP:
            self.live(STEP)
            yield self.now - begin


def charging(name: str, dialect: Dialect, second: float, phase: float) -> Node:
    node = Node(name, MAPS[dialect].balancing, second)
    node.charge()
    for _ in range(3):
        node.broadcast(80)
        node.live(1)
    node.live(phase)
    return node


@every_node
def test_without_broadcasts_it_counts_until_its_contactor_is_open(
    name: str, dialect: Dialect, second: float
) -> None:
    for phase in PHASES:
        node = charging(name, dialect, second, phase)
        node.broadcast(80)
        *_, seconds = node.until_open()
        assert seconds <= node.habits.stops_after


@every_node
def test_after_a_0_it_has_the_time_that_it_needs(
    name: str, dialect: Dialect, second: float
) -> None:
    for phase in PHASES:
        node = charging(name, dialect, second, phase)
        node.broadcast(0)
        for seconds in node.until_open():
            assert seconds <= node.habits.opens_within
            if round(seconds / STEP) % round(2 / STEP) == 0:
                node.broadcast(0)
        assert not node.outlet.contactor
