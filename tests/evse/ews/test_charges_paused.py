"""A charge that goes on although the port is paused."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import NotConfirmedError
from custom_components.evse_bus.evse.model import Fault, OrderChange
from tests.simulated_time import now
from tests.virtual.ews_commands import COMMANDS

from .scene import EwsScene, play

CHARGES = Fault.CHARGES_ALTHOUGH_PAUSED
OFF = OrderChange(allowed=False)


@pytest.mark.parametrize("port", [1, 2])
def test_power_that_flows_in_a_pause_is_a_fault(port: int) -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge(port)
        charger = scene.charger(port)
        scene.cars[port - 1].drawn_anyway = 8.0
        await asyncio.sleep(30)
        assert not charger.faults
        begin = now()
        await charger.change_orders(OFF)
        assert scene.status(port) in {0x42, 0x50}
        await scene.until(lambda: charger.faults)
        assert 10 <= now() - begin < 20
        assert charger.faults == {CHARGES}
        assert not scene.charger(3 - port).faults
        scene.cars[port - 1].drawn_anyway = 0.0
        await scene.until(lambda: not charger.faults)

    play(EwsScene(), acts)


def test_the_own_power_of_box_and_car_is_no_fault() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        # 0.15 A on three phases: 100 W.
        scene.cars[0].drawn_anyway = 0.15
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(60)
        assert scene.connector().power
        assert not scene.charger().faults

    play(EwsScene(), acts)


def test_a_box_that_does_not_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """It accepts the order without an effect."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        monkeypatch.setitem(COMMANDS, "sl", lambda _box, _parameters: b"\0")
        with pytest.raises(NotConfirmedError):
            await scene.charger().change_orders(OFF)
        await scene.until(lambda: CHARGES in scene.charger().faults)
        assert scene.charger().faults == {CHARGES, Fault.LIMIT_NOT_TAKEN}

    play(EwsScene(), acts)
