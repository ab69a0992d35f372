"""Diagnostics and log of an EWS-Box: nothing that tells whose house it is."""

import json
import logging
import socket
from typing import Any

from homeassistant.config_entries import ConfigEntryDisabler
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr
from homeassistant.helpers.json import JSONEncoder
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.diagnostics import (
    async_get_config_entry_diagnostics,
    async_get_device_diagnostics,
)
from custom_components.evse_bus.evse.ews.network import line
from tests.common import (
    call,
    get_entity,
    identity,
    running,
    wait_for_state,
)
from tests.ews import HOST, charge, listening, plug_in, polled, quick_car
from tests.virtual import EwsBox, EwsCard, VirtualBus

SERIAL = "728193645508"
KNOWN_BY = f"ews_{SERIAL}"
CARD = EwsCard(
    group=7321, number=5417, name="SCHMIDT", tag=bytes.fromhex("04a1b2c3d4e5f6")
)
PRIVATE = (
    SERIAL,
    "Millers",
    "SCHMIDT",
    "04a1b2c3d4e5f6",
    "verysecret",
    "alsosecret",
    "Px7q",
    "Erika",
    "Mustermann",
    "Heidestrasse",
    "0221 123456",
    HOST,
)
"""What nobody else needs to know, as texts."""


def private_box(**options: object) -> EwsBox:
    """Return a box that knows a lot about its owner."""
    box = EwsBox(serial=SERIAL, rfid=True, cars=(quick_car(),), **options)  # type: ignore[arg-type]
    box.system.admin_password = b"verysecret".ljust(12, b"\0")
    box.system.card_pin = b"Px7q"
    box.user.user_password = b"alsosecret".ljust(12, b"\0")
    return box


def texts(data: Any) -> list[str]:  # noqa: ANN401 - JSON
    """Return all texts of diagnostics, frames also as what they say."""
    if isinstance(data, dict):
        found = [str(key) for key in data]
        found += [bytes.fromhex(data["hex"]).decode("latin-1")] if "hex" in data else []
        return found + [text for value in data.values() for text in texts(value)]
    if isinstance(data, list):
        return [text for value in data for text in texts(value)]
    return [str(data)]


def assert_private(data: object, *more: str) -> dict[str, Any]:
    """Return data as it is downloaded, which tells nothing that is private."""
    whole = json.dumps(data, cls=JSONEncoder, allow_nan=False)
    told: dict[str, Any] = json.loads(whole)
    values = texts(told)
    everything = "\n".join([whole, *values])
    for one in (*PRIVATE, *more, CARD.group, CARD.number):
        if isinstance(one, int):
            assert str(one) not in values
            continue
        assert one not in everything, one
        # As it passes on the wire.
        assert one.encode().hex() not in everything, one
    assert CARD.user()[:4].hex() not in everything
    return told


async def live(
    hass: HomeAssistant, entry: MockConfigEntry, bus: VirtualBus, box: EwsBox
) -> None:
    """Let somebody charge with a card, and let all that is stored be read."""
    switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
    status = await get_entity(hass, "sensor", entry, "1_status")
    await plug_in(bus, box)
    box.press_key(1, 1)
    box.present_card(CARD)
    asked = await get_entity(hass, "binary_sensor", entry, "1_start_requested")
    await wait_for_state(hass, asked, "on")
    await call(hass, "switch.turn_on", switch)
    await wait_for_state(hass, status, "charging")
    registry = dr.async_get(hass)
    device = registry.async_get_device_by_identifier(
        (DOMAIN, identity(entry)), entry.entry_id
    )
    assert device is not None
    read = {
        name
        for name in hass.services.async_services_for_domain(DOMAIN)
        if name.startswith("read_")
    }
    assert len(read) > 1
    for name in sorted(read):
        await hass.services.async_call(
            DOMAIN,
            name,
            {
                "device_id": device.id,
                **({"block": "network"} if "param" in name else {}),
            },
            blocking=True,
            return_response=True,
        )
    await polled(bus, box)


async def all_diagnostics(
    hass: HomeAssistant, entry: MockConfigEntry
) -> dict[str, dict[str, Any]]:
    """Return what is downloaded of the entry and of each of its devices."""
    everything = {"entry": await async_get_config_entry_diagnostics(hass, entry)}
    registry = dr.async_get(hass)
    devices: list[dr.DeviceEntry | dr.ChildDeviceEntry] = list(
        dr.async_entries_for_config_entry(registry, "bus")
    )
    for port in (1, 2):
        child = registry.async_get_child_device_by_identifier(
            (DOMAIN, f"{KNOWN_BY}_{port}"), "bus"
        )
        assert child is not None
        devices.append(child)
    for device in devices:
        (key,) = (key for _, key in device.identifiers)
        everything[key] = await async_get_device_diagnostics(hass, entry, device)
    return everything


