"""Flows as the frontend goes through them, each text they show looked up."""

import asyncio
from collections.abc import Mapping
from functools import cache
import json
from pathlib import Path
import re
from typing import TYPE_CHECKING, Any

from homeassistant.components.repairs import repairs_flow_manager
from homeassistant.config_entries import (
    SOURCE_IGNORE,
    SOURCE_INTEGRATION_DISCOVERY,
    SOURCE_RECONFIGURE,
    SOURCE_USER,
    ConfigEntry,
    ConfigSubentry,
)
from homeassistant.core import Event, callback
from homeassistant.data_entry_flow import (
    EVENT_DATA_ENTRY_FLOW_PROGRESS_UPDATE,
    EVENT_DATA_ENTRY_FLOW_PROGRESSED,
    FlowResultType,
    section,
)
from homeassistant.helpers import config_validation as cv, issue_registry as ir
from homeassistant.helpers.selector import NumberSelector, SelectSelector
from homeassistant.setup import async_setup_component
import probatio as vol

from custom_components.evse_bus.const import DOMAIN, SUBENTRY_CHARGER

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

ENGLISH = Path(__file__).parents[1] / f"custom_components/{DOMAIN}/translations/en.json"
PATIENCE = 50
BROWSER = 1.0
"""Time until a browser that shows a search has subscribed to its end, s."""
NOWHERE = "/dev/serial/by-id/usb-there-is-no-such-adapter"
IMPOSED = {
    "installation_limit": 20,
    "search_current": "6",
    "fail_safe_current": 6.5,
    "fail_safe_timeout": 90,
    "confirm": True,
}
"""What is confirmed before an EVBox is searched."""


@cache
def english() -> dict[str, Any]:
    return json.loads(ENGLISH.read_text())


def has_range(text: str, lowest: float, highest: float) -> bool:
    """Return whether a text names both ends of a range."""
    numbers = {float(number) for number in re.findall(r"\d+(?:\.\d+)?", text)}
    return {float(lowest), float(highest)} <= numbers


