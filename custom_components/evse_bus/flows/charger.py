"""The form for one charger: its fields, their validation, the stored data. Pure."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from homeassistant.const import CONF_ADDRESS, CONF_NAME
from homeassistant.data_entry_flow import section
from homeassistant.helpers.selector import TextSelector
import probatio as vol

from ..configuration import PORT_LIMITS
from ..const import (
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INSTALLATION_LIMIT,
    CONF_INSTALLATION_LIMIT_2,
    CONF_ORDER_LIFETIME,
    CONF_POLL_INTERVAL,
    CONF_PORTS,
    CONF_SERIAL,
    CONF_VOLTAGE,
)
from ..evse.model import MINIMUM_CURRENT
from ..evse.options import Choice, Quantity, Toggle
from ..evse.safety import MAXIMUM_TIMEOUT
from .address import Errors, address_field
from .schema import (
    DEFAULT_FAIL_SAFE_TIMEOUT,
    amperes,
    check_currents,
    check_timeout,
    default_of,
    dropdown,
    is_number,
    model_name,
    option_fields,
    quantity,
)

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentry, ConfigSubentryData

    from ..evse.options import Option
    from ..evse.protocol import Protocol
    from ..evse.scan import Address, FoundCharger

CONF_EXPERT: Final = "expert"
"""Key of the collapsed section."""

LONGEST_POLL_INTERVAL: Final = 3600
"""s"""
LONGEST_ORDER_LIFETIME: Final = 7 * 24 * 60
"""min"""

YES: Final = "✓"
NO: Final = "-"
"""In tables, instead of words that would have to be translated."""

_NAME_DIGITS: Final = 8
"""Characters of an address that a default name contains."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A charger that is about to be added."""

    address: Address
    found: FoundCharger | None = None
    """Result of the search, if it was searched for and has answered."""

    def serial(self, protocol: Protocol) -> str | None:
        """Return its serial number, if known."""
        if self.found is not None and self.found.serial is not None:
            return self.found.serial
        return protocol.address.serial(self.address)

    def placeholders(self, protocol: Protocol) -> dict[str, str]:
        """Return the placeholders for the texts of its form."""
        found = self.found
        each = (
            (found.maximum_currents or (found.maximum_current,)) if found else (None,)
        )
        return {
            "address": protocol.address.label(self.address),
            "model": model_name(found) if found else "?",
            "firmware": (found and found.info.firmware) or "?",
            "serial": self.serial(protocol) or "?",
            "maximum": " + ".join("?" if one is None else f"{one:g} A" for one in each),
        }

    def suggestions(self, protocol: Protocol, limit: float) -> dict[str, Any]:
        """Return suggested values for its form; ``limit``: of the installation, A.

        The suggested limit of a port is not above the maximum that the box reports for
        it: a higher one would have no effect.
        """
        each = self.found.maximum_currents if self.found else ()
        if not each:
            return dict.fromkeys(PORT_LIMITS[: protocol.ports], limit)
        limits = (
            limit if maximum is None else max(MINIMUM_CURRENT, min(limit, maximum))
            for maximum in each
        )
        offered = dict(zip(PORT_LIMITS, limits, strict=False))
        return {CONF_PORTS: str(len(each)), **offered}


def default_name(protocol: Protocol, address: Address) -> str:
    """Return the suggested name of a charger."""
    form = protocol.address
    if form.single:
        return protocol.make.name
    label = form.title(address)
    if form.is_serial:
        label = label[-_NAME_DIGITS:]
    return f"{protocol.make.name} {label}"


# -- The form --------------------------------------------------------------------


