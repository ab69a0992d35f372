"""Sharing a circuit limit: shares, values of broadcasts, and draws; pure."""

from dataclasses import dataclass, field
from typing import Any

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.smartevse.dialects import (
    FAMILIES,
    MAPS,
    STOPS_ALONE,
    Balancing,
    Dialect,
    Family,
)
from custom_components.evse_bus.evse.smartevse.sharing import (
    LOWEST,
    Claim,
    Contactor,
    Draw,
    above_share,
    fit_to_limit,
    grant,
    next_values,
    offered,
    split,
)

ROW = FAMILIES[Family.V2_17]


def claims(*demands: int) -> list[Claim]:
    return [
        Claim(unit=2 + n, demand=demand, since=n) for n, demand in enumerate(demands)
    ]


@pytest.mark.parametrize(
    ("limit", "minimum", "demands", "shares"),
    [
        (160, 60, (160,), (160,)),
        (160, 60, (160, 160), (80, 80)),
        # The other gets the part that one cannot use.
        (160, 60, (60, 160), (60, 100)),
        (250, 60, (100, 130, 320), (83, 83, 83)),
        (320, 60, (60, 130, 320), (60, 130, 130)),
        (400, 60, (60, 130, 320), (60, 130, 210)),
        # First come, first served, where there is not enough.
        (160, 60, (160, 160, 160), (80, 80, 0)),
        (180, 60, (160, 160, 160), (60, 60, 60)),
        (160, 100, (160, 160), (160, 0)),
        # A demand below the minimum is met all the same.
        (160, 80, (60, 160), (60, 100)),
        (59, 60, (160,), (0,)),
        (0, 60, (160,), (0,)),
        (160, 60, (0, 160), (0, 160)),
    ],
)
def test_split(
    limit: int, minimum: int, demands: tuple[int, ...], shares: tuple[int, ...]
) -> None:
    assert tuple(split(limit, minimum, claims(*demands)).values()) == shares


@pytest.mark.parametrize(
    ("limit", "values", "active", "fitted"),
    [
        # One charges with the whole limit: the value of the other is 0 until it requests.
        (160, (160, 160), (2,), (160, 0)),
        (200, (160, 100), (2,), (160, 0)),
        (320, (160, 100), (2,), (160, 100)),
        # None charges: no value is above its part.
        (160, (160, 160), (), (80, 80)),
        (160, (160, 160, 160), (), (0, 0, 0)),
        (160, (160,), (), (160,)),
        # The second is being stopped, and offers 6 A until it has received that.
        (130, (70, 60, 0), (2, 3, 4), (60, 60, 0)),
        (80, (80, 0), (2, 3), (60, 0)),
    ],
)
def test_fit_to_limit(
    limit: int,
    values: tuple[int, ...],
    active: tuple[int, ...],
    fitted: tuple[int, ...],
) -> None:
    by_unit = dict(enumerate(values, 2))
    assert tuple(fit_to_limit(limit, by_unit, active).values()) == fitted


@given(
    limit=st.integers(0, 900),
    minimum=st.integers(60, 160),
    demands=st.lists(st.integers(0, 800), min_size=1, max_size=3),
    idle=st.lists(st.integers(60, 800), max_size=2),
)
def test_the_values_of_a_broadcast_are_never_above_the_limit(
    limit: int, minimum: int, demands: list[int], idle: list[int]
) -> None:
    shares = split(limit, minimum, claims(*demands))
    values = shares | dict(enumerate(idle, 10))
    fitted = fit_to_limit(limit, values, shares)
    assert sum(fitted.values()) <= limit
    assert all(fitted[unit] <= value for unit, value in values.items())
    assert all(value == 0 or value >= LOWEST for value in fitted.values())
    if len(shares) * LOWEST <= limit and all(shares.values()):
        # Nothing is taken from those that draw where there is enough.
        assert {unit: fitted[unit] for unit in shares} == shares


def test_6_a_is_reserved_first_for_boxes_that_cannot_be_stopped() -> None:
    gone = Claim(unit=2, demand=60, since=9, fixed=True)
    stopping = Claim(unit=3, demand=0, since=9, fixed=True)
    last = Claim(unit=4, demand=160)
    assert split(160, 60, [gone, last]) == {2: 60, 4: 100}
    assert split(190, 60, [gone, stopping, last]) == {2: 60, 3: 0, 4: 70}
    assert split(160, 60, [gone, stopping, last]) == {2: 60, 3: 0, 4: 0}


