"""Adding a bus of EVBoxes, where a search sets limits."""

from typing import TYPE_CHECKING, Any

from homeassistant.data_entry_flow import InvalidData
import pytest

from tests.flow import IMPOSED, charger, fields, port_step
from tests.virtual import (
    EvboxChargePoint,
    VirtualBus,
    orders_in,
)

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant


pytestmark = pytest.mark.usefixtures("not_set_up", "quick_search")


async def test_single_evbox_is_found_with_confirmed_values_only(
    hass: HomeAssistant,
) -> None:
    box = EvboxChargePoint(1923054, modules=2)
    with VirtualBus.in_loop(box) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        assert flow.step == "impose"
        assert flow.result["menu_options"] == [
            "search_single",
            "search_addresses",
            "manual",
        ]
        await flow.choose("search_single")
        assert fields(flow) == {
            "installation_limit": 16,
            "search_current": "6",
            "fail_safe_current": 6,
            "fail_safe_timeout": 60,
            "command": "68",
            "confirm": False,
        }
        await flow.submit(IMPOSED | {"confirm": False})
        assert flow.errors == {"confirm": "not_confirmed"}
        await flow.submit(IMPOSED | {"fail_safe_current": 21})
        assert flow.errors == {"fail_safe_current": "above_installation_limit"}
        await flow.submit(IMPOSED | {"installation_limit": "nan"})
        assert flow.errors == {"installation_limit": "not_a_number"}
        await flow.submit(IMPOSED | {"fail_safe_timeout": "nan"})
        assert flow.errors == {"fail_safe_timeout": "not_a_number"}
        await flow.submit(IMPOSED | {"fail_safe_timeout": 14})
        assert flow.errors == {"fail_safe_timeout": "timeout_too_short"}
        assert not bus.log.total
        assert not box.orders

        await flow.submit(IMPOSED)
        await flow.wait()
        assert flow.step == "select"
        await bus.wait_for_async(lambda: not bus.connected)
        assert box.orders
        for order in box.orders:
            assert order.limits == (6, 6, 6)
            assert order.fallback == (6, 6, 6)
            assert order.timeout == 90
        assert fields(flow)["installation_limit"] == 20

        await flow.submit({"chargers": ["1923054"], "installation_limit": 20})
        assert fields(flow) == {
            "name": "EVBox 01923054",
            "installation_limit": 20,
            "fail_safe_current": 6.5,
            "fail_safe_timeout": 90,
            "expert": {
                "poll_interval": 5,
                "voltage": 230,
                "command": "68",
                "information": "00" * 16,
                "one_phase_modules": False,
            },
        }
        await flow.submit(charger("Garage", 20, fail_safe_timeout=90))
        await flow.reload()
        assert flow.step == "confirm_evbox"
        table = flow.result["description_placeholders"]["chargers"]
        assert table == "| Garage | 01923054 | 20 A | 6 A | 90 s |"
        await flow.submit()

    entry = flow.result["result"]
    assert entry.data == {"protocol": "evbox", "device": bus.url}
    [stored] = entry.subentries.values()
    assert stored.unique_id == "evbox_1923054"
    assert stored.data["address"] == 1923054
    assert stored.data["serial"] == "1923054"
    assert stored.data["fail_safe_timeout"] == 90
    assert isinstance(stored.data["fail_safe_timeout"], int)
    assert stored.data["information"] == "00" * 16


