"""Helpers of the tests that run the integration inside Home Assistant."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from copy import deepcopy
from functools import partial
from itertools import count
import os
import socket
from typing import Any

from homeassistant.config_entries import (
    ConfigEntryState,
    ConfigSubentryData,
    ConfigSubentryDataWithId,
)
from homeassistant.const import STATE_UNAVAILABLE, STATE_UNKNOWN
from homeassistant.core import (
    Event,
    EventStateChangedData,
    HomeAssistant,
    State,
    callback,
)
from homeassistant.helpers import entity_registry as er
from homeassistant.helpers.event import async_track_state_change_event
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN, SUBENTRY_CHARGER
from custom_components.evse_bus.energy import TOTALS, TOTALS_KEY, TotalStore
from custom_components.evse_bus.issues import report_orders_written
from custom_components.evse_bus.stores.orders import (
    KNOWN_KEY,
    ORDERS,
    ORDERS_KEY,
    OrderStore,
    Record,
    encode,
)
from tests.virtual import AblBox, EvboxChargePoint, SmartEvse, VirtualBus
from tests.virtual.device import Device
from tests.virtual.ews_box import EwsBox

FILES = (ORDERS_KEY, KNOWN_KEY, TOTALS_KEY)
PATIENCE = 15.0
"""Longest time a virtual charger may take to be seen, s."""

_EXTRA: dict[str, dict[str, Any]] = {
    "abl": {"phase_order": [1, 2, 3]},
    "evbox": {"command": 68, "information": "00" * 16, "fail_safe_timeout": 60},
    "smartevse": {},
    "smartevse_master": {},
    "ews": {"ports": 2, "installation_limit_2": 16.0},
}


def charger(
    protocol: str,
    address: int | str,
    *,
    serial: str | None = None,
    title: str | None = None,
    **data: object,
) -> ConfigSubentryDataWithId:
    """Return a charger subentry as the config flow stores it.

    Polled as fast as the bus goes, unless ``data`` says otherwise.
    """
    known_by = _identity(protocol, serial)
    return ConfigSubentryDataWithId(
        subentry_id=f"{protocol}{address}",
        data={
            **({} if known_by is None else {"identity": known_by}),
            "address": address,
            "serial": serial,
            "installation_limit": 16.0,
            "voltage": 230.0,
            "poll_interval": 0.1,
            "order_lifetime": None,
            "fail_safe_current": 6.0,
            **_EXTRA[protocol],
            **data,
        },
        subentry_type=SUBENTRY_CHARGER,
        title=title or f"Charger {address}",
        unique_id=known_by,
    )


def _identity(protocol: str, serial: str | None) -> str | None:
    """Return what a box is known by for good; ``None``: its subentry's id."""
    family = protocol.removesuffix("_network")
    if serial is None or family.startswith("smartevse"):
        return None
    return f"{family}_{serial}"


def bus_entry(
    protocol: str,
    url: str,
    *chargers: ConfigSubentryData,
    title: str = "Bus",
    entry_id: str = "bus",
    **data: object,
) -> MockConfigEntry:
    """Return a bus's config entry as the config flow stores it."""
    return MockConfigEntry(
        domain=DOMAIN,
        entry_id=entry_id,
        title=title,
        data={"protocol": protocol, "device": url, **data},
        subentries_data=chargers,
    )


async def setup_bus(
    hass: HomeAssistant,
    protocol: str,
    url: str,
    *chargers: ConfigSubentryData,
    **options: object,
) -> MockConfigEntry:
    """Set up a bus; return when Home Assistant has, chargers may not be seen yet."""
    entry = bus_entry(protocol, url, *chargers, **options)
    entry.add_to_hass(hass)
    await hass.config_entries.async_setup(entry.entry_id)
    await hass.async_block_till_done()
    return entry


def charger_of(device: Device, **data: object) -> ConfigSubentryDataWithId:
    """Return the subentry of a virtual charger."""
    if isinstance(device, AblBox):
        return charger("abl", device.device_id, serial=device.serial, **data)
    if isinstance(device, SmartEvse):
        return charger(protocol_of(device), device.unit, **data)
    if isinstance(device, EwsBox):
        return ews_charger(device, **data)
    assert isinstance(device, EvboxChargePoint)
    number = int(device.serial)
    return charger("evbox", number, serial=str(number), **data)


def ews_charger(
    box: EwsBox, *, title: str = "Yard", **data: object
) -> ConfigSubentryDataWithId:
    """Return the subentry of a virtual EWS-Box; its ports are chargers of their own."""
    made = charger("ews", box.serial, serial=box.serial, title=title, **data)
    return {**made, "subentry_id": f"ews{box.serial[-2:]}"}


def protocol_of(device: Device) -> str:
    """Return how a virtual charger is spoken to."""
    if isinstance(device, SmartEvse) and device.outlet.slave:
        return "smartevse_master"
    return device.protocol


@asynccontextmanager
async def running(
    hass: HomeAssistant,
    *devices: Device,
    time_scale: float = 1.0,
    supply: Mapping[str, float] | None = None,
    **data: object,
) -> AsyncIterator[tuple[MockConfigEntry, VirtualBus]]:
    """Run a virtual bus with its chargers set up; unload before the port goes.

    ``time_scale``: the devices' time runs faster; ``supply``: what they share.
    """
    with VirtualBus.in_loop(*devices, time_scale=time_scale) as bus:
        chargers = [charger_of(device, **data) for device in devices]
        protocol = protocol_of(devices[0])
        entry = await setup_bus(hass, protocol, bus.url, *chargers, **(supply or {}))
        assert entry.state is ConfigEntryState.LOADED, entry.reason
        try:
            yield entry, bus
        finally:
            if entry.state is ConfigEntryState.LOADED:
                await hass.config_entries.async_unload(entry.entry_id)
                await hass.async_block_till_done()


