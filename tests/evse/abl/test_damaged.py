"""Replies damaged in a way that their checksum still fits.

The checksum is the sum of the bytes: two errors that cancel each other pass it. What
no reply proves alone (more current than can flow, another state, limit or identity)
counts only when others agree.
"""

import asyncio
from collections.abc import Callable
from random import Random

from hypothesis import HealthCheck, Phase, given, settings, strategies as st

from custom_components.evse_bus.evse.abl import AblCharger
from custom_components.evse_bus.evse.abl.plausibility import StatusCheck
from custom_components.evse_bus.evse.abl.registers import Reading
from custom_components.evse_bus.evse.model import Fault, OrderChange
from tests.simulated_time import now, simulate
from tests.virtual import AblBox, Car

from .scene import LIMIT, Scene, config, orders, until

GRACE = 20.0
PAUSE = 0x3E8
DEFAULT = 0x10B
BEGIN, END = 1, -4
"""Of the bytes in hex: after the colon, before checksum and line end."""


def lrc(body: bytes) -> int:
    return -sum(body) & 0xFF


def line(body: bytes) -> bytes:
    return b">" + (body + bytes((lrc(body),))).hex().upper().encode() + b"\r\n"


def content(reply: bytes) -> bytes:
    return bytes.fromhex(reply[BEGIN:END].decode())


def cancelling(reply: bytes, rng: Random) -> bytes:
    """Flip one bit in each of two bytes, so that the sum stays what it is."""
    body = bytearray(content(reply))
    pairs = [
        (one, two, 1 << bit)
        for one in range(len(body))
        for two in range(len(body))
        for bit in range(8)
        if body[one] >> bit & 1 > body[two] >> bit & 1
    ]
    if not pairs:
        return reply
    one, two, mask = rng.choice(pairs)
    body[one] ^= mask
    body[two] ^= mask
    damaged = line(bytes(body))
    assert lrc(bytes(body)) == lrc(content(reply))
    return damaged


def distort(box: AblBox, change: Callable[[bytes], bytes]) -> None:
    """Change each reply of a box."""
    send = box.send

    def changed(data: bytes, turn_round: float, silence: float = 0.0) -> None:
        send(change(data), turn_round, silence)

    box.send = changed  # type: ignore[method-assign]


def damage_some(box: AblBox, rng: Random, share: float) -> list[bytes]:
    """Damage that share of the replies, never two in a row; return the damaged ones."""
    damaged: list[bytes] = []
    before = False

    def change(data: bytes) -> bytes:
        nonlocal before
        if before or rng.random() > share:
            before = False
            return data
        before = True
        damaged.append(cancelling(data, rng))
        return damaged[-1]

    distort(box, change)
    return damaged


def box_of_16_a(car: Car | None = None, rated: int = DEFAULT) -> AblBox:
    box = AblBox(1, car=car)
    box.outlet.default_duty = DEFAULT
    box.outlet.icmax = box.outlet.icmax_shown = DEFAULT
    box.outlet.rated_duty = rated
    return box


def plugged(**options: float) -> Car:
    car = Car(**options)  # type: ignore[arg-type]
    car.plug_in()
    return car


async def begun(scene: Scene, current: float = 10.0) -> AblCharger:
    charger = scene.add(
        config(poll_interval=2.0, installation_limit=32), orders(current, allowed=True)
    )
    await until(lambda: charger.available and charger.info is not None, 60)
    return charger


@settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    derandomize=True,
)
@given(st.integers(0, 2**32), st.sampled_from([0.05, 0.2]), st.booleans())
def test_no_single_damaged_reply_becomes_a_value(
    seed: int,
    share: float,
    paused: bool,  # noqa: FBT001
) -> None:
    async def scene_of() -> None:
        rng = Random(seed)  # noqa: S311 - repeatable on purpose
        box = box_of_16_a(plugged())
        async with Scene(box) as scene:
            damaged = damage_some(box, rng, share)
            charger = await begun(scene)
            await asyncio.sleep(30)
            if paused:
                box.set_by_other_master(0)
                await asyncio.sleep(30)
            seen: list[str] = []
            away = -GRACE

            def note() -> None:
                nonlocal away
                if not charger.available:
                    away = now()
                # After an absence the limits of the time before are not known.
                known = now() > away + GRACE
                seen.extend(wrong(box, charger, paused=paused, limits_known=known))

            charger.subscribe(note)
            before = len(scene.writes())
            await asyncio.sleep(300)
            assert damaged
            assert seen == []
            # A pause of another stands, and nothing is written above the default.
            assert not paused or scene.writes()[before:] == []
            assert all(code <= DEFAULT or code == PAUSE for code in scene.writes(LIMIT))

    simulate(scene_of())


def wrong(
    box: AblBox, charger: AblCharger, *, paused: bool, limits_known: bool
) -> list[str]:
    """Return what is shown and cannot be."""
    found = []
    if charger.info is not None and charger.info.serial != box.serial:
        found.append(f"serial {charger.info.serial}")
    if charger.box.highest not in (None, 16.0):
        found.append(f"highest {charger.box.highest}")
    if Fault.OVERCURRENT in charger.noticed or Fault.LIMIT_EXCEEDED in charger.noticed:
        found.append(f"{charger.noticed}")
    if (reading := charger.reading) is None:
        return found
    connector = reading.connectors[1]
    if connector.raw_state != box.state:
        found.append(f"state {connector.raw_state}")
    if reading.allowed is not (not paused):
        found.append(f"allowed {reading.allowed}")
    highest = max((one for one in connector.current if one is not None), default=0.0)
    # 10 A are offered, or none; the box carries 16.
    most = (1.0 if paused else 11.5) if limits_known else 18.6
    if highest > most:
        found.append(f"{highest} A")
    return found


