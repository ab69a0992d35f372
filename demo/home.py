"""Set-up of a new Home Assistant: buses, limits, automation, dashboard."""

import asyncio
from collections.abc import Mapping
import json
from typing import Any, Final

from .automation import AUTOMATION_ID, answer_start_requests
from .buses import BUSES, Answer, DemoBus
from .client import Client
from .dashboard import ICON, TITLE, URL_PATH, dashboard
from .flow import add_discovered, add_entry, find_offer
from .listing import DOMAIN, ListedBus, list_buses
from .settings import DemoError, Settings
from .terminal import Progress, report

PATIENCE: Final = 60.0
"""Longest wait until all chargers show all their connectors, s."""
BOX_PATIENCE: Final = 20.0
"""Longest wait until a box dials, s."""
GLANCE: Final = 0.5


async def furnish(client: Client, settings: Settings) -> None:
    """Add what is missing."""
    new = [bus for bus in BUSES if await _add_bus(client, settings, bus)]
    if new:
        buses = await _all_listed(client)
        for bus in new:
            await _first_limits(client, bus, buses)
    else:
        buses = await _listed(client)
    await _add_automation(client, buses)
    await _show_dashboard(client, settings, buses)


async def _add_bus(client: Client, settings: Settings, bus: DemoBus) -> bool:
    """Add a bus; return whether any part of it was missing."""
    answers = bus.answers(settings)
    with Progress(f"{bus.title}: config flow") as progress:
        new = await add_entry(client, DOMAIN, answers, progress.show)
        progress.outcome = "completed" if new else "this bus is set up already"
    if bus.dials:
        for serial in bus.names:
            new |= await _add_box(client, bus, serial, answers)
    return new


async def _add_box(
    client: Client, bus: DemoBus, serial: str, answers: Mapping[str, Answer]
) -> bool:
    """Add a box that has dialled, as it is offered; return whether it was missing."""
    unique_id = f"ews_{serial}"
    with Progress(f"{bus.names[serial]}: discovered") as progress:
        if unique_id in await _chargers(client):
            progress.outcome = "this box is set up already"
            return False
        while (flow := await find_offer(client, DOMAIN, unique_id)) is None:
            if progress.seconds > BOX_PATIENCE:
                # The discovery may have been ignored.
                progress.outcome = "not offered"
                return False
            progress.show("waiting until it dials")
            await asyncio.sleep(GLANCE)
        await add_discovered(client, flow, answers, progress.show)
        progress.outcome = "added"
        return True


async def _chargers(client: Client) -> set[str]:
    """Return the unique ids of all chargers that are set up."""
    found: set[str] = set()
    for entry in await client.command("config_entries/get", domain=DOMAIN):
        subentries = await client.command(
            "config_entries/subentries/list", entry_id=entry["entry_id"]
        )
        found.update(one["unique_id"] for one in subentries)
    return found


async def _listed(client: Client) -> list[ListedBus]:
    return list_buses(
        await client.command("config/entity_registry/list"),
        await client.command("config/device_registry/list"),
    )


async def _all_listed(client: Client) -> list[ListedBus]:
    """Wait for the first replies of the chargers, with their number of connectors."""
    expected = sum(bus.connectors for bus in BUSES)
    with Progress("Chargers: waiting for their first replies") as progress:
        while True:
            buses = await _listed(client)
            listed = sum(
                connector.find("status", "charging") is not None
                for bus in buses
                for charger in bus.chargers
                for connector in charger.connectors.values()
            )
            if listed >= expected:
                return buses
            if progress.seconds > PATIENCE:
                report(f"only {listed} of {expected} connectors have reported")
                return buses
            progress.show(f"{listed} of {expected} connectors")
            await asyncio.sleep(GLANCE)


async def _first_limits(client: Client, bus: DemoBus, buses: list[ListedBus]) -> None:
    """Raise the limits from the fail-safe values that a new charger begins with."""
    for listed in buses:
        for charger in listed.chargers:
            if charger.name not in bus.currents:
                continue
            for part in (charger, *charger.connectors.values()):
                if entity := part.find("charging_current"):
                    values = {"entity_id": entity, "value": bus.currents[charger.name]}
                    await client.post("services/number/set_value", values)


async def _add_automation(client: Client, buses: list[ListedBus]) -> None:
    """Add the automation for start requests, unless there is one, changed or not."""
    wanted = answer_start_requests(buses)
    entities = await client.command("config/entity_registry/list")
    there = {one["unique_id"] for one in entities if one["platform"] == "automation"}
    if wanted is not None and AUTOMATION_ID not in there:
        await client.post(f"config/automation/config/{AUTOMATION_ID}", wanted)


async def _show_dashboard(
    client: Client, settings: Settings, buses: list[ListedBus]
) -> None:
    """Create the dashboard, or update it unless the user has changed it."""
    ours = settings.folder / "dashboard.json"
    wanted = dashboard(buses)
    present = await client.command("lovelace/dashboards/list")
    if not any(one["url_path"] == URL_PATH for one in present):
        await client.command(
            "lovelace/dashboards/create",
            url_path=URL_PATH,
            title=TITLE,
            icon=ICON,
            show_in_sidebar=True,
        )
        await _open_first(client)
    elif not await _is_ours(client, ours.read_text("utf-8") if ours.exists() else ""):
        return
    await client.command("lovelace/config/save", url_path=URL_PATH, config=wanted)
    ours.write_text(json.dumps(wanted), encoding="utf-8")


async def _is_ours(client: Client, written: str) -> bool:
    try:
        stored = await client.command("lovelace/config", url_path=URL_PATH)
    except DemoError:
        # An earlier start was interrupted before it saved one.
        return True
    return written != "" and stored == json.loads(written)


async def _open_first(client: Client) -> None:
    stored = await client.command("frontend/get_system_data", key="core")
    core: Mapping[str, Any] = stored["value"] or {}
    await client.command(
        "frontend/set_system_data",
        key="core",
        value={**core, "default_panel": URL_PATH},
    )
