"""The forms for a bus and for the search: asked, refused, stored. Pure.

A form's texts stand in ``translations/en.json``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

from homeassistant.const import CONF_DEVICE
from homeassistant.data_entry_flow import section
from homeassistant.helpers.selector import (
    BooleanSelector,
    NumberSelector,
    NumberSelectorConfig,
    NumberSelectorMode,
    SelectOptionDict,
    SelectSelector,
    SelectSelectorConfig,
    SelectSelectorMode,
    SerialPortSelector,
)
import probatio as vol

from ..const import (
    CONF_BAUDRATE,
    CONF_COMMAND,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_INSTALLATION_LIMIT_2,
    CONF_PARITY,
    CONF_POLL_INTERVAL,
    CONF_PROTOCOL,
    CONF_STOP_BITS,
)
from ..evse.errors import RefusedOrderError
from ..evse.model import MAXIMUM_CURRENT, MINIMUM_CURRENT
from ..evse.safety import INTERVALS_PER_TIMEOUT, MAXIMUM_TIMEOUT, number
from .address import ADDRESSES, Errors

if TYPE_CHECKING:
    from ..evse.framing import LineSettings
    from ..evse.protocol import Protocol
    from ..evse.scan import FoundCharger

# Keys of the forms that are stored under another name, or not at all.
CONF_LINE: Final = "line"
CONF_CHARGERS: Final = "chargers"
CONF_CONFIRM: Final = "confirm"
CONF_SEARCH_CURRENT: Final = "search_current"

SUGGESTED_LIMIT: Final = 16.0
"""Offered, never taken unseen: the user confirms what the wiring may carry, A."""
DEFAULT_FAIL_SAFE_TIMEOUT: Final = 60

MAKES: Final[Mapping[str, tuple[str, ...]]] = {
    "evbox": ("evbox",),
    "abl": ("abl",),
    "smartevse": ("smartevse", "smartevse_master"),
    "ews": ("ews", "ews_network"),
}
"""What people choose first, and the protocols that it can then be."""

COMMANDS: Final = ("68", "69")
"""EVBox messages; 69 has no serial number, so every box feels spoken to."""
SEARCH_CURRENTS: Final = ("0", "6")
"""What a search may set, A: no more before a box has told its maximum."""


# -- Fields ----------------------------------------------------------------------


def amperes(lowest: float = 0) -> NumberSelector:
    """Return a field for a current, A."""
    return quantity(lowest, MAXIMUM_CURRENT, 0.1, "A")


def quantity(lowest: float, highest: float, step: float, unit: str) -> NumberSelector:
    """Return a field for a number to be typed."""
    return NumberSelector(
        NumberSelectorConfig(
            min=lowest,
            max=highest,
            step=step,
            unit_of_measurement=unit,
            mode=NumberSelectorMode.BOX,
        )
    )


def dropdown(key: str, options: Iterable[str]) -> SelectSelector:
    """Return a field to choose from; its texts stand under ``selector.<key>``."""
    return SelectSelector(
        SelectSelectorConfig(
            options=list(options),
            translation_key=key,
            mode=SelectSelectorMode.DROPDOWN,
        )
    )


def suggest(key: str, value: object) -> vol.Marker:
    """Return the key of a field that is filled in, but not taken unseen."""
    return vol.Required(key, description={"suggested_value": value})


def default_of(protocol: Protocol, name: str) -> Any:  # noqa: ANN401 - any field's
    """Return what a protocol sets up a charger with, unless told otherwise."""
    return next(one.default for one in fields(protocol.config) if one.name == name)


# -- Checks that several forms share ---------------------------------------------


def is_number(value: object) -> bool:
    """Return whether a value is a finite number from 0.

    The number field lets NaN through every range.
    """
    try:
        number(value)
    except RefusedOrderError:
        return False
    return True


def check_currents(typed: Mapping[str, Any]) -> Errors:
    """Return what is wrong with the currents of a form."""
    keys = (CONF_INSTALLATION_LIMIT, CONF_INSTALLATION_LIMIT_2, CONF_FAIL_SAFE_CURRENT)
    errors = {
        key: "not_a_number"
        for key in keys
        if key in typed and not is_number(typed[key])
    }
    if errors:
        return errors
    limit = typed.get(CONF_INSTALLATION_LIMIT, MAXIMUM_CURRENT)
    if typed.get(CONF_FAIL_SAFE_CURRENT, 0) > limit:
        return {CONF_FAIL_SAFE_CURRENT: "above_installation_limit"}
    return {}


def check_timeout(typed: Mapping[str, Any], poll_interval: float) -> Errors:
    """Return what is wrong with the fail-safe time-out of a form, if it has one."""
    if (timeout := typed.get(CONF_FAIL_SAFE_TIMEOUT)) is None:
        return {}
    if not is_number(timeout):
        return {CONF_FAIL_SAFE_TIMEOUT: "not_a_number"}
    if timeout < INTERVALS_PER_TIMEOUT * poll_interval:
        return {CONF_FAIL_SAFE_TIMEOUT: "timeout_too_short"}
    return {}


# -- The bus ---------------------------------------------------------------------


def protocol_form() -> vol.Schema:
    """Ask which chargers they are."""
    return vol.Schema(
        {
            vol.Required(CONF_PROTOCOL): SelectSelector(
                SelectSelectorConfig(
                    options=list(MAKES),
                    translation_key=CONF_PROTOCOL,
                    mode=SelectSelectorMode.LIST,
                )
            )
        }
    )


def port_form(usual: LineSettings, more: vol.Schema | None = None) -> vol.Schema:
    """Ask for the port; experts may say how bytes look on the wire.

    ``more`` is asked between the two.
    """
    line = {
        vol.Required(CONF_BAUDRATE, default=usual.baudrate): quantity(
            300, 921_600, 1, "Bd"
        ),
        vol.Required(CONF_PARITY, default=usual.parity.lower()): dropdown(
            CONF_PARITY, ("n", "e", "o")
        ),
        vol.Required(CONF_STOP_BITS, default=str(usual.stop_bits)): dropdown(
            CONF_STOP_BITS, ("1", "2")
        ),
    }
    return vol.Schema(
        {
            vol.Required(CONF_DEVICE): SerialPortSelector(),
            **(more.schema if more is not None else {}),
            vol.Required(CONF_LINE): section(vol.Schema(line), {"collapsed": True}),
        }
    )


def port_suggestions(data: Mapping[str, Any], settings: LineSettings) -> dict[str, Any]:
    """Return what is stored of a bus as the port form shows it."""
    return {
        CONF_DEVICE: data[CONF_DEVICE],
        CONF_LINE: {
            CONF_BAUDRATE: settings.baudrate,
            CONF_PARITY: settings.parity.lower(),
            CONF_STOP_BITS: str(settings.stop_bits),
        },
    }


def bus_data(protocol: Protocol, typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry's data of a filled-in port form: overrides where they differ.

    Raises RefusedOrderError for a baud rate that is no number.
    """
    line = typed[CONF_LINE]
    wanted = {
        CONF_BAUDRATE: int(number(line[CONF_BAUDRATE], CONF_BAUDRATE)),
        CONF_PARITY: line[CONF_PARITY].upper(),
        CONF_STOP_BITS: int(line[CONF_STOP_BITS]),
    }
    usual = {
        CONF_BAUDRATE: protocol.settings.baudrate,
        CONF_PARITY: protocol.settings.parity,
        CONF_STOP_BITS: protocol.settings.stop_bits,
    }
    return {
        CONF_PROTOCOL: protocol.key,
        CONF_DEVICE: typed[CONF_DEVICE].strip(),
        **{key: value for key, value in wanted.items() if value != usual[key]},
    }