@given(
    limit=st.integers(0, 900),
    minimum=st.integers(60, 160),
    demands=st.lists(st.integers(0, 800), max_size=3),
)
def test_a_split_keeps_to_the_limit_and_to_the_demands(
    limit: int, minimum: int, demands: list[int]
) -> None:
    shares = split(limit, minimum, claims(*demands))
    assert sum(shares.values()) <= limit
    for claim in claims(*demands):
        share = shares[claim.unit]
        assert share <= claim.demand
        assert share == 0 or share >= min(minimum, claim.demand) >= LOWEST
    rest = limit - sum(shares.values())
    unsatisfied = [c for c in claims(*demands) if LOWEST <= shares[c.unit] < c.demand]
    # Less is left than there are boxes that could use it.
    assert not unsatisfied or rest < len(unsatisfied)


def test_a_value_out_of_range_counts_as_the_lowest() -> None:
    assert [offered(value) for value in (0, 59, 60, 800, 801)] == [60, 60, 60, 800, 60]


def test_a_draw_counts_everything_a_box_may_be_following() -> None:
    draw = Draw(ROW)
    draw.read(100, 0.0, Contactor.CLOSED)
    draw.sent(80, 1.0)
    assert draw.most(1.0) == 100
    draw.read(80, 1.2, Contactor.CLOSED)
    assert draw.most(1.2) == 80
    draw.sent(130, 2.0)
    assert draw.most(2.0) == 130
    draw.read(80, 2.2, Contactor.CLOSED)
    assert draw.most(2.2) == 80
    draw.read(130, 2.2, Contactor.OPEN)
    assert draw.most(2.2) == 0


def test_a_box_that_does_not_answer_may_still_receive() -> None:
    draw = Draw(ROW)
    draw.read(160, 0.0, Contactor.CLOSED)
    for second in range(2, 30, 2):
        draw.sent(60, second)
        most = 160 if second < STOPS_ALONE else 60
        assert draw.most(second) == most
    # Without a broadcast it has stopped.
    assert draw.most(28 + STOPS_ALONE) == 0


def test_a_draw_is_unknown_before_the_first_broadcast() -> None:
    draw = Draw(ROW, unknown_since=0.0)
    draw.sent(60, 5.0)
    assert draw.most(11.9) == float("inf")
    assert draw.most(12.0) == 60
    draw.requested(6.0)
    assert draw.most(6.0) == 0


def test_a_grant_counts_until_a_later_broadcast_was_surely_received() -> None:
    draw = Draw(ROW)
    draw.read(160, 0.0, Contactor.OPEN)
    draw.granted(160, 1.0)
    draw.sent(80, 2.0)
    assert draw.most(2.0) == 160
    # 0 may be the memory of a box that was switched off and on before the grant.
    draw.read(0, 2.1, Contactor.CLOSED)
    assert draw.most(2.1) == 160
    draw.sent(80, 3.0)
    draw.read(80, 3.1, Contactor.CLOSED)
    assert draw.most(3.1) == 80


def test_a_repeated_request_does_not_undo_its_grant() -> None:
    draw = Draw(ROW)
    draw.read(100, 0.0, Contactor.OPEN)
    draw.granted(100, 1.0)
    draw.requested(1.1)
    assert draw.most(1.1) == 100


# -- From 2.20 on --------------------------------------------------------------------

V2_30, HEAD, V3_OLD = (
    MAPS[one].balancing for one in (Dialect.V2_30, Dialect.V2_HEAD, Dialect.V3_OLD)
)


@pytest.mark.parametrize(
    ("row", "until"), [(V2_30, 12.0), (HEAD, 20.0), (V3_OLD, float("inf"))]
)
def test_a_silent_node_counts_until_it_has_stopped_by_itself(
    row: Balancing, until: float
) -> None:
    draw = Draw(row)
    draw.read(160, 0.0, Contactor.CLOSED)
    assert draw.most(min(until, 1e6) - 0.1) == 160
    assert draw.most(min(until, 1e6)) == (0 if until < float("inf") else 160)


