"""The pure parts of the benchmarks; their figures are not for tests."""

import asyncio
import json

from hypothesis import given, strategies as st
import pytest

from benchmarks.blocks import watch
from benchmarks.figures import Figure, gaps, percentile, results, table
from benchmarks.responder import _answer
from benchmarks.set_value import _seen
from benchmarks.witness import Heard
from custom_components.evse_bus.evse.modbus import AsciiFramer

MEASURED = Figure(
    benchmark="scan", name="mean", value=271.04, unit="ms", aim=252.0, note="why"
)


def test_percentile_is_nearest_rank() -> None:
    values = [15.0, 20.0, 35.0, 40.0, 50.0]
    assert [percentile(values, share) for share in (0.05, 0.3, 0.4, 0.5, 1.0)] == [
        15.0,
        20.0,
        20.0,
        35.0,
        50.0,
    ]


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.001, 1.0))
def test_percentile_is_not_exceeded_by_its_share(
    values: list[float], share: float
) -> None:
    found = percentile(values, share)
    assert found in values
    assert sum(value <= found for value in values) >= share * len(values) - 1e-6


def test_no_percentile_of_nothing() -> None:
    with pytest.raises(ValueError, match="no values"):
        percentile([], 0.5)


def test_gaps() -> None:
    assert gaps([1.0, 1.5, 3.0]) == [0.5, 1.5]
    assert gaps([1.0]) == []


def test_aims() -> None:
    assert MEASURED.met is False
    assert MEASURED.shown_aim == "<= 252.0 NO"
    told = Figure(benchmark="scan", name="mean", value=1.0)
    assert told.met is None
    assert told.shown_aim == ""
    assert Figure(benchmark="a", name="b", value=0, aim=0).met is True


def test_table() -> None:
    other = Figure(benchmark="scan", name="longest", value=0.5, digits=2)
    assert table([MEASURED, other]).splitlines() == [
        "| benchmark | figure  |    value | aim         | note |",
        "|-----------|---------|---------:|-------------|------|",
        "| scan      | mean    | 271.0 ms | <= 252.0 NO | why  |",
        "|           | longest |     0.50 |             |      |",
    ]


def test_results_can_be_written() -> None:
    written = results([MEASURED], {"cores": 2}, {"scan": "so"}, quick=True)
    assert json.loads(json.dumps(written)) == written
    assert written["figures"][0]["met"] is False


def test_responder_answers_with_good_frames() -> None:
    framer = AsciiFramer()
    (frame,) = framer.feed(_answer(1, "2EA1106403E803E803E8"))
    assert (frame.unit, frame.is_reply, framer.bad) == (1, True, 0)
    assert frame.raw == b">01030A2EA1106403E803E803E8EE\r\n"


def test_call_is_found_in_the_log() -> None:
    read, write = b":0103002E0005C9\r\n", b":010E0014\r\n"
    limit = b":01100014000102010AC5\r\n"
    log = [
        Heard(1.0, 1.1, from_client=True, data=b":0203002E0005C8\r\n"),
        Heard(1.2, 1.3, from_client=False, data=b">02"),
        Heard(1.4, 1.5, from_client=True, data=read),
        Heard(1.6, 1.7, from_client=False, data=b">01"),
        Heard(1.8, 1.9, from_client=True, data=limit),
        Heard(2.0, 2.1, from_client=False, data=b">01"),
        Heard(2.2, 2.3, from_client=True, data=write),
    ]
    call = _seen(log, 1, 1.25, 2.15, raises=True)
    assert call.turn == pytest.approx(0.15)
    assert call.limit == pytest.approx(0.55)
    assert call.in_progress == pytest.approx(0.3)
    assert call.rest == pytest.approx(0.05)


async def test_blocks_are_timed_and_the_loop_left_as_it_was() -> None:
    before = asyncio.Handle._run
    with watch() as blocks:
        # The callback that we are in ends, and another one.
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    assert asyncio.Handle._run is before
    assert blocks.seconds
    assert blocks.as_dict()["callbacks"] == len(blocks.seconds)
