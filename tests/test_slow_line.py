"""A line too slow for its protocol: the flow says so before, a repair issue after."""

from homeassistant.core import HomeAssistant
from homeassistant.helpers import issue_registry as ir
import pytest

from tests.common import charger_of, get_entity, setup_bus, wait_for_state
from tests.evse.simulated_line import until
from tests.flow import IMPOSED, Flow, charger, english, port_step, smartevse_step
from tests.virtual import AblBox, EvboxChargePoint, SmartEvse, VirtualBus

pytestmark = pytest.mark.usefixtures("quick_search")

SERIALS = range(1000, 1004)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for searches on slow lines; the time is simulated."""
    monkeypatch.setattr("tests.flow.PATIENCE", 900.0)
    monkeypatch.setattr("tests.common.PATIENCE", 900.0)


def evboxes() -> list[EvboxChargePoint]:
    return [EvboxChargePoint(f"{one:08d}", min_interval=1) for one in SERIALS]


def issue_text(hass: HomeAssistant) -> tuple[str, str] | None:
    """Return the key and text of the one issue, if there is one."""
    found = list(ir.async_get(hass).issues.values())
    if not found:
        return None
    [issue] = found
    text = english()["issues"][issue.translation_key]["description"]
    placeholders = issue.translation_placeholders or {}
    return str(issue.translation_key), text.format(**placeholders)


def slow(bus: VirtualBus, each_way: float) -> None:
    bus.adapter.delay_out = bus.adapter.delay_in = each_way


async def four_evboxes(hass: HomeAssistant, bus: VirtualBus, fallback: int) -> Flow:
    """Return the flow of a bus with four boxes, after the last of their forms."""
    flow = await port_step(hass, "evbox", bus.url)
    await flow.choose("search_addresses")
    serials = [str(one) for one in SERIALS]
    await flow.submit(IMPOSED | {"serial_numbers": serials})
    await flow.wait()
    assert flow.step == "select"
    await flow.submit({"chargers": serials, "installation_limit": 16})
    for serial in serials:
        await flow.submit(charger(serial, fail_safe_timeout=fallback))
    return flow


@pytest.mark.usefixtures("not_set_up")
@pytest.mark.parametrize(("fallback", "warns"), [(15, True), (60, False)])
async def test_the_flow_warns_before_the_bus_is_added(
    hass: HomeAssistant,
    fallback: int,
    warns: bool,  # noqa: FBT001
) -> None:
    with VirtualBus.in_loop(*evboxes()) as bus:
        slow(bus, 1.5)
        flow = await four_evboxes(hass, bus, fallback)
        if warns:
            assert flow.step == "line_too_slow"
            assert flow.tells("about 3.", "within 15 s")
            await flow.reload()
            assert flow.step == "line_too_slow"
            await flow.submit()
        assert flow.step == "confirm_evbox"
        await flow.submit()
        assert len(flow.result["result"].subentries) == len(SERIALS)


@pytest.mark.usefixtures("not_set_up")
async def test_a_fast_line_is_not_warned_of(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(*evboxes()) as bus:
        flow = await four_evboxes(hass, bus, 15)
        assert flow.step == "confirm_evbox"
        flow.abort()


@pytest.mark.usefixtures("not_set_up")
async def test_replies_that_come_too_late_are_no_silence(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(3)) as bus:
        slow(bus, 2.0)
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "replies_too_late"
        assert flow.tells("about 4.0 s", "3 s at most")
        flow.abort()


@pytest.mark.usefixtures("not_set_up")
async def test_replies_that_come_too_late_for_a_master(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(SmartEvse(load_balance=2)) as bus:
        slow(bus, 0.5)
        flow = await smartevse_step(hass, "master", bus.url)
        await flow.submit({"supply_limit": 16, "supply_minimum": 6})
        await flow.wait()
        assert flow.step == "replies_too_late"
        flow.abort()


async def test_a_running_bus_reports_deadlines_that_it_cannot_keep(
    hass: HomeAssistant,
) -> None:
    boxes = evboxes()
    with VirtualBus.in_loop(*boxes) as bus:
        chargers = [charger_of(one, fail_safe_timeout=15) for one in boxes]
        entry = await setup_bus(hass, "evbox", bus.url, *chargers)
        for index in range(len(boxes)):
            await get_entity(hass, "number", entry, "charging_current", index=index)
        assert issue_text(hass) is None

        slow(bus, 1.5)
        await until(lambda: issue_text(hass))
        key, text = issue_text(hass) or ("", "")
        assert key == "line_too_slow"
        assert "within 15 s" in text

        slow(bus, 0.1)
        await until(lambda: issue_text(hass) is None)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_running_bus_reports_replies_that_come_too_late(
    hass: HomeAssistant,
) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger_of(box))
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")

        slow(bus, 2.0)
        await until(lambda: issue_text(hass))
        key, text = issue_text(hass) or ("", "")
        assert key == "replies_too_late"
        assert "3 s at most" in text
        await wait_for_state(hass, status, "unavailable")

        slow(bus, 0.1)
        await wait_for_state(hass, status, "available")
        await until(lambda: issue_text(hass) is None)
        await hass.config_entries.async_unload(entry.entry_id)
