"""The automations of the documentation, as they stand there."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import timedelta
from pathlib import Path
import re

from homeassistant.core import HomeAssistant
from homeassistant.setup import async_setup_component
from homeassistant.util import dt as dt_util
from homeassistant.util.yaml import parse_yaml
import pytest
from pytest_homeassistant_custom_component.common import async_fire_time_changed

from tests.common import call, get_entity, running, wait_for_state
from tests.virtual import AblBox, Car, EwsBox, EwsCard, VirtualBus

ROOT = Path(__file__).parents[1]


@asynccontextmanager
async def automated(
    hass: HomeAssistant, alias: str, page: str = "README.md"
) -> AsyncIterator[None]:
    """Run one of a page's automations."""
    text = (ROOT / page).read_text()
    blocks = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (wanted,) = (
        parsed
        for block in blocks
        if (parsed := parse_yaml(block)).get("alias") == alias
    )
    assert await async_setup_component(hass, "automation", {"automation": wanted})
    await hass.async_block_till_done()
    (automation,) = hass.states.async_all("automation")
    assert automation.state == "on"
    try:
        yield
    finally:
        await hass.async_block_till_done()
        await call(hass, "automation.turn_off", automation.entity_id)


@pytest.mark.parametrize(
    ("export", "amperes"),
    [(-7000, None), (-2760, 6), (-2070, 7), (0, 10), (1400, 12), (9000, 16)],
)
async def test_charge_from_the_sun(
    hass: HomeAssistant, export: float, amperes: int | None
) -> None:
    """At 10 A the house has this much to give away (W)."""
    box = AblBox(1)
    async with running(hass, box, title="Carport") as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        assert (limit, allowed) == (
            "number.carport_charging_current",
            "switch.carport_charging_allowed",
        )
        await call(hass, "number.set_value", limit, value=10)
        await call(hass, "switch.turn_on", allowed)
        hass.states.async_set("sensor.grid_export_power", str(export))
        async with automated(hass, "Charge from the sun"):
            minute = dt_util.utcnow().replace(second=0, microsecond=600_000)
            async_fire_time_changed(hass, minute + timedelta(minutes=1))
            if amperes is None:
                await wait_for_state(hass, allowed, "off")
                await bus.wait_for_async(lambda: box.ic_amps == 0)
                return
            await wait_for_state(hass, limit, str(float(amperes)))
            await wait_for_state(hass, allowed, "on")
            await bus.wait_for_async(lambda: amperes - 0.06 < box.ic_amps <= amperes)


async def test_spare_the_main_fuse(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box, title="Carport") as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        hass.states.async_set("sensor.main_current_l1", "20")
        async with automated(hass, "Spare the main fuse"):
            hass.states.async_set("sensor.main_current_l1", "24.5")
            await wait_for_state(hass, limit, "6.0")
            await bus.wait_for_async(lambda: box.ic_amps <= 6)


async def test_the_main_fuse_is_spared_by_a_charger_that_was_away(
    hass: HomeAssistant,
) -> None:
    box = AblBox(1)
    async with running(hass, box, title="Carport") as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        hass.states.async_set("sensor.main_current_l1", "20")
        async with automated(hass, "Spare the main fuse"):
            bus.remove(box)
            await wait_for_state(hass, limit, "unavailable")
            hass.states.async_set("sensor.main_current_l1", "24.5")
            await hass.async_block_till_done()
            bus.add(box)
            await wait_for_state(hass, limit, "6.0")
            await bus.wait_for_async(lambda: box.ic_amps <= 6)


# -- An EWS-Box asks before it charges ---------------------------------------------


@asynccontextmanager
async def yard(
    hass: HomeAssistant, box: EwsBox, car: Car
) -> AsyncIterator[tuple[VirtualBus, str]]:
    """Run a box with a card reader, and a car that waits at its first port."""
    async with running(hass, box) as (entry, bus):
        allowed = await get_entity(hass, "switch", entry, "1_charging_allowed")
        assert allowed == "switch.yard_port_1_charging_allowed"
        status = await get_entity(hass, "sensor", entry, "1_status")
        await get_entity(hass, "event", entry, "1_start_request")
        await get_entity(hass, "event", entry, "card")
        car.plug_in()
        await wait_for_state(hass, status, "preparing")
        yield bus, allowed


async def test_a_start_request_of_a_known_card_is_answered(hass: HomeAssistant) -> None:
    car = Car()
    box = EwsBox(cars=(car, None), rfid=True)
    async with (
        yard(hass, box, car) as (bus, allowed),
        automated(hass, "Answer a start request"),
    ):
        box.present_card(EwsCard(group=7, number=43))
        await bus.wait_for_async(lambda: box.reader.valid)
        assert not box.ports[0].contactor
        box.press_key(1, 1)
        await bus.wait_for_async(lambda: box.ports[0].contactor)
        await wait_for_state(hass, allowed, "on")


async def test_a_start_request_of_another_card_is_not(hass: HomeAssistant) -> None:
    car = Car()
    box = EwsBox(cars=(car, None), rfid=True)
    requested = "binary_sensor.yard_port_1_start_requested"
    async with yard(hass, box, car) as (bus, _allowed):
        box.present_card(EwsCard(group=7, number=44))
        async with automated(hass, "Answer a start request"):
            box.press_key(1, 1)
            await wait_for_state(hass, requested, "on")
            await wait_for_state(hass, requested, "off")
        await bus.wait_for_async(lambda: box.ports[0].start_mode == 0)
        assert not box.ports[0].history.starts
        assert [one.parameters for one in box.commands_named("sl")] == [b"\x01\x01"]


@pytest.mark.parametrize(
    ("tag", "starts"), [("04a1b2c3d4e5f6", True), ("04a1b2c3d4e5f7", False)]
)
async def test_a_card_of_another_format_is_accepted(
    hass: HomeAssistant, tag: str, *, starts: bool
) -> None:
    car = Car()
    box = EwsBox(cars=(car, None), rfid=True)
    card = EwsCard(tag=bytes.fromhex(tag), foreign=True)
    async with (
        yard(hass, box, car) as (bus, _allowed),
        automated(hass, "Accept a card of another format", "docs/ews.md"),
    ):
        box.present_card(card)
        await wait_for_state(hass, "event.yard_card", lambda state: state.state)
        await hass.async_block_till_done()
        assert len(box.commands_named("ma")) == starts
        box.press_key(1, 1)
        if starts:
            await bus.wait_for_async(lambda: box.ports[0].contactor)
        else:
            assert not box.ports[0].history.starts
