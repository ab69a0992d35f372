"""Entities and devices as tables of text, for snapshots that can be read in a review.

An entity is one row and, indented below it, whatever is unusual for an entity of this
integration. A field that is in neither has its usual value (`_USUAL`), follows from
the rest of the row, or differs from run to run (`VARYING`).
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from textwrap import wrap
from typing import Any, Final

from attrs import asdict
from homeassistant.core import HomeAssistant, State
from homeassistant.helpers import device_registry as dr, entity_registry as er
from homeassistant.helpers.entity import Entity
from homeassistant.helpers.entity_platform import async_get_platforms
from homeassistant.util import slugify

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.identity import identity_of

UNSTEADY: Final = "…"
"""Stands for a state that depends on the moment of the snapshot."""
_NO_STATE: Final = "(no state)"
_DISABLED: Final = "off"
_NO_KEY: Final = "-"
"""The name is the device class's."""
_INDENT: Final = 6 * " "
_WIDTH: Final = 120
"""Longest line of what stands below a row, characters."""

VARYING: Final = {
    *("id", "device_id", "config_entry_id", "config_subentry_id"),
    *("created_at", "modified_at", "_cache", "categories", "compat_aliases"),
    "original_name_unprefixed",
}
_USUAL: Final[Mapping[str, object]] = {
    "area_id": None,
    "device_class": None,
    "disabled_by": None,
    "has_entity_name": True,
    "hidden_by": None,
    "icon": None,
    "labels": set(),
    "name": None,
    "original_icon": None,
    "platform": DOMAIN,
    "previous_unique_id": None,
    "suggested_object_id": None,
    "supported_features": 0,
}
_ENTITY_HEAD: Final = (
    *("entity", "value", "unit", "digits", "class", "state class", "category"),
    *("default", "unique id", "key", "name"),
)
_DEVICE_VARYING: Final = {
    *("id", "config_entry_id", "config_subentry_id", "created_at", "modified_at"),
    *("via_device_id", "parent_device_id"),
    *("composite_device_id", "composite_primary_config_entry"),
    *("has_composite_identifiers", "split_at"),
}
_DEVICE_USUAL: Final[Mapping[str, object]] = {
    "area_id": None,
    "configuration_url": None,
    "connections": set(),
    "disabled_by": None,
    "entry_type": None,
    "labels": set(),
    "model_id": None,
    "name_by_user": None,
}
_DEVICE_COLUMNS: Final = (
    *("name", "manufacturer", "model", "serial_number", "hw_version", "sw_version"),
)


def entity_table(
    hass: HomeAssistant, entries: Iterable[er.RegistryEntry], unsteady: tuple[str, ...]
) -> str:
    """Return a table of entities, ordered by entity id.

    ``unsteady``: endings of the unique ids whose states are left out.
    """
    entities = {
        entity.entity_id: entity
        for platform in async_get_platforms(hass, DOMAIN)
        for entity in platform.entities.values()
    }
    rows: list[Sequence[str]] = [_ENTITY_HEAD]
    notes: list[Mapping[str, object]] = [{}]
    for entry in sorted(entries, key=lambda entry: entry.entity_id):
        steady = not entry.unique_id.endswith(unsteady)
        state = hass.states.get(entry.entity_id) if steady else None
        enabled = _enabled_by_default(entities[entry.entity_id])
        capabilities = _plain(entry.capabilities or {})
        options = _plain(entry.options)
        digits = options.get("sensor", {}).pop("suggested_display_precision", "")
        rows.append(
            (
                entry.entity_id,
                state.state if state else _NO_STATE if steady else UNSTEADY,
                entry.unit_of_measurement or "",
                str(digits),
                entry.original_device_class or "",
                capabilities.get("state_class", ""),
                entry.entity_category or "",
                "" if enabled else _DISABLED,
                entry.unique_id,
                _key(hass, entry),
                entry.original_name or "",
            )
        )
        notes.append(
            {
                **_entry_notes(hass, entry),
                **_option_notes(entry, options),
                **_without(capabilities, "state_class"),
                **(_state_notes(hass, entry, state) if state else {}),
            }
        )
    return _text(rows, notes)


def device_table(devices: Iterable[dr.DeviceEntry | dr.ChildDeviceEntry]) -> str:
    """Return a table of devices, in their order.

    A device that belongs to another stands below it and is indented.
    """
    rows: list[Sequence[str]] = [("device", *_DEVICE_COLUMNS[1:], "identifiers")]
    notes: list[Mapping[str, object]] = [{}]
    for device in devices:
        fields = _plain(
            asdict(
                device,
                filter=lambda attribute, _: not attribute.name.startswith("_"),
            )
        )
        part_of = fields.get("via_device_id") or fields.get("parent_device_id")
        cells = [fields.pop(column, None) or "" for column in _DEVICE_COLUMNS]
        cells[0] = ("  " if part_of else "") + cells[0]
        identifiers = sorted(":".join(one) for one in fields.pop("identifiers"))
        rows.append((*cells, " ".join(identifiers)))
        notes.append(_unusual(fields, _DEVICE_VARYING, _DEVICE_USUAL))
    return _text(rows, notes)


