"""Corrupt replies that pass both checksums become no value and no identity."""

import asyncio
from collections.abc import Callable

from hypothesis import assume, given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import ImplausibleReplyError
from custom_components.evse_bus.evse.model import CurrentLimit, Fault, Orders
from tests.evse.simulated_line import until
from tests.simulated_time import simulate
from tests.virtual import Car, EvboxChargePoint, Module
from tests.virtual.evbox_frames import checked, frame

from .replies import module, reply
from .scene import EvboxLine, Scene
from .test_plausibility import Receiver

# Places in the text of a reply to 68: manual, "Response". A current has 0.1 A.
SERIAL = slice(6, 14)
MAXIMUM = slice(18, 22)
CURRENTS = slice(28, 40)


class Damage:
    """Changes some replies; their checksums are those of the new text."""

    def __init__(self, line: EvboxLine) -> None:
        self.changes: list[dict[slice, str]] = []
        """New text for the next replies, by its place."""
        line.damage = self

    def __call__(self, data: bytes) -> bytes:
        text = checked(data[1:-1].decode())
        if text is None or not self.changes:
            return data
        for place, new in self.changes.pop(0).items():
            text = text[: place.start] + new + text[place.stop :]
        return frame(text)


def charging_at_8_amperes() -> EvboxChargePoint:
    car = Car(max_current=8.0)
    car.plug_in()
    return EvboxChargePoint(1923054, [Module(car)])


def run(act: Callable[[Scene, Damage], object], address: int = 1923054) -> None:
    async def scene() -> None:
        stage = Scene.of(charging_at_8_amperes())
        damage = Damage(stage.line)
        async with stage:
            stage.add(
                address, Orders(limit=CurrentLimit(current=25.0)), poll_interval=10.0
            )
            await act(stage, damage)  # type: ignore[misc]

    simulate(scene())


@pytest.mark.parametrize("count", [1, 2])
def test_a_current_above_the_order_is_shown_when_the_next_reply_agrees(
    count: int,
) -> None:
    """33.6 A where the box carries 8.0 A and was limited to 25 A."""

    async def act(stage: Scene, damage: Damage) -> None:
        (charger,) = stage.bus.chargers.values()
        await asyncio.sleep(120.0)
        shown: list[float] = []
        times = len(stage.line.sent)

        def look() -> None:
            assert charger.reading is not None
            shown.append(charger.reading.connectors[1].current[0] or 0.0)

        charger.subscribe(look)
        damage.changes = [{CURRENTS: "0150" + "0150" + "0150"}] * count
        await until(lambda: not damage.changes)
        await asyncio.sleep(30.0)
        look()
        assert (33.6 in shown) is (count > 1)
        assert shown[-1] == pytest.approx(8.0, abs=0.1)
        # Asked for again at the earliest time that the box allows: after 1 s.
        first, again = [sent.at for sent in stage.line.sent[times:]][:2]
        assert 1.0 <= again - first < 2.0

    run(act)


def test_an_unconfirmed_current_counts_for_guards_at_once() -> None:
    async def act(stage: Scene, damage: Damage) -> None:
        (charger,) = stage.bus.chargers.values()
        await asyncio.sleep(120.0)
        seen: list[tuple[float | None, float | None]] = []

        def look() -> None:
            assert charger.reading is not None
            one = charger.reading.connectors[1]
            seen.append((one.current[0], one.drawn_at_most[0]))

        charger.subscribe(look)
        damage.changes = [{CURRENTS: "00C8" + "00C8" + "00C8"}]
        await until(lambda: not damage.changes)
        await asyncio.sleep(0.5)
        # Within the limit of 25 A, and not shown.
        assert seen[-1] == (8.0, 20.0)
        await asyncio.sleep(3.0)
        assert seen[-1] == (8.0, 8.0)

    run(act)


MODULE = slice(24, 28)
VOLTAGES = slice(60, 72)
ENERGY = slice(52, 60)


