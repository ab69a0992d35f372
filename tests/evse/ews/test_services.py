"""Cards, meter, LEDs, parameters and firmware, on the virtual box."""

import asyncio
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from unittest.mock import patch
from zoneinfo import ZoneInfo

import pytest

from custom_components.evse_bus.evse.errors import NotConfirmedError, RefusedOrderError
from custom_components.evse_bus.evse.ews.firmware import upload
from custom_components.evse_bus.evse.ews.timing import TCP_TIMING
from custom_components.evse_bus.evse.ews.wire.answers import EwsRefusedError, Refusal
from custom_components.evse_bus.evse.ews.wire.cards import (
    AcceptedCard,
    EntryKind,
    card_entry,
)
from custom_components.evse_bus.evse.ews.wire.commands import (
    LED_ON,
    PortLeds,
    ReaderTarget,
)
from custom_components.evse_bus.evse.ews.wire.parameters import (
    EXTRA_BLOCK,
    INSTALLATION_BLOCK,
    SYSTEM_BLOCK,
    USER_BLOCK,
    HiddenSecretError,
    SystemMode,
    SystemParameters,
)
from tests.virtual.ews_parameters import SystemParameters as VirtualParameters
from tests.virtual.ews_rfid import Card

from .scene import EwsScene, play
from .test_agreement import Damage


def test_a_card_is_accepted() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.present_card(Card(foreign=True))
        await asyncio.sleep(1)
        card = AcceptedCard(group=7, number=42, user="MAX", tag=bytes(7))
        await scene.charger().services.accept_card(card)
        assert scene.box.reader.accepted
        assert scene.box.reader.noted == Card(7, 42, "MAX", bytes(7))

    play(EwsScene(options={"rfid": True}), acts)


@pytest.mark.parametrize("lost", [False, True])
def test_the_card_list(*, lost: bool) -> None:
    async def acts(scene: EwsScene) -> None:
        services = scene.charger().services
        before = await services.read_cards()
        if lost:
            scene.line.mute = lambda name: name == "sf"
        entry = card_entry(EntryKind.CARD, 3, 4)
        after = await services.write_cards({5: entry})
        assert after.entries[5] == entry
        assert after.entries[:5] == before.entries[:5]
        assert await services.read_cards() == after
        assert len(scene.line.named("sf")) == 1
        with pytest.raises(RefusedOrderError):
            await services.write_cards({64: entry})

    play(EwsScene(), acts)


def test_meter_leds_reader_and_network() -> None:
    async def acts(scene: EwsScene) -> None:
        services = scene.charger(2).services
        await services.set_meter(12_345_678)
        await scene.until(lambda: scene.connector(2).energy == 12_345_678)
        assert scene.connector(1).energy == 0
        await services.set_leds(PortLeds(red=LED_ON), PortLeds())
        assert await services.card_reader(ReaderTarget.READER, 2, b"id")
        with pytest.raises(EwsRefusedError) as raised:
            await services.card_reader(ReaderTarget.CARD, 2, b"")
        assert raised.value.reason is Refusal.CARD_READER_COMMAND
        with pytest.raises(RefusedOrderError):
            await services.card_reader(ReaderTarget.READER, 60, b"id")
        assert (await services.read_dhcp()).lease == 0

    play(EwsScene(options={"manual_io": True}), acts)


def test_leds_are_refused_by_a_box_that_has_them_itself() -> None:
    async def acts(scene: EwsScene) -> None:
        with pytest.raises(EwsRefusedError) as raised:
            await scene.charger().services.set_leds(PortLeds(), PortLeds(red=LED_ON))
        assert raised.value.reason is Refusal.LEDS

    play(EwsScene(), acts)


def test_a_lost_answer_raises_where_nothing_can_be_read_back() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.mute = lambda name: name in ("cr", "ma")
        with pytest.raises(NotConfirmedError):
            await scene.charger().services.set_meter(5)
        with pytest.raises(NotConfirmedError):
            await scene.charger().services.accept_card(AcceptedCard(group=1, number=1))
        assert len(scene.line.named("cr", "ma")) == 2

    play(EwsScene(), acts)


def test_the_clock_is_set_by_the_user() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.charger().box.clock = lambda: datetime(2026, 1, 2, 3, 4, tzinfo=UTC)
        await scene.charger().services.set_clock(ZoneInfo("Europe/Berlin"))
        assert f"{scene.box.clock():%Y-%m-%d %H:%M}" == "2026-01-02 04:04"

    play(EwsScene(), acts)


# -- Parameters ---------------------------------------------------------------------


