"""The automations of the documentation, as they stand there."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
import logging
from math import floor, inf
from pathlib import Path
import re
from typing import Any

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
from homeassistant.setup import async_setup_component
from homeassistant.util import dt as dt_util
from homeassistant.util.yaml import parse_yaml
import pytest
from pytest_homeassistant_custom_component.common import async_fire_time_changed

from tests.common import call, get_entity, running, state_of, wait_for_state
from tests.odd_boxes import ODD_BOXES, OddBox
from tests.virtual import AblBox, Car, EwsBox, EwsCard, VirtualBus

ROOT = Path(__file__).parents[1]


PAGES = ("README.md", *(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")))
RUN_HERE = {
    *("Charge from the sun", "Spare the main fuse", "Answer a start request"),
    "Accept a card of another format",
}
"""Aliases of the automations that this module runs."""


def blocks(page: str) -> list[dict[str, Any]]:
    """Return the YAML blocks of a page."""
    text = (ROOT / page).read_text()
    found = re.findall(r"```ya?ml\n(.*?)```", text, re.DOTALL)
    return [parse_yaml(block) for block in found]


async def test_every_block_is_run_here(hass: HomeAssistant) -> None:
    """An automation by its alias; what else there is, Home Assistant takes."""
    found = [block for page in PAGES for block in blocks(page)]
    assert sorted(block["alias"] for block in found if "alias" in block) == sorted(
        RUN_HERE
    )
    others = [block for block in found if "alias" not in block]
    assert [list(block) for block in others] == [["logger"]]
    for block in others:
        assert await async_setup_component(hass, "logger", block)


@asynccontextmanager
async def automated(
    hass: HomeAssistant, alias: str, page: str = "README.md"
) -> AsyncIterator[None]:
    """Run one of a page's automations; none of its runs may stop in the middle."""
    assert alias in RUN_HERE
    (wanted,) = (block for block in blocks(page) if block.get("alias") == alias)
    failed: list[str] = []

    class Failures(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            failed.append(record.getMessage())

    handler = Failures(logging.ERROR)
    logger = logging.getLogger("homeassistant.components.automation")
    logger.addHandler(handler)
    assert await async_setup_component(hass, "automation", {"automation": wanted})
    await hass.async_block_till_done()
    (automation,) = hass.states.async_all("automation")
    assert automation.state == "on"
    try:
        yield
    finally:
        await hass.async_block_till_done()
        await call(hass, "automation.turn_off", automation.entity_id)
        logger.removeHandler(handler)
    assert not failed


@dataclass
class Carport:
    """A charger called Carport, with a car that charges if it may."""

    hass: HomeAssistant
    bus: VirtualBus
    odd: OddBox
    car: Car
    installation: float
    limit: str = "number.carport_charging_current"
    allowed: str = "switch.carport_charging_allowed"
    reason: str = "sensor.carport_pause_reason"
    may_charge: bool = True

    async def order(self, current: float) -> None:
        await call(self.hass, "number.set_value", self.limit, value=current)
        await self.settles(current)

    async def settles(self, current: float) -> None:
        """Wait until an order stands, and the car draws what it may by it."""
        odd = self.odd
        kept = str(float(odd.kept(current)))
        await wait_for_state(self.hass, self.limit, kept)
        reason = odd.reason(current, self.installation)
        await wait_for_state(
            self.hass, self.reason, reason if self.may_charge else "not_allowed"
        )
        draws = odd.offers(current, self.installation)
        await self.bus.wait_for_async(
            lambda: draws - 0.2 < self.car.current <= draws, timeout=100
        )
        expected = "on" if self.may_charge else "off"
        assert state_of(self.hass, self.allowed) == expected

    async def allow(self) -> None:
        """Allow charging; a household socket says where it never can."""
        with suppress(HomeAssistantError):
            await call(self.hass, "switch.turn_on", self.allowed)
            return
        assert self.odd.offers(inf, self.installation) == 0
        self.may_charge = False


@asynccontextmanager
async def carport(
    hass: HomeAssistant, odd: OddBox, installation: float = 16.0
) -> AsyncIterator[Carport]:
    car = Car(max_current=32, reaction=0.0, ramp=0.1)
    # Only a pause of ours may stop it.
    car.min_current = 0
    async with running(
        hass,
        odd.make(car),
        title="Carport",
        installation_limit=installation,
        **odd.data,
    ) as (entry, bus):
        port = Carport(hass, bus, odd, car, installation)
        limit = await get_entity(hass, "number", entry, f"{odd.port}charging_current")
        assert limit == port.limit
        car.plug_in()
        # Long enough for every box to see the car.
        await asyncio.sleep(15)
        await port.allow()
        yield port


@pytest.mark.parametrize("kind", ODD_BOXES)
@pytest.mark.parametrize("installation", [6.0, 13.7, 32.0])
async def test_charge_from_the_sun(
    hass: HomeAssistant, kind: str, installation: float
) -> None:
    """With every box, whatever it can do: the limit follows the sun."""
    odd = ODD_BOXES[kind]
    async with carport(hass, odd, installation) as port:
        order = min(10.0, installation)
        await port.order(order)
        async with automated(hass, "Charge from the sun"):
            time = dt_util.utcnow().replace(second=0, microsecond=600_000)
            for export in (0, 1400, 9000, -2760, -2070, -9000, 3000, 16000, -690):
                hass.states.async_set("sensor.grid_export_power", str(export))
                now = odd.kept(order) if odd.offers(order, installation) else 0
                order = max(0, min(floor(now + export / 690), installation))
                time += timedelta(minutes=1)
                async_fire_time_changed(hass, time)
                await hass.async_block_till_done()
                await port.settles(order)


@pytest.mark.parametrize("kind", ODD_BOXES)
@pytest.mark.parametrize("installation", [6.0, 13.7, 32.0])
async def test_spare_the_main_fuse_with_every_box(
    hass: HomeAssistant, kind: str, installation: float
) -> None:
    async with carport(hass, ODD_BOXES[kind], installation) as port:
        await port.order(installation)
        hass.states.async_set("sensor.main_current_l1", "20")
        async with automated(hass, "Spare the main fuse"):
            hass.states.async_set("sensor.main_current_l1", "24.5")
            await hass.async_block_till_done()
            await port.settles(6)
            assert port.car.current <= 6


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