async def test_evboxes_are_found_by_their_serial_numbers(hass: HomeAssistant) -> None:
    wanted = EvboxChargePoint(1923054), EvboxChargePoint(777)
    stranger = EvboxChargePoint(4444)
    with VirtualBus.in_loop(*wanted, stranger) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_addresses")
        await flow.submit(IMPOSED | {"serial_numbers": ["01923054", "x"]})
        assert flow.errors == {"serial_numbers": "bad_serial_number"}
        await flow.submit(IMPOSED | {"serial_numbers": ["777", "00000777"]})
        assert flow.errors == {"serial_numbers": "address_twice"}
        await flow.submit(IMPOSED | {"serial_numbers": ["777", "0"]})
        assert flow.errors == {"serial_numbers": "any_not_alone"}
        await flow.submit(IMPOSED | {"serial_numbers": [" "]})
        assert flow.errors == {"serial_numbers": "no_address"}
        assert not bus.log.total

        await flow.submit(IMPOSED | {"serial_numbers": ["01923054", "777", "5"]})
        await flow.wait()
        assert flow.step == "select"
        assert fields(flow)["chargers"] == ["1923054", "777"]
        assert not stranger.orders
        assert all(one.serial != "00000000" for one in orders_in(bus.log.bursts()))
        await flow.submit({"chargers": ["777"], "installation_limit": 20})
        await flow.submit(charger("Left", fail_safe_timeout=60))
        await flow.submit()

    [stored] = flow.result["result"].subentries.values()
    assert stored.unique_id == "evbox_777"