# -- The search ------------------------------------------------------------------


def impose_form(protocol: Protocol, *, ask_addresses: bool) -> vol.Schema:
    """Ask for all that a search sets, where every message sets limits.

    Without addresses everybody is searched: then also those that know only the
    message without a serial number can be found.
    """
    address = ADDRESSES[protocol.key]
    first: dict[vol.Marker, object] = {}
    last: dict[vol.Marker, object] = {}
    if ask_addresses:
        first[vol.Required(address.many)] = address.selector_many
    else:
        usual = str(default_of(protocol, CONF_COMMAND))
        last[vol.Required(CONF_COMMAND, default=usual)] = dropdown(
            CONF_COMMAND, COMMANDS
        )
    last[vol.Required(CONF_CONFIRM, default=False)] = BooleanSelector()
    return vol.Schema(
        first
        | {
            suggest(CONF_INSTALLATION_LIMIT, SUGGESTED_LIMIT): amperes(MINIMUM_CURRENT),
            vol.Required(CONF_SEARCH_CURRENT, default=SEARCH_CURRENTS[-1]): dropdown(
                CONF_SEARCH_CURRENT, SEARCH_CURRENTS
            ),
            vol.Required(CONF_FAIL_SAFE_CURRENT, default=MINIMUM_CURRENT): amperes(),
            vol.Required(
                CONF_FAIL_SAFE_TIMEOUT, default=DEFAULT_FAIL_SAFE_TIMEOUT
            ): quantity(1, MAXIMUM_TIMEOUT, 1, "s"),
        }
        | last
    )


def check_impose(protocol: Protocol, typed: Mapping[str, Any]) -> Errors:
    """Return what is wrong with the values that a search would set."""
    errors = check_currents(typed) | check_timeout(
        typed, default_of(protocol, CONF_POLL_INTERVAL)
    )
    if not typed[CONF_CONFIRM]:
        errors[CONF_CONFIRM] = "not_confirmed"
    return errors


def found_form(options: list[SelectOptionDict], *, multiple: bool) -> vol.Schema:
    """Ask which of the chargers found to add.

    Of several it is also asked what their wiring may carry, once for all; for one
    alone the next form asks that.
    """
    every = [option["value"] for option in options]
    chosen: vol.Marker = (
        vol.Required(CONF_CHARGERS, default=every)
        if multiple
        else vol.Required(CONF_CHARGERS, default=every[0])
    )
    config = SelectSelectorConfig(
        options=options, multiple=multiple, mode=SelectSelectorMode.LIST
    )
    form: dict[vol.Marker, object] = {chosen: SelectSelector(config)}
    if multiple:
        limit = suggest(CONF_INSTALLATION_LIMIT, SUGGESTED_LIMIT)
        form[limit] = amperes(MINIMUM_CURRENT)
    return vol.Schema(form)


def found_options(
    protocol: Protocol, found: Iterable[FoundCharger]
) -> list[SelectOptionDict]:
    """Return the chargers found as a list to choose from."""
    show = ADDRESSES[protocol.key].show
    return [
        SelectOptionDict(
            value=str(one.address),
            label=f"{show(one.address)}: {model_name(one)}"
            + (f" ({one.serial})" if one.serial else ""),
        )
        for one in found
    ]


def model_name(found: FoundCharger) -> str:
    """Return what a charger found is."""
    info = found.info
    firmware = f", firmware {info.firmware}" if info.firmware else ""
    return f"{info.manufacturer} {info.model}{firmware}"
