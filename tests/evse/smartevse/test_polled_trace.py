"""A polled SmartEVSE that knows only the recorded exchanges of the maker's firmware.

Other requests of the library would stay unanswered, and what it writes must be a
recorded request, byte for byte.
"""

import asyncio
from dataclasses import dataclass, field
from typing import override

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import NotConfirmedError
from custom_components.evse_bus.evse.line import Line
from custom_components.evse_bus.evse.modbus import rtu_frame
from custom_components.evse_bus.evse.model import (
    CurrentLimit,
    Limits,
    OrderChange,
    Orders,
    Setting,
    Status,
)
from custom_components.evse_bus.evse.safety import clamp
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.config import PolledConfig
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from custom_components.evse_bus.evse.smartevse.registers import write_current
from tests.simulated_time import now, simulate

from .test_trace import TRACE

READ = "000400a0000931ff"
CONFIGURATION = ("000400c0000931e1", "000400e0000cf028")
OVERRIDE = "001000a6000102"
OVERRIDE_10 = write_current(
    0,
    Dialect.V2_17,
    clamp(Orders(limit=CurrentLimit(current=10)), Limits(installation=10)),
).hex()
NO_ACCESS = "001000a70001020000b2d7"
ACCESS = "001000a700010200017317"


def reply(what: str) -> str:
    return next(str(one["reply"]) for one in TRACE["normal"] if one["what"] == what)


B = reply("car plugged in (pilot 9 V): state B")
C_AT_MAXIMUM = reply("car asks for power (pilot 6 V): state C")
C_AT_10 = reply("read back 2.6 s later")
A_NO_ACCESS = reply("read right after: state A although the car is plugged in")
A_ACCESS = reply("3 s later")
A_UNUSED = next(
    one["reply"] for one in TRACE["normal"] if one["what"] == "same at unit 0"
)


@dataclass
class Recorded:
    """The recorded box: its present status, and the requests that it received."""

    status: str = A_UNUSED
    override_follows: bool = True
    requests: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)

    def answer(self, request: str) -> str | None:
        self.requests.append(request)
        if request == READ:
            return self.status
        if request.startswith(OVERRIDE):
            if self.override_follows and request == OVERRIDE_10:
                asyncio.get_running_loop().call_later(1.8, self.become, C_AT_10)
            return reply("FC10 A6=140 (14.0 A)")
        if request == NO_ACCESS:
            self.become(A_NO_ACCESS)
            return reply("FC10 A7=0 (no access) while charging")
        if request == ACCESS:
            self.become(A_ACCESS)
            return reply("FC10 A7=1 (access)")
        if request == CONFIGURATION[0]:
            return reply("FC04 read C0..C8 (factory defaults)")
        self.unknown.append(request)
        return None

    def become(self, status: str) -> None:
        self.status = status


class Tape(Line):
    """A wire to the recorded box."""

    def __init__(self, box: Recorded) -> None:
        super().__init__("tape", POLLED.settings)
        self.box = box
        self._open = False

    @property
    @override
    def is_open(self) -> bool:
        return self._open

    @override
    async def open(self) -> None:
        self._open = True
        self.last_activity = now()

    @override
    async def close(self) -> None:
        self._open = False

    @override
    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        end = now() + len(data) * self.settings.byte_time
        self.last_activity = end
        answer = self.box.answer(data.hex()) or self._shorter(data)
        if answer is not None:
            frame = bytes.fromhex(answer)
            at = end + 0.01 + len(frame) * self.settings.byte_time
            asyncio.get_running_loop().call_at(at, self.on_data, frame)
        return end

    def _shorter(self, data: bytes) -> str | None:
        """Answer a part of a recorded block: registers E0 to E2 of E0 to EB."""
        if data[:6].hex() != "000400e00003":
            return None
        self.box.unknown.remove(data.hex())
        whole = bytes.fromhex(reply("FC04 read E0..EB (factory defaults)"))
        return rtu_frame(0, b"\x04\x06" + whole[3:9]).hex()


def test_a_recorded_session() -> None:
    async def scene() -> Recorded:
        box = Recorded()
        line = Tape(box)
        bus = Bus(line, POLLED.framer(), POLLED.timing, "tape")
        charger = POLLED.charger(
            PolledConfig(key="box", name="box", address=0, installation_limit=14.0),
            Orders(limit=CurrentLimit(current=14.0)),
        )
        bus.add(charger)
        async with bus:
            await asyncio.sleep(3)
            assert charger.reading is not None
            assert charger.reading.connectors[1].status is Status.AVAILABLE
            assert charger.reading.settings[Setting.MAXIMUM_CURRENT] == 13
            # Its own 13 A are less than the order.
            assert charger.limits.ceiling == 13
            box.status = B
            await asyncio.sleep(3)
            assert charger.reading.connectors[1].plugged is True
            assert charger.reading.offered_current == 13
            box.status = C_AT_MAXIMUM
            await asyncio.sleep(3)
            assert charger.reading.connectors[1].charging is True
            assert charger.reading.maximum_current == 13
            await charger.change_orders(OrderChange(allowed=False))
            assert charger.reading.connectors[1].plugged is None
            assert charger.reading.allowed is False
            await charger.change_orders(OrderChange(allowed=True))
            await asyncio.sleep(3)
            assert charger.reading.allowed is True
        return box

    box = simulate(scene())
    writes = [one for one in box.requests if one.startswith("0010")]
    assert NO_ACCESS in writes
    assert ACCESS in writes
    # Only the overrides are not in the recording: 6.0 A before a car comes, then 13.0 A.
    others = {one[14:18] for one in writes if one not in (NO_ACCESS, ACCESS)}
    assert others == {"003c", "0082"}
    assert box.unknown == []


@pytest.mark.parametrize("follows", [True, False])
def test_a_refused_override_counts_when_it_is_read_back(*, follows: bool) -> None:
    """``00 10 03 3c 01``, and 10.0 A read back: recorded like this."""

    async def scene() -> None:
        box = Recorded(status=C_AT_MAXIMUM, override_follows=follows)
        bus = Bus(Tape(box), POLLED.framer(), POLLED.timing, "tape")
        charger = POLLED.charger(
            PolledConfig(key="box", name="box", address=0, installation_limit=16.0),
            Orders(limit=CurrentLimit(current=13.0)),
        )
        bus.add(charger)
        async with bus:
            await asyncio.sleep(5)
            began = now()
            if not follows:
                with pytest.raises(NotConfirmedError):
                    await charger.change_orders(OrderChange(current=10))
                return
            await charger.change_orders(OrderChange(current=10))
            assert charger.reading is not None
            assert charger.reading.offered_current == 10
            # The box took its 1.8 s, and the order was not confirmed sooner.
            assert 1.8 <= now() - began < 3

    simulate(scene())