async def test_single_evbox_that_knows_only_69_is_asked_for_its_serial_number(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(EvboxChargePoint(1923054)) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_single")
        await flow.submit(IMPOSED | {"command": "69", "search_current": "0"})
        await flow.wait()
        assert {order.command for order in bus.devices[0].orders} == {69}
        assert bus.devices[0].orders[0].limits == (0, 0, 0)
        await flow.submit({"chargers": ["0"], "installation_limit": 20})
        assert fields(flow)["serial_number"] == "00000000"
        assert fields(flow)["expert"]["command"] == "69"
        typed = charger("Garage", fail_safe_timeout=90, expert={"command": "69"})
        await flow.submit(typed | {"serial_number": "19-23054"})
        assert flow.errors == {"serial_number": "bad_serial_number"}
        await flow.submit(typed | {"serial_number": " 1923054 "})
        await flow.submit()
    [stored] = flow.result["result"].subentries.values()
    assert stored.unique_id == "evbox_1923054"
    assert stored.data["command"] == 69


async def test_message_without_serial_number_is_for_a_box_alone(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop() as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("manual")
        await flow.submit({"serial_numbers": ["1", "2"]})
        typed = charger("One", fail_safe_timeout=90)
        await flow.submit(typed | {"expert": {"command": "69"}})
        assert flow.errors == {"base": "command_not_alone"}
        await flow.submit(typed)
        await flow.submit(typed | {"expert": {"command": "69"}})
        assert flow.errors == {"base": "command_not_alone"}
        flow.abort()


async def test_nobody_answers_an_evbox_search(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop() as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_single")
        await flow.submit(IMPOSED)
        await flow.wait()
        assert flow.step == "nothing_found"
        assert flow.result["menu_options"] == ["scan", "impose", "manual", "port"]
        await flow.choose("impose")
        await flow.choose("search_addresses")
        # What was confirmed once is offered again, the confirmation is not.
        offered = fields(flow)
        assert offered["installation_limit"] == 20
        assert offered["fail_safe_timeout"] == 90
        assert offered["confirm"] is False
        flow.abort()


@pytest.mark.parametrize(
    ("search", "addresses", "step"),
    [
        # Everybody was asked: then several may have answered at once.
        ("search_single", {}, "duplicates"),
        ("search_addresses", {"serial_numbers": ["42"]}, "unreadable"),
    ],
)
async def test_answers_that_nobody_can_read(
    hass: HomeAssistant, search: str, addresses: dict[str, Any], step: str
) -> None:
    box = EvboxChargePoint(42, min_interval=0)
    with VirtualBus.in_loop(box) as bus:
        box.faults.once("corrupt")
        box.faults.once("corrupt")
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose(search)
        await flow.submit(IMPOSED | addresses)
        await flow.wait()
        assert flow.step == step
        assert flow.result["menu_options"] == ["scan", "impose", "manual", "port"]
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


async def test_evbox_typed_in_without_a_word_on_the_wire(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(EvboxChargePoint(1923054)) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("manual")
        await flow.submit({"serial_numbers": ["123456789"]})
        assert flow.errors == {"serial_numbers": "bad_serial_number"}
        await flow.submit({"serial_numbers": ["1923054", "0"]})
        assert flow.errors == {"serial_numbers": "any_not_alone"}
        await flow.submit({"serial_numbers": ["1923054", "42"]})
        await flow.submit(charger("One", fail_safe_timeout=60))
        await flow.submit(
            charger(
                "Two",
                fail_safe_timeout=60,
                expert={
                    "command": "68",
                    "information": "0a" * 16,
                    "one_phase_modules": True,
                },
            )
        )
        await flow.submit()
        assert not bus.log.total
    one, two = flow.result["result"].subentries.values()
    assert one.data["address"] == 1923054
    assert two.data["command"] == 68
    assert two.data["information"] == "0A" * 16
    assert two.data["one_phase_modules"] is True


async def test_the_only_evbox_may_stay_without_its_serial_number(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop() as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("manual")
        await flow.submit({"serial_numbers": ["0"]})
        await flow.submit(
            charger("Only", fail_safe_timeout=60, serial_number="00000000")
        )
        await flow.submit()
    [only] = flow.result["result"].subentries.values()
    assert (only.data["address"], only.data["serial"]) == (0, None)
    assert only.unique_id is None


async def test_somebody_else_talks_all_the_time(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(EvboxChargePoint(1923054)) as bus:
        bus.foreign_traffic(b"\x02ABCD\x03" * 8, 0.02)
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_single")
        await flow.submit(IMPOSED)
        await flow.wait()
        assert flow.step == "port"
        assert flow.errors == {"base": "line_busy"}
        flow.abort()


@pytest.mark.parametrize(
    ("wrong", "errors"),
    [
        ({"name": " "}, {"name": "name_empty"}),
        ({"installation_limit": "nan"}, {"installation_limit": "not_a_number"}),
        ({"fail_safe_current": "nan"}, {"fail_safe_current": "not_a_number"}),
        (
            {"fail_safe_current": 16.1},
            {"fail_safe_current": "above_installation_limit"},
        ),
        ({"fail_safe_timeout": "nan"}, {"fail_safe_timeout": "not_a_number"}),
        ({"fail_safe_timeout": 14}, {"fail_safe_timeout": "timeout_too_short"}),
        (
            {"expert": {"poll_interval": 20.1}},
            {"fail_safe_timeout": "timeout_too_short"},
        ),
        ({"expert": {"poll_interval": "nan"}}, {"base": "expert_not_a_number"}),
        ({"expert": {"voltage": "nan"}}, {"base": "expert_not_a_number"}),
        ({"expert": {"order_lifetime": "nan"}}, {"base": "expert_not_a_number"}),
        ({"expert": {"information": "00"}}, {"base": "bad_information"}),
        ({"expert": {"information": "zz" * 16}}, {"base": "bad_information"}),
    ],
)
async def test_charger_form_says_what_is_wrong(
    hass: HomeAssistant, wrong: dict[str, Any], errors: dict[str, str]
) -> None:
    with VirtualBus.in_loop() as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("manual")
        await flow.submit({"serial_numbers": ["42"]})
        good = charger("Box", fail_safe_timeout=60)
        await flow.submit(good | wrong)
        assert flow.step == "charger"
        assert flow.errors == errors
        await flow.submit(good)
        assert flow.step == "confirm_evbox"
        flow.abort()


@pytest.mark.parametrize(
    "wrong",
    [
        {"installation_limit": 5.9},
        {"installation_limit": 80.1},
        {"installation_limit": "inf"},
        {"fail_safe_current": -1},
        {"fail_safe_timeout": 0},
        {"fail_safe_timeout": 65536},
        {"expert": {"poll_interval": 3601}},
        {"expert": {"poll_interval": -1}},
        {"expert": {"order_lifetime": 0}},
        {"expert": {"command": "70"}},
    ],
)
async def test_charger_form_takes_nothing_out_of_range(
    hass: HomeAssistant, wrong: dict[str, Any]
) -> None:
    with VirtualBus.in_loop() as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("manual")
        await flow.submit({"serial_numbers": ["42"]})
        with pytest.raises(InvalidData):
            await flow.submit(charger("Box", fail_safe_timeout=60) | wrong)
        flow.abort()