def charger_form(
    protocol: Protocol,
    *,
    ask_address: bool = False,
    ask_serial: bool = False,
    new: bool = True,
) -> vol.Schema:
    """Return the form for a charger: name, limits, and a section with the rest.

    ``ask_address``, ``ask_serial``: also these; where the address is the serial number,
    ``ask_serial`` counts. The fail-safe values are asked for only when a charger
    is added; later they are entities.
    """
    address = protocol.address
    form: dict[vol.Marker, object] = {vol.Required(CONF_NAME): TextSelector()}
    if ask_serial if address.is_serial else ask_address:
        marker = vol.Optional if address.optional else vol.Required
        form[marker(address.key)] = address_field(address)
    if ask_serial and address.has_serial and not address.is_serial:
        form[vol.Optional(CONF_SERIAL)] = TextSelector()
    if protocol.ports > 1:
        counts = tuple(str(count) for count in range(1, protocol.ports + 1))
        form[vol.Required(CONF_PORTS, default=counts[-1])] = dropdown(
            CONF_PORTS, counts
        )
    form[vol.Required(CONF_INSTALLATION_LIMIT)] = amperes(MINIMUM_CURRENT)
    if protocol.ports > 1:
        form[vol.Optional(CONF_INSTALLATION_LIMIT_2)] = amperes(MINIMUM_CURRENT)
    if new:
        form[vol.Required(CONF_FAIL_SAFE_CURRENT, default=MINIMUM_CURRENT)] = amperes()
        if protocol.probe_sets_limits:
            form[
                vol.Required(CONF_FAIL_SAFE_TIMEOUT, default=DEFAULT_FAIL_SAFE_TIMEOUT)
            ] = quantity(1, MAXIMUM_TIMEOUT, 1, "s")
    if protocol.lifetime_is_fail_safe:
        form |= _LIFETIME
    form |= option_fields(_prominent(protocol))
    form[vol.Required(CONF_EXPERT)] = section(
        _expert_form(protocol), {"collapsed": True}
    )
    return vol.Schema(form)


_LIFETIME: Final[Mapping[vol.Marker, object]] = {
    vol.Optional(CONF_ORDER_LIFETIME): quantity(1, LONGEST_ORDER_LIFETIME, 1, "min")
}


def _prominent(protocol: Protocol) -> list[Option]:
    return [option for option in protocol.options if option.prominent]


def _expert_form(protocol: Protocol) -> vol.Schema:
    form: dict[vol.Marker, object] = {
        vol.Required(
            CONF_POLL_INTERVAL, default=default_of(protocol, CONF_POLL_INTERVAL)
        ): quantity(0, LONGEST_POLL_INTERVAL, 0.1, "s"),
    }
    if protocol.asks_voltage:
        form[vol.Required(CONF_VOLTAGE, default=default_of(protocol, CONF_VOLTAGE))] = (
            quantity(100, 300, 0.1, "V")
        )
    if not protocol.lifetime_is_fail_safe:
        form |= _LIFETIME
    form |= option_fields(one for one in protocol.options if not one.prominent)
    return vol.Schema(form)


def check_charger(
    protocol: Protocol,
    typed: Mapping[str, Any],
    others: Collection[Mapping[str, Any]],
) -> Errors:
    """Return the errors in a filled-in charger form.

    ``others``: stored data, as far as known, of the other chargers of the bus. Errors
    in the collapsed section are reported for the whole form: a mark on a hidden field
    would not be seen.
    """
    errors = check_currents(typed)
    expert = typed[CONF_EXPERT]
    if typed.get(CONF_PORTS) == "2":
        errors = _check_second(typed) | errors
    if not typed[CONF_NAME].strip():
        errors[CONF_NAME] = "name_empty"
    if not is_number(typed.get(CONF_ORDER_LIFETIME, 0)):
        errors[CONF_ORDER_LIFETIME] = "not_a_number"
    numbers = (CONF_POLL_INTERVAL, CONF_VOLTAGE, CONF_ORDER_LIFETIME)
    if not all(is_number(expert[key]) for key in numbers if key in expert):
        errors["base"] = "expert_not_a_number"
        return errors
    for option in protocol.options:
        if (wrong := _check_option(option, typed, others)) is not None:
            errors.setdefault(option.name if option.prominent else "base", wrong)
    return errors | check_timeout(typed, expert[CONF_POLL_INTERVAL])


def _check_second(typed: Mapping[str, Any]) -> Errors:
    """Return the errors in the limit of a second port."""
    if (limit := typed.get(CONF_INSTALLATION_LIMIT_2)) is None:
        return {CONF_INSTALLATION_LIMIT_2: "second_limit_missing"}
    if typed.get(CONF_FAIL_SAFE_CURRENT, 0) > limit:
        return {CONF_FAIL_SAFE_CURRENT: "above_second_limit"}
    return {}


def _check_option(
    option: Option,
    typed: Mapping[str, Any],
    others: Collection[Mapping[str, Any]],
) -> str | None:
    """Return the key of the error in an option; ``None``: there is none."""
    try:
        stored = option.store(_typed_option(option, typed))
    except ValueError:
        return f"bad_{option.name}"
    if others and isinstance(option, Choice):
        # Both ways: neither this charger beside others, nor it beside such a one.
        each = (stored, *(other.get(option.name) for other in others))
        if any(map(option.needs_solitude, each)):
            return f"{option.name}_not_alone"
    return None


