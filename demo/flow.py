"""Going through a config flow, step by step."""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, Final

from .buses import Answer
from .client import Client
from .settings import DemoError

FLOWS: Final = "config/config_entries/flow"
GLANCE: Final = 0.2
"""Seconds between two reads of a step that takes a while."""


def fill(fields: Iterable[Mapping[str, Any]], values: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return the input for a form in which only these values are changed.

    ``fields``: as Home Assistant sends a form to its frontend. A field without a
    suggestion, a default or a value stays empty.
    """
    typed: dict[str, Any] = {}
    for field in fields:
        name = field["name"]
        suggested = (field.get("description") or {}).get("suggested_value")
        if field.get("type") == "expandable":
            typed[name] = fill(field["schema"], values.get(name, {}))
        elif name in values:
            typed[name] = values[name]
        elif suggested is not None:
            typed[name] = suggested
        elif field.get("default") is not None:
            typed[name] = field["default"]
    return typed


async def add_entry(
    client: Client,
    domain: str,
    answers: Mapping[str, Answer],
    waiting: Callable[[str], None],
) -> bool:
    """Go through a config flow; return whether it created an entry.

    ``waiting`` is called with the name of a step that takes a while. Raises DemoError.
    """
    step = await client.post(FLOWS, {"handler": domain})
    return await _to_the_end(client, step, answers, waiting, "already_configured")


async def find_offer(client: Client, domain: str, unique_id: str) -> str | None:
    """Return the id of the discovery flow of a box, once it is offered."""
    flows = await client.command("config_entries/flow/progress")
    return next(
        (
            flow["flow_id"]
            for flow in flows
            if flow["handler"] == domain
            and flow["context"].get("unique_id") == unique_id
        ),
        None,
    )


async def add_discovered(
    client: Client,
    flow_id: str,
    answers: Mapping[str, Answer],
    waiting: Callable[[str], None],
) -> None:
    """Go through the flow of a box that has dialled. Raises DemoError."""
    step = await client.get(f"{FLOWS}/{flow_id}")
    await _to_the_end(client, step, answers, waiting, "box_added")


async def _to_the_end(
    client: Client,
    step: Mapping[str, Any],
    answers: Mapping[str, Answer],
    waiting: Callable[[str], None],
    good_end: str,
) -> bool:
    """Go on from a step; return whether it created an entry; raises DemoError."""
    flow = f"{FLOWS}/{step['flow_id']}"
    while step["type"] != "create_entry":
        if step["type"] == "abort":
            if step["reason"] == good_end:
                return False
            raise DemoError(f"The config flow was aborted: {step['reason']}")
        try:
            step = await _next(client, flow, step, answers, waiting)
        except BaseException:
            # A flow left open would show in the frontend.
            with suppress(DemoError):
                await client.delete(flow)
            raise
    return True


async def _next(
    client: Client,
    flow: str,
    step: Mapping[str, Any],
    answers: Mapping[str, Answer],
    waiting: Callable[[str], None],
) -> Mapping[str, Any]:
    name = step["step_id"]
    if step["type"] in ("progress", "progress_done"):
        waiting(name)
        await asyncio.sleep(GLANCE)
        return _mapping(await client.get(flow))
    if step.get("errors"):
        raise DemoError(f"The config flow refused step {name}: {step['errors']}")
    if name not in answers:
        raise DemoError(f"The config flow came to step {name}, which has no values")
    answer = answers[name]
    typed = answer(step) if callable(answer) else answer
    if step["type"] == "form":
        typed = fill(step["data_schema"] or (), typed)
    return _mapping(await client.post(flow, typed))


def _mapping(answer: Any) -> Mapping[str, Any]:  # noqa: ANN401 - as the API answers
    if not isinstance(answer, dict):
        raise DemoError(f"The config flow answered {answer!r}")
    return answer
