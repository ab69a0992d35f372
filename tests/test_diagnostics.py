"""Diagnostics: enough to find a fault, nothing that tells whose house it is."""

from collections.abc import Mapping
from datetime import datetime
import json
from typing import Any

from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr
from homeassistant.helpers.json import JSONEncoder
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.diagnostics import (
    async_get_config_entry_diagnostics,
    async_get_device_diagnostics,
)
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests.common import call, get_entity, running, wait_for_state, wait_until
from tests.virtual import AblBox, EvboxChargePoint, SmartEvse


def texts(data: object) -> list[str]:
    """Return all strings in diagnostics, frames also as what they say."""
    if isinstance(data, Mapping):
        found = [str(key) for key in data]
        found += [bytes.fromhex(data["hex"]).decode("latin-1")] if "hex" in data else []
        return found + [text for value in data.values() for text in texts(value)]
    if isinstance(data, list):
        return [text for value in data for text in texts(value)]
    return [str(data)]


async def diagnostics(hass: HomeAssistant, entry: Any) -> dict[str, Any]:  # noqa: ANN401 - a mock's entry
    """Return diagnostics as they are downloaded."""
    data = await async_get_config_entry_diagnostics(hass, entry)
    return json.loads(json.dumps(data, cls=JSONEncoder, allow_nan=False))


async def test_abl(hass: HomeAssistant) -> None:
    box = AblBox(1, serial="2W22xy01234567")
    async with running(hass, box, title="Wallbox of the Millers") as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=10)
        data = await diagnostics(hass, entry)

        everything = "\n".join(texts(data))
        assert "Millers" not in everything
        assert bus.url not in everything
        assert box.serial not in everything
        # As it passes on the wire: hex digits of its characters.
        assert box.serial.encode().hex().upper() not in everything

        assert data["line"]["settings"] == "38400 8E1"
        assert data["bus"]["connected"] is True
        assert data["bus"]["requests"] > 0
        charger = data["chargers"][0]
        assert charger["config"]["address"] == 1
        assert charger["orders"]["limit"]["current"] == 10
        assert charger["reading"]["connectors"]["1"]["raw_state"] == "A1"
        assert charger["statistics"]["replies"] > 0
        assert charger["info"]["serial"] == "**REDACTED**"
        frames = data["frames"]
        assert {frame["direction"] for frame in frames} == {"in", "out"}
        assert datetime.fromisoformat(frames[0]["time"]).tzinfo
        assert b":010300010002F9\r\n".hex() in {frame["hex"] for frame in frames}


async def test_evbox(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 2, min_interval=0)
    async with running(hass, box, poll_interval=0.5) as (entry, _):
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        data = await diagnostics(hass, entry)
        everything = "\n".join(texts(data))
        # Its address is its serial number.
        assert "1923054" not in everything
        assert data["chargers"][0]["config"]["address"] == "**REDACTED**"
        assert data["chargers"][0]["reading"]["connectors"].keys() == {"1", "2"}


async def test_smartevse(hass: HomeAssistant) -> None:
    box = SmartEvse("2.30+", serial=0x7A69)
    async with running(hass, box) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status")
        await wait_until(hass, lambda: entry.subentries["smartevse1"].data["serial"])
        data = await diagnostics(hass, entry)
        charger = data["chargers"][0]
        assert charger["config"]["address"] == 1
        assert charger["info"]["firmware"] == "2.30, development version"
        assert charger["reading"]["details"]["dialect"] == "2.30+"
        assert charger["config"]["serial"] == "**REDACTED**"
        assert data["master"] is None
        frames = [frame["hex"] for frame in data["frames"]]
        # The status block is there, but for the number and for what it adds up to.
        assert any(frame.endswith(b"****".hex()) for frame in frames)
        assert str(0x7A69) not in "\n".join(texts(data))
        assert not any("7a69" in frame for frame in frames)


async def test_a_bus_with_a_master(hass: HomeAssistant) -> None:
    box = SmartEvse(load_balance=2)
    async with running(hass, box, supply={"supply_limit": 14.0}) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        await bus.wait_for_async(lambda: box.broadcasts)
        data = await diagnostics(hass, entry)
        assert data["set_up"]["supply_limit"] == 14.0
        master = data["master"]
        assert master["supply"] == {"limit": 14.0, "minimum": 6.0}
        assert master["order"] == {"limit": None}
        assert master["shares"] == {"2": 6.0}
        assert master["silent"] is False
        assert master["noticed"] == []
        assert master["statistics"]["missed_deadlines"] >= 0
        assert data["chargers"][0]["reading"]["details"]["load_balancing"] == 2


