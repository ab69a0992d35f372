"""Limits that a ChargePoint does not keep to."""

from custom_components.evse_bus.evse.limit_monitor import LimitMonitor


def exceeds(monitor: LimitMonitor, now: float, *used: float) -> bool:
    one, two, three = used if len(used) == 3 else 3 * used
    return monitor.exceeded(now, (one, two, three), 15.0)


def test_a_limit_can_be_exceeded_only_after_its_grace() -> None:
    monitor = LimitMonitor()
    monitor.sent(100.0, (6.0, 6.0, 6.0), answered=True)
    assert not any(exceeds(monitor, 100.0 + second, 32.0) for second in range(15))
    assert not exceeds(monitor, 115.0, 32.0)
    assert exceeds(monitor, 116.0, 32.0)


def test_a_fault_takes_two_readings_and_ends_with_one() -> None:
    monitor = LimitMonitor()
    monitor.sent(0.0, (10.0, 16.0, 10.0), answered=True)
    assert not exceeds(monitor, 20.0, 12.0)
    assert not exceeds(monitor, 21.0, 11.5)
    assert not exceeds(monitor, 22.0, 0.0, 0.0, 11.6)
    assert exceeds(monitor, 23.0, 0.0, 0.0, 11.6)
    assert not exceeds(monitor, 24.0, 11.5, 17.8, 11.5)


def test_a_car_that_follows_a_falling_limit_late_is_no_fault() -> None:
    monitor = LimitMonitor()
    for second in range(60):
        monitor.sent(second, 3 * (40.0 - second / 2,), answered=True)  # type: ignore[arg-type]
        assert not exceeds(monitor, second, 40.0 - (second - 14) / 2)


def test_an_unanswered_raise_counts_an_unanswered_lowering_does_not() -> None:
    monitor = LimitMonitor()
    monitor.sent(0.0, (10.0, 10.0, 10.0), answered=True)
    monitor.sent(50.0, (16.0, 6.0, 10.0), answered=False)
    for second in range(51, 80):
        assert not exceeds(monitor, second, 16.0, 10.0, 10.0)
    monitor.sent(80.0, (10.0, 10.0, 10.0), answered=True)
    assert not exceeds(monitor, 94.0, 16.0)
    exceeds(monitor, 96.0, 16.0)
    assert exceeds(monitor, 97.0, 16.0)