def test_a_node_that_was_sent_0_counts_until_that_is_confirmed_or_it_stops() -> None:
    draw = Draw(V2_30)
    draw.read(160, 0.0, Contactor.CLOSED)
    for second in range(1, 12, 2):
        draw.sent(0, second)
        assert draw.most(second) == 160
    assert draw.may_charge(11.9)
    # It has received one of them, or has missed all and stopped.
    assert not draw.may_charge(12.0)
    draw.read(0, 12.1, Contactor.OPEN)
    assert draw.most(12.1) == 0


@pytest.mark.parametrize("value", [0, 1, 50, 59])
def test_a_node_that_charges_offers_6_a_at_least(value: int) -> None:
    draw = Draw(V2_30)
    draw.read(value, 0.0, Contactor.CLOSED)
    assert draw.most(0.0) == LOWEST
    draw.sent(value, 1.0)
    assert draw.most(1.0) == LOWEST


def test_c1_counts_what_came_before_it() -> None:
    """The car may still draw it, whatever word is read back."""
    draw = Draw(HEAD)
    draw.read(160, 0.0, Contactor.CLOSED)
    draw.sent(0, 1.0)
    draw.read(0, 2.0, Contactor.ENDING)
    assert draw.most(2.0) == 160
    draw.read(0, 4.0, Contactor.OPEN)
    assert draw.most(4.0) == 0


def test_a_grant_counts_all_that_came_before_the_request() -> None:
    """Its pilot may not have followed a broadcast while it asked."""
    draw = Draw(V2_30)
    draw.read(160, 0.0, Contactor.OPEN)
    draw.sent(60, 1.0)
    draw.read(60, 2.0, Contactor.ASKED)
    assert draw.most(2.0) == 0
    assert draw.at_grant == 160
    draw.granted_as_broadcast(2.1)
    assert draw.most(2.1) == 160
    # It may have received that before its grant.
    draw.read(60, 3.0, Contactor.CLOSED)
    assert draw.most(3.0) == 160
    draw.sent(80, 4.0)
    draw.read(80, 4.1, Contactor.CLOSED)
    assert draw.most(4.1) == 80


def test_a_grant_after_a_fresh_start_costs_6_a() -> None:
    draw = Draw(V2_30)
    draw.read(0, 0.0, Contactor.OPEN)
    draw.read(0, 1.0, Contactor.ASKED)
    assert draw.at_grant == LOWEST
    draw.sent(60, 1.1)
    draw.granted_as_broadcast(1.2)
    assert draw.most(1.2) == LOWEST


def test_one_that_may_go_on_for_ever_is_unknown_until_it_is_read() -> None:
    draw = Draw(V3_OLD, unknown_since=0.0)
    draw.sent(0, 1.0)
    assert draw.most(1e6) == float("inf")
    draw.read(60, 1e6, Contactor.CLOSED)
    assert draw.most(1e6) == 60


# -- The property ------------------------------------------------------------------


@dataclass
class Slave:
    """The behaviour of the firmware (PROTOCOLS.md, 3)."""

    received: int = 0
    pilot: int = 0
    closed: bool = False
    in_b: bool = False
    silence: float = 0.0

    def broadcast(self, value: int) -> None:
        self.received = value
        self.silence = 0.0
        if self.closed or self.in_b:
            self.pilot = offered(value)

    def granted(self, value: int) -> None:
        if value:
            self.pilot = offered(value)
            self.closed = True

    def passes(self, seconds: float) -> None:
        self.silence += seconds
        if self.silence >= STOPS_ALONE - 1:
            self.closed = False

    @property
    def contactor(self) -> Contactor:
        return Contactor.CLOSED if self.closed else Contactor.OPEN

    @property
    def offers(self) -> int:
        return self.pilot if self.closed else 0


