"""Replies damaged in spite of their checksum become no value, event or identity."""

import asyncio
from dataclasses import replace
from datetime import datetime, timedelta
from functools import reduce
from itertools import pairwise

from hypothesis import Phase, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.events import ChargeEnded, ChargeStarted
from custom_components.evse_bus.evse.ews.agreement import (
    Agreement,
    box_continues,
    equal,
    never,
    ports_continue,
)
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.ews.scan import scan
from custom_components.evse_bus.evse.ews.wire.box_status import (
    BOX,
    BoxFlags,
    decode_box,
)
from custom_components.evse_bus.evse.ews.wire.status import PORT, decode_ports
from custom_components.evse_bus.evse.meter import SessionMeter, Total
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from tests.simulated_time import simulate

from .scene import SERIAL, EwsLine, EwsScene, play

CONFIG = EwsPortConfig(key="scan", name="scan", address=1, installation_limit=32.0)
ORDERS = Orders(limit=CurrentLimit(current=16.0))
DATA = 6
"""Index of the first byte of a record in its frame."""


class Damage:
    """Flips bits in answers to one command so that their checksum still matches."""

    def __init__(self, line: EwsLine, name: str) -> None:
        self.flips: list[dict[int, int]] = []
        """Bits to flip in the next answers, by the index of their byte in the record."""
        self.damaged = 0
        self._name = name.encode()
        self._say = line.say
        line.say = self  # type: ignore[method-assign]

    def __call__(self, data: bytes) -> None:
        if self.flips and data[3:6] == b"A" + self._name:
            changed = bytearray(data)
            for at, bits in self.flips.pop(0).items():
                changed[DATA + at] ^= bits
            assert reduce(int.__xor__, changed[1:]) == 0
            data = bytes(changed)
            self.damaged += 1
        self._say(data)


