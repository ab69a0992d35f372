"""The port of a bus: what can be wrong with it, and how it is changed."""

import errno
import fcntl
import os
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from homeassistant.data_entry_flow import FlowResultType
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.config_flow import EvseBusConfigFlow
from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.protocols import PROTOCOLS, protocols_by_make
from custom_components.evse_bus.flows.listener import ListenerOptionsFlow
from custom_components.evse_bus.flows.search import is_same_port
from custom_components.evse_bus.flows.subentry import ChargerSubentryFlow
from tests.flow import IMPOSED, NOWHERE, charger, english, port_step
from tests.virtual import (
    EvboxChargePoint,
    VirtualBus,
)

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant


pytestmark = pytest.mark.usefixtures("not_set_up", "quick_search")


OPEN = "custom_components.evse_bus.evse.line.create_serial_connection"


@pytest.mark.real_time
async def test_port_errors_are_told_apart(hass: HomeAssistant, tmp_path: Path) -> None:
    with VirtualBus.pty() as bus:
        flow = await port_step(hass, "evbox", NOWHERE)
        assert flow.errors == {"base": "port_missing"}

        other = os.open(bus.url, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(other, fcntl.LOCK_EX)
        await flow.submit({"device": bus.url, "line": {}})
        assert flow.errors == {"base": "port_busy"}
        os.close(other)

        no_port = tmp_path / "no_port"
        no_port.touch()
        await flow.submit({"device": str(no_port), "line": {}})
        assert flow.errors == {"base": "port_settings"}

        await flow.submit({"device": "socket://nothing", "line": {}})
        assert flow.errors == {"base": "port_settings"}

        await flow.submit({"device": " ", "line": {}})
        assert flow.errors == {"device": "no_port"}

        await flow.submit({"device": bus.url, "line": {"baudrate": "nan"}})
        assert flow.errors == {"base": "bad_line_settings"}

        await flow.submit({"device": bus.url, "line": {"reply_timeout": "nan"}})
        assert flow.errors == {"base": "bad_line_settings"}

        await flow.submit({"device": bus.url, "line": {}})
        assert flow.step == "impose"
        await bus.wait_for_async(lambda: not bus.connected)
        flow.abort()


@pytest.mark.parametrize(
    ("error", "key"),
    [
        (PermissionError(errno.EACCES, "not yours"), "port_permission"),
        (OSError(errno.EMFILE, "too many open files"), "cannot_open"),
        (RuntimeError("a library's own"), "unknown"),
    ],
)
async def test_port_errors_that_only_a_kernel_can_make(
    hass: HomeAssistant,
    error: Exception,
    key: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with patch(OPEN, side_effect=error):
        flow = await port_step(hass, "evbox", NOWHERE)
    assert flow.errors == {"base": key}
    if key != "port_permission":
        assert str(error) in caplog.text
    flow.abort()


@pytest.mark.usefixtures("socket_enabled")
async def test_network_port_that_nobody_serves(hass: HomeAssistant) -> None:
    with VirtualBus.tcp() as bus:
        url = bus.url
    flow = await port_step(hass, "evbox", url)
    assert flow.errors == {"base": "port_missing"}
    flow.abort()


@pytest.mark.real_time
@pytest.mark.usefixtures("socket_enabled")
async def test_bus_on_a_network_port(hass: HomeAssistant) -> None:
    with VirtualBus.tcp(EvboxChargePoint(42)) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_addresses")
        await flow.submit(IMPOSED | {"serial_numbers": ["42"]})
        await flow.wait()
        await flow.submit({"chargers": ["42"], "installation_limit": 16})
        await flow.submit(charger("Box", fail_safe_timeout=60))
        await flow.submit()
    entry = flow.result["result"]
    assert entry.title == f"EVBox bus ({bus.url.split('//')[1]})"


async def test_overrides_are_stored_and_used(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop() as bus:
        flow = await port_step(
            hass, "evbox", bus.url, baudrate=19200, parity="e", stop_bits="2"
        )
        await flow.choose("manual")
        await flow.submit({"serial_numbers": ["42"]})
        await flow.submit(charger("Box", fail_safe_timeout=60))
        await flow.submit()
    assert flow.result["result"].data == {
        "protocol": "evbox",
        "device": bus.url,
        "baudrate": 19200,
        "parity": "E",
        "stop_bits": 2,
    }


async def test_one_port_is_one_bus(hass: HomeAssistant, tmp_path: Path) -> None:
    with VirtualBus.in_loop() as bus:
        MockConfigEntry(
            domain=DOMAIN, data={"protocol": "abl", "device": bus.url}
        ).add_to_hass(hass)
        flow = await port_step(hass, "evbox", bus.url)
        assert flow.result["reason"] == "already_configured"

        # Neither is it another one by another name.
        link = tmp_path / "usb-adapter"
        link.symlink_to(bus.url)
        flow = await port_step(hass, "evbox", str(link))
        assert flow.result["type"] is FlowResultType.ABORT
        assert flow.result["reason"] == "already_configured"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("socket://gw:4001", "socket://GW.local.:4001"),
        ("socket://gw:4001", "socket://gw:4001/"),
        ("socket://gw.local:4001", "rfc2217://gw:4001"),
        ("socket://192.0.2.5:4001", "RFC2217://192.0.2.5:4001/"),
        ("socket://[2001:db8::1]:4001", "socket://[2001:DB8:0::1]:4001"),
    ],
)
async def test_network_port_in_two_spellings_is_one_port(
    hass: HomeAssistant, one: str, other: str
) -> None:
    for first, second in ((one, other), (other, one)):
        entry = MockConfigEntry(
            domain=DOMAIN, data={"protocol": "abl", "device": first}
        )
        entry.add_to_hass(hass)
        flow = await port_step(hass, "evbox", second)
        assert flow.result["type"] is FlowResultType.ABORT
        assert flow.result["reason"] == "already_configured"
        await hass.config_entries.async_remove(entry.entry_id)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("socket://gw:4001", "socket://gw:4002"),
        ("socket://gw:4001", "socket://gw2:4001"),
        ("socket://gw:bad", "socket://gw:worse"),
        ("esphome://gw/?port_name=A", "esphome://gw/?port_name=B"),
    ],
)
def test_other_addresses_are_other_ports(one: str, other: str) -> None:
    assert not is_same_port(one, other)


