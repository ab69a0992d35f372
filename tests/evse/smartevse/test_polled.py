"""A polled SmartEVSE in all dialects: orders, readings, and their checks."""

import asyncio
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotConfirmedError,
    SharedAddressError,
    SupersededError,
)
from custom_components.evse_bus.evse.model import (
    Capability,
    Fault,
    Mode,
    OrderChange,
    PauseReason,
    Status,
)
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from tests.simulated_time import now, simulate

from .polled_scene import (
    ALL,
    HEAD,
    LATER,
    OLDER,
    V2_17,
    V2_20,
    V2_30,
    PolledScene,
    play,
)

FIRMWARE = {
    V2_17: "2.17",
    V2_20: "2.20",
    V2_30: "2.30",
    HEAD: "2.30, development version",
}
each = pytest.mark.parametrize("dialect", ALL)
older = pytest.mark.parametrize("dialect", OLDER)


@each
def test_the_dialect_is_found_by_reading(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        assert scene.charger.dialect is dialect

    scene = play(PolledScene(dialect), acts)
    first = scene.writes()[0].when
    before = [sent for sent in scene.line.sent if sent.when < first]
    # Dialect, status and both halves of the settings come before any write.
    assert len(before) >= 4


@each
def test_no_car(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await asyncio.sleep(32)
        assert scene.connector.status is Status.AVAILABLE
        assert scene.connector.raw_state == "A"
        assert scene.connector.plugged is False
        assert scene.connector.charging is False
        assert scene.reading.allowed is True
        assert scene.reading.offered_current is None
        assert scene.reading.maximum_current == 16
        assert scene.reading.mode is Mode.NORMAL
        has = Capability.TEMPERATURE in scene.charger.capabilities
        assert has == (dialect in LATER)
        assert scene.reading.temperature == (20 if dialect in LATER else None)

    play(PolledScene(dialect), acts)


@each
def test_a_car_charges_within_the_order(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        assert scene.box.offers == 10
        assert scene.connector.status is Status.CHARGING
        assert scene.connector.raw_state == "C"
        assert scene.connector.plugged is True
        assert scene.connector.charging is True
        assert scene.reading.offered_current == 10
        assert scene.charger.faults == frozenset()

    play(PolledScene(dialect), acts)


@each
def test_the_override_is_6_a_before_a_car_comes(dialect: Dialect) -> None:
    """The next cable is not known, and the override takes precedence over its coding."""

    async def acts(scene: PolledScene) -> None:
        await scene.polled(1)
        assert scene.currents() == [60]
        scene.outlet.cable = 13
        await scene.charge()
        await scene.polled(4)
        assert scene.box.offers == 13

    scene = play(PolledScene(dialect, current=32, maximum=32, cable=32), acts)
    assert max(scene.currents()) <= 130


@each
@pytest.mark.parametrize("amperes", [7.3, 12.0])
def test_a_limit_is_confirmed_by_its_read_back(
    dialect: Dialect, amperes: float
) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        began = now()
        await scene.charger.change_orders(OrderChange(current=amperes))
        assert scene.box.offers == amperes
        assert scene.reading.offered_current == amperes
        assert now() - began < (14 if dialect in LATER else 3.5)

    play(PolledScene(dialect), acts)


@each
def test_off_is_off_and_stays_so(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        began = now()
        await scene.charger.change_orders(OrderChange(allowed=False))
        # A pause does not wait for the quiet time.
        assert now() - began < 0.5
        assert not scene.outlet.access
        await scene.until(lambda: not scene.box.controller.outlet.contactor, 7)
        # A limit starts no charge.
        await scene.charger.change_orders(OrderChange(current=16))
        await scene.polled(3)
        assert scene.box.offers == 0
        assert scene.accesses() == [0]
        assert scene.reading.allowed is False
        assert scene.reading.offered_current == 0

    play(PolledScene(dialect), acts)


@older
def test_without_access_an_older_box_hides_the_car(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.charger.change_orders(OrderChange(allowed=False))
        assert scene.connector.raw_state == "A"
        assert scene.connector.plugged is None
        assert scene.connector.status is Status.OUT_OF_SERVICE
        await scene.charger.change_orders(OrderChange(allowed=True))
        assert scene.connector.plugged is not False
        await scene.until(lambda: scene.box.state == "C")

    play(PolledScene(dialect), acts)


@pytest.mark.parametrize("dialect", [V2_17, V2_20, V2_30])
@pytest.mark.parametrize("plugged", [True, False])
def test_after_off_and_on_a_car_that_keeps_its_request_is_not_gone(
    dialect: Dialect, *, plugged: bool
) -> None:
    """The box reports A until the car has let go once: that is no "unplugged"."""

    async def acts(scene: PolledScene) -> None:
        if plugged:
            await scene.charge()
        await scene.charger.change_orders(OrderChange(allowed=False))
        scene.outlet.pilot_voltage = 6 if plugged else None
        await scene.charger.change_orders(OrderChange(allowed=True))
        await asyncio.sleep(600)
        assert scene.connector.raw_state == "A"
        assert scene.connector.plugged is None
        scene.outlet.pilot_voltage = 9
        await scene.until(lambda: scene.connector.plugged is True)
        scene.outlet.pilot_voltage = 12
        await scene.until(lambda: scene.connector.plugged is False)

    play(PolledScene(dialect), acts)


@each
def test_without_a_measured_cable_6_a_are_written(dialect: Dialect) -> None:
    """A plugged car, and a box that reports 0 for its cable: no more is known to fit."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(3)
        assert scene.box.offers == 10
        since = now()
        scene.outlet.cable_measured = 0
        await scene.until(lambda: scene.box.offers == 6, 60)
        current = MAPS[dialect].current_register
        written = [one for one in scene.writes(since=since) if one.register == current]
        assert {one.value for one in written} == {60}

    play(PolledScene(dialect), acts)


def test_a_request_that_its_master_did_not_answer_is_no_unplugged_car() -> None:
    """It goes back to A, with the car in, and asks again; one that left asks for A."""

    async def acts(scene: PolledScene) -> None:
        await asyncio.sleep(25)
        assert scene.connector.plugged is False
        status = scene.charger.status
        assert status is not None
        for waiting, shown in (("E", False), ("F", None)):
            for state in (waiting, "A"):
                scene.charger.on_status(replace(status, raw_state=state), now())
            assert scene.connector.plugged is shown

    play(PolledScene(V2_17), acts)


@each
def test_right_after_power_up_a_plugged_car_is_not_gone(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        seen: list[bool | None] = []
        scene.on_step.append(lambda: seen.append(_plugged(scene)))
        scene.box.controller.power_cycle()
        await scene.until(lambda: scene.box.state == "C", 60)
        assert False not in seen
        scene.car.leave()
        await scene.until(lambda: _plugged(scene) is False, 60)

    play(PolledScene(dialect), acts)


def _plugged(scene: PolledScene) -> bool | None:
    reading = scene.charger.reading
    return None if reading is None else reading.connectors[1].plugged


def test_without_access_a_later_box_still_reports_the_car() -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.charger.change_orders(OrderChange(allowed=False))
        assert scene.connector.raw_state == "C1"
        assert scene.connector.charging is None
        await scene.polled(2)
        assert scene.connector.raw_state == "B1"
        assert scene.connector.plugged is True
        assert scene.connector.charging is False
        assert scene.connector.status is Status.SUSPENDED_EVSE

    play(PolledScene(HEAD), acts)


@each
def test_on_again(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.polled(1)
        assert scene.accesses() == [0]
        scene.car.plug_in()
        await scene.polled(2)
        assert scene.box.offers == 0
        await scene.charger.change_orders(OrderChange(allowed=True))
        assert scene.outlet.access
        await scene.until(lambda: scene.box.offers == 10)

    play(PolledScene(dialect, allowed=False), acts)


@each
def test_a_limit_of_0_a_is_a_pause_until_the_next_limit(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.charger.change_orders(OrderChange(current=0))
        await scene.until(lambda: scene.box.offers == 0, 7)
        await scene.polled(2)
        assert scene.accesses() == [0]
        await scene.charger.change_orders(OrderChange(current=8))
        assert scene.accesses() == [0, 1]
        await scene.until(lambda: scene.box.offers == 8)

    scene = play(PolledScene(dialect), acts)
    assert 0 not in scene.currents()


@each
def test_a_limit_does_not_turn_on_access_that_it_did_not_turn_off(
    dialect: Dialect,
) -> None:
    """Access was turned off at the box before the limit was 0 A."""

    async def acts(scene: PolledScene) -> None:
        scene.box.controller.outlet.set_access(False)
        await scene.polled(2)
        await scene.charger.change_orders(OrderChange(current=0))
        await scene.charger.change_orders(OrderChange(current=10))
        await scene.polled(2)
        assert not scene.outlet.access
        assert 1 not in scene.accesses()

    play(PolledScene(dialect), acts)


@each
def test_a_pause_by_the_user_outlasts_a_limit_of_0_a(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charger.change_orders(OrderChange(current=0))
        await scene.charger.change_orders(OrderChange(allowed=False))
        await scene.charger.change_orders(OrderChange(current=10))
        await scene.polled(2)
        assert 1 not in scene.accesses()

    play(PolledScene(dialect), acts)


@each
def test_access_opened_at_the_box_is_closed_again(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.polled(1)
        scene.car.plug_in()
        scene.outlet.access = True
        await scene.polled(2)
        assert not scene.outlet.access
        await scene.until(lambda: scene.box.offers == 0, 7)

    play(PolledScene(dialect, allowed=False), acts)


@each
def test_access_closed_at_the_box_stays_closed(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        scene.box.controller.outlet.set_access(False)
        await scene.polled(3)
        assert not scene.outlet.access
        assert scene.accesses() == []
        assert scene.reading.allowed is False

    play(PolledScene(dialect, allowed=True), acts)


@each
def test_a_box_that_loses_its_override_gets_it_again(dialect: Dialect) -> None:
    """A write of 0 by another device removes the override."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        scene.outlet.override = 0
        await scene.until(lambda: scene.outlet.pilot_current > 10)
        took = await scene.until(lambda: scene.box.offers == 10)
        assert took < (14 if dialect in LATER else 7)
        assert scene.charger.statistics.reasserted >= 1

    play(PolledScene(dialect), acts)


@each
def test_a_short_power_failure(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        scene.box.controller.power_cycle()
        await scene.polled(2)
        await scene.until(lambda: scene.box.offers == 10)
        await scene.polled(2)
        assert scene.box.offers == 10
        assert scene.charger.faults == frozenset()

    play(PolledScene(dialect), acts)


@each
def test_a_box_that_ignores_the_access_bit(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        scene.box.controller.ignore_access = True
        with pytest.raises(NotConfirmedError):
            await scene.charger.change_orders(OrderChange(allowed=False))
        assert Fault.LIMIT_NOT_TAKEN in scene.charger.faults
        scene.box.controller.ignore_access = False
        # The order stands: a later poll applies it.
        await scene.polled(3)
        assert not scene.outlet.access
        assert Fault.LIMIT_NOT_TAKEN not in scene.charger.faults

    play(PolledScene(dialect), acts)


@each
def test_a_car_that_charges_without_access_is_a_fault(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        assert not scene.charger.faults
        scene.outlet.keeps_charging = True
        begin = now()
        with pytest.raises(NotConfirmedError):
            await scene.charger.change_orders(OrderChange(allowed=False))
        assert not scene.outlet.access
        await scene.until(lambda: scene.charger.faults, 60)
        assert now() - begin >= 10
        # The box has taken the order.
        assert scene.charger.faults == {Fault.CHARGES_ALTHOUGH_PAUSED}
        assert scene.reading.allowed is False
        scene.outlet.keeps_charging = False
        scene.outlet.set_access(allowed=False)
        await scene.until(lambda: not scene.charger.faults, 30)

    play(PolledScene(dialect), acts)


@each
def test_access_turned_off_at_the_box_counts_as_well(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        scene.outlet.keeps_charging = True
        scene.outlet.set_access(allowed=False)
        await scene.until(lambda: scene.charger.faults, 60)
        assert scene.charger.faults == {Fault.CHARGES_ALTHOUGH_PAUSED}

    play(PolledScene(dialect), acts)


@each
def test_lost_answers(dialect: Dialect) -> None:
    """A write whose reply is lost is confirmed by its read-back."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        lost: list[bytes] = []

        def lose(data: bytes) -> bool:
            if data[1] == 0x10 and len(lost) < 2:
                lost.append(data)
                return True
            return False

        scene.box.loses = lose
        await scene.charger.change_orders(OrderChange(current=8))
        assert scene.box.offers == 8
        await scene.charger.change_orders(OrderChange(allowed=False))
        assert not scene.outlet.access
        assert len(lost) == 2

    play(PolledScene(dialect), acts)


def test_an_error_is_a_fault() -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        scene.outlet.temperature = 70
        await scene.until(lambda: Fault.TEMP_HIGH in scene.charger.faults)
        assert scene.connector.status is Status.FAULTED
        assert scene.connector.plugged is None
        assert scene.reading.fault_codes == ("0x04",)

    play(PolledScene(V2_17), acts)


def test_the_serial_number_is_checked() -> None:
    async def run_wrong() -> PolledScene:
        scene = PolledScene(HEAD, expected="815")
        async with scene:
            await scene.until(lambda: Fault.WRONG_CHARGER in scene.charger.faults)
            await asyncio.sleep(30)
            with pytest.raises(EvseError):
                await scene.charger.change_orders(OrderChange(allowed=False))
        return scene

    scene = simulate(run_wrong())
    assert scene.writes() == []
    assert scene.charger.reading is None


def test_another_box_in_its_place() -> None:
    async def acts(scene: PolledScene) -> None:
        scene.serial = 815
        scene.replace_box(HEAD)
        since = now()
        await scene.until(lambda: Fault.WRONG_CHARGER in scene.charger.faults)
        await asyncio.sleep(60)
        assert scene.writes(since=since) == []

    play(PolledScene(HEAD), acts)


def test_a_changed_firmware_is_identified_anew() -> None:
    async def acts(scene: PolledScene) -> None:
        scene.replace_box(HEAD)
        scene.dialect = HEAD
        await scene.until(lambda: scene.charger.dialect in LATER)
        await scene.charge()
        await scene.polled(3)
        assert scene.box.offers == 10

    play(PolledScene(V2_20, unit=1), acts)


def test_at_address_0_a_box_must_be_alone() -> None:
    async def acts(scene: PolledScene) -> None:
        since = now()
        scene.bus.add(PolledScene(HEAD).make_charger("other"))
        with pytest.raises(SharedAddressError):
            await scene.charger.change_orders(OrderChange(allowed=False))
        assert scene.writes(since=since) == []
        assert Fault.DUPLICATE_ADDRESS in scene.charger.faults

    play(PolledScene(V2_17), acts)


@each
@pytest.mark.parametrize("stop", [True, False])
def test_shutdown(dialect: Dialect, *, stop: bool) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        before = scene.charger.orders
        await scene.charger.on_shutdown()
        assert scene.outlet.access is not stop
        assert scene.charger.orders == before

    play(PolledScene(dialect, stop_on_shutdown=stop), acts)


@each
def test_an_order_that_is_not_renewed(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.until(lambda: scene.box.offers == 10)
        await scene.until(lambda: scene.box.offers == 6, 90)
        assert Capability.FAIL_SAFE_CURRENT in scene.charger.capabilities

    play(PolledScene(dialect, lifetime=40.0), acts)


@each
def test_a_limit_below_its_own_minimum_is_refused(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        assert scene.charger.limits.minimum == 8
        await scene.charge()
        assert scene.charger.pause_reason is None
        await scene.charger.change_orders(OrderChange(current=7))
        assert not scene.outlet.access
        assert scene.charger.orders.limit.current == 7
        assert scene.charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        assert scene.charger.orders.allowed is not False
        await scene.charger.change_orders(OrderChange(current=8))
        assert scene.outlet.access
        await scene.until(lambda: scene.charger.pause_reason is None)

    play(PolledScene(dialect, minimum=8), acts)


@each
def test_what_was_allowed_below_the_minimum_starts_with_a_higher_limit(
    dialect: Dialect,
) -> None:
    """Permission stands, whatever came first: only the limit was missing."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.charger.change_orders(OrderChange(allowed=False))
        await scene.charger.change_orders(OrderChange(current=0))
        assert scene.charger.pause_reason is PauseReason.NOT_ALLOWED
        await scene.charger.change_orders(OrderChange(allowed=True))
        assert not scene.outlet.access
        assert scene.charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        await scene.charger.change_orders(OrderChange(current=9))
        assert scene.outlet.access
        await scene.until(lambda: scene.box.offers == 9, 90)
        # The user's own pause is no limit's to lift.
        await scene.charger.change_orders(OrderChange(current=3))
        await scene.charger.change_orders(OrderChange(allowed=False))
        await scene.charger.change_orders(OrderChange(current=9))
        assert not scene.outlet.access

    play(PolledScene(dialect), acts)


@older
def test_poll_interval(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await asyncio.sleep(10)
        since = now()
        await asyncio.sleep(100)
        reads = [one for one in scene.line.sent if one.when >= since]
        assert 45 <= len(reads) <= 51

    play(PolledScene(dialect), acts)


@each
def test_nothing_is_written_unnecessarily(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(5)
        since = now()
        await asyncio.sleep(240)
        assert scene.writes(since=since) == []
        assert not scene.box.controller.eeprom_writes

    play(PolledScene(dialect), acts)


@each
def test_scan(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        shares: list[float] = []
        since = now()
        report = await POLLED.scan(
            scene.bus, scene.charger.config, scene.charger.orders, shares.append
        )
        (found,) = report.found
        assert found.address == scene.box.unit == (0 if dialect in OLDER else 1)
        assert found.info.firmware == FIRMWARE[dialect]
        assert found.serial == ("4711" if dialect in LATER else None)
        assert found.maximum_current == 16
        assert shares[0] == 0
        assert shares[-1] == 1
        assert report.duplicates == ()
        assert all(
            sent.data[1] in (3, 4) for sent in scene.line.sent if sent.when > since
        )

    play(PolledScene(dialect), acts)


def test_a_start_whose_answer_was_lost_gives_way_to_a_pause() -> None:
    async def acts(scene: PolledScene) -> None:
        scene.box.misses = lambda data: data[1] == 0x10
        start = asyncio.create_task(
            scene.charger.change_orders(OrderChange(allowed=True))
        )
        await scene.until(lambda: 1 in scene.accesses())
        since = now()
        # Not received either, but access is read back to be off already.
        await scene.charger.change_orders(OrderChange(allowed=False))
        with pytest.raises(SupersededError):
            await start
        assert 1 not in scene.accesses(since=since + 0.01)

    play(PolledScene(V2_20, allowed=False), acts)


@each
def test_a_power_failure_between_two_cars(dialect: Dialect) -> None:
    """The override is written again before the next car comes."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(3)
        scene.car.leave()
        await scene.polled(3)
        scene.box.controller.power_cycle()
        await scene.polled(2)
        assert scene.outlet.override == 60

    play(PolledScene(dialect), acts)


def test_a_2_20_that_does_not_answer_all_probes_is_unsupported() -> None:
    """It replies to 0xA0 with a number but not to 0xA9: nothing is written."""

    async def run() -> PolledScene:
        scene = PolledScene(V2_20)
        scene.box.misses = lambda data: data[1] == 3
        async with scene:
            await scene.until(
                lambda: Fault.UNSUPPORTED_FIRMWARE in scene.charger.faults
            )
            await asyncio.sleep(60)
        return scene

    scene = simulate(run())
    assert scene.writes() == []
    assert scene.charger.reading is None
    assert scene.charger.dialect is None


@each
def test_two_boxes_with_one_address(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        scene.box.loses = lambda _data: True
        write = scene.line.write

        def collide(data: bytes, *, reply_may_equal: bool = False) -> float:
            end = write(data, reply_may_equal=reply_may_equal)
            asyncio.get_running_loop().call_at(
                end + 0.01, scene.line.noise, bytes.fromhex("01041200ffffffff0000")
            )
            return end

        scene.line.write = collide  # type: ignore[method-assign]
        await scene.until(lambda: Fault.DUPLICATE_ADDRESS in scene.charger.faults, 90)
        scene.line.write = write  # type: ignore[method-assign]
        scene.box.loses = lambda _data: False
        await scene.until(
            lambda: Fault.DUPLICATE_ADDRESS not in scene.charger.faults, 90
        )

    play(PolledScene(dialect), acts)


@pytest.mark.parametrize("lowered", [False, True])
def test_a_search_for_the_smallest_current_is_no_disobedience(*, lowered: bool) -> None:
    """HEAD offers 6 and 8 A in turn first; only then does it follow a limit of 6 A."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        begun = now()
        if lowered:
            await scene.charger.change_orders(OrderChange(current=6))
            assert now() - begun < 110
        else:
            await asyncio.sleep(110)
        assert scene.outlet.state == "C"
        assert scene.box.offers == 6
        assert not scene.charger.faults
        assert scene.charger.orders.limit.current == 6
        assert len([one for one in scene.writes() if one.register == 2]) <= 3

    play(PolledScene(HEAD, current=10 if lowered else 6, measures=True), acts)
