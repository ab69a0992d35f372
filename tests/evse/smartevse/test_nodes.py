"""Our master with nodes of 2.20 and later: one box after the other, its whole story."""

import asyncio
from itertools import pairwise

import pytest

from custom_components.evse_bus.evse.errors import NotAvailableError, NotConfirmedError
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.model import (
    Circuit,
    FailSafe,
    Fault,
    OrderChange,
    PauseReason,
)
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from custom_components.evse_bus.evse.smartevse.master import LISTENING, PERIOD, SLACK
from custom_components.evse_bus.evse.smartevse.slave import (
    LONG_STATUS_INTERVAL,
    MAXIMUM_INTERVAL,
)
from tests.evse.smartevse.scene import MasterScene, Sent
from tests.simulated_time import now, simulate

V2 = ("2.20", "2.30", "2.30+")
V3 = ("3", "3.8", "3.6")
GENTLE = ("2.30+", *V3)
each = pytest.mark.parametrize("dialect", [*V2, *V3])
each_2 = pytest.mark.parametrize("dialect", V2)
each_3 = pytest.mark.parametrize("dialect", V3)
ROUND = PERIOD + 0.5


def words(sent: Sent) -> tuple[int, ...]:
    """Return the values of a write of several registers."""
    return sent.values


def states(scene: MasterScene, unit: int, since: float = 0.0) -> list[tuple[int, ...]]:
    """Return the states and errors written to a unit, in their order."""
    return [
        words(sent)
        for sent in scene.line.sent
        if sent.when >= since
        and sent.data[:2] == bytes((unit, 16))
        and sent.data[5] == 2
    ]


def accesses(scene: MasterScene, unit: int, since: float = 0.0) -> list[int]:
    """Return the values of its access that were written."""
    register = 0xA7 if scene.dialect == "2.20" else 5
    return [
        words(sent)[0]
        for sent in scene.line.sent
        if sent.when >= since
        and sent.data[:2] == bytes((unit, 16))
        and sent.data[2:6] == bytes((0, register, 0, 1))
    ]


def scene_of(dialect: str, **more: object) -> MasterScene:
    return MasterScene(**({"units": (2,), "dialect": dialect} | more))  # type: ignore[arg-type]


async def charging(scene: MasterScene, *units: int) -> None:
    await asyncio.sleep(8)
    await scene.charge(*units)
    await asyncio.sleep(2 * ROUND)