def test_no_damaged_state_is_shown_or_ends_a_charge() -> None:
    """0x40 with two flips is 0x50: ended."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        damage = Damage(scene.line, "rc")
        states = set()
        scene.charger().subscribe(lambda: states.add(scene.connector().raw_state))
        before = len(scene.events)
        for at in (0, 6, 24, 40):
            damage.flips = [{0: 0x10, PORT.length + at: 0x10}]
            await scene.until(lambda: not damage.flips)
            await asyncio.sleep(5.0)
        assert damage.damaged == 4
        assert states == {"0x40"}
        assert not [
            one
            for one in scene.events[before:]
            if isinstance(one, ChargeEnded | ChargeStarted)
        ]
        assert scene.unlocked() == []
        assert scene.line.orders(6) == scene.line.orders(2) == []

    play(EwsScene(), acts)


@settings(max_examples=20, deadline=None, phases=[Phase.generate])
@given(st.data())
def test_one_damaged_reply_changes_no_value(data: st.DataObject) -> None:
    """Any two equal flips in any record, while one port charges."""
    name, length = data.draw(
        st.sampled_from([("rc", 2 * PORT.length), ("rd", 56), ("rs", BOX.length)])
    )
    at = st.integers(0, length - 1)
    pairs = [
        data.draw(st.tuples(at, at).filter(lambda pair: pair[0] != pair[1]))
        for _ in range(5)
    ]
    bits = [1 << data.draw(st.integers(0, 7)) for _ in pairs]

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        # The car takes its time.
        await asyncio.sleep(15.0)
        damage = Damage(scene.line, name)
        shown = set()

        def look() -> None:
            reading = scene.reading()
            one = reading.connectors[1]
            session = scene.box.ports[0].session
            # Neither more than has flowed, nor older than the last polls.
            assert one.energy is not None
            assert session.total_wh - 30 <= one.energy <= session.total_wh
            assert one.session_energy is not None
            assert session.wh - 30 <= one.session_energy <= session.wh
            assert one.session_time is not None
            assert session.seconds - 6 <= one.session_time <= session.seconds
            still = replace(one, energy=0.0, session_energy=0.0, session_time=0)
            shown.add(repr((still, reading.maximum_current, reading.faults)))

        look()
        for port in scene.ports:
            scene.charger(port).subscribe(look)
        for (one, other), bit in zip(pairs, bits, strict=True):
            damage.flips = [{one: bit, other: bit}]
            await scene.until(lambda: not damage.flips)
            await asyncio.sleep(4.0)
        assert len(shown) == 1
        assert scene.charger().available
        assert scene.charger().info is not None
        assert scene.charger().info.serial == SERIAL  # type: ignore[union-attr]

    play(EwsScene(), acts)


@pytest.mark.parametrize("count", [1, 2])
def test_a_serial_number_is_found_when_two_replies_agree(count: int) -> None:
    """The search repeats ``rs``; a damaged number is neither found nor bound."""

    async def find() -> None:
        scene = EwsScene(ports=())
        damage = Damage(scene.line, "rs")
        # The last digit, with a flip in the size of the web page.
        damage.flips = [{12 + 11: 2, 24 + n: 2} for n in range(count)]
        await scene.bus.start()
        result = await scan(scene.bus, CONFIG, ORDERS, lambda _share: None)
        await scene.bus.stop()
        assert damage.damaged == count
        (found,) = result.found
        assert found.serial == found.address == SERIAL

    simulate(find())


def test_a_maximum_counts_when_two_replies_agree() -> None:
    async def acts(scene: EwsScene) -> None:
        damage = Damage(scene.line, "rs")
        offset = next(f for f in BOX.fields if f.name == "maximum_current")
        at = sum(f.width for f in BOX.fields[: BOX.fields.index(offset)])
        maxima = set()
        scene.charger().subscribe(lambda: maxima.add(scene.charger().limits.reported))
        # 32 A becomes 48 A.
        damage.flips = [{at: 0x10, 24: 0x10}, {at: 0x10, 25: 0x10}]
        await scene.until(lambda: not damage.flips)
        await asyncio.sleep(20)
        maxima.add(scene.charger().limits.reported)
        assert maxima == {32.0}

    play(EwsScene(), acts)


def test_implausible_meters_hold_up_no_command() -> None:
    """Its meters run too fast, between any two readings; all else works."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        session = scene.box.ports[0].session

        say = scene.line.say

        def hurry(data: bytes) -> None:
            session.total_wh += 20.0
            session.wh += 20.0
            say(data)

        scene.line.say = hurry  # type: ignore[method-assign]
        await asyncio.sleep(20.0)
        assert scene.charger().available
        assert scene.connector().raw_state == "0x40"
        await scene.charger().change_orders(OrderChange(allowed=False))
        assert scene.status() == 0x50

    play(EwsScene(), acts)