@dataclass
class World:
    limit: int
    minimum: int
    slaves: dict[int, Slave]
    demands: dict[int, int]
    draws: dict[int, Draw] = field(default_factory=dict)
    now: float = 0.0
    gone: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.draws = {unit: Draw(ROW, unknown_since=0.0) for unit in self.slaves}

    def shares(self, asking: int | None = None) -> dict[int, int]:
        active = []
        for unit, draw in self.draws.items():
            demand = self.demands[unit]
            unreachable = unit in self.gone or demand < LOWEST
            fixed = draw.may_draw and unreachable
            if draw.may_draw or unit == asking:
                demand = min(demand, LOWEST) if fixed else demand
                active.append(Claim(unit=unit, demand=demand, since=unit, fixed=fixed))
        return dict.fromkeys(self.draws, 0) | split(self.limit, self.minimum, active)

    def broadcast(self, hearing: set[int], asking: int | None = None) -> None:
        values = next_values(self.limit, self.shares(asking), self.draws, self.now)
        for unit, value in values.items():
            self.draws[unit].sent(value, self.now)
            if unit in hearing:
                self.slaves[unit].broadcast(value)

    def read(self, unit: int) -> None:
        if unit not in self.gone:
            slave = self.slaves[unit]
            self.draws[unit].read(slave.received, self.now, slave.contactor)

    def ask(self, unit: int, *, arrives: bool) -> None:
        slave = self.slaves[unit]
        if slave.closed or unit in self.gone:
            return
        self.draws[unit].requested(self.now)
        share = self.shares(unit)[unit]
        value = grant(self.limit, share, unit, self.draws, self.now)
        if value:
            self.draws[unit].granted(value, self.now)
        if arrives:
            slave.granted(value)

    def wait(self, seconds: float) -> None:
        self.now += seconds
        for slave in self.slaves.values():
            slave.passes(seconds)

    def does(self, what: str, *rest: Any) -> None:  # noqa: ANN401 - a step
        unit = rest[0]
        match what:
            case "ask":
                self.ask(unit, arrives=rest[1])
            case "end":
                self.slaves[unit].closed = False
            case "b":
                self.slaves[unit].in_b = not self.slaves[unit].in_b
            case "demand":
                self.demands[unit] = rest[1]
            case "gone":
                self.gone.add(unit)
            case "back":
                self.gone.discard(unit)
            case "reset":
                self.slaves[unit] = Slave()
            case _:
                # Read, broadcast, wait.
                getattr(self, what)(*rest)

    @property
    def offers(self) -> int:
        return sum(slave.offers for slave in self.slaves.values())


units = st.sampled_from((2, 3, 4))
steps = st.one_of(
    st.tuples(st.just("broadcast"), st.sets(units)),
    st.tuples(st.just("read"), units),
    st.tuples(st.just("ask"), units, st.booleans()),
    st.tuples(st.just("end"), units),
    st.tuples(st.just("b"), units),
    st.tuples(st.just("demand"), units, st.sampled_from((0, 60, 77, 160, 320))),
    st.tuples(st.just("gone"), units),
    st.tuples(st.just("back"), units),
    st.tuples(st.just("reset"), units),
    st.tuples(st.just("wait"), st.sampled_from((0.1, 1.0, 2.0, 6.0, 11.5))),
)


@settings(max_examples=400, deadline=None)
@given(
    limit=st.integers(180, 400),
    minimum=st.sampled_from((60, 80)),
    before=st.tuples(*(st.sampled_from((0, 0, 60, 60)),) * 3),
    story=st.lists(steps, max_size=60),
)
def test_boxes_never_offer_more_than_the_limit(
    limit: int, minimum: int, before: tuple[int, int, int], story: list[tuple]
) -> None:
    """18 A are 6 A for each of three, whether it can be stopped or not."""
    slaves = {
        unit: Slave(received=pilot, pilot=pilot, closed=pilot > 0)
        for unit, pilot in zip((2, 3, 4), before, strict=True)
    }
    world = World(limit, minimum, slaves, dict.fromkeys(slaves, 320))
    for what, *rest in story:
        world.does(what, *rest)
        assert world.offers <= limit


def test_first_others_go_down_then_one_goes_up() -> None:
    slaves = {2: Slave(received=160, pilot=160, closed=True), 3: Slave(received=80)}
    world = World(160, 60, slaves, {2: 160, 3: 160})
    world.read(2)
    world.read(3)
    world.ask(3, arrives=True)
    assert slaves[3].offers == 0
    assert above_share(world.shares(3), world.draws, world.now) == [2]
    # It misses the first: it does not count as down before it is read back.
    world.broadcast({3}, asking=3)
    world.read(2)
    assert grant(160, 80, 3, world.draws, world.now) == 0
    world.broadcast({2, 3}, asking=3)
    assert grant(160, 80, 3, world.draws, world.now) == 0
    world.read(2)
    assert grant(160, 80, 3, world.draws, world.now) == 80
    world.ask(3, arrives=True)
    assert [slave.offers for slave in slaves.values()] == [80, 80]