def _typed_option(option: Option, typed: Mapping[str, Any]) -> object:
    fields = typed if option.prominent else typed[CONF_EXPERT]
    return fields.get(option.name, option.default)


# -- The stored data -------------------------------------------------------------


def charger_data(
    protocol: Protocol, address: Address, serial: str | None, typed: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the data of a subentry from a filled-in and checked charger form."""
    expert = typed[CONF_EXPERT]
    data: dict[str, Any] = {
        CONF_ADDRESS: address,
        CONF_SERIAL: serial,
        CONF_INSTALLATION_LIMIT: typed[CONF_INSTALLATION_LIMIT],
        CONF_POLL_INTERVAL: expert[CONF_POLL_INTERVAL],
        CONF_ORDER_LIFETIME: expert.get(
            CONF_ORDER_LIFETIME, typed.get(CONF_ORDER_LIFETIME)
        ),
    }
    if CONF_VOLTAGE in expert:
        data[CONF_VOLTAGE] = expert[CONF_VOLTAGE]
    if CONF_PORTS in typed:
        data[CONF_PORTS] = int(typed[CONF_PORTS])
        if data[CONF_PORTS] > 1:
            data[CONF_INSTALLATION_LIMIT_2] = typed[CONF_INSTALLATION_LIMIT_2]
    if CONF_FAIL_SAFE_CURRENT in typed:
        data[CONF_FAIL_SAFE_CURRENT] = typed[CONF_FAIL_SAFE_CURRENT]
    if CONF_FAIL_SAFE_TIMEOUT in typed:
        data[CONF_FAIL_SAFE_TIMEOUT] = int(typed[CONF_FAIL_SAFE_TIMEOUT])
    for option in protocol.options:
        data[option.name] = option.store(_typed_option(option, typed))
    return data


def charger_suggestions(protocol: Protocol, subentry: ConfigSubentry) -> dict[str, Any]:
    """Return the stored data of a charger as values of its form."""
    stored = subentry.data
    address = protocol.address
    place: Address = stored[CONF_ADDRESS]
    if address.optional and stored[CONF_SERIAL]:
        # The serial number that was found: if left empty, any box would be accepted.
        place = stored[CONF_SERIAL]
    expert = {
        key: stored[key]
        for key in (CONF_VOLTAGE, CONF_POLL_INTERVAL, CONF_ORDER_LIFETIME)
        if stored.get(key) is not None
    }
    suggestions = {
        CONF_NAME: subentry.title,
        address.key: address.show(place),
        CONF_INSTALLATION_LIMIT: stored[CONF_INSTALLATION_LIMIT],
        CONF_EXPERT: expert,
    }
    for option in protocol.options:
        if stored.get(option.name) is not None:
            fields = suggestions if option.prominent else expert
            fields[option.name] = option.show(stored[option.name])
    if CONF_PORTS in stored:
        suggestions[CONF_PORTS] = str(stored[CONF_PORTS])
    more = (CONF_SERIAL, CONF_INSTALLATION_LIMIT_2, CONF_ORDER_LIFETIME)
    return suggestions | {
        key: stored[key] for key in more if stored.get(key) is not None
    }


def confirm_row(protocol: Protocol, charger: ConfigSubentryData) -> str:
    """Return a row of the summary table for a new charger."""
    data = charger["data"]
    limits = [f"{data[key]:g} A" for key in PORT_LIMITS if key in data]
    cells = [
        charger["title"].replace("|", "/"),
        protocol.address.label(data[CONF_ADDRESS]) or NO,
        " + ".join(limits),
        f"{data[CONF_FAIL_SAFE_CURRENT]:g} A",
    ]
    if CONF_FAIL_SAFE_TIMEOUT in data:
        cells.append(f"{data[CONF_FAIL_SAFE_TIMEOUT]} s")
    if protocol.lifetime_is_fail_safe:
        lifetime = data[CONF_ORDER_LIFETIME]
        cells.append(NO if lifetime is None else f"{lifetime:g} min")
    cells += [
        _cell(option, data[option.name])
        for option in protocol.options
        if option.prominent
    ]
    return f"| {' | '.join(cells)} |"


def _cell(option: Option, stored: Any) -> str:  # noqa: ANN401 - JSON
    """Return a stored value of an option for the summary table."""
    if isinstance(option, Toggle):
        return YES if stored else NO
    if isinstance(option, Quantity):
        return f"{stored:g} {option.unit}"
    return str(option.show(stored))
