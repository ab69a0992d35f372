"""The makers' later firmwares as recorded, and virtual boxes in their place.

2.20, 2.30 and HEAD (2.30+): a factory-new box at its recorder with the recorder's car,
and nodes at the recorder's master.
"""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
import re
from typing import TYPE_CHECKING, Any, Literal

from .smartevse_alone import SmartEvseAlone

if TYPE_CHECKING:
    from .smartevse_outlet import SmartEvseOutlet

TRACES = Path(__file__).parents[1] / "traces"

# The steps of the car, s.
STEP = 0.05
# The recorded car asks for power after this time of PWM, and lets go after this time
# without (`about`), s.
ASKS_AFTER, LETS_GO_AFTER = 1.0, 0.4
# A second of the recorded boxes (the broadcasts in `master` come every two), s.
SECOND = 1.0063

NOTE = re.compile(r" ?\[pilot (steady|[\d.]+ A), contactor (open|closed)\]")

CarState = Literal["away", "plugged", "wants"]


@dataclass(frozen=True)
class Firmware:
    """A recorded firmware: its dialect here, and its serial number.

    `polled`: the sections of one recording in its order, and the pause before each, s:
    the trace does not have it, and the box's own cycle runs every two seconds.
    """

    trace: str
    dialect: str
    polled: dict[str, float]
    serial: int = 0

    def sections(self) -> dict[str, list[dict[str, Any]]]:
        """Return the trace."""
        path = TRACES / f"smartevse_v2_{self.trace}.json"
        return json.loads(path.read_text())  # type: ignore[no-any-return]


FIRMWARES = [
    Firmware(
        "20",
        "2.20",
        {
            "reads": 0.0,
            "normal": 1.7,
            "heat": 0.0,
            "next_car": 0.0,
            "power_cycle": 0.0,
            "config": 0.0,
        },
    ),
    Firmware(
        "30",
        "2.30",
        {
            "reads": 0.0,
            "normal": 1.0,
            "polled_too_often": 0.1,
            "heat": 1.0,
            "next_car": 1.0,
            "power_cycle": 1.0,
            "config": 1.0,
        },
    ),
    Firmware(
        "head",
        "2.30+",
        {
            "reads": 0.4,
            "normal": 0.6,
            "polled_too_often": 0.2,
            "heat": 0.2,
            "next_car": 1.0,
            "power_cycle": 1.0,
            "config": 1.0,
        },
        0x1E1E,
    ),
]