@each
def test_a_car_is_granted_b_then_c_and_has_its_current_at_once(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await asyncio.sleep(8)
            scene.box(2).car.plug_in()
            await scene.until(lambda: scene.offers > 0)
            # What its broadcasts said before the grant; then the next one.
            assert scene.offers == 6
            await asyncio.sleep(0.5)
            assert scene.offers == 16
            assert states(scene, 2) == [(5, 0), (7, 0)]
            assert accesses(scene, 2) == []
            await asyncio.sleep(100)
            assert states(scene, 2) == [(5, 0), (7, 0)]

    simulate(scene())


@each
def test_one_that_waits_with_a_word_of_0_is_not_shown_at_its_maximum(
    dialect: str,
) -> None:
    """HEAD without a master begins at its maximum while it reports 0."""

    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await asyncio.sleep(8)
            scene.box(3).car.plug_in(request=False)
            await scene.until(lambda: scene.box(3).state == "B")
            await scene.charge(2)
            await asyncio.sleep(3 * ROUND)
            slave = scene.slave(3)
            assert slave.status is not None
            assert (slave.status.raw_state, slave.status.current) == ("B", 0)
            assert slave.reading is not None
            assert slave.reading.offered_current == 6

    simulate(scene())


@each
def test_each_request_is_answered_within_a_round(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=tuple(range(2, 9)), limit=63.0) as scene:
            await asyncio.sleep(10)
            for unit in scene.units:
                scene.box(unit).car.plug_in()
            waiting: dict[int, float] = {}
            for _ in range(3000):
                await asyncio.sleep(0.01)
                for unit in scene.units:
                    if scene.box(unit).state in ("F", "G"):
                        waiting.setdefault(unit, now())
                        assert now() - waiting[unit] < ROUND
                    else:
                        waiting.pop(unit, None)
            assert all(scene.box(unit).state == "C" for unit in scene.units)
            assert max(scene.gaps(1010.0)) <= PERIOD + SLACK + 0.03

    simulate(scene())


@each_2
@pytest.mark.parametrize("after", [0.3, 0.8, 1.3, 1.8])
def test_a_wish_that_a_command_has_read_waits_for_no_poll(
    dialect: str, after: float
) -> None:
    async def scene() -> None:
        async with scene_of(dialect, allowed=False) as scene:
            await asyncio.sleep(8)
            scene.box(2).car.plug_in()
            await asyncio.sleep(6 + after)
            await scene.slave(2).change_orders(OrderChange(allowed=True))
            allowed = now()
            await asyncio.sleep(0.7)
            assert states(scene, 2, allowed - 0.5)[:1] == [(5, 0)]

    simulate(scene())


def test_a_broadcast_in_the_turn_of_a_box_is_not_repeated_at_once() -> None:
    async def scene() -> None:
        # A lowered supply is exceeded until the boxes have followed.
        async with scene_of("2.30", units=(2, 3), watch=False) as scene:
            await charging(scene, 2, 3)
            master = scene.master

            async def lower(turn: Turn) -> None:
                lowered = asyncio.create_task(
                    master.change_circuit(Circuit(limit=14, minimum=6))
                )
                await asyncio.sleep(0)
                await master.send_broadcast(turn)
                await lowered

            await scene.until(lambda: now() - scene.broadcasts()[-1].when > 0.3)
            begun = now()
            await scene.slave(2).run(lower)
            await asyncio.sleep(0.3)
            sent = [sent.values for sent in scene.broadcasts(begun)]
            assert sent == [(0, 70, 70, 0, 0, 0, 0, 0)]

    simulate(scene())


@each
def test_a_new_current_takes_one_broadcast(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            for current in (10.0, 6.0, 13.0):
                begin = now()
                await scene.slave(2).change_orders(OrderChange(current=current))
                assert now() - begin < 0.7
                await asyncio.sleep(0.1)
                assert scene.offers == current
            assert states(scene, 2) == [(5, 0), (7, 0)]

    simulate(scene())


@each
def test_the_last_is_refused_and_comes_when_there_is_current_again(
    dialect: str,
) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3, 4), limit=14.0) as scene:
            await charging(scene, 2, 3)
            scene.box(4).car.plug_in()
            begin = now()
            await scene.until(lambda: states(scene, 4))
            assert states(scene, 4) == [(4, 1)]
            await asyncio.sleep(100)
            # It does not ask again, and nothing is repeated.
            assert states(scene, 4) == [(4, 1)]
            assert scene.slave(4).faults == {Fault.LESS_6A}
            assert accesses(scene, 4) == []
            scene.box(2).car.leave()
            left = now()
            await scene.until(lambda: scene.box(4).state == "C")
            assert 60 < now() - left < 70
            closed = 9 if dialect in GENTLE else 0
            assert states(scene, 4, begin) == [(4, 1), (closed, 0), (5, 0), (7, 0)]

    simulate(scene())


@each
def test_nobody_begins_before_the_others_have_confirmed_less(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3), limit=16.0) as scene:
            await charging(scene, 2)
            assert scene.offers == 16
            scene.box(2).misses = lambda data: data[:2] == b"\x09\x10"
            scene.box(3).car.plug_in()
            await asyncio.sleep(7)
            # It has not received its lower current: it may only be refused.
            assert scene.box(3).state != "C"
            assert (7, 0) not in states(scene, 3)

    simulate(scene())


@each
def test_a_second_car_starts_as_soon_as_the_first_has_gone_down(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3), limit=16.0) as scene:
            await charging(scene, 2)
            begin = now()
            await scene.charge(3)
            assert now() - begin < 3 * ROUND
            await asyncio.sleep(ROUND)
            assert [box.offers for box in scene.line.boxes.values()] == [8, 8]
            assert states(scene, 3) == [(5, 0), (7, 0)]

    simulate(scene())


# -- Pauses ------------------------------------------------------------------------


