"""A listener for EWS-Boxes, as a person adds and changes it in the frontend."""

from collections.abc import Iterator
import socket
from typing import TYPE_CHECKING
from unittest.mock import Mock, patch

from homeassistant.config_entries import ConfigEntryState
from homeassistant.data_entry_flow import FlowResultType
from homeassistant.exceptions import HomeAssistantError
import pytest

from tests.common import bus_entry, free_port, wait_until
from tests.flow import Flow, ews_step, fields
from tests.listening import (
    HOST,
    OTHER,
    SERIAL,
    dialling,
    listener_of,
    listening,
    stored_box,
)

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("socket_enabled")

ADAPTERS = "homeassistant.components.network.util.ifaddr.get_adapters"
SOURCE = "homeassistant.components.network.async_get_source_ip"
OFFERED = "custom_components.evse_bus.flows.listener._SUGGESTED"
NOT_OURS = "192.0.2.9"


def adapter(name: str, *addresses: str) -> Mock:
    made = [
        Mock(is_IPv6=":" in one, ip=(one, 0, 0) if ":" in one else one)
        for one in addresses
    ]
    for one in made:
        one.network_prefix = 24
    return Mock(nice_name=name, ips=made, index=1)


@pytest.fixture(autouse=True)
def adapters() -> Iterator[None]:
    """Let the machine be reached by an address that can be used in tests."""
    made = [
        adapter("lo", HOST, "127.0.0.2"),
        adapter("eth1", NOT_OURS, "2001:db8::9"),
    ]
    with patch(ADAPTERS, return_value=made), patch(SOURCE, return_value=HOST):
        yield


async def listen_step(hass: HomeAssistant) -> Flow:
    flow = await ews_step(hass, "ews_network")
    assert flow.step == "listen"
    return flow


# -- Adding ------------------------------------------------------------------------


async def test_listener_runs_before_there_is_any_box(hass: HomeAssistant) -> None:
    with socket.create_server((HOST, 0)) as somebody:
        # The first port that would be offered is in use.
        first = somebody.getsockname()[1]
        with patch(OFFERED, range(first, first + 100)):
            flow = await listen_step(hass)
        assert flow.tells("no password", "no encryption")
        offered = fields(flow)
        assert offered["host"] == HOST
        assert first < offered["port"] < first + 100
        [host, *_] = flow.result["data_schema"].schema.values()
        # Boxes know no IPv6, and dial nobody inside of this machine.
        assert host.config["options"] == [
            {"value": HOST, "label": f"{HOST} (lo)"},
            {"value": NOT_OURS, "label": f"{NOT_OURS} (eth1)"},
        ]
        port = offered["port"]
        await flow.submit({"host": f" {HOST} ", "port": port})
    assert flow.result["type"] is FlowResultType.CREATE_ENTRY
    assert flow.tells(f"{HOST}, port {port}", "Discovered")
    entry = flow.result["result"]
    assert entry.title == f"EWS-Boxes ({HOST}:{port})"
    assert entry.data == {"protocol": "ews_network", "host": HOST, "port": port}
    assert not entry.subentries
    await hass.async_block_till_done()
    assert entry.state is ConfigEntryState.LOADED
    with socket.create_connection((HOST, port)):
        pass
    assert await hass.config_entries.async_unload(entry.entry_id)


async def test_all_addresses_can_be_chosen_but_not_dialled(hass: HomeAssistant) -> None:
    flow = await listen_step(hass)
    await flow.submit({"host": "0.0.0.0", "port": free_port()})  # noqa: S104
    assert flow.result["type"] is FlowResultType.CREATE_ENTRY
    assert flow.tells(f"listens at {HOST}, port")
    await hass.async_block_till_done()
    entry = flow.result["result"]
    assert entry.data["host"] == "0.0.0.0"  # noqa: S104
    assert await hass.config_entries.async_unload(entry.entry_id)


async def test_machine_without_a_network_can_be_told_an_address(
    hass: HomeAssistant,
) -> None:
    with (
        patch(ADAPTERS, return_value=[]),
        patch(SOURCE, side_effect=HomeAssistantError),
    ):
        flow = await listen_step(hass)
    assert fields(flow)["host"] == ""
    flow.abort()


