"""Rotations: which phase of the house a phase of a box is."""

from itertools import permutations

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.house.phases import Rotation, in_house, offered_on

ORDERS = [one for one in Rotation if len(one.value) == 3]
AMPERES = st.floats(0, 80)


def test_the_six_orders_are_all_there_are() -> None:
    assert sorted(offered_on(one, 3) for one in ORDERS) == sorted(
        permutations((0, 1, 2))
    )


@pytest.mark.parametrize(
    ("rotation", "found"),
    [
        (Rotation.RST, (1, 2, 3)),
        (Rotation.RTS, (1, 3, 2)),
        (Rotation.SRT, (2, 1, 3)),
        (Rotation.STR, (3, 1, 2)),
        (Rotation.TRS, (2, 3, 1)),
        (Rotation.TSR, (3, 2, 1)),
        (Rotation.L1, (1, 0, 0)),
        (Rotation.L2, (0, 1, 0)),
        (Rotation.L3, (0, 0, 1)),
        (Rotation.UNKNOWN, (1, 1, 1)),
    ],
)
def test_currents_of_a_box_in_the_house(
    rotation: Rotation, found: tuple[float, float, float]
) -> None:
    """OCPP 1.6: in SRT the box's L1 is the house's L2 (S), its L2 the house's L1."""
    assert in_house((1, 2, 3), rotation, 3) == found


def test_a_box_with_one_wire_in_an_order() -> None:
    assert offered_on(Rotation.STR, 1) == (1,)
    assert offered_on(Rotation.UNKNOWN, 1) == (0, 1, 2)
    assert in_house((16, 0, 0), Rotation.STR, 1) == (0, 16, 0)


@given(st.tuples(AMPERES, AMPERES, AMPERES), st.sampled_from(ORDERS))
def test_unknown_never_counts_more_than_any_order(
    currents: tuple[float, float, float], order: Rotation
) -> None:
    unknown = in_house(currents, Rotation.UNKNOWN, 3)
    known = in_house(currents, order, 3)
    assert all(one <= other for one, other in zip(unknown, known, strict=True))
    assert sorted(known) == sorted(currents)