@each_2
def test_off_is_access_where_that_is_volatile(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            slave = scene.slave(2)
            await slave.change_orders(OrderChange(allowed=False))
            assert scene.offers == 0
            assert accesses(scene, 2) == [0]
            assert slave.reading is not None
            assert slave.reading.allowed is False
            # It is the master's memory: a power failure turns access on again.
            scene.box(2).controller.power_cycle()
            await asyncio.sleep(30)
            assert set(accesses(scene, 2)) == {0}
            assert not scene.box(2).controller.outlet.access
            assert scene.most == 16
            begin = now()
            await slave.change_orders(OrderChange(allowed=True))
            await scene.until(lambda: scene.box(2).state == "C")
            # Only one that goes on asking without access had to be refused.
            assert now() - begin < (25 if dialect != "2.30+" else 75)
            assert accesses(scene, 2).count(1) == 1

    simulate(scene())


@each_3
def test_off_is_a_broadcast_of_0_and_refusal_where_access_is_stored(
    dialect: str,
) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            slave = scene.slave(2)
            await slave.change_orders(OrderChange(allowed=False))
            assert scene.offers == 0
            assert not scene.box(2).controller.outlet.contactor
            assert not slave.is_allowed
            assert slave.pause_reason is PauseReason.NOT_ALLOWED
            await asyncio.sleep(100)
            # It has asked again once, after its 15 s, and was refused.
            assert states(scene, 2)[2:] == [(4, 1)]
            scene.box(2).controller.power_cycle()
            begin = now()
            await asyncio.sleep(60)
            assert states(scene, 2, begin) == [(4, 1)]
            assert Fault.CHARGES_ALTHOUGH_PAUSED not in slave.faults
            await slave.change_orders(OrderChange(allowed=True))
            assert slave.is_allowed
            begin = now()
            await scene.until(lambda: scene.box(2).state == "C")
            assert now() - begin < 70
            assert accesses(scene, 2) == []
            assert scene.box(2).controller.outlet.flash_writes == 0  # type: ignore[attr-defined]

    simulate(scene())


@each_3
def test_a_limit_below_the_minimum_is_a_pause_that_ends_by_itself(
    dialect: str,
) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            slave = scene.slave(2)
            await slave.change_orders(OrderChange(current=5.0))
            assert scene.offers == 0
            assert slave.pause_reason is PauseReason.LIMIT_TOO_LOW
            await slave.change_orders(OrderChange(current=9.0))
            begin = now()
            await scene.until(lambda: scene.offers == 9)
            assert now() - begin < 30
            assert accesses(scene, 2) == []

    simulate(scene())


@each_3
def test_access_is_stored_only_as_an_action_of_its_own(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            slave = scene.slave(2)
            await slave.store_access(allowed=False)
            assert scene.offers == 0
            await asyncio.sleep(30)
            assert accesses(scene, 2) == [0]
            # No order turns it on again.
            with pytest.raises(NotAvailableError, match="memory"):
                await slave.change_orders(OrderChange(allowed=True))
            await slave.change_orders(OrderChange(current=9.0))
            await asyncio.sleep(100)
            assert accesses(scene, 2) == [0]
            assert scene.offers == 0
            await slave.store_access(allowed=True)
            await scene.until(lambda: scene.offers == 9)
            # The memory wears out: a value that stands is not written.
            await slave.store_access(allowed=True)
            assert accesses(scene, 2) == [0, 1]

    simulate(scene())


@each_2
def test_access_that_is_not_kept_is_not_stored(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            with pytest.raises(NotAvailableError):
                await scene.slave(2).store_access(allowed=False)
            assert scene.offers == 16

    simulate(scene())


@each
def test_a_box_that_was_turned_off_at_the_box_stays_off(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            scene.box(2).controller.outlet.set_access(False)
            await asyncio.sleep(200)
            assert scene.offers == 0
            assert 1 not in accesses(scene, 2)
            assert len(states(scene, 2)) == 2

    simulate(scene())


@each
def test_lack_of_supply_is_0_and_refusal_without_access(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3), limit=16.0, watch=False) as scene:
            await charging(scene, 2)
            await scene.charge(3)
            await asyncio.sleep(2 * ROUND)
            await scene.master.change_circuit(Circuit(limit=8.0))
            await asyncio.sleep(1.0)
            # The last one to begin.
            assert [box.offers for box in scene.line.boxes.values()] == [8, 0]
            assert scene.slave(3).pause_reason is PauseReason.SUPPLY_TOO_LOW
            await asyncio.sleep(60)
            assert scene.box(3).offers == 0
            assert states(scene, 3)[2:] == [(4, 1)]
            await scene.master.change_circuit(Circuit(limit=16.0))
            await scene.until(lambda: scene.box(3).state == "C")
            assert accesses(scene, 3) == []

    simulate(scene())


@pytest.mark.parametrize(
    ("dialect", "within"), [("2.30+", 25), ("3", 25), ("2.30", 80)]
)
def test_after_a_short_lack_of_supply_it_is_back_as_soon_as_it_asks(
    dialect: str, within: float
) -> None:
    async def scene() -> None:
        async with scene_of(dialect, watch=False) as scene:
            await charging(scene, 2)
            await scene.master.change_circuit(Circuit(limit=5.0))
            await asyncio.sleep(4)
            assert scene.offers == 0
            await scene.master.change_circuit(Circuit(limit=16.0))
            begin = now()
            await scene.until(lambda: scene.offers == 16)
            assert now() - begin < within

    simulate(scene())


# -- Failures ----------------------------------------------------------------------


@each
def test_a_grant_is_never_repeated_without_a_new_status(dialect: str) -> None:
    """Its reply is lost: the next status shows whether it was taken."""

    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await asyncio.sleep(8)
            scene.box(2).loses = lambda data: data[1] == 16
            await scene.charge(2)
            await asyncio.sleep(20)
            assert states(scene, 2) == [(5, 0), (7, 0)]

    simulate(scene())


@each
def test_a_grant_that_is_lost_follows_the_next_status(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await asyncio.sleep(8)
            lost = 0

            def misses(data: bytes) -> bool:
                nonlocal lost
                lost += data[:2] == b"\x02\x10"
                return data[:2] == b"\x02\x10" and lost in (1, 3)

            scene.box(2).misses = misses
            await scene.charge(2)
            assert states(scene, 2) == [(5, 0), (5, 0), (7, 0), (7, 0)]
            polls = [s for s in scene.line.sent if s.data[:2] == b"\x02\x04"]
            grants = [s.when for s in scene.line.sent if s.data[:2] == b"\x02\x10"]
            for grant in grants:
                before = max(poll.when for poll in polls if poll.when < grant)
                assert grant - before < 0.6

    simulate(scene())


@each
def test_silence_of_ours_stops_it_and_one_broadcast_brings_it_back(
    dialect: str,
) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            scene.box(2).deaf = True
            await asyncio.sleep(25)
            stops = scene.slave(2).fail_safe is FailSafe.STOPS
            assert stops == (dialect not in ("3.6", "3.8"))
            assert (scene.offers == 0) == (dialect != "3.6")
            scene.box(2).deaf = False
            await scene.until(lambda: scene.slave(2).available)
            await scene.until(lambda: scene.offers == 16)
            assert not scene.slave(2).faults

    simulate(scene())


@each
def test_a_power_failure_is_followed_by_a_new_request(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            scene.box(2).controller.power_cycle()
            assert scene.offers == 0
            await scene.until(lambda: scene.offers == 16)
            assert states(scene, 2) == [(5, 0), (7, 0), (5, 0), (7, 0)]

    simulate(scene())


@each
def test_never_more_than_the_cable_of_the_next_car(dialect: str) -> None:
    """The box does not clamp: 40 A on a 32 A cable were signalled."""

    async def scene() -> None:
        async with scene_of(dialect, limit=32.0, current=32.0, maximum=32) as scene:
            await charging(scene, 2)
            assert scene.offers == 32
            scene.box(2).car.leave()
            await asyncio.sleep(0.2)
            scene.box(2).controller.outlet.cable = 13
            pilots = []
            await asyncio.sleep(3)
            scene.box(2).car.plug_in()
            for _ in range(1000):
                await asyncio.sleep(0.01)
                pilots.append(scene.box(2).controller.outlet.pilot_current)
            assert scene.offers == 13
            assert max(pilots) == 13

    simulate(scene())


@each
def test_the_cable_is_not_forgotten_with_a_lost_reply(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, limit=32.0, current=32.0, maximum=32) as scene:
            scene.box(2).controller.outlet.cable = 13
            await charging(scene, 2)
            assert scene.offers == 13
            scene.box(2).mute = True
            begin = now()
            await scene.until(lambda: scene.slave(2).status is None)
            await asyncio.sleep(ROUND)
            assert scene.slave(2).limits.ceiling == 13
            await asyncio.sleep(2 * ROUND)
            scene.box(2).mute = False
            await asyncio.sleep(ROUND)
            sent = [one.values[1] for one in scene.broadcasts(begin)]
            assert max(sent) == 130

    simulate(scene())


@each
def test_6_a_while_no_cable_was_measured(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, limit=32.0) as scene:
            await asyncio.sleep(20)
            assert {sent.values[1] for sent in scene.broadcasts()} == {60}
            assert scene.slave(2).limits.ceiling == 6

    simulate(scene())


@each
def test_a_maximum_lowered_at_the_box_counts_while_it_charges(dialect: str) -> None:
    async def scene() -> None:
        more = {"limit": 32.0, "current": 32.0, "maximum": 25}
        async with scene_of(dialect, **more) as scene:
            await charging(scene, 2)
            assert scene.offers == 25
            scene.box(2).controller.outlet.settings["max_current"] = 10
            begin = now()
            await scene.until(lambda: scene.offers == 10)
            assert now() - begin < MAXIMUM_INTERVAL + 2 * ROUND

    simulate(scene())


@each
def test_the_block_of_the_makers_master_is_polled(dialect: str) -> None:
    """Temperature and serial number are in a longer one, read now and then."""

    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await asyncio.sleep(8)
            begin = now()
            await asyncio.sleep(120)
            reads = scene.frames("0204", begin)
            long = [one for one in reads if one.startswith("02040000000c")]
            short = "020400a0000b" if dialect == "2.20" else "020400000008"
            assert {one[:12] for one in reads} - {"02040000000c"} == {short}
            assert len(long) == (
                0 if dialect == "2.20" else int(120 / LONG_STATUS_INTERVAL)
            )
            slave = scene.slave(2)
            assert slave.reading is not None
            assert slave.info is not None
            if dialect != "2.20":
                assert slave.reading.temperature == 20
                assert slave.info.serial == "1"

    simulate(scene())


@pytest.mark.parametrize("dialect", [*V2[1:], *V3])
def test_another_box_in_its_place_is_not_written_to(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            scene.plug_box(2).controller.serial = 7
            scene.box(2).car.plug_in()
            begin = now() + LONG_STATUS_INTERVAL
            await asyncio.sleep(100)
            assert Fault.WRONG_CHARGER in scene.slave(2).faults
            assert states(scene, 2, begin) == []

    simulate(scene())


KEPT = {
    "2.20": Dialect.V2_20,
    "2.30": Dialect.V2_30,
    "2.30+": Dialect.V2_HEAD,
    "3": Dialect.V3,
    "3.8": Dialect.V3_OLD,
}


@each
def test_no_request_comes_sooner_than_that_of_a_recorded_master(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3), limit=20.0) as scene:
            await scene.charge(2)
            silences: list[float] = []
            add_up = scene.line.on_sent

            def note(sent: Sent) -> None:
                silences.append(now() - scene.line.busy_until)
                add_up(sent)

            scene.line.on_sent = note
            await scene.charge(3)
            await asyncio.sleep(10)
            assert len(silences) > 10
            assert min(silences) >= 0.03 - 1e-6

    simulate(scene())


@pytest.mark.parametrize("dialect", ["2.20", "2.30", "2.30+", "3"])
def test_absent_nodes_are_asked_one_a_round_and_delay_nobody(dialect: str) -> None:
    async def scene() -> None:
        scene = scene_of(
            dialect,
            units=tuple(range(2, 9)),
            limit=32.0,
            kept=KEPT[dialect],
            current=16.0,
        )
        async with scene:
            for unit in range(3, 9):
                del scene.line.boxes[unit]
            await asyncio.sleep(LISTENING + 20)
            await charging(scene, 2)
            assert scene.offers == 16
            begin = now()
            await asyncio.sleep(60)
            others = [
                sent.when
                for sent in scene.line.sent
                if sent.data[1] == 4 and sent.data[0] != 2 and sent.when > begin
            ]
            assert others
            assert len(others) <= 60 / PERIOD + 1
            own = [s.when for s in scene.line.sent if s.data[:2] == b"\x02\x04"]
            gaps = [b - a for a, b in pairwise(own) if a > begin]
            # A probe of one of them, and then a broadcast, may be first.
            assert max(gaps) < PERIOD + 0.7
            assert max(scene.gaps(begin)) <= PERIOD + SLACK + 0.03

    simulate(scene())


@pytest.mark.parametrize("kept", [Dialect.V3_OLD, None])
def test_nobody_begins_beside_one_that_was_never_read_and_may_go_on_for_ever(
    kept: Dialect | None,
) -> None:
    """It may be charging with all of the supply: 3.x before 3.7.4 never stop."""

    async def scene() -> None:
        async with scene_of("3.8", units=(2, 3), kept=kept) as scene:
            box = scene.line.boxes.pop(3)
            await asyncio.sleep(8)
            scene.box(2).car.plug_in()
            await asyncio.sleep(120)
            assert scene.offers == 0
            # It is neither granted nor refused: it need not wait for a minute.
            assert states(scene, 2) == []
            slave = scene.slave(2)
            assert slave.pause_reason is PauseReason.OTHER_NOT_READ
            scene.line.boxes[3] = box
            begin = now()
            await scene.until(lambda: scene.offers == 16)
            assert now() - begin < 45
            assert slave.pause_reason is None

    simulate(scene())


def test_only_who_may_not_begin_waits_for_another_to_be_read() -> None:
    """Not one that charges, nor where the other must have stopped by itself."""

    async def scene() -> None:
        async with scene_of("3.8") as scene:
            await charging(scene, 2)
            scene.add(3)
            await asyncio.sleep(30)
            assert scene.master.waits_for_unread(2)
            assert scene.offers > 0
            assert scene.slave(2).pause_reason is None
        async with scene_of("2.30", units=(2, 3), kept=Dialect.V2_30) as scene:
            scene.line.boxes.pop(3)
            await asyncio.sleep(5)
            assert scene.slave(2).pause_reason is None

    simulate(scene())


def test_one_that_was_never_read_is_forgotten_when_it_is_removed() -> None:
    async def scene() -> None:
        async with scene_of("3.8", units=(2, 3)) as scene:
            scene.line.boxes.pop(3)
            await asyncio.sleep(8)
            scene.box(2).car.plug_in()
            await asyncio.sleep(30)
            assert scene.offers == 0
            await scene.bus.remove(scene.slave(3))
            await scene.until(lambda: scene.offers == 16)

    simulate(scene())


# -- Start and end -----------------------------------------------------------------


@each
def test_a_restart_into_charging_nodes(dialect: str) -> None:
    """Nothing goes up before both were read; nobody is stopped."""

    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await charging(scene, 2, 3)
            assert scene.offers == 16
            await scene.bus.stop()
            scene.box(3).mute = True
            scene.new_bus()
            for unit in (2, 3):
                scene.add(unit)
            begin = now()
            await scene.bus.start()
            await asyncio.sleep(11)
            first = min(s.when for s in scene.broadcasts(begin))
            assert first - begin < 5
            assert scene.box(2).offers <= 8
            assert scene.box(3).offers <= 8
            scene.box(3).mute = False
            await scene.until(lambda: scene.slave(3).available)
            await asyncio.sleep(60)
            assert scene.offers == 16

    simulate(scene())


@pytest.mark.parametrize("dialect", ["3.6", "3.8"])
def test_one_that_may_go_on_for_ever_keeps_its_current_until_it_is_read(
    dialect: str,
) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await charging(scene, 2, 3)
            scene.line.boxes.pop(3)
            await asyncio.sleep(300)
            assert scene.box(2).offers == 8
            scene.plug_box(3)
            await scene.until(lambda: scene.slave(3).available)
            await scene.until(lambda: scene.box(2).offers == 16)

    simulate(scene())


@pytest.mark.parametrize("dialect", ["2.20", "2.30", "2.30+", "3"])
def test_the_share_of_one_that_has_stopped_by_itself_is_free(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await charging(scene, 2, 3)
            scene.line.boxes.pop(3)
            await asyncio.sleep(40)
            assert scene.box(2).offers == 16

    simulate(scene())


@each
def test_one_that_is_silent_but_listens_gets_a_0(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await charging(scene, 2, 3)
            scene.box(3).mute = True
            await asyncio.sleep(12)
            assert scene.box(3).offers == 0
            # Its car is back when it answers again.
            scene.box(3).mute = False
            await scene.until(lambda: scene.box(3).offers == 8)

    simulate(scene())


@each
def test_a_clean_end_stops_one_that_might_go_on_for_ever(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            await scene.slave(2).on_shutdown()
            stopped = scene.offers == 0
            assert stopped == (scene.slave(2).fail_safe is FailSafe.UNPROVEN)
            assert accesses(scene, 2) == []

    simulate(scene())


@each
def test_a_box_that_is_removed_is_stopped_first(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await charging(scene, 2, 3)
            slave = scene.slave(3)
            await slave.on_shutdown(removed=True)
            await scene.bus.remove(slave)
            assert scene.box(3).offers == 0
            await asyncio.sleep(60)
            assert scene.box(3).offers == 0
            assert scene.box(2).offers == 16
            assert accesses(scene, 3) == ([0] if dialect in V2 else [])

    simulate(scene())


@each
def test_a_box_that_does_not_stop_is_an_error(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(dialect) as scene:
            await charging(scene, 2)
            scene.box(2).misses = lambda data: data[1] == 16
            with pytest.raises(NotConfirmedError):
                await scene.slave(2).change_orders(OrderChange(allowed=False))
            scene.box(2).misses = lambda _data: False
            await asyncio.sleep(5)
            assert scene.offers == 0

    simulate(scene())