async def test_what_is_wrong_with_an_address_is_said(hass: HomeAssistant) -> None:
    flow = await listen_step(hass)
    port = free_port()
    with socket.create_server((HOST, 0)) as somebody:
        busy = somebody.getsockname()[1]
        for typed, errors in (
            ({"host": "homeassistant.local"}, {"host": "bad_address"}),
            ({"host": ""}, {"host": "bad_address"}),
            ({"host": NOT_OURS}, {"base": "listen_missing"}),
            ({"port": busy}, {"base": "listen_busy"}),
            ({"port": "nan"}, {"port": "bad_port"}),
            ({"port": 4712.5}, {"port": "bad_port"}),
        ):
            await flow.submit({"host": HOST, "port": port} | typed)
            assert flow.step == "listen"
            assert flow.errors == errors, typed
            if "host" in typed:
                assert fields(flow)["host"] == typed["host"]
        # Nothing was left open by trying.
        await flow.submit({"host": HOST, "port": port})
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
    await hass.async_block_till_done()
    entry = flow.result["result"]
    assert await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.parametrize(
    ("error", "key"),
    [
        (PermissionError(13, "not yours"), "listen_permission"),
        (OSError(24, "too many open files"), "cannot_listen"),
    ],
)
async def test_errors_that_only_a_kernel_can_make(
    hass: HomeAssistant, error: OSError, key: str, caplog: pytest.LogCaptureFixture
) -> None:
    flow = await listen_step(hass)
    with patch.object(hass.loop, "create_server", side_effect=error):
        await flow.submit({"host": HOST, "port": 4712})
    assert flow.errors == {"base": key}
    if key == "cannot_listen":
        # The text says that the log has the reason.
        assert "too many open files" in caplog.text
    flow.abort()


