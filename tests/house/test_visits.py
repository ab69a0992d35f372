"""Visits: their begin and end, the phases of the car, and what is kept."""

from math import nan
from typing import Any

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.house.readings import (
    ChargerReport,
    ChargerSettings,
    Mode,
)
from custom_components.evse_bus.house.visits import (
    SEEN,
    WITHOUT_CURRENT,
    Kept,
    Visit,
)

KEPT = Kept(mode=Mode.SUN, serial="A1", session="7", starts=3, charging=True)


def visit_of(**settings: Any) -> Visit:  # noqa: ANN401 - of the settings
    return Visit(ChargerSettings(charger="a", **settings))


def look(
    visit: Visit,
    now: float,
    *,
    paused: bool = False,
    **report: Any,  # noqa: ANN401 - of the report
) -> bool:
    return visit.look(ChargerReport(at=now, **report), now, paused=paused)


def test_from_plug_to_unplug() -> None:
    visit = visit_of()
    visit.starts = 4
    assert not look(visit, 0, plugged=True)
    assert not look(visit, 1, plugged=False)
    assert visit.absent
    assert look(visit, 2, plugged=True)
    assert visit.starts == 0


def test_unplugged_in_our_pause_is_no_end_where_a_box_says_so_anyway() -> None:
    visit = visit_of(unplug_is_reported_in_a_pause=False)
    visit.starts = 4
    look(visit, 0, plugged=True)
    look(visit, 1, plugged=False, paused=True)
    assert not look(visit, 2, plugged=True)
    assert not visit.absent
    look(visit, 3, plugged=False)
    assert not visit.absent
    assert look(visit, 4, plugged=True)


def test_without_reports_of_the_plug_it_ends_after_half_a_day_without_current() -> None:
    visit = visit_of()
    visit.starts = 4
    look(visit, 0, currents=(6.0, 6.0, 6.0))
    assert not look(visit, WITHOUT_CURRENT)
    assert look(visit, WITHOUT_CURRENT + 1)
    assert not look(visit, WITHOUT_CURRENT + 2)
    plugged = visit_of()
    look(plugged, 0, plugged=True)
    assert not look(plugged, 2 * WITHOUT_CURRENT, plugged=True)


def test_another_session_is_another_visit() -> None:
    visit = visit_of()
    assert not look(visit, 0, session="1")
    assert not look(visit, 1, session=None)
    assert not look(visit, 2, session="1")
    assert look(visit, 3, session="2")


def test_phases_are_those_seen_else_set_else_wired() -> None:
    assert visit_of().phases == 3
    assert visit_of(phases=1).phases == 1
    assert visit_of(wired=1, phases=3).phases == 1
    visit = visit_of()
    look(visit, 0, currents=(10.0, 0.2, None))
    look(visit, SEEN - 1, currents=(10.0, 0.0, nan))
    assert visit.phases == 3
    look(visit, SEEN, currents=(10.0, 0.0, None))
    assert visit.phases == 1
    look(visit, SEEN + 1, currents=(0.0, 0.0, 0.0))
    assert visit.phases == 1
    for at in (100, 131):
        look(visit, at, currents=(6.0, 6.0, 6.0))
    assert visit.phases == 3
    look(visit, 200, currents=(6.0, 0.0, 0.0))
    assert visit.phases == 3
    look(visit, 300, session="1")
    assert look(visit, 301, session="2")
    assert visit.phases == 3


def test_what_is_kept_comes_back() -> None:
    assert Kept.from_dict(KEPT.as_dict()) == KEPT


@pytest.mark.parametrize(
    "changed",
    [
        {"mode": "fastest"},
        {"starts": -1},
        {"starts": True},
        {"starts": 1.5},
        {"serial": 3},
        {"charging": 1},
        {"other": 1},
    ],
)
def test_damaged_values_are_lost_ones(changed: dict[str, Any]) -> None:
    assert Kept.from_dict({**KEPT.as_dict(), **changed}) is None


@given(st.recursive(st.none() | st.floats() | st.text(), st.lists))
def test_anything_else_is_lost_too(values: object) -> None:
    assert Kept.from_dict(values) is None
    assert Kept.from_dict({"mode": values}) is None
