"""The two walks of docs/architecture.md: one reading in, one set-point out."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import re
import sys
from types import FrameType

from homeassistant.core import HomeAssistant

from tests.common import call, get_entity, running, wait_for_state
from tests.virtual import AblBox, Car

ROOT = Path(__file__).parents[1]
INTEGRATION = ROOT / "custom_components/evse_bus"

PLUMBING = {"evse/conversation.py", "evse/listeners.py"}
"""Files that call the next one without a look at what passes."""


def documented(title: str) -> list[str]:
    """Return the files of a walk, in the order of the document."""
    text = (ROOT / "docs/architecture.md").read_text()
    section = text.split(f"### {title}\n", 1)[1].split("\n#", 1)[0]
    return re.findall(r"^\| `([\w/]+\.py)` \|", section, flags=re.MULTILINE)


def file_of(frame: FrameType) -> str | None:
    prefix = f"{INTEGRATION}/"
    name = frame.f_code.co_filename
    return name.removeprefix(prefix) if name.startswith(prefix) else None


class Walk:
    """The files in which a function was called, and those on the stack at its end."""

    def __init__(self, end: Callable[[FrameType], bool]) -> None:
        self.called: set[str] = set()
        self.on_the_way: set[str] = set()
        self._end = end

    def profile(self, frame: FrameType, event: str, _argument: object) -> None:
        if event != "call":
            return
        if (name := file_of(frame)) is not None:
            self.called.add(name)
        if self._end(frame):
            outer: FrameType | None = frame
            while outer is not None:
                if (name := file_of(outer)) is not None:
                    self.on_the_way.add(name)
                outer = outer.f_back

    def check(self, files: list[str], most: int) -> None:
        """Check that the documented files are those of this walk."""
        assert 0 < len(files) == len(set(files)) <= most
        assert set(files) <= self.called
        assert self.on_the_way
        assert self.on_the_way - PLUMBING <= set(files)


@contextmanager
def walking(end: Callable[[FrameType], bool]) -> Iterator[Walk]:
    walk = Walk(end)
    sys.setprofile(walk.profile)
    try:
        yield walk
    finally:
        sys.setprofile(None)


async def test_the_walks_are_as_documented(hass: HomeAssistant) -> None:
    def shows_a_sensor(frame: FrameType) -> bool:
        return frame.f_code.co_name == "update_attributes" and (
            file_of(frame) == "sensor.py"
        )

    def writes(frame: FrameType) -> bool:
        return frame.f_code.co_name == "write" and file_of(frame) == "evse/line.py"

    car = Car(max_current=16)
    async with running(hass, AblBox(1, car=car)) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await wait_for_state(hass, status, "available")
        await call(hass, "number.set_value", limit, value=16)
        with walking(shows_a_sensor) as reading:
            car.plug_in()
            await wait_for_state(hass, status, "charging")
        with walking(writes) as set_point:
            await call(hass, "number.set_value", limit, value=10)
    reading.check(documented("One reading in"), most=15)
    set_point.check(documented("One set-point out"), most=18)
