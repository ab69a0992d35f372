"""The forms for a bus and for the search, and form fields that others share. Pure."""

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
    Selector,
    SelectSelector,
    SelectSelectorConfig,
    SelectSelectorMode,
    SerialPortSelector,
    TextSelector,
)
import probatio as vol

from ..const import (
    CONF_BAUDRATE,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_INSTALLATION_LIMIT_2,
    CONF_PARITY,
    CONF_POLL_INTERVAL,
    CONF_PROTOCOL,
    CONF_REPLY_TIMEOUT,
    CONF_STOP_BITS,
)
from ..evse.errors import RefusedOrderError
from ..evse.model import MAXIMUM_CURRENT, MINIMUM_CURRENT
from ..evse.options import Choice, Option, Quantity, Toggle
from ..evse.protocols import protocols_by_make
from ..evse.safety import INTERVALS_PER_TIMEOUT, MAXIMUM_TIMEOUT, number
from .address import Errors, address_field

if TYPE_CHECKING:
    from ..evse.framing import LineSettings
    from ..evse.protocol import Protocol
    from ..evse.scan import FoundCharger

# Keys of form fields that are stored under another name, or not at all.
CONF_LINE: Final = "line"
CONF_CHARGERS: Final = "chargers"
CONF_CONFIRM: Final = "confirm"
CONF_SEARCH_CURRENT: Final = "search_current"

SUGGESTED_LIMIT: Final = 16.0
"""Offered, but not a default: the user confirms the limit of the wiring, A."""
DEFAULT_FAIL_SAFE_TIMEOUT: Final = 60
"""s"""
REPLY_TIMEOUTS: Final = (0.1, 10)
"""Range of a reply time-out set by hand, s."""
SEARCH_CURRENTS: Final = ("0", "6")
"""Currents that a search may set, A: no more before a box has reported its maximum."""


# -- Fields ----------------------------------------------------------------------


def amperes(lowest: float = 0) -> NumberSelector:
    """Return a field for a current, A."""
    return quantity(lowest, MAXIMUM_CURRENT, 0.1, "A")


def quantity(lowest: float, highest: float, step: float, unit: str) -> NumberSelector:
    """Return a field for a typed number."""
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
    """Return a list to choose from; its texts are under ``selector.<key>``."""
    return SelectSelector(
        SelectSelectorConfig(
            options=list(options),
            translation_key=key,
            mode=SelectSelectorMode.DROPDOWN,
        )
    )


def option_field(option: Option) -> Selector[Any]:
    """Return the field for an option of a protocol."""
    if isinstance(option, Choice):
        return dropdown(option.name, option.values)
    if isinstance(option, Toggle):
        return BooleanSelector()
    if isinstance(option, Quantity):
        return quantity(option.lowest, option.highest, option.step, option.unit)
    return TextSelector()


def option_fields(options: Iterable[Option]) -> dict[vol.Marker, object]:
    """Return the fields for some options, each with its default."""
    return {
        vol.Required(option.name, default=option.default): option_field(option)
        for option in options
    }


def suggest(key: str, value: object) -> vol.Marker:
    """Return the key of a required field with a suggested value, but no default."""
    return vol.Required(key, description={"suggested_value": value})


def default_of(protocol: Protocol, name: str) -> Any:  # noqa: ANN401 - any field's
    """Return the default of a field of the protocol's `ChargerConfig`."""
    return next(one.default for one in fields(protocol.config) if one.name == name)


# -- Validation that several forms share -----------------------------------------


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
    """Return the errors in the currents of a form."""
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
    """Return the errors in the fail-safe time-out of a form, if it has one."""
    if (timeout := typed.get(CONF_FAIL_SAFE_TIMEOUT)) is None:
        return {}
    if not is_number(timeout):
        return {CONF_FAIL_SAFE_TIMEOUT: "not_a_number"}
    if timeout < INTERVALS_PER_TIMEOUT * poll_interval:
        return {CONF_FAIL_SAFE_TIMEOUT: "timeout_too_short"}
    return {}


# -- The bus ---------------------------------------------------------------------


def protocol_form() -> vol.Schema:
    """Return the form for the make of the chargers."""
    return vol.Schema(
        {
            vol.Required(CONF_PROTOCOL): SelectSelector(
                SelectSelectorConfig(
                    options=list(protocols_by_make()),
                    translation_key=CONF_PROTOCOL,
                    mode=SelectSelectorMode.LIST,
                )
            )
        }
    )


def port_form(usual: LineSettings, more: vol.Schema | None = None) -> vol.Schema:
    """Return the form for the port, with the line settings in a collapsed section.

    ``more`` is a form to insert between the two.
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
        vol.Optional(CONF_REPLY_TIMEOUT): quantity(*REPLY_TIMEOUTS, 0.1, "s"),
    }
    return vol.Schema(
        {
            vol.Required(CONF_DEVICE): SerialPortSelector(),
            **(more.schema if more is not None else {}),
            vol.Required(CONF_LINE): section(vol.Schema(line), {"collapsed": True}),
        }
    )


def port_suggestions(data: Mapping[str, Any], settings: LineSettings) -> dict[str, Any]:
    """Return the stored data of a bus as values of the port form."""
    return {
        CONF_DEVICE: data[CONF_DEVICE],
        CONF_LINE: {
            CONF_BAUDRATE: settings.baudrate,
            CONF_PARITY: settings.parity.lower(),
            CONF_STOP_BITS: str(settings.stop_bits),
            **{key: data[key] for key in (CONF_REPLY_TIMEOUT,) if key in data},
        },
    }


def bus_data(protocol: Protocol, typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a config entry from a filled-in port form.

    Line settings are stored only where they differ from those of the protocol. Raises
    RefusedOrderError for a baud rate or time-out that is not a number.
    """
    line = typed[CONF_LINE]
    timeout = line.get(CONF_REPLY_TIMEOUT)
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
        **(
            {} if timeout is None else {CONF_REPLY_TIMEOUT: number(timeout, "time-out")}
        ),
    }


# -- The search ------------------------------------------------------------------


def impose_form(protocol: Protocol, *, ask_addresses: bool) -> vol.Schema:
    """Return the form for the values that a search sets.

    Without addresses it reaches every box on the line, and asks for the options that
    decide how an unknown box is addressed.
    """
    form = protocol.address
    first: dict[vol.Marker, object] = {}
    last: dict[vol.Marker, object] = {}
    if ask_addresses:
        first[vol.Required(form.plural)] = address_field(form, multiple=True)
    else:
        last |= option_fields(one for one in protocol.options if one.before_search)
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
    """Return the errors in the values that a search would set."""
    errors = check_currents(typed) | check_timeout(
        typed, default_of(protocol, CONF_POLL_INTERVAL)
    )
    if not typed[CONF_CONFIRM]:
        errors[CONF_CONFIRM] = "not_confirmed"
    return errors


def found_form(options: list[SelectOptionDict], *, multiple: bool) -> vol.Schema:
    """Return the form for the chargers to add.

    If several can be added, it also asks for their installation limit; otherwise the
    next form does.
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
    """Return the chargers found as options to choose from."""
    label = protocol.address.label
    return [
        SelectOptionDict(
            value=str(one.address),
            label=f"{label(one.address)}: {model_name(one)}"
            + (f" ({one.serial})" if one.serial else ""),
        )
        for one in found
    ]


def model_name(found: FoundCharger) -> str:
    """Return manufacturer, model and firmware of a charger found."""
    info = found.info
    firmware = f", firmware {info.firmware}" if info.firmware else ""
    return f"{info.manufacturer} {info.model}{firmware}"