class Flow:
    """One flow of the config entry or of one of its subentries."""

    def __init__(self, hass: HomeAssistant, entry: ConfigEntry | None = None) -> None:
        self.hass = hass
        self.entry = entry
        self.result: dict[str, Any] = {}
        self.progress: list[float] = []
        self.shown: list[str] = []
        self.texts = english()["config"]
        self.manager = hass.config_entries.flow

    @classmethod
    async def add_bus(cls, hass: HomeAssistant) -> Flow:
        flow = cls(hass)
        await flow._start(DOMAIN, {"source": SOURCE_USER})
        return flow

    @classmethod
    async def change_bus(cls, hass: HomeAssistant, entry: ConfigEntry) -> Flow:
        flow = cls(hass, entry)
        context = {"source": SOURCE_RECONFIGURE, "entry_id": entry.entry_id}
        await flow._start(DOMAIN, context)
        return flow

    @classmethod
    async def add_charger(cls, hass: HomeAssistant, entry: ConfigEntry) -> Flow:
        return await cls._charger(hass, entry, {"source": SOURCE_USER})

    @classmethod
    async def change_charger(
        cls, hass: HomeAssistant, entry: ConfigEntry, subentry: ConfigSubentry
    ) -> Flow:
        context = {
            "source": SOURCE_RECONFIGURE,
            "subentry_id": subentry.subentry_id,
        }
        return await cls._charger(hass, entry, context)

    @classmethod
    async def change_settings(
        cls, hass: HomeAssistant, entry: ConfigEntry, subentry: ConfigSubentry
    ) -> Flow:
        flow = await cls.change_charger(hass, entry, subentry)
        return await flow.choose("settings")

    @classmethod
    async def replace_charger(
        cls, hass: HomeAssistant, entry: ConfigEntry, subentry: ConfigSubentry
    ) -> Flow:
        flow = await cls.change_charger(hass, entry, subentry)
        return await flow.choose("replace")

    @classmethod
    async def _charger(
        cls, hass: HomeAssistant, entry: ConfigEntry, context: dict[str, Any]
    ) -> Flow:
        flow = cls(hass, entry)
        flow.texts = english()["config_subentries"][SUBENTRY_CHARGER]
        flow.manager = hass.config_entries.subentries
        await flow._start((entry.entry_id, SUBENTRY_CHARGER), context)
        return flow

    @classmethod
    async def repair(cls, hass: HomeAssistant, key: str) -> Flow:
        """Open the flow that fixes an issue."""
        assert await async_setup_component(hass, "repairs", {})
        manager = repairs_flow_manager(hass)
        assert manager is not None
        found = issue(hass, key)
        assert found is not None
        flow = cls(hass)
        flow.texts = english()["issues"][found.translation_key]["fix_flow"]
        flow.manager = manager
        await flow._start(DOMAIN, {"issue_id": key})
        return flow

    @classmethod
    async def change_options(cls, hass: HomeAssistant, entry: ConfigEntry) -> Flow:
        flow = cls(hass, entry)
        flow.texts = english()["options"]
        flow.manager = hass.config_entries.options
        await flow._start(entry.entry_id, {"source": SOURCE_USER})
        return flow

    @classmethod
    async def discovered(cls, hass: HomeAssistant, flow_id: str) -> Flow:
        """Open a flow that began by itself, as the frontend does."""
        flow = cls(hass)
        flow._take(await flow.manager.async_configure(flow_id))
        return flow

    async def _start(self, handler: object, context: dict[str, Any]) -> None:
        self._take(await self.manager.async_init(handler, context=context))

    @property
    def flow_id(self) -> str:
        return self.result["flow_id"]

    @property
    def step(self) -> str:
        return self.result["step_id"]

    @property
    def errors(self) -> dict[str, str]:
        return self.result["errors"]

    async def submit(self, typed: Mapping[str, Any] | None = None) -> Flow:
        """Send a form."""
        assert self.result["type"] is FlowResultType.FORM
        self._take(await self.manager.async_configure(self.flow_id, dict(typed or {})))
        return self

    async def choose(self, option: str) -> Flow:
        """Choose from a menu."""
        assert option in self.result["menu_options"]
        self._take(
            await self.manager.async_configure(self.flow_id, {"next_step_id": option})
        )
        return self

    async def wait(self) -> Flow:
        """Wait for the end of a search, as the frontend does: for its event.

        It subscribes once it shows the progress; an earlier event is lost.
        """
        assert self.result["type"] is FlowResultType.SHOW_PROGRESS
        done = asyncio.Event()

        @callback
        def progressed(event: Event) -> None:
            if event.data["flow_id"] == self.flow_id:
                done.set()

        @callback
        def progress(event: Event) -> None:
            if event.data["flow_id"] == self.flow_id:
                self.progress.append(event.data["progress"])

        listen = self.hass.bus.async_listen
        stop = [listen(EVENT_DATA_ENTRY_FLOW_PROGRESS_UPDATE, progress)]
        try:
            await asyncio.sleep(BROWSER)
            stop.append(listen(EVENT_DATA_ENTRY_FLOW_PROGRESSED, progressed))
            async with asyncio.timeout(PATIENCE):
                await done.wait()
        finally:
            for one in stop:
                one()
        self._take(await self.manager.async_configure(self.flow_id))
        return self

    async def reload(self) -> Flow:
        """Ask for the present step again, as a page does that is loaded again."""
        self._take(await self.manager.async_configure(self.flow_id))
        return self

    def abort(self) -> None:
        """Close the dialogue."""
        self.manager.async_abort(self.flow_id)

    def tells(self, *words: str) -> bool:
        """Return whether one text of the present step has all these words."""
        return any(all(word in text for word in words) for text in self.shown)

    # -- Everything that is shown has a text --------------------------------------

    def _take(self, result: Mapping[str, Any]) -> None:
        self.result = dict(result)
        self.shown = []
        kind = result["type"]
        given = result.get("description_placeholders") or {}
        if kind is FlowResultType.ABORT:
            if "translation_domain" not in result:
                self._text(self.texts["abort"][result["reason"]], given)
        elif kind is FlowResultType.CREATE_ENTRY:
            if (described := result["description"]) is not None:
                self._text(self.texts["create_entry"][described], given)
        elif kind is FlowResultType.SHOW_PROGRESS:
            self._text(self.texts["progress"][result["progress_action"]], given)
        elif kind is FlowResultType.MENU:
            texts = self._step_texts(given)
            described = texts.get("menu_option_descriptions", {})
            for option in result["menu_options"]:
                self._text(texts["menu_options"][option], given)
                if option in described:
                    self._text(described[option], given)
        elif kind is FlowResultType.FORM:
            self._form(result, given)

    def _form(self, result: Mapping[str, Any], given: Mapping[str, str]) -> None:
        texts = self._step_texts(given)
        for error in (result["errors"] or {}).values():
            self._text(self.texts["error"][error], given)
        if (schema := result["data_schema"]) is not None:
            # As the frontend gets it; raises for what cannot be told to it.
            vol.to_field_list(schema, custom_serializer=cv.custom_serializer)
            self._fields(schema, texts, given)

    def _step_texts(self, given: Mapping[str, str]) -> dict[str, Any]:
        texts = self.texts["step"][self.step]
        self._text(texts["title"], given)
        self._text(texts["description"], given)
        return texts

    def _fields(
        self, schema: vol.Schema, texts: dict[str, Any], given: Mapping[str, str]
    ) -> None:
        for key, field in schema.schema.items():
            if isinstance(field, section):
                inner = texts["sections"][key.schema]
                self._text(inner["name"], given)
                self._text(inner["description"], given)
                self._fields(field.schema, inner, given)
                continue
            self._text(texts["data"][key.schema], given)
            self._text(texts["data_description"][key.schema], given)
            if isinstance(field, SelectSelector) and (
                key := field.config.get("translation_key")
            ):
                labels = english()["selector"][key]["options"]
                assert set(field.config["options"]) <= set(labels)
            if isinstance(field, NumberSelector):
                # Home Assistant refuses what is outside, in words of its own.
                text = texts["data_description"][key.schema]
                assert has_range(text, field.config["min"], field.config["max"]), text

    def _text(self, text: str, given: Mapping[str, str]) -> None:
        wanted = set(re.findall(r"{(\w+)}", text))
        assert wanted <= given.keys(), text
        self.shown.append(text.format(**given))


