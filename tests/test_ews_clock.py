"""The clock of an EWS-Box is kept right, in Home Assistant's time zone."""

from datetime import datetime, timedelta
import struct
import sys

from homeassistant.core import HomeAssistant
from homeassistant.util import dt as dt_util
import pytest

from custom_components.evse_bus.evse.ews.box import EwsBox as EwsSession
from tests.common import get_entity, running
from tests.ews import polled
from tests.virtual import EwsBox
from tests.virtual.ews_records import EwsCommand

CLOCK = struct.Struct(">HBBBBB")


def local() -> datetime:
    """Return the time as the house has it, without a zone."""
    return dt_util.now().replace(tzinfo=None)


def off(box: EwsBox) -> timedelta:
    """Return by how much the box's clock is wrong now."""
    return abs(box.clock() - local())


def time_of(command: EwsCommand) -> datetime:
    """Return what a clock was set to."""
    return datetime(*CLOCK.unpack(command.parameters))  # noqa: DTZ001 - the box has no zone


@pytest.mark.parametrize("zone", ["Europe/Berlin", "America/New_York", "Asia/Kolkata"])
async def test_a_wrong_clock_is_set_once(hass: HomeAssistant, zone: str) -> None:
    await hass.config.async_set_time_zone(zone)
    box = EwsBox()
    async with running(hass, box) as (_, bus):
        await bus.wait_for_async(lambda: box.commands_named("sc"))
        assert off(box) < timedelta(seconds=2)
        await polled(bus, box, 20)
        (command,) = box.commands_named("sc")
        assert abs(time_of(command) - local()) < timedelta(seconds=10)


@pytest.mark.parametrize(("wrong_by", "is_set"), [(20, False), (90, True), (-90, True)])
async def test_a_clock_may_be_wrong_by_a_minute(
    hass: HomeAssistant,
    wrong_by: int,
    is_set: bool,  # noqa: FBT001 - a parameter of a test
) -> None:
    box = EwsBox()
    box.set_clock(local() + timedelta(seconds=wrong_by))
    async with running(hass, box) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        await polled(bus, box, 10)
        assert bool(box.commands_named("sc")) is is_set


async def test_another_time_zone_counts_at_once(hass: HomeAssistant) -> None:
    await hass.config.async_update(time_zone="Europe/Berlin")
    box = EwsBox()
    async with running(hass, box) as (entry, bus):
        await bus.wait_for_async(lambda: box.commands_named("sc"))
        before = box.clock()
        connected = bus.opened
        await hass.config.async_update(time_zone="Asia/Tokyo")
        await bus.wait_for_async(lambda: len(box.commands_named("sc")) == 2, timeout=20)
        assert off(box) < timedelta(seconds=2)
        ahead = box.clock() - before
        assert timedelta(hours=6) < ahead < timedelta(hours=9)
        # The line stayed open, and other changes of the settings are none of the box.
        assert bus.opened == connected
        await hass.config.async_update(location_name="Home")
        await polled(bus, box, 10)
        assert len(box.commands_named("sc")) == 2
        assert entry.runtime_data.chargers


async def test_a_clock_is_set_again_after_a_power_cut(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The box says that it was restarted; its clock is in the year 2000 then."""
    monkeypatch.setattr(sys.modules[EwsSession.__module__], "BOX_INTERVAL", 0.3)
    box = EwsBox()
    async with running(hass, box) as (_, bus):
        await bus.wait_for_async(lambda: box.commands_named("sc"))
        # Its flag of the last start must have been seen to be gone, by two replies.
        await bus.wait_for_async(lambda: len(box.commands_named("rs")) > 6)
        box.power_cycle(0.5)
        await bus.wait_for_async(lambda: len(box.commands_named("sc")) == 2, timeout=20)
        assert off(box) < timedelta(seconds=2)