async def test_a_real_over_current_is_shown_and_a_fault() -> None:
    """More than 1.1 x 16 A + 1 A, in each reply: three of them are believed."""
    car = plugged(max_current=32.0)
    box = box_of_16_a(car)
    async with Scene(box) as scene:
        charger = await begun(scene, 16.0)
        await until(lambda: box.state == "C2")
        await asyncio.sleep(10)
        assert charger.faults == frozenset()
        car.greedy = 1.19
        shown: list[float] = []
        charger.subscribe(lambda: shown.append(highest_of(charger)))
        await asyncio.sleep(8)
        assert max(shown) > 18.6
        assert Fault.OVERCURRENT in charger.noticed
        # Once believed, each poll needs one read.
        reads = len(scene.reads(1))
        await asyncio.sleep(20)
        assert len(scene.reads(1)) - reads <= 11
        assert Fault.LIMIT_EXCEEDED in charger.noticed
        car.greedy = 1.0
        await until(lambda: not charger.noticed)


def highest_of(charger: AblCharger) -> float:
    if charger.reading is None:
        return 0.0
    currents = charger.reading.connectors[1].current
    return max((one for one in currents if one is not None), default=0.0)


async def test_without_0x0f_the_wiring_is_the_maximum() -> None:
    car = plugged(max_current=32.0)
    box = AblBox(1, car=car, default_current=32.0, tells_icmax=False)
    async with Scene(box) as scene:
        charger = scene.add(
            config(poll_interval=2.0, installation_limit=16), orders(16)
        )
        await until(lambda: charger.available and charger.info is not None)
        await asyncio.sleep(20)
        box.set_by_other_master(32)
        box.outlet.ignore_limit = True
        await until(lambda: Fault.OVERCURRENT in charger.noticed, 30)
        assert highest_of(charger) > 18.6


async def test_one_reply_with_more_than_is_offered_is_not_shown() -> None:
    """9.8 A become 25.8 A in one reply: within a 32 A box, and not within 10 A."""
    box = box_of_16_a(plugged(), rated=0x215)
    box.outlet.default_duty = 0x215
    async with Scene(box) as scene:
        charger = await begun(scene)
        await until(lambda: box.state == "C2")
        await asyncio.sleep(40)
        hit = False

        def change(data: bytes) -> bytes:
            nonlocal hit
            body = bytearray(content(data))
            if hit or body[2:4] != b"\x0a\x2e":
                return data
            hit = True
            # The high byte of the first current, and the low byte of the second.
            body[7] += 1
            body[10] -= 1
            return line(bytes(body))

        distort(box, change)
        shown: list[float] = []
        charger.subscribe(lambda: shown.append(highest_of(charger)))
        reads = len(scene.reads(1))
        begin = now()
        await asyncio.sleep(20)
        assert hit
        assert max(shown, default=0.0) < 11
        assert charger.statistics.implausible == 1
        # Read again in the same turn.
        assert len(scene.reads(1)) - reads <= (now() - begin) / 2 + 2


def test_a_serial_number_is_learnt_from_two_replies() -> None:
    """Else the right one would be another box's for ever."""

    async def scene_of() -> None:
        box = box_of_16_a()
        async with Scene(box) as scene:
            hits = 0

            def change(data: bytes) -> bytes:
                nonlocal hits
                body = bytearray(content(data))
                if hits or body[2:4] != b"\x10\x50":
                    return data
                hits += 1
                body[5] += 1
                body[6] -= 1
                return line(bytes(body))

            distort(box, change)
            charger = await begun(scene)
            assert hits
            assert charger.serial == box.serial
            await charger.change_orders(OrderChange(current=8))
            assert not charger.faults

    simulate(scene_of())


# -- The replies that make a status count ----------------------------------------------

QUIET = Reading(
    state=0xC2,
    plugged=True,
    reduced=False,
    en1=True,
    en2=False,
    duty=0x10A,
    currents=(10.0, 10.0, 10.0),
)


def with_currents(*currents: float) -> Reading:
    one, two, three = currents
    return Reading(
        state=QUIET.state,
        plugged=True,
        reduced=False,
        en1=True,
        en2=False,
        duty=QUIET.duty,
        currents=(one, two, three),
    )


def after(*kept: Reading, offered: float = 16.0) -> Callable[[Reading], int]:
    check = StatusCheck()
    for at, reading in enumerate(kept):
        check.keep(reading, at, offered=offered, maximum=16.0, grace=0.5)
    return lambda reading: check.needed(reading, len(kept), maximum=16.0, grace=0.5)


def test_how_many_replies_a_status_needs() -> None:
    assert after()(QUIET) == 2
    assert after(QUIET)(QUIET) == 1
    assert after(QUIET)(with_currents(16.0, 0.0, 0.0)) == 1
    # Above what is offered, and above what can be.
    assert after(QUIET, offered=10.0)(with_currents(16.0, 0.0, 0.0)) == 2
    assert after(QUIET)(with_currents(0.0, 0.0, 18.7)) == 3
    high = with_currents(0.0, 0.0, 20.0)
    assert after(QUIET, high)(with_currents(0.0, 0.0, 21.0)) == 1
    assert after(QUIET, high)(with_currents(21.0, 0.0, 0.0)) == 3
    # That the one before was as high within bounds does not help.
    assert after(with_currents(0.0, 0.0, 18.0))(with_currents(0.0, 0.0, 19.0)) == 3
