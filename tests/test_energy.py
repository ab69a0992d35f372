"""Energy totals: they grow by what has flowed, and by nothing else."""

from collections.abc import Callable
from datetime import timedelta
import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

from homeassistant.const import EVENT_HOMEASSISTANT_FINAL_WRITE
from homeassistant.core import (
    Event,
    EventStateChangedData,
    HomeAssistant,
    State,
    callback,
)
from homeassistant.helpers import entity_registry as er, issue_registry as ir
from homeassistant.util import dt as dt_util
from hypothesis import given, strategies as st
import pytest
from pytest_homeassistant_custom_component.common import async_fire_time_changed

from custom_components.evse_bus import energy as energy_module, sensor as sensor_module
from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.energy import (
    INTERVAL,
    PATIENCE,
    STEP,
    TOTALS_KEY,
    Clocks,
    MeterRecord,
    MeterTotal,
    SummedTotal,
    TotalStore,
)
from custom_components.evse_bus.evse.meter import most_energy
from custom_components.evse_bus.stores.file import StoredFile
from tests.common import crash, get_entity, running, shut_down, wait_for_state
from tests.ews import polled
from tests.virtual import AblBox, Car, EvboxChargePoint, Module
from tests.virtual.ews_box import EwsBox

meters = st.floats(0, 1e9)
NOW = Clocks(monotonic=50.0, wall=1_000_000.0)
DAY = 86_400.0
TRANSLATIONS = Path(energy_module.__file__).parent / "translations"


def later(seconds: float, *, corrected: float = 0.0) -> Clocks:
    """Return the clocks after a time; the wall clock was corrected meanwhile."""
    return Clocks(NOW.monotonic + seconds, NOW.wall + seconds + corrected)


@given(meters, meters)
def test_the_first_meter_is_shown_as_it_is(first: float, rise: float) -> None:
    total = MeterTotal()
    assert total.update(first, 0, NOW) == first
    assert total.update(first + rise, 0, NOW) == first + rise


@given(meters, st.lists(st.tuples(meters, st.integers(0, 3)), min_size=1))
def test_another_meter_never_makes_a_step(
    first: float, readings: list[tuple[float, int]]
) -> None:
    total = MeterTotal()
    shown = total.update(first, 0, NOW)
    before = {0: first}
    for meter, generation in readings:
        previous, shown = shown, total.update(meter, generation, NOW)
        # A generation that is resumed has counted since its own last value, at most.
        growth = max(meter - before.get(generation, meter), 0.0)
        assert 0 <= shown - previous <= growth + 1e-6 * (1 + meter + shown)
        before[generation] = meter


@given(meters, meters, st.floats(0, 1000))
def test_the_meter_of_another_box_continues_the_total(
    total: float, meter: float, rise: float
) -> None:
    """Whatever it has counted before, and however long the exchange took."""
    continued = MeterTotal(MeterRecord(total, None, NOW.wall - DAY))
    assert continued.update(meter, 0, NOW) == pytest.approx(
        total, abs=1e-6 * (1 + meter)
    )
    after = later(PATIENCE + 1)
    assert continued.update(meter + rise, 0, after) == pytest.approx(
        total + rise, abs=1e-6 * (1 + meter)
    )
    assert continued.not_counted is None
    record = continued.record(after)
    assert record is not None
    assert record.meter == meter + rise