async def test_a_charger_that_never_answered(hass: HomeAssistant) -> None:
    """No reading, no minimum of anything: JSON has no infinity."""
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        bus.remove(box)
        await hass.config_entries.async_reload(entry.entry_id)
        data = await diagnostics(hass, entry)
        assert data["chargers"][0]["reading"] is None
        assert data["chargers"][0]["statistics"]["round_trip_min"] is None


async def test_of_one_device(hass: HomeAssistant) -> None:
    one, two = AblBox(1), AblBox(2, serial="2W22xy00000002")
    async with running(hass, one, two) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status", index=1)
        find = dr.async_get(hass).async_get_device_by_identifier
        device = find((DOMAIN, f"abl_{two.serial}"), "bus")
        data = await async_get_device_diagnostics(hass, entry, device)
        assert data["charger"]["config"]["address"] == 2
        data = await async_get_device_diagnostics(
            hass, entry, find((DOMAIN, "bus"), "bus")
        )
        assert len(data["chargers"]) == 2


@pytest.mark.parametrize(
    ("protocol", "data", "shown"),
    [
        # What is cut off or damaged is logged too.
        ("evbox", b"\x0280A06801923054000", b"\x0280A068********000"),
        ("evbox", b"\x0280A069003C003C003C", b"\x0280A069003C003C003C"),
        (
            "abl",
            b">010310500032573232787930313233343536",
            b">01031050" + b"*" * 28,
        ),
        ("evbox", b"\x0280A06801", b"\x0280A068**"),
        ("abl", b">010310503257", b">01031050****"),
        ("abl", b">01030A2EA1106403E803E803E8EE", b">01030A2EA1106403E803E803E8EE"),
        # Twelve registers, the last one is it; the checksum would tell, too.
        (
            "smartevse",
            b"\1\4\x18" + b"\0" * 22 + b"ziCC",
            b"\1\4\x18" + b"\0" * 22 + b"****",
        ),
        ("smartevse", b"\1\4\x18" + b"\n" * 22 + b"z", b"\1\4\x18" + b"\n" * 22 + b"*"),
        (
            "smartevse",
            b"\0\4\x12" + b"\0" * 18 + b"CC",
            b"\0\4\x12" + b"\0" * 18 + b"CC",
        ),
        ("smartevse_master", b"\0\x10\0\1zi", b"\0\x10\0\1zi"),
    ],
)
def test_serial_numbers_in_frames(protocol: str, data: bytes, shown: bytes) -> None:
    assert PROTOCOLS[protocol].serials.hide(data) == shown


@pytest.mark.parametrize(
    ("protocol", "data", "shown"),
    [
        # Read in two lumps: the second one begins in the middle.
        ("evbox", b"923054003C\x03", b"********3C\x03"),
        ("abl", b"3233343536AE\r\n", b"************\r\n"),
        ("evbox", b"\x02A08069", b"\x02A08069"),
        # Another command was made of 68 on the way.
        ("evbox", b"\x02A0804801923054", b"\x02A08048********"),
        ("abl", b">0103105132573232AE", b">01031051********AE"),
        ("smartevse", b"\0\0ziCC", b"\0\0**CC"),
    ],
)
def test_serial_numbers_in_pieces(protocol: str, data: bytes, shown: bytes) -> None:
    known = {"evbox": b"01923054", "abl": b"32573232", "smartevse": b"zi"}
    serials = PROTOCOLS[protocol].serials
    assert serials.hide(data, [known[protocol]], whole=False) == shown


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_serial_numbers_that_are_none(protocol: str) -> None:
    assert PROTOCOLS[protocol].serials.encoded([None, ""]) == []


@pytest.mark.parametrize("serial", ["0", "65536", "x", "-1", "1.5"])
def test_what_is_no_register_is_no_serial_number(serial: str) -> None:
    serials = PROTOCOLS["smartevse"].serials
    assert serials.encoded([serial, "31337"]) == [b"zi"]


@pytest.mark.parametrize("protocol", ["abl", "evbox"])
async def test_a_bad_line_tells_no_serial_number(
    hass: HomeAssistant, protocol: str
) -> None:
    """Answers cut, damaged and delivered in lumps."""
    box = (
        AblBox(1, serial="2W22xy01234567")
        if protocol == "abl"
        else EvboxChargePoint(1923054, 2, min_interval=0)
    )
    async with running(hass, box, poll_interval=0.2) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_current_l1")
        for _ in range(2):
            box.faults.once("corrupt")
            box.faults.once("truncate")
        log = entry.runtime_data.bus.wire.frames

        def unreadable() -> int:
            return sum(frame.direction == "unreadable" for frame in log)

        await bus.wait_for_async(unreadable, timeout=20)
        data = await diagnostics(hass, entry)
        everything = "\n".join(texts(data["frames"]))
        assert "1923054" not in everything
        assert box.serial.encode().hex().upper() not in everything