_ports = count(os.getpid() * 7)


def free_port() -> int:
    """Return a TCP port that nobody uses, nor will by chance.

    It lies below those that the kernel gives to connections, and other processes of
    the tests begin elsewhere.
    """
    while True:
        port = 10_000 + next(_ports) % 10_000
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


async def crash(
    hass: HomeAssistant, entry: MockConfigEntry, storage: dict[str, Any]
) -> None:
    """End a bus as a killed process does: nothing more is sent or written."""
    on_disk = {key: deepcopy(storage[key]) for key in FILES if key in storage}
    await shut_down(hass, entry)
    for key in FILES:
        storage.pop(key, None)
    storage.update(on_disk)


async def shut_down(hass: HomeAssistant, entry: MockConfigEntry) -> None:
    """End a bus as a clean stop does: the next set-up reads the files anew."""
    await hass.config_entries.async_unload(entry.entry_id)
    await hass.async_block_till_done()
    forget_orders(hass)


def forget_orders(hass: HomeAssistant) -> None:
    """Drop all orders and totals from memory, also those that are not written yet."""
    store = hass.data.get(ORDERS)
    if store is not None:
        store._next_write.cancel()
        store._pending = False
    hass.data[ORDERS] = OrderStore(hass, partial(report_orders_written, hass))
    if (totals := hass.data.get(TOTALS)) is not None:
        totals._next_write.cancel()
    hass.data[TOTALS] = TotalStore(hass)


def stored_order(
    storage: dict[str, Any], owner: str, port: int | None = None
) -> dict[str, Any]:
    """Return the stored record of a charger, by the id of its subentry."""
    suffix = "" if port is None else f"_{port}"
    [record] = [
        record
        for key, record in storage[ORDERS_KEY]["data"].items()
        if record.get("owner") == owner and key.endswith(suffix)
    ]
    return dict(record)


def orders_file(**records: Record[Any]) -> dict[str, Any]:
    """Return a file of orders; colons in keys are written as two underscores."""
    data = {key.replace("__", ":"): encode(one) for key, one in records.items()}
    return {"version": 1, "minor_version": 1, "key": ORDERS_KEY, "data": data}


async def call(
    hass: HomeAssistant,
    service: str,
    entity: str,
    **data: object,
) -> None:
    """Call a service for an entity and wait for it."""
    domain, name = service.split(".")
    await hass.services.async_call(
        domain, name, {"entity_id": entity, **data}, blocking=True
    )


def state_of(hass: HomeAssistant, entity: str) -> str:
    """Return an entity's state, which must be there."""
    state = hass.states.get(entity)
    assert state is not None, entity
    return state.state


def subentry_id(entry: MockConfigEntry, index: int = 0) -> str:
    """Return the id of one of a bus's chargers."""
    return list(entry.subentries)[index]


def identity(entry: MockConfigEntry, index: int = 0) -> str:
    """Return the beginning of the unique ids of one of a bus's chargers."""
    subentry = list(entry.subentries.values())[index]
    return str(subentry.data.get("identity", subentry.subentry_id))


def entity_id(
    hass: HomeAssistant,
    platform: str,
    entry: MockConfigEntry,
    key: str,
    *,
    index: int = 0,
) -> str | None:
    """Return an entity of a charger; a connector's key begins with its number."""
    return er.async_get(hass).async_get_entity_id(
        platform, DOMAIN, f"{identity(entry, index)}_{key}"
    )


async def get_entity(
    hass: HomeAssistant,
    platform: str,
    entry: MockConfigEntry,
    key: str,
    *,
    index: int = 0,
) -> str:
    """Wait until an entity of a charger is there and has a state; return its id."""
    found = ""

    def is_there() -> bool:
        nonlocal found
        found = entity_id(hass, platform, entry, key, index=index) or ""
        state = hass.states.get(found) if found else None
        return state is not None and state.state != STATE_UNAVAILABLE

    await wait_until(hass, is_there)
    return found


async def wait_until(hass: HomeAssistant, condition: Callable[[], object]) -> None:
    """Wait until something holds; looked at after each event in Home Assistant."""
    if condition():
        return
    holds = asyncio.Event()

    @callback
    def look(_event: Event[Any]) -> None:
        if condition():
            holds.set()

    stop = hass.bus.async_listen("*", look)
    try:
        async with asyncio.timeout(PATIENCE):
            await holds.wait()
    finally:
        stop()


async def wait_for_state(
    hass: HomeAssistant,
    entity: str,
    expected: str | Callable[[State], object],
) -> State:
    """Wait until an entity has a state, or one that a function takes; return it."""

    def fits(state: State | None) -> bool:
        if state is None:
            return False
        if callable(expected):
            return state.state not in (STATE_UNAVAILABLE, STATE_UNKNOWN) and bool(
                expected(state)
            )
        return state.state == expected

    now = hass.states.get(entity)
    if now is not None and fits(now):
        return now
    seen: asyncio.Future[State] = hass.loop.create_future()

    @callback
    def changed(event: Event[EventStateChangedData]) -> None:
        state = event.data["new_state"]
        if state is not None and fits(state) and not seen.done():
            seen.set_result(state)

    stop = async_track_state_change_event(hass, entity, changed)
    try:
        async with asyncio.timeout(PATIENCE):
            return await seen
    except TimeoutError:
        message = f"{entity} is {hass.states.get(entity)}, expected {expected}"
        raise AssertionError(message) from None
    finally:
        stop()
