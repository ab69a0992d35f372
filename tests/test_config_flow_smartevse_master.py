"""Adding a bus on which Home Assistant is the master of SmartEVSEs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from homeassistant.data_entry_flow import InvalidData
import pytest

from custom_components.evse_bus.evse.smartevse import master
from tests.flow import Flow, charger, fields, smartevse_step
from tests.virtual import SmartEvse, VirtualBus, smartevse_requests_in
from tests.virtual.smartevse_frames import read_frame

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("not_set_up", "quick_search")

SUPPLY = {"supply_limit": 25, "supply_minimum": 7}


def slave(unit: int, **more: object) -> SmartEvse:
    return SmartEvse(load_balance=unit, **more)


async def searched(
    hass: HomeAssistant, bus: VirtualBus, supply: dict[str, Any] = SUPPLY
) -> Flow:
    """Go as far as the end of the search."""
    flow = await smartevse_step(hass, "master", bus.url)
    assert flow.step == "supply"
    await flow.submit(supply)
    return await flow.wait()


# -- What they share ---------------------------------------------------------------


async def test_shared_supply_is_asked_before_anything_is_said(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await smartevse_step(hass, "master", bus.url)
        assert flow.step == "supply"
        assert fields(flow) == {"supply_limit": 16, "supply_minimum": 6}
        assert flow.tells("cable and the fuse")
        await flow.submit({"supply_limit": "nan", "supply_minimum": 6})
        assert flow.errors == {"supply_limit": "not_a_number"}
        await flow.submit({"supply_limit": 16, "supply_minimum": "nan"})
        assert flow.errors == {"supply_minimum": "not_a_number"}
        await flow.submit({"supply_limit": 9.9, "supply_minimum": 10})
        assert flow.errors == {"supply_minimum": "above_supply"}
        for wrong in (
            {"supply_limit": 5.9},
            {"supply_limit": 561},
            {"supply_limit": "inf"},
            {"supply_minimum": 5.9},
            {"supply_minimum": 16.1},
        ):
            with pytest.raises(InvalidData):
                await flow.submit({"supply_limit": 16, "supply_minimum": 6} | wrong)
        assert not bus.log.total
        await flow.submit({"supply_limit": 10, "supply_minimum": 10})
        assert flow.step == "scan"
        flow.abort()


# -- Search ------------------------------------------------------------------------


async def test_slaves_are_found_and_added(hass: HomeAssistant) -> None:
    boxes = slave(2), slave(4)
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await searched(hass, bus)
        assert flow.progress == sorted(flow.progress)
        assert flow.progress[-1] == 1
        assert flow.step == "select"
        assert fields(flow) == {"chargers": ["2", "4"], "installation_limit": 16}
        options = flow.result["data_schema"].schema["chargers"].config["options"]
        assert [one["label"].split(":")[0] for one in options] == [
            "Slave 1 / Node 1",
            "Slave 3 / Node 3",
        ]
        await bus.wait_for_async(lambda: not bus.connected)
        # A search only reads: no broadcast either.
        for box in boxes:
            assert not box.writes
            assert not box.broadcasts

        await flow.submit({"chargers": ["2", "4"], "installation_limit": 16})
        assert flow.tells("Charger 1 of 2", "firmware 2.17 at Slave 1 / Node 1")
        assert fields(flow) == {
            "name": "SmartEVSE Node 1",
            "installation_limit": 16,
            "fail_safe_current": 6,
            "expert": {"poll_interval": 2, "voltage": 230},
        }
        await flow.submit(charger("Left"))
        await flow.submit(
            charger("Right", 13, expert={"order_lifetime": 30, "poll_interval": 3})
        )
        await flow.reload()
        assert flow.step == "confirm_smartevse_master"
        table = flow.result["description_placeholders"]["chargers"]
        assert (
            table == "| Left | Slave 1 / Node 1 | 16 A | 6 A |\n"
            "| Right | Slave 3 / Node 3 | 13 A | 6 A |"
        )
        assert flow.tells(
            "25 A per phase", "less than 7 A", "12 s at most", "perhaps never"
        )
        await flow.submit()

    entry = flow.result["result"]
    assert entry.title == f"SmartEVSE bus ({Path(bus.url).name})"
    assert entry.data == {
        "protocol": "smartevse_master",
        "device": bus.url,
        "supply_limit": 25.0,
        "supply_minimum": 7.0,
    }
    left, right = entry.subentries.values()
    assert left.unique_id is None
    assert left.data == {
        "address": 2,
        "serial": None,
        "installation_limit": 16,
        "voltage": 230,
        "poll_interval": 2,
        "order_lifetime": None,
        "fail_safe_current": 6,
        "dialect": "2.17",
    }
    assert right.data["address"] == 4
    assert right.data["installation_limit"] == 13
    assert right.data["order_lifetime"] == 30


async def test_no_box_is_offered_more_than_all_of_them_share(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(slave(2)) as bus:
        flow = await searched(hass, bus, {"supply_limit": 10, "supply_minimum": 6})
        assert fields(flow)["installation_limit"] == 10
        flow.abort()


async def test_another_master_is_noticed_and_nothing_is_said(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(master, "LISTENING", 2.5)
    other, node = SmartEvse(load_balance=1), slave(2)
    with VirtualBus.in_loop(other, node) as bus:
        await bus.wait_for_async(lambda: node.broadcasts)
        flow = await searched(hass, bus)
        assert flow.step == "other_master"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("LOAD BAL is Master", bus.url)
        assert not smartevse_requests_in(bus.log.bursts())

        # The other one is set to Slave, as the text says.
        bus.remove(other)
        monkeypatch.setattr(master, "LISTENING", 0.3)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


async def test_box_that_asks_its_meter_and_answers_nobody(hass: HomeAssistant) -> None:
    """As a 3.x that is disabled; it is no other master, and does not yield."""
    with VirtualBus.in_loop(baud=9600) as bus:
        bus.foreign_traffic(read_frame(10, 0x0000, 6, 4), every=2.0)
        flow = await searched(hass, bus)
        assert flow.step == "foreign_requests"
        assert flow.tells("Node 1 to 7")
        flow.abort()


async def test_nodes_of_later_firmware_are_found_at_all_addresses(
    hass: HomeAssistant,
) -> None:
    boxes = slave(2, dialect="2.30"), slave(5, dialect="2.30+"), slave(8, dialect="3")
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await searched(hass, bus)
        assert flow.progress == sorted(flow.progress)
        assert flow.step == "select"
        assert fields(flow)["chargers"] == ["2", "5", "8"]
        await flow.submit({"chargers": ["2", "5", "8"], "installation_limit": 16})
        assert fields(flow)["name"] == "SmartEVSE Node 1"
        for name in ("A", "B", "C"):
            await flow.submit(charger(name))
        assert flow.step == "confirm_smartevse_master"
        await flow.submit()
        for box in boxes:
            assert not box.writes
            assert not box.broadcasts
    kept = [one.data["dialect"] for one in flow.result["result"].subentries.values()]
    assert kept == ["2.30", "2.30+", "3.x"]


async def test_box_that_perhaps_does_not_stop_is_told(hass: HomeAssistant) -> None:
    boxes = slave(2, dialect="3.6"), slave(3, dialect="3")
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await searched(hass, bus)
        await flow.submit({"chargers": ["2", "3"], "installation_limit": 16})
        await flow.submit(charger("Old one"))
        await flow.submit(charger("New one"))
        assert flow.step == "fail_safe_unproven"
        assert flow.tells("**Old one**", "before 3.7.4", "Update")
        await flow.submit()
        assert flow.step == "confirm_smartevse_master"
        flow.abort()


@pytest.mark.parametrize(
    ("dialects", "shown"),
    [
        (("2.17", "2.30"), "firmware 2.17\n\n- Slave 2 / Node 2: SmartEVSE v2"),
        (("2.17", "2.20"), "firmware 2.17\n\n- Slave 2 / Node 2: SmartEVSE v2"),
        (("2.30+", "2.20"), "firmware 2.20\n\n- Slave 1 / Node 1: SmartEVSE v2"),
        (("3", "2.20"), "firmware 2.20\n\n- Slave 1 / Node 1: SmartEVSE v3"),
    ],
)
async def test_mix_of_firmwares_is_refused(
    hass: HomeAssistant, dialects: tuple[str, str], shown: str
) -> None:
    first, second = (
        slave(unit, dialect=dialect) for unit, dialect in enumerate(dialects, start=2)
    )
    with VirtualBus.in_loop(first, second) as bus:
        flow = await searched(hass, bus)
        assert flow.step == "mixed_firmware"
        assert flow.result["menu_options"] == ["scan", "port"]
        assert shown in flow.result["description_placeholders"]["chargers"]
        assert flow.tells("off this line", "Update", "Another setting under LOAD BAL")
        # As the text says.
        bus.remove(second)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        assert not first.writes
        flow.abort()


async def test_two_boxes_with_one_unit_are_told(hass: HomeAssistant) -> None:
    twins = slave(2, name="one"), slave(2, name="other", cable=32, min_current=10)
    with VirtualBus.in_loop(*twins, slave(3)) as bus:
        flow = await searched(hass, bus)
        assert flow.step == "duplicates"
        assert flow.tells("at Slave 1 / Node 1 on", "a number of its own")
        await flow.choose("select")
        assert fields(flow)["chargers"] == ["3"]
        flow.abort()


async def test_slaves_are_typed_in(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await searched(hass, bus)
        assert flow.step == "nothing_found"
        await flow.choose("manual")
        [slaves] = flow.result["data_schema"].schema.values()
        assert slaves.config["options"] == [str(unit) for unit in range(2, 9)]
        with pytest.raises(InvalidData):
            await flow.submit({"slaves": ["1"]})
        await flow.submit({"slaves": []})
        assert flow.errors == {"slaves": "no_address"}
        await flow.submit({"slaves": ["3", "2"]})
        await flow.submit(charger("Three"))
        await flow.submit(charger("Two"))
        await flow.submit()
    three, two = flow.result["result"].subentries.values()
    assert (three.data["address"], two.data["address"]) == (3, 2)
    assert two.unique_id is None


async def test_shared_supply_typed_once_is_offered_again(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(baud=9600) as bus:
        flow = await searched(hass, bus)
        await flow.choose("port")
        await flow.submit({"device": bus.url, "line": {}})
        assert flow.step == "supply"
        assert fields(flow) == SUPPLY
        flow.abort()