@pytest.mark.parametrize("lost", range(1, 12))
def test_a_command_survives_any_one_lost_reading(lost: int) -> None:
    """A record that has changed is read twice: either reply may get lost."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        answers = 0

        def mute(name: str) -> bool:
            nonlocal answers
            answers += name in ("rc", "rd", "rs", "id")
            return answers == lost and name not in ("st", "sl")

        scene.line.mute = mute
        await scene.charger().change_orders(OrderChange(current=10.0))
        await scene.charger().change_orders(OrderChange(allowed=False))
        assert scene.status() == 0x50
        assert answers >= lost

    play(EwsScene(), acts)


# -- Agreement -----------------------------------------------------------------------


def test_replies_that_differ_never_agree() -> None:
    series = Agreement[int](equal, never).begin()
    assert not any(series.agrees(number, 0.0) for number in range(10))
    assert series.agrees(9, 0.0)


def test_a_reply_that_repeats_the_one_before_counts_at_once() -> None:
    agreement = Agreement[int](equal, never)
    agreement.counts(7, 0.0)
    assert agreement.begin().agrees(7, 1.0)
    agreement.forget()
    assert not agreement.begin().agrees(7, 1.0)


def test_a_noisy_pilot_needs_three_replies() -> None:
    (quiet,) = decode_ports(bytes(2 * PORT.length), count=1)
    noisy = [
        (replace(quiet, pwm_minimum=-11.9 - n / 100, session_time=n),) for n in range(5)
    ]
    series = Agreement(equal, ports_continue).begin()
    assert [series.agrees(one, now) for now, one in enumerate(noisy)][:3] == [
        False,
        False,
        True,
    ]
    jumps = [(replace(quiet, pwm_minimum=-12.0 + n),) for n in range(5)]
    series = Agreement(equal, ports_continue).begin()
    assert not any(series.agrees(one, 0.0) for one in jumps)
    series = Agreement(equal, ports_continue).begin()
    assert not series.agrees(noisy[0], 0.0)
    series.interrupt()
    assert not series.agrees(noisy[1], 1.0)
    assert not series.agrees(noisy[2], 2.0)


def test_all_of_a_box_status_must_agree_but_its_clock_and_restart_flag() -> None:
    data = bytearray(BOX.length)
    data[12:24] = SERIAL.encode()
    before = replace(decode_box(bytes(data)), clock=datetime(2026, 1, 1, 12, 0, 0))  # noqa: DTZ001 - as the box has it
    one = timedelta(seconds=1)
    assert before.clock is not None
    later = replace(before, clock=before.clock + one, flags=BoxFlags.RESTARTED)
    assert box_continues(before, later, 1.0)
    assert not box_continues(before, replace(later, clock=None), 1.0)
    assert not box_continues(before, replace(later, clock=before.clock + 9 * one), 1.0)
    for field, value in {
        "serial": "012345678902",
        "maximum_current": 48,
        "server_connected": True,
        "flags": BoxFlags.BACKUP_CHARGED,
    }.items():
        assert not box_continues(before, replace(later, **{field: value}), 1.0)


# -- The charge under way ------------------------------------------------------------


def check(meter: SessionMeter, *readings: tuple[float, int, float]) -> list[bool]:
    """Return what becomes of readings: energy (Wh), time (s), when (s)."""
    return [meter.check(Total(energy, at), time) for energy, time, at in readings]


def test_a_charge_goes_on_or_another_begins_at_zero() -> None:
    meter = SessionMeter()
    assert check(meter, (900, 600, 0), (902, 602, 2), (904, 604, 4)) == [
        False,
        False,
        True,
    ]
    assert check(meter, (906, 606, 6)) == [True]
    # Nothing was read for 10 minutes: another charge has begun meanwhile.
    assert check(meter, (1500, 300, 606), (1502, 302, 608)) == [True, True]
    assert check(meter, (0, 0, 610), (0, 0, 612), (5, 2, 614)) == [True, True, True]


@pytest.mark.parametrize(
    ("energy", "time"),
    [(9096, 606), (906, 8798), (905, 0), (0, 606), (903, 606), (906, 603)],
)
def test_an_implausible_charge_needs_three_readings(energy: float, time: int) -> None:
    meter = SessionMeter()
    check(meter, (900, 600, 0), (902, 602, 2), (904, 604, 4))
    odd = [(energy, time, 6.0), (energy, time, 8.0), (energy, time, 10.0)]
    assert check(meter, *odd[:2], (910, 610, 12)) == [False, False, True]
    odd = [(energy, time, at + 8) for _, _, at in odd]
    assert check(meter, *odd) == [False, False, True]


@given(
    st.lists(
        st.tuples(st.integers(0, 2**17), st.integers(0, 2**17), st.floats(0.1, 100)),
        max_size=30,
    )
)
def test_no_single_reading_of_a_charge_makes_a_step(
    readings: list[tuple[int, int, float]],
) -> None:
    meter = SessionMeter()
    at, accepted = 0.0, []
    for energy, time, pause in readings:
        at += pause
        accepted.append(meter.check(Total(energy, at), time))
    assert not any(accepted[:2])
    for ((before, *_), (after, _, pause)), accepted_both in zip(
        pairwise(readings), pairwise(accepted), strict=True
    ):
        if all(accepted_both):
            grown = after - before if after >= before else after
            assert grown <= 100 + 17.7 * pause
