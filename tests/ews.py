"""Helpers of the tests that run EWS-Boxes inside Home Assistant."""

from collections.abc import AsyncIterator, Sequence
from contextlib import ExitStack, asynccontextmanager
import logging
from typing import Any

from homeassistant.config_entries import ConfigEntryState, ConfigSubentryData
from homeassistant.core import HomeAssistant
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from tests.common import call, ews_charger, free_port, get_entity, wait_for_state
from tests.virtual import Car, EwsBox, EwsCommand, EwsDialler, VirtualBus

HOST = "127.0.0.1"
RETRY = 0.1
"""Pause of a virtual box between two attempts to dial, s."""

STOP, REQUEST_START, START, OPTIMISE, DO_NOT_OPTIMISE, PAUSE, LOCK = range(1, 8)
"""Orders of ``sl``."""


def quick_car() -> Car:
    """Return a car that does at once what it may."""
    return Car(reaction=0.0, ramp=0.1)


# -- What a box was told ---------------------------------------------------------


def orders(box: EwsBox, port: int = 1) -> list[int]:
    """Return the orders of ``sl`` that a port was given, oldest first."""
    told = [one.parameters for one in box.commands_named("sl")]
    return [order for number, order in told if number == port]


def limits(box: EwsBox, port: int = 1) -> list[int]:
    """Return the limits that a port was told (``st``), A, oldest first."""
    return [one.amps for one in box.currents_set if one.port == port]


def names(commands: Sequence[EwsCommand]) -> set[str]:
    """Return which commands are among these."""
    return {one.name for one in commands}


# -- A charge --------------------------------------------------------------------


async def plug_in(bus: VirtualBus, box: EwsBox, port: int = 1) -> None:
    """Let a car come; return when it waits for its start."""
    car = box.ports[port - 1].car
    assert car is not None
    car.plug_in()
    await bus.wait_for_async(lambda: box.ports[port - 1].status == 0x30)


async def charge(
    hass: HomeAssistant,
    entry: MockConfigEntry,
    bus: VirtualBus,
    box: EwsBox,
    port: int = 1,
) -> str:
    """Let a car come and charge; return the switch that allowed it."""
    switch = await get_entity(hass, "switch", entry, f"{port}_charging_allowed")
    status = await get_entity(hass, "sensor", entry, f"{port}_status")
    await plug_in(bus, box, port)
    await wait_for_state(hass, status, "preparing")
    await call(hass, "switch.turn_on", switch)
    await wait_for_state(hass, status, "charging")
    return switch


async def polled(bus: VirtualBus, box: EwsBox, times: int = 5) -> None:
    """Wait until a box was asked so often again how its ports are."""
    before = len(box.commands_named("rc"))
    await bus.wait_for_async(
        lambda: len(box.commands_named("rc")) >= before + times, timeout=15
    )


# -- Boxes that dial us ----------------------------------------------------------

BOXES = "sensor.bus_connected_boxes"


def said(caplog: pytest.LogCaptureFixture, words: str) -> int:
    """Return how often we have said something that a user sees."""
    return sum(
        words in record.getMessage()
        for record in caplog.records
        if record.levelno >= logging.WARNING and DOMAIN in record.name
    )


def listener_entry(
    port: int,
    *chargers: ConfigSubentryData,
    allowed: Sequence[str] = (),
    entry_id: str = "bus",
) -> MockConfigEntry:
    """Return a listener's config entry as the config flow stores it."""
    return MockConfigEntry(
        domain=DOMAIN,
        entry_id=entry_id,
        title="Bus",
        data={"protocol": "ews_network", "host": HOST, "port": port},
        options={"allowed": list(allowed)},
        subentries_data=chargers,
    )


def dialler_of(entry: MockConfigEntry, box: EwsBox, **options: Any) -> EwsDialler:  # noqa: ANN401 - of a dialler
    """Return what dials a listener for a box; begun by ``with``."""
    return EwsDialler(
        box,
        HOST,
        entry.data["port"],
        **{"retry": RETRY, "source_ports": 0, "own_thread": False, **options},
    )


@asynccontextmanager
async def listening(
    hass: HomeAssistant,
    *boxes: EwsBox,
    allowed: Sequence[str] = (),
    time_scale: float = 1.0,
    **data: object,
) -> AsyncIterator[tuple[MockConfigEntry, list[EwsDialler]]]:
    """Run a listener with these boxes set up, which dial it; then unload it."""
    chargers = [ews_charger(box, **data) for box in boxes]
    entry = listener_entry(free_port(), *chargers, allowed=allowed)
    entry.add_to_hass(hass)
    await hass.config_entries.async_setup(entry.entry_id)
    await hass.async_block_till_done()
    assert entry.state is ConfigEntryState.LOADED, entry.reason
    with ExitStack() as stack:
        diallers = [
            stack.enter_context(dialler_of(entry, box, time_scale=time_scale))
            for box in boxes
        ]
        try:
            yield entry, diallers
        finally:
            if entry.state is ConfigEntryState.LOADED:
                await hass.config_entries.async_unload(entry.entry_id)
                await hass.async_block_till_done()