async def test_one_address_has_one_listener(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        where = {"host": HOST, "port": listener_of(entry).port}
        hass.config_entries.async_update_entry(entry, data=entry.data | where)
        await hass.async_block_till_done()
        flow = await listen_step(hass)
        await flow.submit(where)
        assert flow.result["type"] is FlowResultType.ABORT
        assert flow.result["reason"] == "already_configured"
        # It is no serial port, so it is in nobody's way there.
        flow = await ews_step(hass, "ews_serial", "/dev/serial/by-id/usb-none")
        assert flow.errors == {"base": "port_missing"}
        flow.abort()


# -- Changing ----------------------------------------------------------------------


async def test_listener_moves_to_another_port(hass: HomeAssistant) -> None:
    first, second = free_port(), free_port()
    flow = await listen_step(hass)
    await flow.submit({"host": HOST, "port": first})
    await hass.async_block_till_done()
    entry = flow.result["result"]
    with dialling(entry) as before:
        await before.wait_for_async(lambda: before.box.requests)

        flow = await Flow.change_bus(hass, entry)
        assert flow.step == "reconfigure_listen"
        assert flow.tells("new address of the server")
        assert fields(flow) == {"host": HOST, "port": first}
        await flow.submit({"host": HOST, "port": "nan"})
        assert flow.errors == {"port": "bad_port"}
        with socket.create_server((HOST, second)):
            await flow.submit({"host": HOST, "port": second})
            assert flow.errors == {"base": "listen_busy"}
        assert listener_of(entry).port == first
        await flow.submit({"host": HOST, "port": second})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.LOADED
        assert entry.data["port"] == second
        # Nobody gave it another name, so it is called by its address.
        assert entry.title == f"EWS-Boxes ({HOST}:{second})"
        await before.wait_for_async(lambda: not before.dial_port.connected)
    with dialling(entry) as after:
        await after.wait_for_async(lambda: after.box.requests)
    assert await hass.config_entries.async_unload(entry.entry_id)


async def test_same_address_again_disturbs_nobody(hass: HomeAssistant) -> None:
    async with listening(hass, stored_box(SERIAL), title="Yard") as entry:
        port = listener_of(entry).port
        where = {"host": HOST, "port": port}
        hass.config_entries.async_update_entry(entry, data=entry.data | where)
        await hass.async_block_till_done()
        running = entry.runtime_data
        with dialling(entry) as dialler:
            await wait_until(hass, lambda: running.connections.connected == 1)
            flow = await Flow.change_bus(hass, entry)
            await flow.submit(where)
            assert flow.result["reason"] == "reconfigure_successful"
            await hass.async_block_till_done()
            assert entry.runtime_data is running
            assert entry.title == "Yard"
            assert not dialler.dropped


async def test_same_port_at_all_addresses_is_not_somebody_elses(
    hass: HomeAssistant,
) -> None:
    everywhere = "0.0.0.0"  # noqa: S104
    flow = await listen_step(hass)
    port = free_port()
    await flow.submit({"host": HOST, "port": port})
    await hass.async_block_till_done()
    entry = flow.result["result"]
    flow = await Flow.change_bus(hass, entry)
    await flow.submit({"host": everywhere, "port": port})
    assert flow.result["reason"] == "reconfigure_successful"
    await hass.async_block_till_done()
    assert entry.data["host"] == everywhere
    flow = await Flow.change_bus(hass, entry)
    await flow.submit({"host": NOT_OURS, "port": port})
    assert flow.errors == {"base": "listen_missing"}
    await flow.submit({"host": HOST, "port": port})
    assert flow.result["reason"] == "reconfigure_successful"
    await hass.async_block_till_done()
    assert entry.state is ConfigEntryState.LOADED
    assert listener_of(entry).host == HOST
    assert await hass.config_entries.async_unload(entry.entry_id)


async def test_listener_that_could_not_start_is_given_another_port(
    hass: HomeAssistant,
) -> None:
    flow = await listen_step(hass)
    port = free_port()
    await flow.submit({"host": HOST, "port": port})
    await hass.async_block_till_done()
    entry = flow.result["result"]
    assert await hass.config_entries.async_unload(entry.entry_id)
    with socket.create_server((HOST, port)):
        assert not await hass.config_entries.async_setup(entry.entry_id)
        assert entry.state is ConfigEntryState.SETUP_RETRY
        flow = await Flow.change_bus(hass, entry)
        await flow.submit({"host": HOST, "port": port})
        assert flow.errors == {"base": "listen_busy"}
        await flow.submit({"host": HOST, "port": free_port()})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.LOADED
        assert await hass.config_entries.async_unload(entry.entry_id)


# -- Who may dial ------------------------------------------------------------------


async def test_restricting_ends_connections_and_reloads_nothing(
    hass: HomeAssistant,
) -> None:
    async with listening(hass, stored_box(SERIAL)) as entry:
        assert entry.supports_options
        running, listener = entry.runtime_data, listener_of(entry)
        with dialling(entry) as dialler:
            await wait_until(hass, lambda: running.connections.connected == 1)
            flow = await Flow.change_options(hass, entry)
            assert flow.step == "init"
            assert fields(flow) == {}
            await flow.submit({"allowed": ["192.0.2.0/24", " 192.0.2/24 "]})
            assert flow.errors == {"allowed": "bad_network"}
            assert flow.tells("“192.0.2/24”")
            assert fields(flow)["allowed"] == ["192.0.2.0/24", " 192.0.2/24 "]
            typed = [
                "192.0.2.77/24",
                " 192.0.2.0/24",
                "",
                "198.51.100.7",
                "2001:db8::/32",
            ]
            await flow.submit({"allowed": typed})
            assert flow.step == "excludes"
            await flow.choose("save")
            assert flow.result["type"] is FlowResultType.CREATE_ENTRY
            networks = ["192.0.2.0/24", "198.51.100.7", "2001:db8::/32"]
            assert entry.options == {"allowed": networks}
            await dialler.wait_for_async(lambda: "by the server" in dialler.dropped)
            await wait_until(hass, lambda: running.connections.connected == 0)
            attempts = dialler.attempts
            await dialler.wait_for_async(lambda: dialler.attempts > attempts + 1)
            assert running.connections.connected == 0

            flow = await Flow.change_options(hass, entry)
            assert fields(flow) == {"allowed": networks}
            await flow.submit({"allowed": [*networks, "127.0.0.0/8"]})
            await wait_until(hass, lambda: running.connections.connected == 1)

            # Without any, all may.
            flow = await Flow.change_options(hass, entry)
            await flow.submit({})
            assert entry.options == {"allowed": []}
            await hass.async_block_till_done()
            assert listener.allowed == ()
            assert running.connections.connected == 1
        assert entry.runtime_data is running
        assert listener_of(entry) is listener


async def test_networks_that_exclude_a_known_box_are_confirmed(
    hass: HomeAssistant,
) -> None:
    """A typing error would end the charge of every car."""
    yard, never = stored_box(SERIAL), {**stored_box(OTHER), "title": "Shed"}
    async with listening(hass, yard, never) as entry:
        running = entry.runtime_data
        with dialling(entry) as dialler:
            await wait_until(hass, lambda: running.connections.connected == 1)
            typed = {"allowed": ["192.0.2.0/24"]}
            flow = await Flow.change_options(hass, entry)
            await flow.submit(typed)
            assert flow.step == "excludes"
            assert flow.tells("- Yard (127.0.0.1)")
            assert not flow.tells("Shed")
            assert running.connections.connected == 1
            await flow.choose("init")
            assert fields(flow) == typed
            # With its address, also in a network, nothing is asked.
            await flow.submit({"allowed": ["192.0.2.0/24", "127.0.0.0/8"]})
            assert flow.result["type"] is FlowResultType.CREATE_ENTRY

            # It counts where it was, when it is away.
            dialler.hang_up(redial=False)
            await wait_until(hass, lambda: running.connections.connected == 0)
            flow = await Flow.change_options(hass, entry)
            await flow.submit(typed)
            assert flow.tells("- Yard (127.0.0.1)")
            await flow.choose("save")
            assert entry.options == typed


async def test_on_a_serial_line_there_is_nobody_to_restrict(
    hass: HomeAssistant,
) -> None:
    async with listening(hass):
        entry = bus_entry("ews", "/dev/serial/by-id/usb-none", entry_id="serial")
        assert not entry.supports_options