async def test_nothing_private_on_a_port(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    box = private_box()
    async with running(hass, box, title="Box of the Millers") as (entry, bus):
        await live(hass, entry, bus, box)
        told = {
            key: assert_private(data, bus.url)
            for key, data in (await all_diagnostics(hass, entry)).items()
        }
        assert set(told) == {"entry", "bus", KNOWN_BY, f"{KNOWN_BY}_1", f"{KNOWN_BY}_2"}

        # And yet there is all that helps to find a fault.
        whole = told["entry"]
        assert whole["line"]["settings"] == "115200 8N1"
        assert whole["bus"]["connected"] is True
        one, two = whole["chargers"]
        assert one["reading"]["connectors"]["1"]["raw_state"] == "0x40"
        assert one["orders"]["allowed"] is True
        assert two["reading"]["connectors"]["2"]["raw_state"] == "0x00"
        assert one["info"]["firmware"] == "M165300103"
        assert one["limits"]["reported"] == 32
        commands = [bytes.fromhex(frame["hex"])[4:6] for frame in whole["frames"]]
        assert {b"id", b"rs", b"rc", b"rd", b"sl", b"st"} <= set(commands)
    assert_log_private(caplog)


def assert_log_private(caplog: pytest.LogCaptureFixture) -> None:
    """Check what we have said ourselves; what Home Assistant says is its own."""
    ours = "\n".join(
        record.getMessage() for record in caplog.records if DOMAIN in record.name
    )
    assert ours
    for one in PRIVATE:
        # What the user calls it is said to the user.
        if one != "Millers":
            assert one not in ours, one


async def test_one_that_is_disabled_tells_how_it_is_set_up(
    hass: HomeAssistant, device_registry: dr.DeviceRegistry
) -> None:
    entry = MockConfigEntry(
        domain=DOMAIN,
        data={"protocol": "ews_network", "host": HOST, "port": 4712},
        disabled_by=ConfigEntryDisabler.USER,
    )
    entry.add_to_hass(hass)
    device = device_registry.async_get_or_create(
        config_entry_id=entry.entry_id, identifiers={(DOMAIN, entry.entry_id)}
    )
    set_up = {"protocol": "ews_network", "host": "**REDACTED**", "port": 4712}
    for told in (
        await async_get_config_entry_diagnostics(hass, entry),
        await async_get_device_diagnostics(hass, entry, device),
    ):
        assert told == {"set_up": set_up}


async def test_each_device_tells_of_itself(hass: HomeAssistant) -> None:
    box = private_box()
    async with running(hass, box) as (entry, _):
        await get_entity(hass, "sensor", entry, "2_status")
        await hass.async_block_till_done()
        told = await all_diagnostics(hass, entry)

        def addresses(key: str) -> list[int]:
            data = told[key]
            chargers = data.get("chargers") or [data["charger"]]
            return [one["config"]["address"] for one in chargers]

        assert addresses(f"{KNOWN_BY}_1") == [1]
        assert addresses(f"{KNOWN_BY}_2") == [2]
        assert addresses(KNOWN_BY) == addresses("bus") == [1, 2]


@pytest.mark.usefixtures("socket_enabled")
async def test_nothing_private_over_the_network(
    hass: HomeAssistant,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(line, "ANSWER_PATIENCE", 1.0)
    caplog.set_level(logging.DEBUG)
    box = private_box()
    async with listening(
        hass, box, allowed=("127.0.0.0/8",), title="Box of the Millers"
    ) as (entry, (dialler,)):
        await live(hass, entry, dialler, box)
        # One connection ends, one dies, and somebody does not say who he is.
        status = await get_entity(hass, "sensor", entry, "1_status")
        dialler.hang_up(redial=False)
        await wait_for_state(hass, status, "unavailable")
        dialler.dial()
        await wait_for_state(hass, status, "charging")
        dialler.vanish(redial=False)
        await wait_for_state(hass, status, "unavailable")
        with socket.create_connection((HOST, entry.data["port"])) as nobody:
            nobody.sendall(b"x" * 10_000)
            statistics = entry.runtime_data.connections.listener.statistics
            await dialler.wait_for_async(lambda: statistics.unidentified)
        assert "was not identified" in caplog.text
        dialler.dial()
        await wait_for_state(hass, status, "charging")
        await polled(dialler, box)
        told = {
            key: assert_private(data)
            for key, data in (await all_diagnostics(hass, entry)).items()
        }
        whole = told["entry"]
        assert whole["listener"]["networks_allowed"] == 1
        assert whole["listener"]["accepted"] >= 2
        (connected,) = whole["boxes"]
        assert connected["bus"]["connected"] is True
        assert connected["frames"]
        assert told[f"{KNOWN_BY}_2"]["frames"]
    assert_log_private(caplog)


async def test_a_listener_with_nobody(
    hass: HomeAssistant, socket_enabled: None
) -> None:
    assert socket_enabled is None
    async with listening(hass) as (entry, _):
        told = assert_private(await async_get_config_entry_diagnostics(hass, entry))
        assert told["boxes"] == told["chargers"] == []
        assert told["listener"]["accepted"] == 0


async def test_a_bad_line_tells_nothing_private(hass: HomeAssistant) -> None:
    """Answers cut, damaged and delivered in lumps."""
    box = private_box()
    async with running(hass, box) as (entry, bus):
        await charge(hass, entry, bus, box)
        box.present_card(CARD)
        for _ in range(8):
            box.faults.once("corrupt")
            box.faults.once("truncate")
        log = entry.runtime_data.bus.wire.frames

        def unreadable() -> int:
            return sum(frame.direction == "unreadable" for frame in log)

        await bus.wait_for_async(lambda: unreadable() > 3, timeout=30)
        assert_private(await async_get_config_entry_diagnostics(hass, entry))