async def test_totals_are_handed_over(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    store = TotalStore(hass)
    await store.async_load()
    for key in ("evbox_1_1_energy", "evbox_1_2_energy", "evbox_12_1_energy"):
        store.put(key, MeterRecord(7000, 5000, NOW.wall))
    await store.async_hand_over("evbox_1", "evbox_9")
    stored = hass_storage[TOTALS_KEY]["data"]
    assert stored["evbox_9_2_energy"] == {
        "total": 7000,
        "meter": None,
        "wall": NOW.wall,
    }
    assert len(stored) == 5
    again = TotalStore(hass)
    await again.async_load()
    assert again.get("evbox_9_1_energy") == MeterRecord(7000, None, NOW.wall)
    # Not those of a serial number that begins alike.
    await again.async_forget("evbox_1")
    assert set(hass_storage[TOTALS_KEY]["data"]) == {
        *("evbox_9_1_energy", "evbox_9_2_energy", "evbox_12_1_energy"),
    }


def test_a_meter_that_reads_zero_for_a_while_is_counted_once() -> None:
    total = MeterTotal()
    assert total.update(5000, 0, NOW) == 5000
    assert total.update(0, 1, NOW) == 5000
    assert total.update(30, 1, NOW) == 5030
    assert total.update(5050, 0, NOW) == 5050
    assert total.update(5060, 0, NOW) == 5060


@given(meters, meters, meters, st.floats(-1e7, 1e7), st.floats(6.0, 80.0))
def test_after_a_restart_only_what_can_have_flowed(
    kept: float, before: float, meter: float, away: float, current: float
) -> None:
    total = MeterTotal(MeterRecord(kept, before, NOW.wall - away))
    shown = total.update(meter, 0, NOW, current)
    growth = shown - kept
    most = most_energy(away, current)
    assert 0 <= growth <= most + 1e-6 * (1 + kept + most)
    assert growth == pytest.approx(
        meter - before if 0 <= meter - before <= most else 0.0,
        abs=1e-6 * (1 + kept + meter),
    )
    # What is not counted is reported in the end.
    total.update(meter, 0, later(PATIENCE), current)
    assert (total.not_counted is not None) is not (0 <= meter - before <= most)


def test_a_computer_that_starts_with_the_time_of_yesterday_loses_nothing() -> None:
    """22 kWh were charged while it was off."""
    stored = MeterRecord(100_000, 40_000, NOW.wall + DAY - 4 * 3600)
    total = MeterTotal(stored)
    assert total.update(62_000, 0, NOW) == 100_000
    assert total.update(62_010, 0, later(20)) == 100_010
    # A restart in the meantime decides nothing.
    assert total.record(later(20)) == MeterRecord(100_010, 40_010, stored.wall)
    assert total.update(62_020, 0, later(40, corrected=DAY)) == 122_020
    assert total.not_counted is None
    # The step is counted once.
    assert total.update(62_030, 0, later(60, corrected=DAY)) == 122_030
    assert total.record(later(60)) == MeterRecord(
        122_030, 62_030, later(60).wall, later(60).monotonic
    )


def test_a_wall_clock_that_is_never_corrected_is_reported() -> None:
    total = MeterTotal(MeterRecord(100_000, 40_000, NOW.wall))
    total.update(62_000, 0, NOW)
    assert total.not_counted is None
    assert total.update(62_000, 0, later(PATIENCE)) == 100_000
    assert total.not_counted == 22_000


def test_a_reload_goes_by_the_monotonic_clock() -> None:
    total = MeterTotal()
    total.update(5000, 0, NOW)
    # The wall clock is set back by a day while nothing is read for an hour.
    total = MeterTotal(total.record(NOW))
    assert total.update(15_000, 0, later(3600, corrected=-DAY)) == 15_000


def test_a_sum_goes_on_when_its_source_begins_anew() -> None:
    total = SummedTotal(total=100.0)
    assert total.update(5.0, "one") == 105.0
    assert total.update(7.0, "one") == 107.0
    assert total.update(2.0, "two") == 109.0
    assert total.update(1.0, "two") == 110.0


async def test_estimated_energy_survives_a_crash(
    hass: HomeAssistant,
    hass_storage: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is shown before it is stored, so it never falls."""
    monkeypatch.setattr(energy_module, "STEP", 0.05)
    monkeypatch.setattr(energy_module, "INTERVAL", 0.1)
    car = Car(reaction=0.0, ramp=0.1)
    async with running(hass, AblBox(1, car=car)) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_estimated_energy")
        shown: list[float] = []

        def look(event: Event[EventStateChangedData]) -> None:
            state = event.data["new_state"]
            if state is None or state.state in {"unavailable", "unknown"}:
                return
            shown.append(float(state.state))
            (record,) = hass_storage[TOTALS_KEY]["data"].values()
            assert shown[-1] * 1000 <= record["total"] + 0.001

        hass.bus.async_listen("state_changed", look, only(energy))
        car.plug_in()
        await wait_for_state(hass, energy, lambda state: is_above(state, 0.0001))
        await crash(hass, entry, hass_storage)
        before = shown[-1]
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, energy, lambda state: is_above(state, before))
    assert shown == sorted(shown)


def only(entity_id: str) -> Callable[[EventStateChangedData], bool]:
    """Return a filter for the events of one entity."""

    @callback
    def is_of(data: EventStateChangedData) -> bool:
        return data["entity_id"] == entity_id

    return is_of


def is_above(state: State, value: float) -> bool:
    return state.state not in {"unavailable", "unknown"} and float(state.state) > value


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for no correction of the wall clock."""
    monkeypatch.setattr(energy_module, "PATIENCE", 0.0)


@pytest.mark.parametrize(
    ("grown", "shown", "count"), [(1000, 11.0, 0), (90_000, 10.0, 1), (-1, 10.0, 1)]
)
@pytest.mark.parametrize("is_entry_removed", [False, True])
@pytest.mark.usefixtures("impatient")
async def test_a_meter_after_a_restart(
    hass: HomeAssistant,
    hass_storage: dict[str, Any],
    grown: int,
    shown: float,
    count: int,
    *,
    is_entry_removed: bool,
) -> None:
    """In 5 minutes, one kWh may have flowed; what may not is reported."""
    box = EvboxChargePoint(1923054, [Module(energy_wh=6000)], min_interval=0)
    async with running(hass, box, poll_interval=0.2) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        await wait_for_state(hass, energy, "6.0")
        await shut_down(hass, entry)
        (record,) = hass_storage[TOTALS_KEY]["data"].values()
        assert record["total"] == record["meter"] == 6000
        record["total"] = 10_000.0
        record["wall"] -= 300
        box.modules[0].energy_wh += grown
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, energy, str(shown))
        assert len(not_counted(hass)) == count
        for text in not_counted(hass):
            assert f"changed by {grown / 1000:+g} kWh" in text
            assert "the meter of Charger 1923054" in text
        # It is found once only, so neither a reload nor a restart takes it away.
        await hass.config_entries.async_reload(entry.entry_id)
        await hass.async_block_till_done()
        assert len(not_counted(hass)) == count
        assert all(
            issue.is_persistent
            for issue in ir.async_get(hass).issues.values()
            if issue.translation_key == "energy_not_counted"
        )
        # But the removal of its charger does.
        if is_entry_removed:
            await hass.config_entries.async_remove(entry.entry_id)
        else:
            (subentry_id,) = entry.subentries
            hass.config_entries.async_remove_subentry(entry, subentry_id)
        await hass.async_block_till_done()
        assert not_counted(hass) == []


def not_counted(hass: HomeAssistant) -> list[str]:
    """Return the texts of the issues about energy, as a user reads them."""
    key = "energy_not_counted"
    texts = json.loads((TRANSLATIONS / "en.json").read_text())["issues"][key]
    return [
        texts["description"].format(**(issue.translation_placeholders or {}))
        for (domain, _), issue in ir.async_get(hass).issues.items()
        if domain == DOMAIN and issue.translation_key == key
    ]


class Wall:
    """The wall clock of the computer, and how wrong it is."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wrong_by = 0.0
        monkeypatch.setattr(sensor_module, "_clocks", self._clocks)

    def _clocks(self, hass: HomeAssistant) -> Clocks:
        wall = dt_util.utcnow().timestamp() + self.wrong_by
        return Clocks(hass.loop.time(), wall)


@pytest.mark.parametrize("make", [EvboxChargePoint, EwsBox])
async def test_a_computer_that_starts_with_yesterdays_time(
    hass: HomeAssistant,
    hass_storage: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    make: type[EvboxChargePoint | EwsBox],
) -> None:
    """22 kWh are charged in 4 h without Home Assistant, and counted in the end."""
    wall = Wall(monkeypatch)
    box = EvboxChargePoint(min_interval=0) if make is EvboxChargePoint else EwsBox()
    set_meter(box, 6000.0)
    async with running(hass, box, poll_interval=0.2) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        await wait_for_state(hass, energy, "6.0")
        await shut_down(hass, entry)
        for record in hass_storage[TOTALS_KEY]["data"].values():
            record["wall"] -= 4 * 3600
        wall.wrong_by = -DAY
        set_meter(box, 28_000.0)
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, energy, "6.0")
        # Consumption of now counts meanwhile.
        set_meter(box, 28_050.0)
        await wait_for_state(hass, energy, "6.05")
        wall.wrong_by = 0.0
        set_meter(box, 28_060.0)
        await wait_for_state(hass, energy, "28.06")
        assert not_counted(hass) == []


async def test_a_meter_that_is_not_itself_after_a_restart(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """It reads 0 at first: what was charged in the absence counts all the same."""
    box = EvboxChargePoint(1923054, [Module(energy_wh=6000)], min_interval=0)
    async with running(hass, box, poll_interval=0.2) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        await wait_for_state(hass, energy, "6.0")
        await shut_down(hass, entry)
        for record in hass_storage[TOTALS_KEY]["data"].values():
            record["wall"] -= 3600
        set_meter(box, 0.0)
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, energy, "6.0")
        set_meter(box, 8000.0)
        await wait_for_state(hass, energy, "8.0")
        assert not_counted(hass) == []


@pytest.mark.parametrize("total", [0.0, 12.05, 5000.0])
async def test_a_meter_that_is_set_adds_nothing(
    hass: HomeAssistant, hass_storage: dict[str, Any], total: float
) -> None:
    """Not now, and not after a crash right behind it."""
    box = EwsBox()
    set_meter(box, 12_000.0)
    async with running(hass, box) as (entry, bus):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        await wait_for_state(hass, energy, "12.0")
        shown: set[str] = set()
        hass.bus.async_listen(
            "state_changed",
            lambda event: shown.add(event.data["new_state"].state),
            only(energy),
        )
        device = er.async_get(hass).async_get(energy)
        assert device is not None
        data = {"device_id": device.device_id, "total": total}
        await hass.services.async_call(DOMAIN, "set_meter_total", data, blocking=True)
        meter = box.ports[0].session
        assert meter.total_wh == total * 1000
        await polled(bus, box)
        meter.total_wh += 30
        await wait_for_state(hass, energy, "12.03")
        await hass.async_block_till_done(wait_background_tasks=True)
        await crash(hass, entry, hass_storage)
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, energy, lambda state: is_above(state, 11))
        meter.total_wh += 10
        await wait_for_state(hass, energy, "12.04")
        assert shown <= {"12.0", "12.03", "12.04", "unavailable", "unknown"}
        assert not_counted(hass) == []


def set_meter(box: EvboxChargePoint | EwsBox, total: float) -> None:
    """Let the meter of the first connector have counted so much, Wh."""
    if isinstance(box, EwsBox):
        box.ports[0].session.total_wh = total
    else:
        box.modules[0].energy_wh = total


@pytest.mark.parametrize(
    "damage", [{"total": None}, {"meter": float("nan")}, {"wall": True}, [], None]
)
async def test_a_damaged_record_is_left_out(
    hass: HomeAssistant, hass_storage: dict[str, Any], damage: object
) -> None:
    good = {"total": 1.0, "meter": 2, "wall": 3.0}
    bad = good | damage if isinstance(damage, dict) else damage
    hass_storage[TOTALS_KEY] = {
        "version": 1,
        "minor_version": 1,
        "key": TOTALS_KEY,
        "data": {"good": good, "bad": bad},
    }
    store = TotalStore(hass)
    await store.async_load()
    assert store.get("good") == MeterRecord(1.0, 2, 3.0)
    assert store.get("bad") is None


async def test_totals_are_written_in_steps_and_at_stop(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    store = TotalStore(hass)
    await store.async_load()

    async def put(total: float, seconds: float) -> float:
        store.put("a", MeterRecord(total, total, 0.0))
        async_fire_time_changed(
            hass, dt_util.utcnow() + timedelta(seconds=seconds), fire_all=True
        )
        await hass.async_block_till_done(wait_background_tasks=True)
        return float(hass_storage[TOTALS_KEY]["data"]["a"]["total"])

    assert await put(0.0, 1) == 0.0
    assert await put(STEP - 1, INTERVAL + 1) == 0.0
    assert await put(STEP, INTERVAL + 1) == STEP
    assert await put(STEP + 1, INTERVAL + 1) == STEP
    hass.bus.async_fire(EVENT_HOMEASSISTANT_FINAL_WRITE)
    await hass.async_block_till_done()
    assert hass_storage[TOTALS_KEY]["data"]["a"]["total"] == STEP + 1


async def test_what_the_disk_refuses_is_not_stored(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    store = TotalStore(hass)
    await store.async_load()
    store.put("a", MeterRecord(5.0, 5.0, 0.0))
    with patch.object(StoredFile, "async_write", return_value=OSError("full")):
        await store.async_flush()
    assert store.stored("a") is None
    await store.async_flush()
    assert store.stored("a") == store.get("a")
    assert hass_storage[TOTALS_KEY]["data"]["a"]["total"] == 5.0
    store._next_write.cancel()
