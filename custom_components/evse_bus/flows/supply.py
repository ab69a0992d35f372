"""The form for the shared supply, where Home Assistant is the master. Pure."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import probatio as vol

from ..const import CONF_SUPPLY_LIMIT, CONF_SUPPLY_MINIMUM
from ..evse.model import MINIMUM_CURRENT
from .schema import is_number, quantity, suggest

if TYPE_CHECKING:
    from ..evse.protocol import Protocol
    from .address import Errors

SUGGESTED_SUPPLY: Final = 16.0
"""The smallest usual circuit for chargers; not a default, the user confirms it, A."""


def supply_form(protocol: Protocol) -> vol.Schema:
    """Return the form for the shared supply; empty where chargers share none."""
    supply = protocol.circuit
    if supply is None:
        return vol.Schema({})
    return vol.Schema(
        {
            suggest(CONF_SUPPLY_LIMIT, SUGGESTED_SUPPLY): quantity(
                MINIMUM_CURRENT, supply.highest, 0.1, "A"
            ),
            vol.Required(CONF_SUPPLY_MINIMUM, default=MINIMUM_CURRENT): quantity(
                MINIMUM_CURRENT, supply.highest_minimum, 0.1, "A"
            ),
        }
    )


def check_supply(typed: Mapping[str, Any]) -> Errors:
    """Return the errors in the shared supply of a form, if it has one."""
    keys = (CONF_SUPPLY_LIMIT, CONF_SUPPLY_MINIMUM)
    errors = {
        key: "not_a_number"
        for key in keys
        if key in typed and not is_number(typed[key])
    }
    if errors or CONF_SUPPLY_LIMIT not in typed:
        return errors
    if typed[CONF_SUPPLY_MINIMUM] > typed[CONF_SUPPLY_LIMIT]:
        return {CONF_SUPPLY_MINIMUM: "above_supply"}
    return {}


def supply_data(values: Mapping[str, Any]) -> dict[str, float]:
    """Return the shared supply from a checked form or from a config entry's data."""
    return {
        key: float(values[key])
        for key in (CONF_SUPPLY_LIMIT, CONF_SUPPLY_MINIMUM)
        if key in values
    }


def supply_texts(data: Mapping[str, Any]) -> dict[str, str]:
    """Return the shared supply as placeholders for texts."""
    return {key: f"{value:g}" for key, value in supply_data(data).items()}