@pytest.mark.parametrize("lost", [False, True])
def test_one_parameter_is_changed_and_nothing_else(*, lost: bool) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        before = scene.box.system.pack("no")
        if lost:
            scene.line.mute = lambda name: name == "sp"
        found = await scene.charger().services.change_parameters(
            SYSTEM_BLOCK, {"maximum_current": 20}
        )
        assert found.maximum_current == 20
        after = scene.box.system.pack("no")
        changed = [at for at in range(len(before)) if before[at] != after[at]]
        assert len(changed) == 1
        assert scene.box.system.max_current == 20
        # The new installation counts at once.
        await scene.until(lambda: scene.charger().limits.ceiling == 20)

    play(EwsScene(), acts)


def test_all_blocks_are_read_and_changed() -> None:
    async def acts(scene: EwsScene) -> None:
        services = scene.charger().services
        scene.box.user.user_password = b"geheim".ljust(12, b"\0")
        await services.change_parameters(INSTALLATION_BLOCK, {"name": "Max"})
        assert (await services.read_parameters(INSTALLATION_BLOCK)).name == "Max"
        await services.change_parameters(EXTRA_BLOCK, {"maximum_current_2": 10})
        assert (await services.read_parameters(EXTRA_BLOCK)).maximum_current_2 == 10
        await services.change_parameters(
            USER_BLOCK, {"zone_code": 1, "user_password": "anders"}
        )
        found = await services.read_parameters(USER_BLOCK)
        assert found.zone_code == 1
        assert "anders" not in repr(found)

    play(EwsScene(), acts)


@pytest.mark.parametrize("masking", ["zeros", "stars"])
def test_hidden_passwords_are_not_written_back(masking: str) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        services = scene.charger().services
        with pytest.raises(RefusedOrderError, match="would erase"):
            await services.change_parameters(SYSTEM_BLOCK, {"maximum_current": 20})
        assert not scene.line.named("sp")
        await services.change_parameters(
            SYSTEM_BLOCK,
            {"maximum_current": 20, "admin_password": "neu", "card_pin": "1234"},
        )
        assert scene.box.system.admin_password.rstrip(b"\0") == b"neu"
        assert scene.box.system.card_pin == b"1234"

    play(EwsScene(options={"masking": masking}), acts)


def test_system_parameters_are_refused_while_a_car_charges() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        await scene.charge()
        with pytest.raises(EwsRefusedError) as raised:
            await scene.charger().services.change_parameters(
                SYSTEM_BLOCK, {"maximum_current": 20}
            )
        assert raised.value.reason is Refusal.SYSTEM_PARAMETERS
        assert scene.status() == 0x40

    play(EwsScene(), acts)


def test_a_field_that_the_box_keeps_raises() -> None:
    """Over the network it takes the rest, and not the server mode."""

    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        scene.box.network = True
        mode = (
            await scene.charger().services.read_parameters(SYSTEM_BLOCK)
        ).mode ^ SystemMode.SERVER
        with pytest.raises(NotConfirmedError, match="mode"):
            await scene.charger().services.change_parameters(
                SYSTEM_BLOCK, {"mode": mode}
            )

    play(EwsScene(), acts)


@pytest.mark.parametrize("field", range(0, 20, 3))
def test_no_damaged_parameter_is_written_back(field: int) -> None:
    """What was read is written: only if two replies are equal."""

    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        before = replace(scene.box.system)
        damage = Damage(scene.line, "rp")
        damage.flips = [{field: 1, 26: 1}]
        await scene.charger().services.change_parameters(SYSTEM_BLOCK, {"ports": 2})
        assert damage.damaged == 1
        assert scene.box.system == replace(before, ports=2)

    play(EwsScene(), acts)


def test_one_bit_is_changed_in_the_field_as_read() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        modes: list[SystemMode] = []

        def exclusive(read: SystemParameters) -> dict[str, object]:
            # Somebody else has changed a bit since we read it last.
            modes.append(read.mode)
            return {"mode": SystemMode(read.mode.value | SystemMode.EXCLUSIVE.value)}

        before = scene.box.system.mode
        scene.box.system.mode ^= SystemMode.CARDS.value
        found = await scene.charger().services.change_parameters(
            SYSTEM_BLOCK, exclusive
        )
        assert modes == [SystemMode(before ^ SystemMode.CARDS.value)]
        assert found.mode == modes[0] | SystemMode.EXCLUSIVE
        assert scene.box.system.mode == found.mode.value
        sent = [one.name for one in scene.line.named("rp", "sp")]
        assert sent[-5:] == ["rp", "rp", "sp", "rp", "rp"]

    play(EwsScene(), acts)


