"""Settings in the EEPROM of a SmartEVSE, and its volatile mode."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import (
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.model import (
    Command,
    Mode,
    OrderChange,
    Range,
    Setting,
)
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from tests.simulated_time import now

from .polled_scene import ALL, HEAD, LATER, OLDER, V2_17, V2_20, PolledScene, play

each = pytest.mark.parametrize("dialect", ALL)

NAMES = {
    Setting.MINIMUM_CURRENT: "min_current",
    Setting.MAXIMUM_CURRENT: "max_current",
    Setting.CIRCUIT_CURRENT: "circuit",
    Setting.MAINS_CURRENT: "mains",
    Setting.MODE_AT_START: "mode",
    Setting.SOLAR_START_CURRENT: "start_current",
    Setting.SOLAR_STOP_TIME: "stop_time",
    Setting.SOLAR_IMPORT_CURRENT: "import_current",
}
CASES = [(dialect, setting) for dialect in ALL for setting in MAPS[dialect].settings]


@pytest.mark.parametrize(("dialect", "setting"), CASES)
def test_a_setting_is_that_of_the_same_name_in_the_box(
    dialect: Dialect, setting: Setting
) -> None:
    """The virtual box was written from the firmware's order, not from our table."""

    async def acts(scene: PolledScene) -> None:
        span = scene.charger.settings[setting]
        for value in (span.minimum, span.maximum):
            await scene.charger.configure(setting, value)
            stored = scene.outlet.settings[NAMES[setting]]
            if dialect is HEAD and setting is Setting.SOLAR_START_CURRENT:
                # In the box an import counts up from -16.
                assert stored == 16 - value
            elif dialect is HEAD and setting is Setting.SOLAR_IMPORT_CURRENT:
                assert stored == 48 + value
            else:
                assert stored == value
            assert scene.reading.settings[setting] == value

    scene = play(PolledScene(dialect), acts)
    # Once for each value that was not set before.
    assert sum(scene.box.controller.eeprom_writes.values()) <= 2


SOLAR = {
    Setting.SOLAR_START_CURRENT: 4,
    Setting.SOLAR_STOP_TIME: 10,
    Setting.SOLAR_IMPORT_CURRENT: 0,
}
"""As a factory-new box shows them in its menu; recorded in 2.20, 2.30 and HEAD."""


