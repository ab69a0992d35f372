"""Totals of the ports: no damaged reply, and no set meter, becomes consumption."""

import asyncio
from functools import reduce
from itertools import pairwise

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import NotConfirmedError

from .scene import EwsLine, EwsScene, play

PORT_1 = 6
"""Index of the first byte about port 1 in a frame with ``rc``'s answer: STX, length,
message-id, command."""
TOTAL = PORT_1 + 23
"""Of the meter total of port 1: 3.2.4, ``rc``."""
LENGTH = 115


class Damage:
    """Damages answers to ``rc`` so that their checksum still matches."""

    def __init__(self, line: EwsLine) -> None:
        self.changes: list[dict[int, int]] = []
        """Bits to flip in the next answers, by index of their byte."""
        self.damaged = 0
        self._say = line.say
        line.say = self  # type: ignore[method-assign]

    def __call__(self, data: bytes) -> None:
        if self.changes and data[3:6] == b"Arc":
            changed = bytearray(data)
            for at, bits in self.changes.pop(0).items():
                changed[at] ^= bits
            assert reduce(int.__xor__, changed[1:]) == 0
            data = bytes(changed)
            self.damaged += 1
        self._say(data)


def at_12_kwh() -> EwsScene:
    scene = EwsScene()
    for port in scene.box.ports:
        port.session.total_wh = 12_000.0
    return scene


@pytest.mark.parametrize(
    "changes",
    [
        # One bit of the total and the same bit of a byte without a meaning here.
        {TOTAL + 1: 0x80, PORT_1 + 19: 0x80},
        {TOTAL + 1: 0x10, TOTAL + 5: 0x10},
        {TOTAL: 0x40, TOTAL + 3: 0x40},
    ],
)
def test_two_equal_bit_flips_are_no_consumption(changes: dict[int, int]) -> None:
    async def acts(scene: EwsScene) -> None:
        damage = Damage(scene.line)
        shown: list[tuple[float | None, int]] = []
        scene.charger().subscribe(
            lambda: shown.append(
                (scene.connector().energy, scene.connector().meter_generation)
            )
        )
        for count in (1, 2):
            damage.changes = [changes] * count
            await asyncio.sleep(20)
        assert damage.damaged == 3
        assert scene.charger().available
        assert {*shown, (scene.connector().energy, 0)} == {(12_000.0, 0)}

    play(at_12_kwh(), acts)


def test_a_meter_at_zero_for_three_polls_resumes() -> None:
    async def acts(scene: EwsScene) -> None:
        session = scene.box.ports[0].session
        session.total_wh = 0.0
        await scene.until(lambda: scene.connector().energy == 0)
        assert scene.connector().meter_generation == 1
        assert scene.connector(2).meter_generation == 0
        session.total_wh = 12_000.0
        await scene.until(lambda: scene.connector().energy == 12_000)
        assert scene.connector().meter_generation == 0

    play(at_12_kwh(), acts)


@pytest.mark.parametrize("total", [0, 12_040, 5_000_000])
@pytest.mark.parametrize("is_lost", [False, True])
def test_a_meter_that_is_set_is_a_new_generation(total: int, *, is_lost: bool) -> None:
    async def acts(scene: EwsScene) -> None:
        if is_lost:
            scene.line.mute = lambda name: name == "cr"
            with pytest.raises(NotConfirmedError):
                await scene.charger().services.set_meter(total)
        else:
            await scene.charger().services.set_meter(total)
        await scene.until(lambda: scene.connector().energy == total)
        assert scene.connector().meter_generation == 1

    play(at_12_kwh(), acts)


@settings(max_examples=15, deadline=None)
@given(st.data())
def test_a_meter_never_grows_by_more_than_is_charged(data: st.DataObject) -> None:
    """A car charges; answers are damaged by pairs of equal flips, at random."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        damage = Damage(scene.line)
        session = scene.box.ports[0].session
        shown: list[float] = []
        generations = set()

        def look() -> None:
            connector = scene.connector()
            generations.add(connector.meter_generation)
            if connector.energy is not None:
                # Not more than the box has counted, and no more than a flip can add
                # that cannot be told from consumption.
                assert connector.energy <= session.total_wh + 300
                shown.append(connector.energy)

        scene.charger().subscribe(look)
        for _ in range(10):
            byte = st.integers(TOTAL, TOTAL + 1)
            other = st.integers(PORT_1 + 15, PORT_1 + 18)
            bit = 1 << data.draw(st.integers(0, 7))
            damage.changes = [{data.draw(byte): bit, data.draw(other): bit}]
            await asyncio.sleep(6)
        assert generations == {0}
        assert all(before <= after for before, after in pairwise(shown))
        assert scene.connector().energy == pytest.approx(session.total_wh, abs=30)

    play(at_12_kwh(), acts)