def test_unknown_bits_do_not_prevent_a_change() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.system.admin_password = b"geheim".ljust(12, b"\0")
        scene.box.system.card_pin = b"4711"
        # The virtual box refuses bits that are not in its manual; a later one may not.
        scene.box.system.mode |= 0x80
        with patch.object(scene.box.system, "write", partial(take, scene.box.system)):
            found = await scene.charger().services.change_parameters(
                SYSTEM_BLOCK,
                lambda read: {
                    "mode": SystemMode(read.mode.value | SystemMode.EXCLUSIVE.value)
                },
            )
        assert found.mode.value & 0x90 == 0x90
        assert scene.box.system.mode & 0x90 == 0x90

    def take(system: VirtualParameters, block: bytes, *, network: bool) -> int:
        assert not network
        system.mode = block[13]
        return 0

    play(EwsScene(), acts)


def test_all_hidden_secrets_are_named() -> None:
    async def acts(scene: EwsScene) -> None:
        with pytest.raises(HiddenSecretError) as raised:
            await scene.charger().services.change_parameters(
                SYSTEM_BLOCK, {"maximum_current": 20}
            )
        assert raised.value.names == ("admin_password", "card_pin")

    play(EwsScene(options={"masking": "stars"}), acts)


@pytest.mark.parametrize("masking", ["no", "stars"])
@pytest.mark.parametrize("lost", ["nothing", "answer", "command"])
def test_a_password_that_may_not_have_been_written_raises(
    masking: str, lost: str
) -> None:
    """Where the box does not hide it, it is read back; else only the answer counts."""

    async def acts(scene: EwsScene) -> None:
        scene.box.user.user_password = b"geheim".ljust(12, b"\0")
        if lost == "answer":
            scene.line.mute = lambda name: name == "su"
        elif lost == "command":
            scene.line.deaf = lambda name: name == "su"
        change = scene.charger().services.change_parameters(
            USER_BLOCK, {"user_password": "anders"}
        )
        known = lost == "nothing" or (lost == "answer" and masking == "no")
        with nullcontext() if known else pytest.raises(NotConfirmedError):
            await change
        assert len(scene.line.named("su")) == 1
        taken = scene.box.user.user_password.rstrip(b"\0")
        assert taken == (b"geheim" if lost == "command" else b"anders")

    play(EwsScene(options={"masking": masking}), acts)


def test_a_text_with_spaces_around_it_is_known_again() -> None:
    async def acts(scene: EwsScene) -> None:
        found = await scene.charger().services.change_parameters(
            INSTALLATION_BLOCK, {"name": " Max "}
        )
        assert found.name == "Max"

    play(EwsScene(), acts)


# -- Firmware -----------------------------------------------------------------------


def test_firmware_in_pieces() -> None:
    image = bytes(range(1, 251)) * 10

    async def acts(scene: EwsScene) -> None:
        done: list[float] = []
        await upload(scene.charger().services, image, done.append)
        assert [len(one.parameters) - 8 for one in scene.line.named("ow")] == [
            1024,
            1024,
            452,
        ]
        assert scene.box.activated == [image]
        assert done == [pytest.approx(n / 3) for n in (1, 2, 3)]
        await scene.until(lambda: scene.box.restarts == 1)
        await scene.until(lambda: scene.box.ports[0].limit == 16)
        # Others had their turns between the pieces.
        assert scene.bus.wire.statistics.missed_deadlines == 0

    play(EwsScene(timing=TCP_TIMING), acts)


def test_a_slow_erasure_is_waited_for() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.mute = lambda _name: False
        scene.box.faults.once("late", 8.0)
        await upload(scene.charger().services, b"\1\2\3")
        assert scene.box.activated == [b"\1\2\3"]

    async def run(scene: EwsScene) -> None:
        # Nothing else is asked meanwhile.
        await scene.until(lambda: scene.line.sent[-1].name == "rd")
        await asyncio.sleep(0.1)
        await acts(scene)

    play(EwsScene(), run)


@pytest.mark.parametrize("lost", ["oe", "ow", "fw"])
def test_an_upload_with_a_lost_answer_ends_there(lost: str) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.deaf = lambda name: name == lost
        with pytest.raises(NotConfirmedError):
            await upload(scene.charger().services, bytes(3000))
        assert not scene.box.activated
        assert len(scene.line.named(lost)) == 1
        await scene.until(lambda: scene.charger().available)

    play(EwsScene(), acts)


def test_no_image_is_no_firmware() -> None:
    async def acts(scene: EwsScene) -> None:
        with pytest.raises(RefusedOrderError):
            await upload(scene.charger().services, b"")
        assert not scene.line.named("oe")

    play(EwsScene(), acts)
