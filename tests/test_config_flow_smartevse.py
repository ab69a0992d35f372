"""Adding one SmartEVSE that is polled, in each of its dialects."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from homeassistant.data_entry_flow import InvalidData
import pytest

from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests.flow import NOWHERE, Flow, charger, fields, smartevse_step
from tests.virtual import SmartEvse, VirtualBus
from tests.virtual.smartevse_frames import read_frame

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("not_set_up", "quick_search")


def polled(name: str, limit: float = 16, **more: object) -> dict[str, Any]:
    return charger(name, limit) | {"stop_on_shutdown": False} | more


async def choose(flow: Flow, unit: str) -> Flow:
    return await flow.submit({"chargers": unit})


# -- Which way ---------------------------------------------------------------------


async def test_each_way_says_what_happens_without_home_assistant(
    hass: HomeAssistant,
) -> None:
    flow = await Flow.add_bus(hass)
    await flow.submit({"protocol": "smartevse"})
    assert flow.step == "mode"
    assert flow.tells("LOAD BAL Disabled", "no fail-safe", "(MAX) for a moment")
    assert flow.tells("Slave 1", "Node 1 to 7", "stop charging after 10 to 20 s")
    await flow.choose("polled")
    assert flow.step == "port"
    flow.abort()


# -- Search ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dialect", "unit", "serial"),
    [("2.17", 0, None), ("2.20", 0, None), ("2.20", 1, None), ("2.30", 1, "4711")],
)
async def test_box_is_found_in_each_dialect(
    hass: HomeAssistant, dialect: str, unit: int, serial: str | None
) -> None:
    box = SmartEvse(dialect, unit=unit, serial=4711)
    with VirtualBus.in_loop(box) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        assert flow.step == "scan"
        await flow.wait()
        assert flow.progress == sorted(flow.progress)
        assert flow.progress[-1] == 1

        assert flow.step == "select"
        assert fields(flow) == {"chargers": str(unit)}
        [option] = flow.result["data_schema"].schema["chargers"].config["options"]
        assert option["label"].startswith(f"{unit}: ")
        assert "SmartEVSE v2" in option["label"]
        assert f"firmware {dialect}" in option["label"]
        await bus.wait_for_async(lambda: not bus.connected)
        assert not box.writes

        await choose(flow, str(unit))
        assert flow.step == "charger"
        assert flow.tells("Charger 1 of 1", f"firmware {dialect}", f" at {unit}, ")
        assert fields(flow) == {
            "name": "SmartEVSE",
            "installation_limit": 16,
            "fail_safe_current": 6,
            "stop_on_shutdown": False,
            "expert": {"poll_interval": 2, "voltage": 230},
        }
        await flow.submit(polled("Garage", order_lifetime=15, stop_on_shutdown=True))

        # Nothing is taken for a confirmation that is none.
        await flow.reload()
        assert flow.step == "confirm_smartevse"
        table = flow.result["description_placeholders"]["chargers"]
        assert table == f"| Garage | {unit} | 16 A | 6 A | 15 min | ✓ |"
        assert flow.tells("has no fail-safe", "begins with MAX", "power failure")
        # Which of the two cannot be read.
        assert flow.tells("2.17 exists in two builds", "takes no limit", "is stopped")
        await flow.submit()

    entry = flow.result["result"]
    assert entry.title == f"SmartEVSE bus ({Path(bus.url).name})"
    assert entry.data == {"protocol": "smartevse", "device": bus.url}
    [stored] = entry.subentries.values()
    # Its serial number has 16 bits: two boxes may have the same.
    assert (stored.title, stored.unique_id) == ("Garage", None)
    assert stored.data == {
        "address": unit,
        "serial": serial,
        "installation_limit": 16,
        "voltage": 230,
        "poll_interval": 2,
        "order_lifetime": 15,
        "fail_safe_current": 6,
        "stop_on_shutdown": True,
        "dialect": dialect,
    }


async def test_line_that_nobody_answers_on(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        assert flow.step == "nothing_found"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("9600 8N1", "LOAD BAL", bus.url)
        bus.add(SmartEvse())
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


async def test_line_on_which_another_device_asks(hass: HomeAssistant) -> None:
    """As a 3.x that is disabled or master: it answers nobody, and asks its meter."""
    with VirtualBus.in_loop(baud=9600) as bus:
        bus.foreign_traffic(read_frame(10, 0x0000, 6, 4), every=2.0)
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        assert flow.step == "foreign_requests"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("Node 1 to 7", "every 2 seconds", "MODE to Normal", bus.url)
        bus.quiet()
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "nothing_found"
        assert flow.tells("A 3.x never answers with LOAD BAL Disabled or Master")
        flow.abort()


@pytest.mark.parametrize("load_balance", [0, 1], ids=["disabled", "master"])
async def test_3x_that_answers_nobody_is_recognised_by_its_requests(
    hass: HomeAssistant, load_balance: int
) -> None:
    box = SmartEvse("3", load_balance=load_balance, settings={"mains_meter": 1})
    with VirtualBus.in_loop(box) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        assert flow.step == "foreign_requests"
        assert flow.tells("SmartEVSE 3.x", "answers nobody", "Node 1 to 7")
        flow.abort()


async def test_3x_that_answers_and_asks_nobody(hass: HomeAssistant) -> None:
    """Disabled, and without a meter: the hint is always there."""
    box = SmartEvse("3", load_balance=0)
    with VirtualBus.in_loop(box) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        assert flow.step == "nothing_found"
        assert flow.tells("A 3.x never answers with LOAD BAL Disabled or Master")
        flow.abort()


async def test_answers_that_nobody_can_read_may_be_two_boxes(
    hass: HomeAssistant,
) -> None:
    box = SmartEvse()
    with VirtualBus.in_loop(box) as bus:
        box.faults.byte_error_rate = 1.0
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        assert flow.step == "duplicates"
        assert flow.tells("at 0 on", "Only one box can be polled")
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        flow.abort()


async def test_adapter_unplugged_during_the_search(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        await bus.wait_for_async(lambda: bus.log.total)
        bus.unplug()
        await flow.wait()
        assert flow.step == "port"
        assert flow.errors == {"base": "port_lost"}
        flow.abort()


async def test_port_that_is_not_there(hass: HomeAssistant) -> None:
    flow = await smartevse_step(hass, "polled", NOWHERE)
    assert flow.errors == {"base": "port_missing"}
    flow.abort()


# -- Typed in ----------------------------------------------------------------------


async def test_box_is_typed_in_without_a_word_on_the_wire(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        said = bus.log.total
        await flow.choose("manual")
        [unit] = flow.result["data_schema"].schema.values()
        assert unit.config["options"] == ["0", "1"]
        for wrong in ("2", "-1", "zero", ["0", "1"]):
            with pytest.raises(InvalidData):
                await flow.submit({"unit": wrong})
        await flow.submit({"unit": "0"})
        assert flow.tells("Charger 1 of 1", "? at 0")
        await flow.submit(polled("Garage"))
        assert flow.step == "confirm_smartevse"
        table = flow.result["description_placeholders"]["chargers"]
        assert table == "| Garage | 0 | 16 A | 6 A | - | - |"
        await flow.submit()
        assert bus.log.total == said
    [stored] = flow.result["result"].subentries.values()
    assert stored.unique_id is None
    assert stored.data["address"] == 0
    assert stored.data["serial"] is None
    assert stored.data["order_lifetime"] is None
    assert stored.data["stop_on_shutdown"] is False


@pytest.mark.parametrize(
    ("wrong", "errors"),
    [
        ({"name": " "}, {"name": "name_empty"}),
        ({"installation_limit": "nan"}, {"installation_limit": "not_a_number"}),
        (
            {"fail_safe_current": 16.1},
            {"fail_safe_current": "above_installation_limit"},
        ),
        ({"order_lifetime": "nan"}, {"order_lifetime": "not_a_number"}),
        ({"expert": {"poll_interval": "nan"}}, {"base": "expert_not_a_number"}),
    ],
)
async def test_charger_form_says_what_is_wrong(
    hass: HomeAssistant, wrong: dict[str, Any], errors: dict[str, str]
) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        await flow.choose("manual")
        await flow.submit({"unit": "1"})
        await flow.submit(polled("Box") | wrong)
        assert flow.step == "charger"
        assert flow.errors == errors
        with pytest.raises(InvalidData):
            await flow.submit(polled("Box", order_lifetime=0))
        flow.abort()


def test_a_limit_is_corrected_soon_after_a_charge_has_begun() -> None:
    """Firmware 2.17 takes one only while a car charges."""
    config = PROTOCOLS["smartevse"].config(key="", name="", address=0)
    assert config.poll_interval <= 2