class Recorded(SmartEvseAlone):
    """A factory-new box at its recorder, with the recorder's car."""

    def __init__(self, firmware: Firmware, cable: int = 16, **settings: int) -> None:
        """Switch it on."""
        super().__init__(
            firmware.dialect,
            cable=cable,
            serial=firmware.serial,
            factory_new=True,
            **settings,
        )
        self.outlet.temperature = 25
        self.outlet.second = SECOND
        self.car: CarState = "away"
        self._since = 0.0
        self._oscillated = False
        self._asks = False
        self.follow()

    def follow(self) -> None:
        """Let the car react to the pilot."""
        oscillates = self.outlet.pilot_current > 0
        if oscillates != self._oscillated:
            self._oscillated, self._since = oscillates, self.now
        lasted = self.now - self._since
        if oscillates and lasted >= ASKS_AFTER - 1e-6:
            self._asks = True
        elif not oscillates and lasted >= LETS_GO_AFTER - 1e-6:
            self._asks = False
        if self.car == "away":
            self.outlet.pilot_voltage = 12
        else:
            asks = self.car == "wants" and self._asks
            self.outlet.pilot_voltage = 6 if asks else 9

    def live(self, seconds: float) -> None:
        """Let time pass, for the car too."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            super().live(min(STEP, end - self.now))
            self.follow()

    def power_cycle(self) -> None:
        """Lose power for a moment; the car stays."""
        self.box.power_cycle()
        self.follow()

    def bring(self, car: CarState) -> None:
        """Change the car."""
        self.car = car
        self.follow()

    def finish_measuring(self) -> None:
        """Wait while it measures a cable (`node_with_master`, after access 1)."""
        while self.outlet.measuring_cable:
            self.live(0.01)

    def exchange(self, request: str) -> str | None:
        """Send a request in hex; return the reply."""
        answer = self.receive(bytes.fromhex(request))
        self.follow()
        return answer.hex() if answer else None


def seen_inside(outlet: SmartEvseOutlet) -> str:
    """Return pilot and contactor as the recorder wrote them."""
    amps = outlet.pilot_current
    pilot = f"{amps:.1f} A" if amps else "steady"
    return f" [pilot {pilot}, contactor {'closed' if outlet.contactor else 'open'}]"


# Cars and temperatures by the beginning of a name.
EVENTS = re.compile(
    r"(?P<wants>car at unit (\d) wants power)|(?P<plugged>car plugged in at unit (\d))"
    r"|(?P<away>car leaves unit (\d))|(?P<lost>unit (\d) loses power)"
    r"|(?P<back>unit (\d) has power again)|(?P<heat>(\d\d) degrees C)"
)
INSIDE = re.compile(r"inside unit (\d)")
LEFT_OUT = re.compile(r"(\d+) equal rounds left out here")
ROUND = 2.0


class Line:
    """Nodes at the recorder's master, on its clock."""

    def __init__(
        self, firmware: Firmware, units: tuple[int, ...], begin: float
    ) -> None:
        """Switch them on, and wait for a time before the recording."""
        self.nodes = {
            unit: Recorded(firmware, cable=32, load_balance=unit, max_current=32)
            for unit in units
        }
        self.dark: set[int] = set()
        self.begin = begin
        for node in self.nodes.values():
            node.live(self.begin)
        self.answers: list[str] = []

    def live_until(self, t: float) -> None:
        """Let all nodes live until a time of the recorder."""
        for node in self.nodes.values():
            node.live(max(0.0, self.begin + t - node.now))

    def send(self, request: str) -> None:
        """Send a frame of the master to all nodes that have power."""
        for unit, node in self.nodes.items():
            if unit not in self.dark:
                node.finish_measuring()
                answer = node.exchange(request)
                self.answers += [answer] if answer else []

    def event(self, what: str) -> None:
        """Do what the recorder did, or compare what it saw."""
        done = EVENTS.match(what)
        if done:
            kind, number = done.lastgroup, int(re.findall(r"\d+", what)[0])
            if kind == "heat":
                for node in self.nodes.values():
                    node.outlet.temperature = number
            elif kind == "lost":
                self.dark.add(number)
            elif kind == "back":
                self.dark.remove(number)
                self.nodes[number].power_cycle()
            else:
                self.nodes[number].bring(kind)  # type: ignore[arg-type]
        note = NOTE.search(what)
        if note:
            unit = INSIDE.search(what)
            node = self.nodes[int(unit[1]) if unit else 2]
            assert seen_inside(node.outlet).strip() == note[0].strip(), what

    def replay(self, entries: list[dict[str, Any]]) -> None:
        """Replay a time-line whole, also the equal rounds that it left out."""
        for index, entry in enumerate(entries):
            where = f"{index} t {entry['t']}: {entry.get('what') or entry}"
            left_out = LEFT_OUT.match(entry.get("event", ""))
            if left_out:
                last = [
                    e
                    for e in entries[:index]
                    if "dir" in e and e["t"] > entry["t"] - ROUND - 0.1
                ]
                delay = entry["t"] - last[0]["t"]
                for number in range(int(left_out[1])):
                    for one in last:
                        self._take(one, delay + number * ROUND, where)
            else:
                self._take(entry, 0.0, where)
        assert self.answers == []

    def _take(self, entry: dict[str, Any], delay: float, where: str) -> None:
        if entry.get("dir") == "slave":
            assert self.answers[:1] == [entry["hex"]], where
            del self.answers[0]
            return
        assert self.answers == [], where
        self.live_until(entry["t"] + delay)
        if "event" in entry:
            self.event(entry["event"])
        else:
            self.send(entry["hex"])
