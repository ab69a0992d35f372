"""A listener that changes while it runs: who may dial, who is set up, who is there."""

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
    stranger,
    until,
)

pytestmark = pytest.mark.usefixtures("socket_enabled")

OTHER = "099999999999"
ELSEWHERE = ip_network("192.0.2.0/24")
HERE = ip_network("127.0.0.0/8")


def is_empty(made: Listener) -> bool:
    """Return whether nothing is kept of anybody."""
    kept = (made._unidentified, made._identified, made._unknown, made._bound)
    return not any(kept) and not made._timers


def test_who_may_not_connect_any_more_is_hung_up_on() -> None:
    """Set up or not, or just about to say who it is."""

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with (
                dialling(made) as box,
                dialling(made, VirtualBox(serial=OTHER)) as other,
                stranger(made) as silent,
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
                # They go on dialling, and are not let in.
                await until(lambda: made.statistics.not_allowed > before + 5)
                assert is_empty(made)
                assert not first(bus).available
                made.allow(())
                await until(lambda: has_reading(bus) and made.unknown_boxes)

    run(scene)


def test_one_that_waits_to_take_a_place_is_hung_up_on(
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


def test_who_is_there() -> None:
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


def test_a_stranger_that_is_set_up_in_time_stays(
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
                # It is a stranger again, and then kept for so long only.
                await until(lambda: made.unknown_boxes)
                times = box.opened
                await until(lambda: box.opened > times)
            await until(lambda: is_empty(made))

    run(scene)


def test_a_box_that_gives_another_number_later_keeps_nobody_out() -> None:
    """The one that is set up would be refused as long as somebody answers for it."""

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
                stranger(made) as silent,
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


def test_what_is_no_host_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names are not asked for in tests: one too long raises UnicodeEncodeError."""

    async def scene() -> None:
        loop = asyncio.get_running_loop()

        async def fails(*_: object) -> None:
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