@pytest.mark.parametrize("dialect", [V2_20, *LATER])
def test_solar_settings_of_a_factory_new_box(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        settings = scene.reading.settings
        assert {one: settings[one] for one in SOLAR} == SOLAR

    play(PolledScene(dialect), acts)


@pytest.mark.parametrize("dialect", [V2_20, *LATER])
@pytest.mark.parametrize("setting", SOLAR)
@pytest.mark.parametrize("plugged", [True, False])
def test_a_solar_setting_is_written_once_and_access_put_back(
    dialect: Dialect, setting: Setting, *, plugged: bool
) -> None:
    async def acts(scene: PolledScene) -> None:
        if plugged:
            scene.car.plug_in()
        await scene.polled(2)
        assert not scene.outlet.access
        offered: list[float] = []
        scene.on_step.append(lambda: offered.append(scene.box.offers))
        new = scene.charger.settings[setting].maximum
        for _ in range(2):
            # Asked for twice, written once.
            await scene.charger.configure(setting, new)
            await scene.polled(1)
            assert scene.reading.settings[setting] == new
            assert not scene.outlet.access
        assert sum(scene.box.controller.eeprom_writes.values()) == 1
        assert len(scene.writes(MAPS[dialect].settings[setting].register)) == 1
        assert max(offered) == 0

    play(PolledScene(dialect, allowed=False), acts)


def test_only_confirmed_settings() -> None:
    assert set(MAPS[V2_17].settings) == {
        Setting.MINIMUM_CURRENT,
        Setting.MAXIMUM_CURRENT,
        Setting.MAINS_CURRENT,
    }


@each
def test_no_maximum_above_the_installation(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        assert scene.charger.settings[Setting.MAXIMUM_CURRENT] == Range(6, 20)
        with pytest.raises(RefusedOrderError):
            await scene.charger.configure(Setting.MAXIMUM_CURRENT, 21)
        with pytest.raises(RefusedOrderError):
            await scene.charger.configure(Setting.MINIMUM_CURRENT, value=True)
        assert not scene.box.controller.eeprom_writes

    play(PolledScene(dialect, installation=20), acts)


@each
def test_an_equal_value_is_not_written(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charger.configure(Setting.MAXIMUM_CURRENT, 16)
        assert not scene.box.controller.eeprom_writes

    play(PolledScene(dialect), acts)


@each
@pytest.mark.parametrize("plugged", [True, False])
def test_access_that_a_setting_opens_is_closed_again(
    dialect: Dialect, *, plugged: bool
) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.polled(1)
        if plugged:
            scene.car.plug_in()
        await scene.polled(1)
        opened: list[float] = []
        scene.on_step.append(
            lambda: opened.append(now()) if scene.outlet.access else None
        )
        offered: list[float] = []
        scene.on_step.append(lambda: offered.append(scene.box.offers))
        await scene.charger.configure(Setting.MAXIMUM_CURRENT, 13)
        assert not scene.outlet.access
        assert scene.outlet.settings["max_current"] == 13
        await scene.polled(2)
        assert not scene.outlet.access
        assert max(opened, default=0) - min(opened, default=0) < 0.3
        assert max(offered) == 0

    play(PolledScene(dialect, allowed=False), acts)


def test_access_that_stays_open_is_an_error() -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charger.change_orders(OrderChange(allowed=False))
        scene.box.controller.ignore_access = True
        with pytest.raises(NotConfirmedError, match="not certain to be off"):
            await scene.charger.configure(Setting.MAXIMUM_CURRENT, 13)

    play(PolledScene(V2_17), acts)


@each
def test_a_lower_maximum_lowers_the_current(dialect: Dialect) -> None:
    """The override takes precedence over the box's own maximum: the clamp is ours."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        assert scene.box.offers == 16
        await scene.charger.configure(Setting.MAXIMUM_CURRENT, 10)
        await scene.until(lambda: scene.box.offers == 10)

    play(PolledScene(dialect, current=16), acts)


@each
def test_a_setting_that_is_not_known(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        scene.charger.configuration = None
        with pytest.raises(NotAvailableError):
            await scene.charger.configure(Setting.MAXIMUM_CURRENT, 13)

    play(PolledScene(dialect), acts)


@each
def test_settings_changed_at_the_box_are_read(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        scene.outlet.settings["max_current"] = 12
        await asyncio.sleep(310)
        assert scene.reading.settings[Setting.MAXIMUM_CURRENT] == 12
        assert scene.charger.limits.ceiling == 12
        block = MAPS[dialect].configuration[1].register
        reads = [s for s in scene.line.sent if int.from_bytes(s.data[2:4]) == block]
        assert len(reads) == 2

    play(PolledScene(dialect), acts)


# -- Mode --------------------------------------------------------------------------


@each
def test_the_mode_of_a_master(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        assert scene.reading.mode is Mode.SMART
        await scene.charger.command(Command.SET_MODE, Mode.SOLAR)
        assert scene.reading.mode is Mode.SOLAR
        assert not scene.box.controller.eeprom_writes

    play(PolledScene(dialect, load_balance=1, settings={"mode": 1}), acts)


@each
@pytest.mark.parametrize(
    ("load_balance", "mode"), [(0, 1), (1, 0)], ids=["alone", "normal"]
)
def test_where_the_mode_cannot_be_set(
    dialect: Dialect, load_balance: int, mode: int
) -> None:
    async def acts(scene: PolledScene) -> None:
        register = MAPS[dialect].mode_register
        with pytest.raises(NotAvailableError, match="menu"):
            await scene.charger.command(Command.SET_MODE, Mode.SOLAR)
        assert scene.writes(register) == []
        # The present mode is accepted.
        now_set = (Mode.NORMAL, Mode.SMART)[mode]
        await scene.charger.command(Command.SET_MODE, now_set)
        assert scene.charger.available

    play(PolledScene(dialect, load_balance=load_balance, settings={"mode": mode}), acts)


def test_a_value_that_is_no_mode_is_refused() -> None:
    async def acts(scene: PolledScene) -> None:
        with pytest.raises(RefusedOrderError):
            await scene.charger.command(Command.SET_MODE, "fast")
        with pytest.raises(NotAvailableError):
            await scene.charger.command(Command.RESET)

    play(PolledScene(V2_20), acts)


@pytest.mark.parametrize("dialect", OLDER)
def test_a_master_is_polled_like_any_other(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.charger.change_orders(OrderChange(current=8))
        assert scene.box.offers == 8

    play(PolledScene(dialect, load_balance=1), acts)
