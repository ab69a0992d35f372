"""A witness finds what is wrong; benchmarks rely on it."""

import asyncio
from random import Random
from types import SimpleNamespace
from typing import Any, cast

import pytest

from benchmarks import adapter_away
from benchmarks.byte_errors import Case, case_figures, watch
from benchmarks.simulated import simulate
from benchmarks.slow_lines import LateReplies
from benchmarks.watched import Scene
from benchmarks.watched_abl import AblScene
from benchmarks.watched_evbox import EvboxScene
from benchmarks.witness import History
from custom_components.evse_bus.evse.errors import NotConfirmedError
from custom_components.evse_bus.evse.model import OrderChange
from tests.virtual.adapter import Adapter


def test_a_value_that_was_true_in_the_window_is_right() -> None:
    history = History(10.0)
    history.add(0.0, "A1")
    history.add(5.0, "B2")
    history.add(6.0, "C2")
    assert history.had("A1", 4.9)
    assert not history.had("A1", 5.0)
    assert history.had("C2", 100.0)


def test_a_number_passes_through_all_between() -> None:
    history = History(10.0)
    history.add(0.0, 0.0)
    history.add(1.0, 16.0)
    assert history.had(7.5, 0.5)
    assert history.had(16.05, 0.5)
    assert not history.had(16.1, 0.5)
    assert not history.had(0.0, 1.0)
    assert not history.had(None, 0.0)


def test_old_values_are_dropped() -> None:
    history = History(10.0)
    for at in range(100):
        history.add(at, at)
    assert history.had(90, 90.0)
    assert not history.had(60, 0.0)


def test_without_errors_nothing_is_wrong() -> None:
    outcome = simulate(watch, Case("abl", AblScene, seconds=900, rate=0.0))
    assert [found.notes for found in outcome.findings] == [[], []]
    by_name = {one.name: one for one in case_figures("abl", outcome)}
    assert all(one.met is not False for one in by_name.values())
    assert by_name["abl: available"].value == 100
    assert outcome.commands
    assert not outcome.failed


async def _run(scene: Scene, spoil: str) -> list[str]:
    async with scene:
        (witness, *_) = scene.witnesses
        device = witness.box.device  # type: ignore[attr-defined]
        await asyncio.sleep(60)
        if spoil == "current":
            # More than three replies agree: the library has to believe it.
            device.distort(current=30.0, times=None)
        elif spoil == "total":
            device.distort(energy_jump=5.0, times=None)
        elif spoil == "serial":
            device.serial = "2W22xy99999999"
            await scene.lose_port(5)
        elif spoil == "limit":
            device.outlet.car.plug_in()
            device.outlet.ignore_limit = True
            with pytest.raises(NotConfirmedError):
                await scene.chargers[0].change_orders(OrderChange(current=6.0))
        elif spoil == "keep-alive":
            scene.virtual.unplug()
        await asyncio.sleep(60)
        found = witness.end()
        return [
            name
            for name in ("wrong", "wrong_totals", "wrong_identities", "over", "missed")
            if getattr(found, name)
        ]


@pytest.mark.parametrize(
    ("make", "spoil", "expected"),
    [
        (EvboxScene, "current", "wrong"),
        (EvboxScene, "total", "wrong_totals"),
        (AblScene, "serial", "wrong_identities"),
        (AblScene, "limit", "over"),
        (AblScene, "keep-alive", "missed"),
        (EvboxScene, "keep-alive", "missed"),
    ],
)
def test_what_is_wrong_is_found(make: type[Scene], spoil: str, expected: str) -> None:
    assert expected in simulate(_run, make(1), spoil)  # type: ignore[call-arg]


def test_absences_are_timed() -> None:
    case = adapter_away.Case("abl", AblScene, times=3, half_open=1)
    outcome = simulate(adapter_away.absences, case)
    assert len(outcome.opened) == len(outcome.read) == 3
    assert all(
        0 < opened <= read
        for opened, read in zip(outcome.opened, outcome.read, strict=True)
    )
    # Only silence shows it.
    assert outcome.half_open[0] > 30


async def test_a_late_answer_that_is_used_is_found() -> None:
    received = asyncio.Queue[bytes]()
    port: Any = SimpleNamespace(opened=1, write=received.put_nowait)
    on_wire: list[bytes] = []
    loop: Any = asyncio.get_running_loop()
    adapter = Adapter(Random(1), on_wire.append, lambda: port, lambda: loop)  # noqa: S311
    adapter.delay_out = adapter.delay_in = 0.4
    line = SimpleNamespace(write=adapter.from_client)

    async def exchange() -> bytes:
        line.write(b"?")
        return await received.get()

    bus = cast("Any", SimpleNamespace(line=line, wire=SimpleNamespace()))
    bus.wire.exchange = exchange
    late = LateReplies(adapter, bus)
    # Given up before its answer comes, which is then taken for that to the next one.
    line.write(b"?")
    await asyncio.sleep(0.5)
    adapter.to_client(b"one")
    assert await bus.wire.exchange() == b"one"
    assert late.used == 1
    waiting = asyncio.create_task(bus.wire.exchange())
    await asyncio.sleep(0.5)
    adapter.to_client(b"two")
    assert await waiting == b"two"
    assert late.used == 1
    assert on_wire == [b"?"] * 3
