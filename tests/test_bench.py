"""The pure parts of the benchmarks; their figures are not tested."""

import asyncio
import gc
import json

from homeassistant.core import HomeAssistant
from hypothesis import given, strategies as st
import pytest

from benchmarks.balancing import (
    Ask,
    Reading,
    Shared,
    SlaveRequest,
    asked_by_state,
    broadcasts,
    longest_silence,
    on_plan,
    readings,
    repeated,
    requests,
    rounds,
    sums,
)
from benchmarks.blocks import watch
from benchmarks.ews_boxes import buses_of, commands, dialling, ews_boxes, operate
from benchmarks.ews_events import Occurrence, delays, reported_by
from benchmarks.ews_listener import _Window, period_figures
from benchmarks.ews_poll import IDEAL, RC, polls
from benchmarks.figures import Figure, gaps, percentile, results, table
from benchmarks.fuse import cases, controller
from benchmarks.fuse_house import DAY, house
from benchmarks.fuse_plant import Outcome, run as run_house
from benchmarks.house_boxes import box_entry
from benchmarks.house_commands import add_entry
from benchmarks.offers import Offer
from benchmarks.oracle import LoggedFrame, _log
from benchmarks.responder import _answer
from benchmarks.set_points import Called, offered_after
from benchmarks.set_value import _seen
from custom_components.evse_bus.evse.modbus import AsciiFramer
from tests.virtual import VirtualBus
from tests.virtual.ews_frames import INFO, command, frame
from tests.virtual.smartevse_frames import crc16

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
def test_a_share_of_the_values_does_not_exceed_the_percentile(
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
    without = Figure(benchmark="scan", name="mean", value=1.0)
    assert without.met is None
    assert without.shown_aim == ""
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


def test_responder_replies_with_good_frames() -> None:
    framer = AsciiFramer()
    (frame,) = framer.feed(_answer(1, "2EA1106403E803E803E8"))
    assert (frame.unit, frame.is_reply, framer.bad) == (1, True, 0)
    assert frame.raw == b">01030A2EA1106403E803E803E8EE\r\n"


def test_call_is_found_in_the_log() -> None:
    read, write = b":0103002E0005C9\r\n", b":010E0014\r\n"
    limit = b":01100014000102010AC5\r\n"
    log = [
        LoggedFrame(1.0, 1.1, from_client=True, data=b":0203002E0005C8\r\n"),
        LoggedFrame(1.2, 1.3, from_client=False, data=b">02"),
        LoggedFrame(1.4, 1.5, from_client=True, data=read),
        LoggedFrame(1.6, 1.7, from_client=False, data=b">01"),
        LoggedFrame(1.8, 1.9, from_client=True, data=limit),
        LoggedFrame(2.0, 2.1, from_client=False, data=b">01"),
        LoggedFrame(2.2, 2.3, from_client=True, data=write),
    ]
    call = _seen(log, 1, 1.25, 2.15, raises=True)
    assert call.turn == pytest.approx(0.15)
    assert call.limit == pytest.approx(0.55)
    assert call.in_progress == pytest.approx(0.3)
    assert call.rest == pytest.approx(0.05)


# -- Load balancing ----------------------------------------------------------------

BROADCAST = "001000010004080064003c00000000ff7a"
"""As recorded."""


def frame_of(head: str) -> str:
    """Return a frame of Modbus from its hex digits without the checksum."""
    return head + crc16(bytes.fromhex(head)).hex()


def _heard(
    start: float, data: str, *, by_us: bool = True, hit: bool = False
) -> LoggedFrame:
    raw = bytes.fromhex(data)
    return LoggedFrame(start, start + 0.01, from_client=by_us, data=raw, collided=hit)


def test_broadcasts_are_found_in_the_log() -> None:
    log = [
        _heard(1.0, BROADCAST),
        _heard(2.0, BROADCAST, by_us=False),
        _heard(3.0, "001000a6000102008cb2a3"),
        _heard(4.0, "020400a00009301d"),
        _heard(5.0, BROADCAST[:-2] + "7b"),
        _heard(6.0, BROADCAST),
    ]
    assert broadcasts(log) == [1.0, 6.0]
    assert longest_silence([1.0, 6.0], 7.0) == 5.0
    assert longest_silence([], 7.0) == 0.0


@pytest.mark.parametrize("head", ["09100001000810", "09100020000810"])
def test_broadcasts_to_nodes_are_found(head: str) -> None:
    assert broadcasts([_heard(1.0, frame_of(head + 16 * "00"))]) == [1.0]


def _request(unit: int, register: int, end: float, *, replied: bool) -> SlaveRequest:
    at = end + 0.1 if replied else None
    return SlaveRequest(unit, register, end, end, at, garbled=False)


def test_repetitions_are_one_wish() -> None:
    made = [
        _request(2, 2, 1.0, replied=False),
        _request(3, 2, 1.5, replied=True),
        _request(2, 2, 2.1, replied=True),
        # Another one, which is given up.
        _request(2, 2, 10.0, replied=False),
        _request(2, 2, 20.0, replied=True),
        _request(2, 3, 29.5, replied=False),
    ]
    found = sorted(repeated(made, 30.0), key=lambda one: one.since)
    assert [(one.kind, one.since, round(one.waited, 3)) for one in found] == [
        ("02", 1.0, 1.2),
        ("02", 1.5, 0.1),
        ("02", 10.0, 0.0),
        ("02", 20.0, 0.1),
        ("03", 29.5, 0.5),
    ]
    assert [one.answered is None for one in found] == [False, False, True, False, True]


def _status(unit: int, state: int) -> str:
    return frame_of(f"{unit:02x}0410{state:04x}" + 14 * "00")


READ, GRANT = "020400000008", "0210000000020400050000"


def test_a_state_in_which_a_node_waits_is_answered() -> None:
    log = [
        _heard(1.0, frame_of(READ)),
        _heard(1.02, _status(2, 4), by_us=False),
        _heard(1.05, frame_of(READ)),
        _heard(1.07, _status(2, 4), by_us=False),
        _heard(1.5, frame_of(GRANT)),
        _heard(3.0, frame_of(READ)),
        _heard(3.02, _status(2, 6), by_us=False),
        # Garbled, and without a reply.
        _heard(5.0, frame_of(READ)),
        _heard(5.02, _status(2, 1), by_us=False, hit=True),
        _heard(7.0, frame_of(READ)),
        _heard(7.02, _status(2, 0), by_us=False),
    ]
    first, second = asked_by_state(log, 9.0)
    assert first == Ask(2, "B", pytest.approx(1.03), 1.5, 1.5)
    assert (second.kind, second.answered) == ("C", None)
    assert second.waited == pytest.approx(4.0)
    made = readings(log)
    assert [one.start for one in made] == [1.0, 1.05, 3.0, 5.0, 7.0]
    assert [one.end is None for one in made] == [False, False, False, True, False]


def test_a_round_ends_when_every_box_was_read() -> None:
    made = [
        Reading(2, 0.1, 0.2),
        Reading(3, 0.3, 0.4),
        Reading(2, 0.5, 0.6),
        Reading(2, 2.1, 2.2),
        Reading(3, 2.3, None),
        Reading(3, 4.1, 4.2),
        Reading(2, 4.3, 4.5),
    ]
    lengths, left_out = rounds([0.0, 2.0, 4.0, 6.0], made, (2, 3))
    assert lengths == [pytest.approx(0.4), pytest.approx(0.5)]
    assert left_out == 1


def test_due_broadcasts_are_separated_from_those_between() -> None:
    times = [9.9, 10.01, 11.0, 12.0, 12.1, 14.5, 15.0, 19.0]
    # At 16 there was none, and the next one is late for 16 and for 18.
    assert on_plan(times, 10.0) == [
        (10.01, pytest.approx(0.01)),
        (12.0, 0.0),
        (14.5, pytest.approx(0.5)),
        (19.0, pytest.approx(3.0)),
        (19.0, pytest.approx(1.0)),
    ]
    assert on_plan([], 10.0) == []


def test_requests_and_their_replies_are_found() -> None:
    asks, granted = "020600020082a858", "02060082003c29c0"
    log = [
        _heard(1.0, asks, by_us=False),
        # The pending reply of another box comes first; then the bus is idle.
        _heard(1.016, "010400a00009302e", by_us=False),
        _heard(1.036, granted),
        _heard(5.0, asks, by_us=False, hit=True),
        # Too late for the first one, in time for the second.
        _heard(6.0, asks, by_us=False),
        _heard(6.5, BROADCAST),
        _heard(6.7, granted),
    ]
    first, second, third = requests(log)
    assert (first.unit, first.register, first.garbled) == (2, 2, False)
    assert first.end == pytest.approx(1.01)
    assert first.idle == pytest.approx(1.026)
    assert first.replied == 1.036
    assert (second.replied, second.garbled) == (None, True)
    assert (third.idle, third.replied) == (pytest.approx(6.01), 6.7)


def _offer(at: float, name: str, amps: float, *, closed: bool = True) -> Offer:
    return Offer(at, name, amps, closed)


def test_a_sum_that_rises_above_the_supply_is_a_violation() -> None:
    shared = [Shared(0.0, 20.0)]
    offers = [
        _offer(1.0, "a", 10.0),
        # An open contactor carries nothing.
        _offer(2.0, "b", 16.0, closed=False),
        _offer(3.0, "b", 10.0),
        # Up and down by the same frame: one moment.
        _offer(4.0, "a", 14.0),
        _offer(4.001, "b", 6.0),
    ]
    found = sums(offers, shared, 10.0)
    assert (found.most, found.violations, found.longest) == (20.0, 0, 0.0)
    assert found.seconds == 0.0
    found = sums([*offers, _offer(5.0, "b", 6.1)], shared, 10.0)
    assert (found.most, found.violations) == (pytest.approx(20.1), 1)
    assert found.seconds == pytest.approx(5.0)
    # Not in the same moment: up before the other one is down.
    offers[-1] = _offer(4.1, "b", 6.0)
    assert sums(offers, shared, 10.0).violations == 1


def test_a_lowered_supply_is_no_violation_but_takes_time() -> None:
    shared = [Shared(0.0, 32.0), Shared(5.0, 12.0)]
    offers = [
        _offer(1.0, "a", 10.0),
        _offer(1.0, "b", 10.0),
        # On its way when the supply was lowered.
        _offer(5.01, "a", 16.0),
        _offer(5.1, "a", 6.0),
        _offer(5.5, "b", 6.0),
    ]
    found = sums(offers, shared, 10.0)
    assert (found.most, found.violations) == (26.0, 0)
    assert found.longest == pytest.approx(0.5)
    # One goes up although the sum is too high already; and it stays so.
    worse = [*offers[:4], _offer(5.2, "b", 11.0)]
    found = sums(worse, shared, 10.0)
    assert (found.violations, found.longest) == (1, pytest.approx(5.0))


def test_an_offer_after_a_set_point_is_found() -> None:
    offers = [
        _offer(1.0, "a", 6.0),
        _offer(2.5, "b", 6.0),
        _offer(3.0, "a", 16.0),
        _offer(3.5, "a", 6.0, closed=False),
        _offer(4.0, "a", 6.0),
    ]
    assert offered_after(Called("a", 6.0, 2.0, 2.1), offers) == 2.0
    assert offered_after(Called("a", 6.0, 4.5, 4.6), offers) is None


@pytest.mark.real_time
async def test_blocks_are_timed_and_the_loop_is_restored() -> None:
    before = asyncio.Handle._run
    with watch() as blocks:
        # This callback ends, and another one runs.
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    assert asyncio.Handle._run is before
    assert blocks.seconds
    assert blocks.as_dict()["callbacks"] == len(blocks.seconds)


@pytest.mark.real_time
async def test_garbage_collection_is_listed_apart_from_own_time() -> None:
    # Many objects, so that a collection takes long enough to be listed.
    objects = [[n] for n in range(300_000)]
    with watch() as blocks:
        await asyncio.sleep(0)
        gc.collect()
        await asyncio.sleep(0)
    assert len(objects) == 300_000
    (_, own, name) = max(blocks.longest)
    assert "ms of it garbage collection" in name
    assert blocks.busiest[0] < own / 2


# -- EWS-Boxes ---------------------------------------------------------------------


def _ews(start: float, data: bytes, *, by_us: bool = True) -> LoggedFrame:
    return LoggedFrame(start, start + 0.01, from_client=by_us, data=data)


def test_polls_of_a_box_are_found_in_the_log() -> None:
    log = [
        _ews(1.0, command("rc")),
        _ews(1.1, command("rc"), by_us=False),
        _ews(1.2, command("rd")),
        _ews(3.0, command("rc")),
    ]
    assert polls(log) == [1.0, 3.0]
    # As in PROTOCOLS.md.
    assert pytest.approx(10.6e-3, abs=0.05e-3) == RC
    assert pytest.approx(20.7e-3, abs=0.05e-3) == IDEAL


def test_a_change_belongs_to_the_last_action_before_it() -> None:
    done = [
        Occurrence(1.0, 1, "press_start"),
        Occurrence(1.2, 1, "press_end"),
        # Without a change; that of the next action of its kind does not count for it.
        Occurrence(2.0, 1, "press_start"),
        Occurrence(3.0, 1, "press_start"),
        Occurrence(4.0, 2, "press_start"),
    ]
    seen = [
        Occurrence(0.5, 1, "press_start"),
        Occurrence(1.01, 1, "press_start"),
        Occurrence(1.22, 1, "press_end"),
        Occurrence(3.03, 1, "press_start"),
        # Of another port, and of another kind.
        Occurrence(4.01, 1, "press_start"),
        Occurrence(4.02, 2, "press_end"),
    ]
    assert delays(done, seen) == pytest.approx([0.01, 0.02, 0.03])


def test_the_record_of_an_action_is_found() -> None:
    record = frame(INFO, b"if" + bytes(9))
    log = [
        _ews(0.9, record, by_us=False),
        _ews(1.005, command("rc")),
        _ews(1.01, frame(b"A", b"rc" + bytes(108)), by_us=False),
        _ews(1.03, record, by_us=False),
    ]
    (reported,) = reported_by(
        log, [Occurrence(1.0, 1, "on"), Occurrence(2.0, 1, "off")]
    )
    assert reported == Occurrence(pytest.approx(1.04), 1, "on")


def test_periods_are_those_within_the_windows() -> None:
    commands_to = {
        "a": [(at, "rc") for at in (0.0, 2.0, 4.5, 10.0, 12.0)],
        "b": [(1.0, "rc"), (1.1, "rd"), (3.0, "rc"), (11.0, "rc"), (13.5, "rc")],
    }
    figures = period_figures(commands_to, [_Window(0.0, 5.0), _Window(9.0, 13.0)])
    found = {one.name: one.value for one in figures}
    assert found["poll period, mean"] == pytest.approx((2.0 + 2.5 + 2.0 + 2.0) / 4)
    assert found["poll period, longest"] == 2.5
    assert found["poll period, p99 of that box"] == 2.5


def test_a_box_is_operated_and_records_its_commands() -> None:
    boxes = ews_boxes(boxes=[{"serial": "000000000042", "manual_io": True}])
    with VirtualBus.pty(*boxes, ring=None) as bus:
        before = bus.time()
        at = operate(bus, "ews-000000000042", "key_down", 2, 3)
        assert before <= at <= bus.time()
        bus.wait_for(lambda: len(bus.log))
        [[start, _, by_us, data, _]] = _log(bus, at)  # type: ignore[misc]
        assert (start >= at, by_us) == (True, False)
        # Key 3 of port 2 is pressed.
        assert data[12:30] == "00" + "00" * 6 + "ff" + "00"
        bus.inject(command("rc"), source="client")
        assert commands(bus, at) == {"ews-000000000042": []}
        bus.wait_for(lambda: commands(bus, at)["ews-000000000042"])
        [[received_at, name]] = commands(bus, at)["ews-000000000042"]
        assert (received_at > at, name) == (True, "rc")
        assert commands(bus, received_at + 1) == {"ews-000000000042": []}


@pytest.mark.usefixtures("not_set_up")
async def test_entries_are_those_of_the_config_flow(hass: HomeAssistant) -> None:
    serial = "000000000042"
    address = {"host": "127.0.0.1", "port": 4712}
    entry = await add_entry(hass, **box_entry([serial], interval=2.0, **address))
    assert entry.data == {"protocol": "ews_network", **address}
    (subentry,) = entry.subentries.values()
    assert subentry.unique_id == f"ews_{serial}"


def test_many_boxes_are_many_buses() -> None:
    boxes = ews_boxes(boxes=[{"serial": f"{n:012d}"} for n in (1, 2, 3)])
    fleet = dialling(boxes, "127.0.0.1:4711")
    assert [bus.devices[0].name for bus in buses_of(fleet)] == [
        "ews-000000000001",
        "ews-000000000002",
        "ews-000000000003",
    ]


def test_the_winter_house_alone_is_seldom_above_its_fuse() -> None:
    trace = house(10)
    above = sum(max(one) > 25 for one in zip(*trace.phases, strict=True))
    assert 35 <= above / 10 <= 47
    assert house(1).phases == tuple(phase[:DAY] for phase in trace.phases)


def test_seconds_above_the_fuse_are_counted() -> None:
    outcome = Outcome(1)
    for current in (26, 32, 32, 25, 26):
        outcome.count(current)
    assert outcome.seconds == [4, 2]
    assert outcome.longest == [3, 2]


def test_without_a_guard_a_car_takes_all() -> None:
    case = cases()[0]
    found = run_house(house(1), controller(case), case.meter, case.box, case.cars)
    assert found.energy > 0.99
    assert found.longest[0] > 60
