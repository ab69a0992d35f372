"""Actions for cards, meter and LEDs of an EWS-Box, and who they are for."""

import re
from unittest.mock import patch

from homeassistant.core import Context, HomeAssistant
from homeassistant.exceptions import (
    HomeAssistantError,
    ServiceValidationError,
    Unauthorized,
)
from homeassistant.helpers import device_registry as dr
import probatio as vol
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry, MockUser

from custom_components.evse_bus.actions.table import ACTIONS
from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.errors import translated_errors
from custom_components.evse_bus.evse.ews.wire.answers import EwsRefusedError, Refusal
from custom_components.evse_bus.evse.ews.wire.frames import CommandId
from tests.common import identity, running, wait_until
from tests.virtual import AblBox
from tests.virtual.ews_box import EwsBox
from tests.virtual.ews_rfid import Card

from .services import said, scene

FREE_FOR_ALL = {"accept_card", "set_leds"}

# -- Who is meant ----------------------------------------------------------------


async def test_actions_are_there_before_any_bus(hass: HomeAssistant) -> None:
    entry = MockConfigEntry(domain=DOMAIN, data={"protocol": "ews", "device": "/x"})
    entry.add_to_hass(hass)
    await hass.config_entries.async_setup(entry.entry_id)
    assert set(hass.services.async_services_for_domain(DOMAIN)) == set(ACTIONS)


