"""*Plugged in* is never "no" while a car is in, whatever box and car went through.

A virtual box of each dialect, polled or as a node of a simple master, has a history
drawn at random; what the driver shows after each reading is compared with the car.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf

from hypothesis import example, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.config import PolledConfig
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from custom_components.evse_bus.evse.smartevse.polled import PolledSmartEvse
from custom_components.evse_bus.evse.smartevse.registers import decode_status
from tests.virtual import Car
from tests.virtual.smartevse_alone import SmartEvseAlone
from tests.virtual.smartevse_frames import (
    words,
    write_frame,
    write_several_frame,
)

BOXES: dict[str, tuple[Dialect, str, int]] = {
    "2.17 polled": (Dialect.V2_17, "2.17", 0),
    "2.17 slave": (Dialect.V2_17, "2.17", 2),
    "2.20 polled": (Dialect.V2_20, "2.20", 0),
    "2.20 node": (Dialect.V2_20, "2.20", 2),
    "2.30 polled": (Dialect.V2_30, "2.30", 0),
    "2.30 node": (Dialect.V2_30, "2.30", 2),
    "HEAD polled": (Dialect.V2_HEAD, "2.30+", 0),
    "HEAD node": (Dialect.V2_HEAD, "2.30+", 2),
    "3.00 node": (Dialect.V3_OLD, "3.00", 2),
    "3.8 node": (Dialect.V3_OLD, "3.8", 2),
    "3.x node": (Dialect.V3, "3", 2),
}
SEEN_WITHIN = 7.0
"""A box sees a car, or that it left, within this time, s: C1, B1 and the pilot that 3.x
cuts for 5 s included."""
ROUND = 2.0
"""Of the master, s."""


class Act(StrEnum):
    """What happens to box and car."""

    PLUG = "a car is plugged in"
    PLUG_LATER = "one that requests nothing yet"
    REQUEST = "the car requests"
    FINISH = "the car is full"
    LEAVE = "the car leaves"
    OFF = "access off"
    ON = "access on"
    BUTTON = "its button is pressed"
    POWER = "power failure of the box"
    HOT = "it is too hot"
    COOL = "it has cooled down"
    MASTER_AWAY = "no broadcast"
    MASTER_BACK = "the master is back"
    REFUSE = "the master has no current"
    GRANT = "it has current again"
    LOST = "replies are lost"
    RECONNECT = "the line was lost and is back"


UNSEEN = (Act.BUTTON, Act.REFUSE)
"""These end a charge without a trace: as when the car has left. A real car lets go of
its request then, and is seen again."""


@dataclass
class History:
    """One box, its car, a master where it has one, and our reader."""

    name: str
    keeps_request: bool
    box: SmartEvseAlone = field(init=False)
    car: Car = field(init=False)
    charger: PolledSmartEvse = field(init=False)
    refuses: bool = False
    away: bool = False
    lost: int = 0
    came_or_left: float = -inf

    def __post_init__(self) -> None:
        self.dialect, line, node = BOXES[self.name]
        self.is_node = bool(node)
        self.car = Car(reaction=0.2, ramp=0.5)
        self.car.requests_without_pwm = self.keeps_request
        self.box = SmartEvseAlone(line, self.car, cable=32, load_balance=node)
        config = PolledConfig(
            key="box",
            name="the box",
            address=0,
            installation_limit=16,
            dialect=self.dialect,
        )
        # Of a node only the address matters here: its master may refuse it.
        object.__setattr__(config, "address", node)
        made = POLLED.charger(config, Orders(limit=CurrentLimit(current=10.0)))
        assert isinstance(made, PolledSmartEvse)
        self.charger = made
        self.charger.dialect = self.dialect

    # -- What happens --------------------------------------------------------------

    def do(self, act: Act) -> None:
        out, car = self.box.outlet, self.car
        access = MAPS[self.dialect].access_register
        acts: dict[Act, Callable[[], object]] = {
            Act.PLUG: lambda: self.come_or_leave(plugs=True),
            Act.PLUG_LATER: lambda: self.come_or_leave(plugs=True, request=False),
            Act.LEAVE: lambda: self.come_or_leave(plugs=False),
            Act.REQUEST: car.request,
            Act.FINISH: car.finish,
            Act.OFF: lambda: self.box.write(access, 0),
            Act.ON: lambda: self.box.write(access, 1),
            Act.BUTTON: out.press,
            Act.POWER: self.box.box.power_cycle,
            Act.HOT: lambda: setattr(out, "temperature", 70),
            Act.COOL: lambda: setattr(out, "temperature", 20),
            Act.MASTER_AWAY: lambda: setattr(self, "away", True),
            Act.MASTER_BACK: lambda: setattr(self, "away", False),
            Act.REFUSE: lambda: setattr(self, "refuses", True),
            Act.GRANT: lambda: setattr(self, "refuses", False),
            Act.LOST: lambda: setattr(self, "lost", 0 if self.charger.misses else 2),
            Act.RECONNECT: self.reconnect,
        }
        acts[act]()

    def come_or_leave(self, *, plugs: bool, request: bool = True) -> None:
        if plugs is self.car.plugged:
            return
        self.came_or_left = self.box.now
        if plugs:
            self.car.plug_in(request=request)
        else:
            self.car.leave()

    def reconnect(self) -> None:
        self.charger.on_line_open()
        self.charger.dialect = self.dialect

    def live(self, seconds: float) -> None:
        """Let time pass, with a reading each so many seconds."""
        end = self.box.now + seconds
        pause = ROUND if self.is_node or self.dialect in _ANY_TIME else 6.5
        while self.box.now < end - 1e-6:
            self.box.live(min(pause, end - self.box.now))
            self.answer_requests()
            self.read()
            if self.is_node and not self.away:
                self.broadcast()

    # -- The master ----------------------------------------------------------------

    def answer_requests(self) -> None:
        """Answer what a slave of 2.17 has sent."""
        sent, self.box.sent = self.box.sent, []
        if self.away or self.dialect is not Dialect.V2_17:
            return
        for _, data in sent:
            register = int.from_bytes(data[2:4])
            grants = register in (2, 3) and not self.refuses
            answer = write_frame(data[0], 0x80 | register, 60 if grants else 0)
            self.box.receive(answer)
            self.box.live(0.05)

    def broadcast(self) -> None:
        """Answer a node that asks, then tell all their currents."""
        row, unit = MAPS[self.dialect].balancing, self.box.box.unit
        if self.dialect is not Dialect.V2_17:
            self.answer_node()
        value = 60 if self.box.state in ("B", "C", "B1", "C1", "G", "G+") else 0
        if self.refuses and self.dialect is not Dialect.V2_17:
            value = 0
        values = [
            value if number == unit else 0 for number in range(1, row.currents + 1)
        ]
        self.box.receive(
            write_several_frame(row.broadcast_unit, row.broadcast_register, *values)
        )

    def answer_node(self) -> None:
        first = 0xA0 if self.dialect is Dialect.V2_20 else 0x0000
        read = self.box.read(first, 2)
        if not read:
            return
        state, error = read
        if state in (4, 6):
            answer = (state, error | 1) if self.refuses else (state + 1, error & ~1)
            self.box.write(first, *answer)
        elif error & 1 and not self.refuses:
            self.box.write(first, state, error & ~1)

    # -- The driver ----------------------------------------------------------------

    def read(self) -> None:
        """Read the status, and compare what is shown with the car."""
        if self.lost:
            self.lost -= 1
            self.charger.on_missed(self.box.now, "no reply")
            return
        block = MAPS[self.dialect].status.block
        read = self.box.read(block.register, block.words)
        if not read:
            self.charger.on_missed(self.box.now, "no reply")
            return
        data = words(*read)
        self.charger.on_status(decode_status(self.dialect, data), self.box.now)
        self.charger.on_reply(self.box.now)
        reading = self.charger.reading
        assert reading is not None
        shown = reading.connectors[1].plugged
        if self.box.now < self.came_or_left + SEEN_WITHIN:
            return
        assert shown in (self.car.plugged, None), self.tell()

    def tell(self) -> str:
        out = self.box.outlet
        return (
            f"at {self.box.now:.0f} s: {out.state}, error {out.error}, access "
            f"{out.access}, car {self.car.plugged}"
        )


_ANY_TIME = (Dialect.V2_17, Dialect.V2_20)

histories = st.lists(
    st.tuples(st.sampled_from(Act), st.floats(0.5, 30.0) | st.just(70.0)),
    min_size=2,
    max_size=14,
)


@pytest.mark.parametrize("name", BOXES)
@settings(max_examples=10)
@given(history=histories, keeps_request=st.booleans())
@example(history=[(Act.OFF, 10.0), (Act.PLUG, 30.0)], keeps_request=False)
@example(history=[(Act.PLUG, 30.0), (Act.BUTTON, 14.0)], keeps_request=False)
@example(
    history=[(Act.PLUG, 30.0), (Act.HOT, 10.0), (Act.COOL, 70.0), (Act.ON, 70.0)],
    keeps_request=True,
)
@example(
    history=[(Act.PLUG, 30.0), (Act.OFF, 10.0), (Act.ON, 70.0), (Act.RECONNECT, 70.0)],
    keeps_request=True,
)
@example(
    history=[(Act.PLUG, 30.0), (Act.OFF, 20.0), (Act.POWER, 10.0), (Act.ON, 70.0)],
    keeps_request=True,
)
def test_what_is_shown_of_the_plug_is_true(
    name: str, history: list[tuple[Act, float]], *, keeps_request: bool
) -> None:
    scene = History(name, keeps_request)
    scene.live(15.0)
    for act, pause in history:
        if keeps_request and act in UNSEEN:
            continue
        scene.do(act)
        # A car that came, asked and was stopped between two readings is not known.
        scene.live(max(pause, 7.0) if keeps_request else pause)
