"""A meter total counts only as far as that much energy may have flowed."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.meter import (
    CONFIRMATIONS,
    RESUME_WITHIN,
    SLACK,
    Meter,
    MeterReading,
    Total,
    most_energy,
)


class Reader:
    """A meter that is read every 5 s."""

    def __init__(self, *totals: float) -> None:
        self.meter = Meter()
        self.now = 0.0
        self.read(*totals)

    def read(self, *totals: float, pause: float = 5.0) -> MeterReading:
        for total in totals:
            self.now += pause
            self.meter.check(Total(total, self.now))
        return self.meter.reading


def test_the_first_total_needs_three_readings() -> None:
    reader = Reader(12_000, 12_001)
    assert reader.meter.reading == MeterReading(None, 0)
    assert reader.read(12_002) == MeterReading(12_002, 0)


@pytest.mark.parametrize("damaged", [8_400_608, 1_078_741, 0, 11_999])
def test_one_damaged_total_changes_nothing(damaged: int) -> None:
    reader = Reader(12_000, 12_000, 12_000)
    assert reader.read(damaged) == MeterReading(12_000, 0)
    assert reader.read(12_010) == MeterReading(12_010, 0)


def test_zero_for_three_polls_is_another_generation_that_is_left_again() -> None:
    reader = Reader(5000, 5000, 5000)
    assert reader.read(0, 0) == MeterReading(5000, 0)
    assert reader.read(0) == MeterReading(0, 1)
    assert reader.read(5000, 5000) == MeterReading(0, 1)
    assert reader.read(5000) == MeterReading(5000, 0)
    # The generation between may come again, too; another one has another number.
    assert reader.read(0, 0, 0) == MeterReading(0, 1)
    assert reader.read(90_000, 90_000, 90_000) == MeterReading(90_000, 2)


def test_a_former_total_is_not_resumed_after_a_long_time() -> None:
    reader = Reader(5000, 5000, 5000, 0, 0, 0)
    assert reader.read(0, pause=RESUME_WITHIN) == MeterReading(0, 1)
    assert reader.read(5000, 5000, 5000) == MeterReading(5000, 2)


@pytest.mark.parametrize("total", [0, 4990, 5000, 5050, 5_000_000])
def test_a_total_that_was_set_is_a_new_generation_at_once(total: int) -> None:
    reader = Reader(5000, 5000, 5000)
    reader.meter.expect(total)
    assert reader.read(total) == MeterReading(total, 1)
    assert reader.read(total + 10) == MeterReading(total + 10, 1)


def test_a_total_that_was_not_set_after_all() -> None:
    reader = Reader(5000, 5000, 5000)
    reader.meter.expect(0)
    assert reader.read(5010) == MeterReading(5010, 0)


@given(
    st.lists(
        st.tuples(
            st.one_of(st.integers(0, 6000), st.integers(0, 2**32 - 1)),
            st.floats(0.1, 1000),
        ),
        max_size=40,
    )
)
def test_no_generation_grows_by_more_than_can_have_flowed(
    readings: list[tuple[int, float]],
) -> None:
    reader = Reader()
    last: dict[int, tuple[float, float]] = {}
    for total, pause in readings:
        shown = reader.read(total, pause=pause)
        if shown.energy is None:
            continue
        if shown.generation in last:
            energy, at = last[shown.generation]
            most = most_energy(reader.now - at)
            assert energy <= shown.energy <= energy + most
        assert reader.meter.last is not None
        last[shown.generation] = (shown.energy, reader.meter.last.at)


@given(st.data())
def test_single_damaged_readings_never_count(data: st.DataObject) -> None:
    """Every other reading at most is damaged: only true totals are ever shown."""
    reader = Reader(12_000, 12_000, 12_000)
    true = 12_000
    for _ in range(data.draw(st.integers(0, 15))):
        true += data.draw(st.integers(0, SLACK))
        flips = data.draw(st.integers(1, 2**32 - 1))
        damaged = true ^ flips
        shown = reader.read(damaged)
        assert shown.generation == 0
        assert shown.energy is not None
        # What is in reach is off by no more than that, and needs no generation.
        if not 0 <= damaged - shown.energy <= most_energy(10):
            assert shown.energy <= true
        if shown.energy <= true:
            assert reader.read(true) == MeterReading(true, 0)
        else:
            assert shown.energy - true <= most_energy(10)
            return


def test_totals_that_do_not_agree_are_never_accepted() -> None:
    reader = Reader(5000, 5000, 5000)
    totals = [9_000_000 - 100_000 * step for step in range(4 * CONFIRMATIONS)]
    assert reader.read(*totals) == MeterReading(5000, 0)