@pytest.mark.usefixtures("not_set_up")
async def test_two_dialogues_for_one_port_in_two_spellings(
    hass: HomeAssistant,
) -> None:
    with patch("custom_components.evse_bus.config_flow.async_try_port") as tried:
        tried.return_value = None
        flows = [
            await port_step(hass, "evbox", url)
            for url in ("socket://gw:4001", "rfc2217://GW.local:4001/")
        ]
        for flow, serial in zip(flows, ("42", "43"), strict=True):
            await flow.choose("manual")
            await flow.submit({"serial_numbers": [serial]})
            await flow.submit(charger("Box", fail_safe_timeout=60))
            await flow.submit()
    assert flows[0].result["type"] is FlowResultType.CREATE_ENTRY
    assert flows[1].result["reason"] == "already_configured"


async def test_another_network_port_is_another_bus(hass: HomeAssistant) -> None:
    MockConfigEntry(
        domain=DOMAIN, data={"protocol": "abl", "device": "socket://192.0.2.5:1"}
    ).add_to_hass(hass)
    flow = await port_step(hass, "evbox", NOWHERE)
    assert flow.errors == {"base": "port_missing"}
    flow.abort()


def test_every_text_belongs_to_a_step() -> None:
    confirm = {f"confirm_{key}" for key in PROTOCOLS}
    menus = {one.make.menu for one in PROTOCOLS.values()} - {""}
    for texts, flow, own in (
        (english()["config"], EvseBusConfigFlow, confirm | menus),
        (english()["config_subentries"]["charger"], ChargerSubentryFlow, confirm),
        (english()["options"], ListenerOptionsFlow, set()),
    ):
        assert own <= texts["step"].keys()
        for step in texts["step"].keys() - own:
            assert hasattr(flow, f"async_step_{step}")


def test_protocols_say_how_they_use_the_line() -> None:
    labels = english()["selector"]["protocol"]["options"]
    makes = protocols_by_make()
    assert labels.keys() == makes.keys()
    for make, protocols in makes.items():
        for protocol in protocols:
            assert str(protocol.settings) in labels[make]