def offers(hass: HomeAssistant) -> dict[str, str]:
    """Return the flows that began by themselves, by the name that they are shown with.

    Each name leads to the id of a flow.
    """
    title = english()["config"]["flow_title"]
    return {
        title.format(**flow["context"]["title_placeholders"]): flow["flow_id"]
        for flow in hass.config_entries.flow.async_progress_by_handler(DOMAIN)
        if flow["context"]["source"] == SOURCE_INTEGRATION_DISCOVERY
    }


async def ignore(hass: HomeAssistant, flow_id: str) -> ConfigEntry:
    """Ignore what is offered, as the frontend does; return the entry that says so."""
    manager = hass.config_entries.flow
    context = manager.async_get(flow_id)["context"]
    result = await manager.async_init(
        DOMAIN,
        context={
            "source": SOURCE_IGNORE,
            "discovery_key": context["discovery_key"],
        },
        data={"unique_id": context["unique_id"], "title": "Not ours"},
    )
    return result["result"]


def fields(flow: Flow) -> dict[str, Any]:
    """Return what a form offers: suggested values and defaults, by key."""
    return _offered(flow.result["data_schema"])


def _offered(schema: vol.Schema) -> dict[str, Any]:
    offered = {}
    for key, field in schema.schema.items():
        if isinstance(field, section):
            offered[key.schema] = _offered(field.schema)
        elif key.description and "suggested_value" in key.description:
            offered[key.schema] = key.description["suggested_value"]
        elif callable(key.default):
            offered[key.schema] = key.default()
    return offered


async def port_step(
    hass: HomeAssistant, protocol: str, device: str, **line: object
) -> Flow:
    flow = await Flow.add_bus(hass)
    assert flow.step == "user"
    await flow.submit({"protocol": protocol})
    assert flow.step == "port"
    return await flow.submit({"device": device, "line": line})


async def smartevse_step(
    hass: HomeAssistant, mode: str, device: str, **line: object
) -> Flow:
    flow = await Flow.add_bus(hass)
    await flow.submit({"protocol": "smartevse"})
    assert flow.step == "mode"
    assert flow.result["menu_options"] == ["polled", "master"]
    await flow.choose(mode)
    assert flow.step == "port"
    assert flow.tells("9600 8N1")
    return await flow.submit({"device": device, "line": line})


async def ews_step(
    hass: HomeAssistant, connection: str, device: str | None = None
) -> Flow:
    flow = await Flow.add_bus(hass)
    await flow.submit({"protocol": "ews"})
    assert flow.step == "connection"
    assert flow.result["menu_options"] == ["ews_serial", "ews_network"]
    await flow.choose(connection)
    if device is None:
        return flow
    assert flow.step == "port"
    assert flow.tells("RS-232 adapter", "115200 8N1")
    return await flow.submit({"device": device, "line": {}})


def box(name: str, *limits: float, **more: object) -> dict[str, Any]:
    """Return what is typed for an EWS-Box, with a limit for each port that is used."""
    keys = ("installation_limit", "installation_limit_2")
    return {
        "name": name,
        "ports": str(len(limits)),
        "fail_safe_current": 6,
        "expert": {},
        **dict(zip(keys, limits, strict=False)),
        **more,
    }


def charger(name: str, limit: float = 16, **more: object) -> dict[str, Any]:
    return {
        "name": name,
        "installation_limit": limit,
        "fail_safe_current": 6,
        "expert": {},
    } | more


def issue(hass: HomeAssistant, key: str) -> ir.IssueEntry | None:
    """Return an issue whose texts are there and fit its placeholders."""
    found = ir.async_get(hass).async_get_issue(DOMAIN, key)
    if found is None:
        return None
    assert found.translation_key is not None
    texts = dict(english()["issues"][found.translation_key])
    if fix := texts.pop("fix_flow", None):
        texts |= fix["step"]["confirm"]
        assert found.is_fixable
    for text in texts.values():
        assert text.format(**found.translation_placeholders or {})
    return found