def _enabled_by_default(entity: Entity) -> bool:
    """Return whether a new entity is enabled, whatever the tests have patched."""
    return getattr(
        entity,
        "_attr_entity_registry_enabled_default",
        entity.entity_description.entity_registry_enabled_default,
    )


def _entry_notes(hass: HomeAssistant, entry: er.RegistryEntry) -> dict[str, object]:
    """Return what is unusual in the registry entry of an entity."""
    fields = _plain(asdict(entry))
    usual = {
        **_USUAL,
        # In the row.
        "capabilities": fields["capabilities"],
        "entity_category": fields["entity_category"],
        "entity_id": entry.entity_id,
        "original_device_class": fields["original_device_class"],
        "original_name": entry.original_name,
        "translation_key": entry.translation_key,
        "unique_id": entry.unique_id,
        "unit_of_measurement": fields["unit_of_measurement"],
        # Partly in the row (`_option_notes`).
        "options": fields["options"],
        # Follows from the row.
        "aliases": [_plain(er.COMPUTED_NAME)],
        "domain": entry.entity_id.split(".")[0],
        "object_id_base": entry.original_name,
    }
    notes = _unusual(fields, VARYING, usual)
    full_name = er.async_get_full_entity_name(hass, entry)
    if slugify(full_name) != entry.entity_id.split(".")[1]:
        notes["full name"] = full_name
    return notes


def _option_notes(
    entry: er.RegistryEntry, options: Mapping[str, Mapping[str, object]]
) -> dict[str, object]:
    """Return the options of an entity but for a suggested unit that is its unit."""
    return {
        f"{domain}.{name}": value
        for domain, some in options.items()
        for name, value in some.items()
        if (name, value) != ("suggested_unit_of_measurement", entry.unit_of_measurement)
    }


def _key(hass: HomeAssistant, entry: er.RegistryEntry) -> str:
    """Return the translation key; empty if the unique id ends with it, after its owner.

    An owner is a charger or a bus, and perhaps the number of a connector or port.
    """
    if entry.translation_key is None:
        return _NO_KEY
    owner = entry.config_entry_id
    if entry.config_subentry_id is not None:
        bus = hass.config_entries.async_get_entry(owner or "")
        assert bus is not None
        owner = identity_of(bus.subentries[entry.config_subentry_id])
    key = entry.unique_id.removeprefix(f"{owner}_")
    if key[0].isdigit() and key[1] == "_":
        key = key[2:]
    return "" if entry.translation_key == key else entry.translation_key


def _state_notes(
    hass: HomeAssistant, entry: er.RegistryEntry, state: State
) -> dict[str, object]:
    """Return attributes of a state that do not follow from its registry entry."""
    usual = {
        **_plain(entry.capabilities or {}),
        "device_class": _plain(entry.original_device_class),
        "friendly_name": er.async_get_legacy_friendly_name(hass, entry),
        "unit_of_measurement": _plain(entry.unit_of_measurement),
    }
    attributes = _plain(state.attributes)
    return {
        f"state.{name}": attributes.get(name, "(none)")
        for name in sorted(usual.keys() | attributes.keys())
        if attributes.get(name) != usual.get(name)
    }


def _unusual(
    fields: Mapping[str, Any], varying: Iterable[str], usual: Mapping[str, object]
) -> dict[str, object]:
    return {
        name: value
        for name, value in fields.items()
        if name not in varying and (name not in usual or value != usual[name])
    }


def _without(fields: Mapping[str, Any], *names: str) -> dict[str, object]:
    return {name: value for name, value in fields.items() if name not in names}


def _plain(value: Any) -> Any:  # noqa: ANN401 - whatever Home Assistant keeps
    """Return a value made of plain types: members of enumerations by their value."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {_plain(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value


def _text(rows: Sequence[Sequence[str]], notes: Sequence[Mapping[str, object]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row, unusual in zip(rows, notes, strict=True):
        cells = [f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells).rstrip())
        if unusual:
            shown = (f"{name}: {_shown(value)}" for name, value in unusual.items())
            lines += wrap(
                "; ".join(shown),
                _WIDTH,
                initial_indent=_INDENT,
                subsequent_indent=_INDENT,
                break_on_hyphens=False,
            )
    return "\n".join(lines)


def _shown(value: object) -> str:
    """Return a value as text; 13 and 13.0 differ."""
    if isinstance(value, list) and value:
        return ", ".join(map(str, value))
    return value if isinstance(value, str) and value else repr(value)