async def test_a_port_and_its_box(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        await here.act("set_meter_total", 1, total=1)
        await here.act("set_meter_total", 2, total=2.5)
        assert here.written("cr") == [
            b"\x01" + (1000).to_bytes(4),
            b"\x02" + (2500).to_bytes(4),
        ]
        # Of two ports one has to be chosen; what concerns the box goes by any.
        assert "Yard" in await here.refuses("set_meter_total", "choose_port", total=1)
        await here.refuses("set_leds", "choose_port", red="on")
        assert len(here.written("cr", "se")) == 2
        for port in (None, 1, 2):
            assert await here.ask("read_card_list", port) == {
                "entries": [],
                "free": 64,
            }


async def test_a_box_with_one_port_is_its_port(hass: HomeAssistant) -> None:
    async with scene(hass, EwsBox(ports=1, manual_io=True), ports=1) as here:
        await here.act("set_meter_total", total=3)
        await here.act("set_leds", red="on")
        assert here.written("cr") == [b"\x01" + (3000).to_bytes(4)]
        assert len(here.written("se")) == 1


async def test_others_are_not_meant(hass: HomeAssistant) -> None:
    foreign = MockConfigEntry(domain="other")
    foreign.add_to_hass(hass)
    stranger = dr.async_get(hass).async_get_or_create(
        config_entry_id=foreign.entry_id, identifiers={("other", "1")}, name="Lamp"
    )
    async with running(hass, AblBox(1)) as (entry, _bus):
        devices = {
            next(iter(device.identifiers))[1]: device.id
            for device in dr.async_entries_for_config_entry(
                dr.async_get(hass), entry.entry_id
            )
        }
        for device_id, key in (
            ("nobody", "service_device_not_found"),
            (stranger.id, "service_device_wrong_domain"),
            (devices[identity(entry)], "not_ews_box"),
            (devices[entry.entry_id], "not_ews_box"),
        ):
            with pytest.raises(ServiceValidationError) as told:
                await hass.services.async_call(
                    DOMAIN,
                    "set_meter_total",
                    {"device_id": device_id, "total": 1},
                    blocking=True,
                )
            assert told.value.translation_key == key
            if key == "not_ews_box":
                assert said(told.value)


async def test_a_bus_that_is_not_loaded(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        device = here.device(1)
        await hass.config_entries.async_unload(here.entry.entry_id)
        with pytest.raises(ServiceValidationError) as told:
            await here.act("set_meter_total", device=device, total=1)
        assert told.value.translation_key == "service_config_entry_not_loaded"
        assert not here.written("cr")


async def test_the_bus_is_no_box(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        bus = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, here.entry.entry_id), here.entry.entry_id
        )
        assert bus is not None
        await here.refuses("set_meter_total", "not_ews_box", device=bus.id, total=1)


async def test_what_is_set_up_is_for_administrators(
    hass: HomeAssistant, hass_read_only_user: MockUser
) -> None:
    context = Context(user_id=hass_read_only_user.id)
    async with scene(hass) as here:
        for name, action in ACTIONS.items():
            data = dict.fromkeys(action.required, "nonsense")
            # Who may is told what is wrong with it, and who may not is not.
            kind = ServiceValidationError if name in FREE_FOR_ALL else Unauthorized
            with pytest.raises(kind):
                await hass.services.async_call(
                    DOMAIN,
                    name,
                    {"device_id": here.device(1), **data},
                    blocking=True,
                    context=context,
                    return_response=action.responds,
                )
        assert not here.written()


async def test_nothing_else_is_taken(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        for name, action in ACTIONS.items():
            data = dict.fromkeys(action.required, "nonsense")
            device = {"device_id": here.device(1)}
            less = [
                {key: value for key, value in data.items() if key != missing}
                for missing in action.required
            ]
            for wrong in (
                data,
                {**data, **device, "unheard_of": 1},
                *({**device, **some} for some in less),
            ):
                with pytest.raises(vol.Invalid):
                    await hass.services.async_call(
                        DOMAIN,
                        name,
                        wrong,
                        blocking=True,
                        return_response=action.responds,
                    )
        assert not here.written()


async def test_a_box_that_is_off(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        here.box.power_off()
        chargers = here.entry.runtime_data.chargers.values()
        await wait_until(
            hass, lambda: not any(one.charger.available for one in chargers)
        )
        await here.refuses(
            "set_meter_total", "no_reply", 1, kind=HomeAssistantError, total=1
        )
        assert not here.written("cr")


# -- Cards -----------------------------------------------------------------------


async def test_a_card_is_accepted(hass: HomeAssistant) -> None:
    async with scene(hass, EwsBox(rfid=True)) as here:
        here.box.present_card(Card(foreign=True))
        await here.act(
            "accept_card", group=7, number="42", user=" MÜLLER ", tag="04a1B2c3d4e5f6"
        )
        assert here.box.reader.accepted
        assert here.box.reader.noted == Card(
            7, 42, "MÜLLER", bytes.fromhex("04a1b2c3d4e5f6")
        )
        await here.act("accept_card", 2, group=16383, number=1)
        assert here.written("ma")[1] == bytes.fromhex("3fff 0001") + bytes(8)


WRONG_CARDS: list[tuple[dict[str, object], str]] = [
    ({"group": 0}, "field_whole_number"),
    ({"group": 16384}, "field_whole_number"),
    ({"group": -1}, "field_whole_number"),
    ({"number": float("nan")}, "field_whole_number"),
    ({"number": float("inf")}, "field_whole_number"),
    ({"number": 1.5}, "field_whole_number"),
    ({"number": True}, "field_whole_number"),
    ({"number": None}, "field_whole_number"),
    ({"number": [1]}, "field_whole_number"),
    ({"user": "123456789"}, "field_text"),
    ({"user": None}, "field_text"),
    ({"user": "Łukasz"}, "field_signs"),
    ({"user": "a\nb"}, "field_signs"),
    ({"tag": "04a1b2c3d4e5"}, "field_tag"),
    ({"tag": "04a1b2c3d4e5fg"}, "field_tag"),
    ({"tag": "04 a1 b2 c3 d4"}, "field_tag"),
    ({"tag": ""}, "field_tag"),
    ({"tag": 4}, "field_tag"),
]


async def test_a_card_that_cannot_be(
    hass: HomeAssistant, subtests: pytest.Subtests
) -> None:
    async with scene(hass) as here:
        for wrong, key in WRONG_CARDS:
            with subtests.test(**wrong):
                data = {"group": 7, "number": 42, **wrong}
                text = await here.refuses("accept_card", key, **data)
                assert next(iter(wrong)) in text
        assert not here.written("ma")


async def test_the_card_list(hass: HomeAssistant) -> None:
    box = EwsBox()
    box.cards.add(1, 7)
    box.cards.add(3, 7, 42)
    async with scene(hass, box) as here:
        before = list(box.cards.entries)
        await here.act(
            "write_card_list",
            entries=[
                {"entry": 5, "kind": "card", "group": 8, "number": 9},
                {"entry": 0, "kind": "free"},
                {"entry": 63, "kind": "group", "group": 16383, "number": 0},
            ],
        )
        assert len(here.written("sf")) == 1
        assert box.cards.entries[5] == 2 << 28 | 8 << 14 | 9
        assert box.cards.entries[0] == 0
        assert box.cards.entries[63] == 1 << 28 | 16383 << 14
        untouched = set(range(64)) - {0, 5, 63}
        assert all(box.cards.entries[at] == before[at] for at in untouched)
        assert await here.ask("read_card_list") == {
            "entries": [
                {
                    "entry": at,
                    "kind": kind,
                    "kind_code": code,
                    "group": group,
                    "number": number,
                }
                for at, kind, code, group, number in (
                    (1, "blocked", 3, 7, 42),
                    (5, "card", 2, 8, 9),
                    (63, "group", 1, 16383, 0),
                )
            ],
            "free": 61,
        }


async def test_entries_that_nobody_knows_are_shown_as_they_are(
    hass: HomeAssistant,
) -> None:
    box = EwsBox()
    box.cards.entries[2] = 9 << 28 | 1 << 14 | 2
    # Free by its kind, though something is left in it.
    box.cards.entries[3] = 5
    async with scene(hass, box) as here:
        told = await here.ask("read_card_list")
        assert [
            (one["entry"], one["kind"], one["kind_code"], one["group"], one["number"])
            for one in told["entries"]
        ] == [(2, "unknown", 9, 1, 2), (3, "free", 0, 0, 5)]
        assert told["free"] == 63


ENTRY = {"entry": 1, "kind": "card", "group": 7, "number": 42}


WRONG_LISTS: list[tuple[object, str]] = [
    ([], "nothing_to_change"),
    ("nonsense", "card_entries"),
    (None, "card_entries"),
    ([ENTRY, 5], "card_entries"),
    ([{"entry": 1}], "card_entries"),
    ([{**ENTRY, "kind_code": 2}], "card_entries"),
    ([{**ENTRY, True: 2}], "card_entries"),
    ([{**ENTRY, "entry": 64}], "field_whole_number"),
    ([{**ENTRY, "entry": -1}], "field_whole_number"),
    ([{**ENTRY, "kind": "unknown"}], "field_option"),
    ([{**ENTRY, "kind": 2}], "field_option"),
    ([{**ENTRY, "kind": ["card"]}], "field_option"),
    ([{**ENTRY, "group": 16384}], "field_whole_number"),
    ([{**ENTRY, "number": float("nan")}], "field_whole_number"),
    ([{**ENTRY, "number": 0}], "card_entry_numbers"),
    ([{**ENTRY, "kind": "free"}], "card_entry_numbers"),
    ([{**ENTRY, "kind": "group"}], "card_entry_numbers"),
    ([{"entry": 1, "kind": "blocked", "group": 7}], "card_entry_numbers"),
    ([ENTRY, {**ENTRY, "number": 43}], "card_entry_twice"),
    # Of a list with one that is wrong nothing is written.
    ([ENTRY, {**ENTRY, "entry": 2, "kind": "free"}], "card_entry_numbers"),
]


async def test_a_card_list_that_cannot_be(
    hass: HomeAssistant, subtests: pytest.Subtests
) -> None:
    async with scene(hass) as here:
        for entries, key in WRONG_LISTS:
            with subtests.test(entries=entries):
                await here.refuses("write_card_list", key, entries=entries)
        assert not here.written("sf")


async def test_a_card_stands_in_the_list_once(hass: HomeAssistant) -> None:
    box = EwsBox()
    box.cards.add(3, 7, 42)
    async with scene(hass, box) as here:
        # In the box, and in what is to be written.
        await here.refuses("write_card_list", "card_twice", entries=[ENTRY])
        await here.refuses(
            "write_card_list",
            "card_twice",
            entries=[{"entry": at, "kind": "group", "group": 8} for at in (4, 5)],
        )
        assert not here.written("sf")
        await here.act("write_card_list", entries=[{"entry": 0, "kind": "free"}, ENTRY])
        assert box.cards.entries[:2] == [0, 2 << 28 | 7 << 14 | 42]


async def test_a_single_entry_needs_no_list(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        await here.act("write_card_list", entries=ENTRY)
        assert here.box.cards.entries[1] == 2 << 28 | 7 << 14 | 42


async def test_a_card_list_that_is_not_taken(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        with patch.object(here.box.cards, "write", return_value=0):
            await here.refuses(
                "write_card_list",
                "cards_not_taken",
                kind=HomeAssistantError,
                entries=[ENTRY],
            )
        assert len(here.written("sf")) == 1


async def test_a_card_list_that_is_not_read(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        here.box.unanswered.add("rf")
        assert "Yard" in await here.fails_to_ask("read_card_list", "not_read")
        here.box.unanswered.clear()


# -- The meter -------------------------------------------------------------------


TOTALS: list[tuple[object, int]] = [
    (0, 0),
    (12345.678, 12_345_678),
    ("12345.678", 12_345_678),
    # A float that is not quite what was meant; and the last digit.
    (0.1 + 0.2, 300),
    (1.0006, 1001),
    (4294967.295, 0xFFFFFFFF),
]


async def test_the_meter(hass: HomeAssistant, subtests: pytest.Subtests) -> None:
    async with scene(hass) as here:
        for total, wh in TOTALS:
            with subtests.test(total=total):
                await here.act("set_meter_total", 2, total=total)
                assert here.written("cr")[-1] == b"\x02" + wh.to_bytes(4)
                assert here.box.ports[1].session.total_wh == wh
        assert len(here.written("cr")) == len(TOTALS)
        assert here.box.ports[0].session.total_wh == 0


WRONG_TOTALS: list[object] = [
    *(float("nan"), float("inf"), -float("inf"), -0.001, 4294967.296, 1e300),
    *("nan", "1e999999", "", "much", None, True, [1]),
]


async def test_a_meter_total_that_cannot_be(
    hass: HomeAssistant, subtests: pytest.Subtests
) -> None:
    async with scene(hass) as here:
        for total in WRONG_TOTALS:
            with subtests.test(total=total):
                await here.refuses("set_meter_total", "field_number", 1, total=total)
        assert not here.written("cr")


async def test_a_lost_answer_is_told(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        here.box.unanswered.add("cr")
        await here.refuses(
            "set_meter_total", "not_confirmed", 1, kind=HomeAssistantError, total=1
        )
        # Once: nobody knows whether it was done.
        assert len(here.written("cr")) == 1


# -- LEDs ------------------------------------------------------------------------

UNCHANGED = "ffff ffff 0000"


@pytest.mark.parametrize("port", [1, 2])
async def test_leds(hass: HomeAssistant, port: int) -> None:
    async with scene(hass, EwsBox(manual_io=True)) as here:
        await here.act(
            "set_leds",
            port,
            red=True,
            green="off",
            orange="blink",
            orange_time_on=100,
            orange_time_off="65534",
            orange_offset=7,
        )
        mine = bytes.fromhex(
            f"ffff 0000 0000 0000 0000 0000 0064 fffe 0007 {UNCHANGED}"
        )
        other = bytes.fromhex(4 * UNCHANGED)
        assert here.written("se") == [mine + other if port == 1 else other + mine]


async def test_leds_blink_without_more_words(hass: HomeAssistant) -> None:
    async with scene(hass, EwsBox(manual_io=True)) as here:
        await here.act("set_leds", 1, spare="blink", green="unchanged", red=False)
        assert here.written("se") == [
            bytes.fromhex(f"0000 0000 0000 {UNCHANGED} {UNCHANGED} 01f4 01f4 0000")
            + bytes.fromhex(4 * UNCHANGED)
        ]


WRONG_LEDS: list[tuple[dict[str, object], str]] = [
    ({}, "nothing_to_change"),
    ({"red": "unchanged"}, "nothing_to_change"),
    ({"red": "lit"}, "field_option"),
    ({"red": 1}, "field_option"),
    ({"red": None}, "field_option"),
    ({"red": "on", "red_time_on": 100}, "led_times"),
    ({"green": "on", "red_offset": 100}, "led_times"),
    ({"red": "blink", "red_time_on": 0}, "field_whole_number"),
    ({"red": "blink", "red_time_on": 65535}, "field_whole_number"),
    ({"red": "blink", "red_time_off": -1}, "field_whole_number"),
    ({"red": "blink", "red_offset": float("nan")}, "field_whole_number"),
    ({"red": "blink", "red_offset": 0.5}, "field_whole_number"),
]


async def test_leds_that_cannot_be(
    hass: HomeAssistant, subtests: pytest.Subtests
) -> None:
    async with scene(hass, EwsBox(manual_io=True)) as here:
        for data, key in WRONG_LEDS:
            with subtests.test(**data):
                await here.refuses("set_leds", key, 1, **data)
        assert not here.written("se")


# -- What a box answers ----------------------------------------------------------


async def test_a_box_that_has_its_leds_itself(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        text = await here.refuses(
            "set_leds", "ews_leds", 1, kind=HomeAssistantError, red="on"
        )
        assert "Yard 1" in text
        assert "answer 1" in text


def code_of(reason: Refusal) -> tuple[CommandId, int]:
    """Return a command and an answer that mean this."""
    for command in CommandId:
        for code in range(1, 256):
            if EwsRefusedError(command, code).reason is reason:
                return command, code
    raise AssertionError(reason)


def test_every_answer_has_a_text_of_its_own() -> None:
    texts = set()
    for reason in Refusal:
        command, code = code_of(reason)
        with (
            pytest.raises(HomeAssistantError) as told,
            translated_errors("Yard 1", "/dev/x"),
        ):
            raise EwsRefusedError(command, code)
        assert told.value.translation_key == f"ews_{reason}"
        text = said(told.value)
        assert "Yard 1" in text
        # What is wrong, and what to do about it.
        assert len(re.findall(r"[.] [A-Z]", text)) >= 1, text
        texts.add(text)
    assert len(texts) == len(Refusal)
