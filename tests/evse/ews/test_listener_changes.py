"""A listener that changes while it runs: allowed networks, registered boxes."""

import asyncio
from ipaddress import ip_address, ip_network

import pytest

from custom_components.evse_bus.evse.errors import PortMissingError
from custom_components.evse_bus.evse.ews import Listener
from custom_components.evse_bus.evse.ews.network import listener as listening
from custom_components.evse_bus.evse.model import Fault
from tests.virtual.ews_box import EwsBox as VirtualBox

from .dialling import (
    HOST,
    SERIAL,
    dialling,
    expected,
    first,
    goes,
    has_reading,
    run,
    server,
    silent_client,
    until,
)

pytestmark = pytest.mark.usefixtures("socket_enabled")

OTHER = "099999999999"
ELSEWHERE = ip_network("192.0.2.0/24")
HERE = ip_network("127.0.0.0/8")


def is_empty(made: Listener) -> bool:
    """Return whether no connection is left."""
    kept = (made._unidentified, made._identified, made._unknown, made._bound)
    return not any(kept) and not made._timers


def test_connections_that_are_no_longer_allowed_end() -> None:
    """Registered or not, or not identified yet."""

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with (
                dialling(made) as box,
                dialling(made, VirtualBox(serial=OTHER)) as other,
                silent_client(made) as silent,
            ):
                await until(lambda: has_reading(bus) and made.unknown_boxes)
                made.allow([HERE])
                await asyncio.sleep(0.2)
                assert not box.dropped
                assert not other.dropped
                before = made.statistics.not_allowed
                made.allow(iter([ELSEWHERE]))
                assert is_empty(made)
                assert made.statistics.not_allowed == before + 3
                assert await goes(silent)
                assert not bus.connected
                assert made.allowed == (ELSEWHERE,)
                # They go on dialling, and are not accepted.
                await until(lambda: made.statistics.not_allowed > before + 5)
                assert is_empty(made)
                assert not first(bus).available
                made.allow(())
                await until(lambda: has_reading(bus) and made.unknown_boxes)

    run(scene)


def test_a_connection_that_waits_to_replace_another_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(listening, "PROOF_TIME", 2.0)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made) as box:
                await until(lambda: has_reading(bus))
                box.vanish()
                await until(lambda: made._proving)
                made.allow([ELSEWHERE])
                assert is_empty(made)
                made.allow([])
                await until(lambda: has_reading(bus))

    run(scene)


def test_connected_boxes() -> None:
    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            assert not made.unknown_boxes
            assert not bus.connected
            with dialling(made), dialling(made, VirtualBox(serial=OTHER)) as other:
                await until(lambda: has_reading(bus) and made.unknown_boxes)
                (found,) = made.unknown_boxes
                assert (found.serial, found.peer) == (OTHER, ip_address(HOST))
                assert found.info.firmware == "M165300103"
                other.hang_up(redial=False)
                await until(lambda: not made.unknown_boxes)
                await made.unregister(SERIAL)
                assert not bus.connected
                await until(
                    lambda: [one.serial for one in made.unknown_boxes] == [SERIAL]
                )

    run(scene)


def test_an_unknown_box_that_is_registered_in_time_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(listening, "UNKNOWN_TIME", 0.5)

    async def scene() -> None:
        async with server() as made:
            with dialling(made) as box:
                await until(lambda: made.unknown_boxes)
                async with expected(made) as bus:
                    assert not made.unknown_boxes
                    assert list(made._bound) == [SERIAL]
                    await asyncio.sleep(1.0)
                    assert not box.dropped
                    assert box.opened == 1
                    assert has_reading(bus)
                # It is unknown again, and kept for so long only.
                await until(lambda: made.unknown_boxes)
                times = box.opened
                await until(lambda: box.opened > times)
            await until(lambda: is_empty(made))

    run(scene)


def test_a_box_that_gives_another_number_later_is_dropped() -> None:
    """The registered one would be refused as long as another answers for it."""

    async def scene() -> None:
        false = VirtualBox(serial=SERIAL)
        async with server() as made, expected(made) as bus:
            with dialling(made, false) as dialler:
                await until(lambda: has_reading(bus))
                await until(lambda: false.ports[1].limit == 16)
                writes = len(false.writes)
                false.serial = OTHER
                bus.group.box.status_due = float("-inf")  # type: ignore[union-attr]
                await until(lambda: dialler.dropped)
                assert Fault.WRONG_CHARGER in first(bus).noticed
                assert not first(bus).available
                with dialling(made):
                    await until(lambda: has_reading(bus))
                    assert Fault.WRONG_CHARGER not in first(bus).faults
                    await until(lambda: made.unknown_boxes)
                    assert made.unknown_boxes[0].serial == OTHER
                assert len(false.writes) == writes

    run(scene)


def test_a_listener_that_stops_leaves_no_connection_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(listening, "PROOF_TIME", 30.0)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with (
                dialling(made) as box,
                dialling(made, VirtualBox(serial=OTHER)),
                silent_client(made) as silent,
            ):
                await until(lambda: has_reading(bus) and made.unknown_boxes)
                box.vanish()
                await until(lambda: made._proving)
                assert made._unidentified
                await made.stop()
                assert not made._timers
                assert not made._unidentified
                # The bus that has it keeps its own.
                assert list(made._identified) == list(made._bound.values())
                assert await goes(silent)

    run(scene)


@pytest.mark.parametrize("host", ["fe80::1%nosuch", "fe80::1"])
def test_an_interface_that_is_not_there_or_not_named(host: str) -> None:
    async def scene() -> None:
        with pytest.raises(PortMissingError):
            await Listener(host, 0).start()

    run(scene)


def test_an_invalid_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests resolve no names; one that is too long raises UnicodeEncodeError."""

    async def scene() -> None:
        loop = asyncio.get_running_loop()

        async def fails(*_: object, **_options: object) -> None:
            (300 * "a").encode("idna")

        monkeypatch.setattr(loop, "create_server", fails)
        with pytest.raises(PortMissingError, match="label"):
            await Listener(300 * "a", 0).start()

    run(scene)


def test_an_address_may_have_its_interface() -> None:
    """The loop-back address in place of a link-local one, which not everybody has."""

    async def scene() -> None:
        made = Listener("::1%1", 0)
        try:
            await made.start()
        except PortMissingError:
            pytest.skip("no IPv6 here")
        await made.stop()

    run(scene)