@pytest.mark.parametrize(
    "change",
    [
        {CURRENTS: "00A000500050"},
        {CURRENTS: "000000000000"},
        {slice(40, 44): "03D4"},
        {VOLTAGES: "00E600E600F6"},
        {MODULE: "0064"},
        {MAXIMUM: "0140"},
        {ENERGY: "00002711"},
    ],
    ids=["current", "no current", "cos phi", "voltage", "minimum", "maximum", "meter"],
)
def test_one_damaged_reply_shows_no_value(change: dict[slice, str]) -> None:
    """All of these are plausible: without another reply that agrees they count not."""

    async def act(stage: Scene, damage: Damage) -> None:
        (charger,) = stage.bus.chargers.values()
        await asyncio.sleep(120.0)
        shown = set()

        def look() -> None:
            assert charger.reading is not None
            one = charger.reading.connectors[1]
            shown.add(
                (
                    *(one.current, one.voltage, one.cos_phi, one.minimum_current),
                    *(one.power, one.meter_generation, charger.reading.maximum_current),
                )
            )
            truth = stage.line.points[0].modules[0].energy_wh
            assert one.energy is not None
            assert truth - 20 <= one.energy <= truth

        charger.subscribe(look)
        look()
        for _ in range(3):
            damage.changes = [change]
            await until(lambda: not damage.changes)
            await asyncio.sleep(15.0)
        assert len(shown) == 1

    run(act)


def test_a_value_that_keeps_changing_is_shown_with_the_third_reply() -> None:
    async def act(stage: Scene, damage: Damage) -> None:
        (charger,) = stage.bus.chargers.values()
        await asyncio.sleep(120.0)
        damage.changes = [
            {CURRENTS: current * 3} for current in ("0064", "00A0", "0078", "0050")
        ]
        await until(lambda: len(damage.changes) == 1)
        await asyncio.sleep(0.5)
        assert charger.reading is not None
        assert charger.reading.connectors[1].current[0] == 12.0

    run(act)


def test_a_car_that_ignores_its_limit_is_shown_with_the_second_reading() -> None:
    async def act(stage: Scene, damage: Damage) -> None:
        (charger,) = stage.bus.chargers.values()
        await asyncio.sleep(120.0)
        damage.changes = [{CURRENTS: "0150" + "0150" + "0150"}] * 20
        await until(lambda: Fault.LIMIT_EXCEEDED in charger.faults)
        assert charger.reading is not None
        assert charger.reading.connectors[1].current == (33.6, 33.6, 33.6)
        assert len(damage.changes) == 18

    run(act)


@pytest.mark.parametrize("wrong", ["01923055", "91923054"])
def test_a_serial_number_is_learnt_from_two_replies(wrong: str) -> None:
    async def act(stage: Scene, damage: Damage) -> None:
        (charger,) = stage.bus.chargers.values()
        damage.changes = [{SERIAL: wrong}]
        seen: list[str | None] = []
        charger.subscribe(
            lambda: seen.append(charger.info.serial if charger.info else None)
        )
        await asyncio.sleep(60.0)
        assert charger.available
        assert charger.faults == frozenset()
        assert charger.info is not None
        assert charger.info.serial == "1923054"
        assert set(seen) <= {None, "1923054"}

    run(act, address=0)


@given(st.floats(0.0, 1000.0), st.floats(35.1, 1000.0))
def test_maximum_and_current_that_rise_together_are_implausible(
    amperes: float, maximum: float
) -> None:
    good = reply(module(amperes=16.0))
    receiver = Receiver(good, good)
    assume(amperes > 35.0 * 1.1 + 1.0)
    with pytest.raises(ImplausibleReplyError):
        receiver.receive(reply(module(amperes=round(amperes, 1)), maximum=maximum))
    assert receiver.maximum.value == 35.0
    accepted = receiver.receive(good)
    assert not accepted.implausible


def test_a_maximum_that_falls_in_one_damaged_reply_holds_no_good_one_back() -> None:
    good = reply(module(amperes=16.0))
    receiver = Receiver(good, good)
    receiver.receive(reply(module(amperes=16.0), maximum=7.0))
    assert receiver.maximum.value == 7.0
    receiver.receive(good)
    assert receiver.maximum.value == 7.0
    receiver.receive(good)
    assert receiver.maximum.value == 35.0
