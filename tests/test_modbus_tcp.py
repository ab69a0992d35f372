"""An adapter that speaks Modbus TCP: the flow names it, and so does a repair issue."""

from homeassistant.core import HomeAssistant
from homeassistant.helpers import issue_registry as ir
import pytest

from custom_components.evse_bus.const import DOMAIN
from tests.common import charger_of, get_entity, setup_bus, wait_for_state, wait_until
from tests.evse.simulated_line import until
from tests.flow import (
    IMPOSED,
    Flow,
    english,
    ews_step,
    port_step,
    smartevse_step,
)
from tests.virtual import AblBox, EvboxChargePoint, SmartEvse, VirtualBus
from tests.virtual.adapter import GatewayKind, ModbusTcpGateway
from tests.virtual.device import Device
from tests.virtual.ews_box import EwsBox

pytestmark = pytest.mark.usefixtures("quick_search")

KINDS: list[GatewayKind] = ["silent", "closes", "answers"]


async def searched(hass: HomeAssistant, protocol: str, url: str) -> Flow:
    """Return the flow of a bus after its search."""
    if protocol == "smartevse":
        flow = await smartevse_step(hass, "polled", url)
    elif protocol == "ews":
        flow = await ews_step(hass, "ews_serial", url)
    else:
        flow = await port_step(hass, protocol, url)
    if protocol == "evbox":
        await flow.choose("search_single")
        await flow.submit(IMPOSED | {"command": "68"})
    return await flow.wait()


async def reported(hass: HomeAssistant) -> None:
    """Wait until there is an issue."""
    await until(lambda: bool(ir.async_get(hass).issues), 120)


BOXES: dict[str, type[Device]] = {
    "abl": AblBox,
    "evbox": EvboxChargePoint,
    "smartevse": SmartEvse,
    "ews": EwsBox,
}


def box_of(protocol: str) -> Device:
    if protocol == "evbox":
        return EvboxChargePoint("01923054", min_interval=1)
    return AblBox(1) if protocol == "abl" else BOXES[protocol]()


@pytest.mark.parametrize("protocol", list(BOXES))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("not_set_up")
async def test_the_flow_names_it(
    hass: HomeAssistant, protocol: str, kind: GatewayKind
) -> None:
    with VirtualBus.in_loop(box_of(protocol), network=True) as bus:
        bus.adapter.gateway = ModbusTcpGateway(kind)
        flow = await searched(hass, protocol, bus.url)
        assert flow.step == "modbus_tcp"
        assert flow.tells(bus.url, "transparent mode")
        assert "port" in flow.result["menu_options"]
        # Set to transparent mode, the same search finds the box.
        bus.adapter.gateway = None
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


@pytest.mark.usefixtures("not_set_up")
async def test_one_that_never_answers_is_a_hint(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(1), network=True) as bus:
        bus.adapter.gateway = ModbusTcpGateway("mute")
        flow = await searched(hass, "abl", bus.url)
        assert flow.step == "nothing_found"
        assert flow.tells("transparent mode")
        flow.abort()


@pytest.mark.parametrize("kind", KINDS)
async def test_a_running_bus_reports_it(hass: HomeAssistant, kind: GatewayKind) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box, network=True) as bus:
        bus.adapter.gateway = ModbusTcpGateway(kind)
        entry = await setup_bus(hass, "abl", bus.url, charger_of(box), title="Yard")
        issues = ir.async_get(hass)
        await reported(hass)
        [issue] = issues.issues.values()
        assert issue.domain == DOMAIN
        text = english()["issues"][issue.translation_key]
        placeholders = issue.translation_placeholders or {}
        assert "Yard" in text["title"].format(**placeholders)
        assert bus.url in text["description"].format(**placeholders)

        bus.adapter.gateway = None
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        await wait_until(hass, lambda: not issues.issues)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_removing_the_bus_removes_the_report(hass: HomeAssistant) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box, network=True) as bus:
        bus.adapter.gateway = ModbusTcpGateway("answers")
        entry = await setup_bus(hass, "abl", bus.url, charger_of(box))
        issues = ir.async_get(hass)
        await reported(hass)
        await hass.config_entries.async_remove(entry.entry_id)
        assert not issues.issues
