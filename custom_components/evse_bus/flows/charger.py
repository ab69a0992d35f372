"""The form for one charger: what is asked, what is refused, what is stored. Pure."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final

from homeassistant.const import CONF_ADDRESS, CONF_NAME
from homeassistant.data_entry_flow import section
from homeassistant.helpers.selector import BooleanSelector, TextSelector
import probatio as vol

from ..configuration import PORT_LIMITS
from ..const import (
    CONF_COMMAND,
    CONF_FAIL_SAFE_CURRENT,
    CONF_FAIL_SAFE_TIMEOUT,
    CONF_INFORMATION,
    CONF_INSTALLATION_LIMIT,
    CONF_INSTALLATION_LIMIT_2,
    CONF_ORDER_LIFETIME,
    CONF_PHASE_ORDER,
    CONF_POLL_INTERVAL,
    CONF_PORTS,
    CONF_SERIAL,
    CONF_STOP_ON_SHUTDOWN,
    CONF_VOLTAGE,
)
from ..evse.model import MINIMUM_CURRENT
from ..evse.safety import MAXIMUM_TIMEOUT
from ..evse.scan import Address
from .address import ADDRESSES, Errors
from .schema import (
    COMMANDS,
    DEFAULT_FAIL_SAFE_TIMEOUT,
    amperes,
    check_currents,
    check_timeout,
    default_of,
    dropdown,
    is_number,
    model_name,
    quantity,
)

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentry, ConfigSubentryData

    from ..evse.protocol import Protocol
    from ..evse.scan import FoundCharger

CONF_EXPERT: Final = "expert"

LONGEST_POLL_INTERVAL: Final = 3600
LONGEST_ORDER_LIFETIME: Final = 7 * 24 * 60
INFORMATION_BYTES: Final = 16
PHASE_ORDERS: Final = ("123", "132", "213", "231", "312", "321")

YES: Final = "✓"
NO: Final = "-"
"""In tables, where a word would have to be translated."""


_PRODUCTS: Final = {"ews": "EWS-Box", "ews_network": "EWS-Box"}
_NAME_DIGITS: Final = 8
"""So much of an address is enough to tell chargers apart."""
_TELL_POWER: Final = frozenset(_PRODUCTS)
"""Protocols whose chargers need no voltage to estimate power from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A charger on its way into the configuration."""

    address: Address
    found: FoundCharger | None = None
    """What it told, if it has been asked and has answered."""

    def serial(self, protocol: Protocol) -> str | None:
        """Return its serial number, as far as known."""
        if self.found is not None and self.found.serial is not None:
            return self.found.serial
        return ADDRESSES[protocol.key].serial(self.address)

    def placeholders(self, protocol: Protocol) -> dict[str, str]:
        """Return what is known of it, for the texts."""
        told = self.found
        each = (told.maximum_currents or (told.maximum_current,)) if told else (None,)
        return {
            "address": ADDRESSES[protocol.key].show(self.address),
            "model": model_name(told) if told else "?",
            "firmware": (told and told.info.firmware) or "?",
            "serial": self.serial(protocol) or "?",
            "maximum": " + ".join("?" if one is None else f"{one:g} A" for one in each),
        }

    def suggestions(self, protocol: Protocol, limit: float) -> dict[str, Any]:
        """Return what its form is to begin with; ``limit``: of the installation.

        What a port can carry at most is no more than its box has been set up for:
        a higher limit would only look as if it could be had.
        """
        each = self.found.maximum_currents if self.found else ()
        if not each:
            return dict.fromkeys(PORT_LIMITS[: protocol.ports], limit)
        limits = (
            limit if told is None else max(MINIMUM_CURRENT, min(limit, told))
            for told in each
        )
        offered = dict(zip(PORT_LIMITS, limits, strict=False))
        return {CONF_PORTS: str(len(each)), **offered}


def short_name(protocol: Protocol) -> str:
    """Return what people call these chargers: the maker's name, or the product's."""
    return _PRODUCTS.get(protocol.key) or protocol.name.split()[0]


def default_name(protocol: Protocol, address: Address) -> str:
    """Return the name offered for a charger."""
    form = ADDRESSES[protocol.key]
    if form.alone:
        return short_name(protocol)
    return f"{short_name(protocol)} {form.show(address)[-_NAME_DIGITS:]}"


# -- The form --------------------------------------------------------------------


def charger_form(
    protocol: Protocol, *, ask_address: bool = False, new: bool = True
) -> vol.Schema:
    """Ask for one charger's name, limits and, collapsed, everything else.

    ``ask_address``: also where it is and who it must be. The fail-safe values are
    asked only of a new charger: later they are entities of its own.
    """
    address = ADDRESSES[protocol.key]
    form: dict[vol.Marker, object] = {vol.Required(CONF_NAME): TextSelector()}
    if ask_address:
        marker = vol.Optional if address.optional else vol.Required
        form[marker(address.one)] = address.selector
        if address.tells_serial and not address.is_serial:
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
    if _lacks_fail_safe(protocol):
        form |= _LIFETIME
        form[vol.Required(CONF_STOP_ON_SHUTDOWN, default=False)] = BooleanSelector()
    form[vol.Required(CONF_EXPERT)] = section(
        _expert_form(protocol), {"collapsed": True}
    )
    return vol.Schema(form)


_LIFETIME: Final[Mapping[vol.Marker, object]] = {
    vol.Optional(CONF_ORDER_LIFETIME): quantity(1, LONGEST_ORDER_LIFETIME, 1, "min")
}


def _lacks_fail_safe(protocol: Protocol) -> bool:
    """Return whether nothing in the box itself ever ends a charge.

    Then what there is instead is not folded away.
    """
    return _has(protocol, CONF_STOP_ON_SHUTDOWN)


def _expert_form(protocol: Protocol) -> vol.Schema:
    form: dict[vol.Marker, object] = {
        vol.Required(
            CONF_POLL_INTERVAL, default=default_of(protocol, CONF_POLL_INTERVAL)
        ): quantity(0, LONGEST_POLL_INTERVAL, 0.1, "s"),
    }
    if protocol.key not in _TELL_POWER:
        form[vol.Required(CONF_VOLTAGE, default=default_of(protocol, CONF_VOLTAGE))] = (
            quantity(100, 300, 0.1, "V")
        )
    if not _lacks_fail_safe(protocol):
        form |= _LIFETIME
    if _has(protocol, CONF_COMMAND):
        form[
            vol.Required(CONF_COMMAND, default=str(default_of(protocol, CONF_COMMAND)))
        ] = dropdown(CONF_COMMAND, COMMANDS)
    if _has(protocol, CONF_INFORMATION):
        zeros = bytes(INFORMATION_BYTES).hex()
        form[vol.Required(CONF_INFORMATION, default=zeros)] = TextSelector()
    if _has(protocol, CONF_PHASE_ORDER):
        form[vol.Required(CONF_PHASE_ORDER, default=PHASE_ORDERS[0])] = dropdown(
            CONF_PHASE_ORDER, PHASE_ORDERS
        )
    return vol.Schema(form)


def _has(protocol: Protocol, name: str) -> bool:
    return any(one.name == name for one in fields(protocol.config))


def check_charger(
    typed: Mapping[str, Any], others: Collection[Mapping[str, Any]]
) -> Errors:
    """Return what is wrong with a filled-in charger form.

    ``others``: what is stored, or known so far, of the bus's other chargers.

    What is in the collapsed section is reported for the whole form: nobody sees a
    mark on a field that is folded away.
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
    if not _is_information(expert.get(CONF_INFORMATION)):
        errors["base"] = "bad_information"
    commands = {expert.get(CONF_COMMAND), *(str(o.get(CONF_COMMAND)) for o in others)}
    if others and COMMANDS[-1] in commands:
        errors["base"] = "command_not_alone"
    return errors | check_timeout(typed, expert[CONF_POLL_INTERVAL])


def _check_second(typed: Mapping[str, Any]) -> Errors:
    """Return what is wrong with the limit of a second port."""
    if (limit := typed.get(CONF_INSTALLATION_LIMIT_2)) is None:
        return {CONF_INSTALLATION_LIMIT_2: "second_limit_missing"}
    if typed.get(CONF_FAIL_SAFE_CURRENT, 0) > limit:
        return {CONF_FAIL_SAFE_CURRENT: "above_second_limit"}
    return {}


def _is_information(text: str | None) -> bool:
    if text is None:
        return True
    try:
        return len(bytes.fromhex(text)) == INFORMATION_BYTES
    except ValueError:
        return False


# -- What is stored --------------------------------------------------------------


def charger_data(
    address: Address, serial: str | None, typed: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a subentry's data of a filled-in and checked charger form."""
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
    for key in (CONF_FAIL_SAFE_CURRENT, CONF_STOP_ON_SHUTDOWN):
        if key in typed:
            data[key] = typed[key]
    if CONF_FAIL_SAFE_TIMEOUT in typed:
        data[CONF_FAIL_SAFE_TIMEOUT] = int(typed[CONF_FAIL_SAFE_TIMEOUT])
    if CONF_COMMAND in expert:
        data[CONF_COMMAND] = int(expert[CONF_COMMAND])
    if CONF_INFORMATION in expert:
        data[CONF_INFORMATION] = bytes.fromhex(expert[CONF_INFORMATION]).hex().upper()
    if CONF_PHASE_ORDER in expert:
        data[CONF_PHASE_ORDER] = [int(one) for one in expert[CONF_PHASE_ORDER]]
    return data


def charger_suggestions(protocol: Protocol, subentry: ConfigSubentry) -> dict[str, Any]:
    """Return what is stored of a charger as the form shows it."""
    stored = subentry.data
    address = ADDRESSES[protocol.key]
    place: Address = stored[CONF_ADDRESS]
    if address.optional and stored[CONF_SERIAL]:
        # The one that was kept: left empty, any other would be taken from now on.
        place = stored[CONF_SERIAL]
    expert = {
        key: stored[key]
        for key in (CONF_VOLTAGE, CONF_POLL_INTERVAL, CONF_ORDER_LIFETIME)
        if stored.get(key) is not None
    }
    if CONF_COMMAND in stored:
        expert[CONF_COMMAND] = str(stored[CONF_COMMAND])
    if CONF_INFORMATION in stored:
        expert[CONF_INFORMATION] = stored[CONF_INFORMATION]
    if CONF_PHASE_ORDER in stored:
        expert[CONF_PHASE_ORDER] = "".join(map(str, stored[CONF_PHASE_ORDER]))
    suggestions = {
        CONF_NAME: subentry.title,
        address.one: address.show(place),
        CONF_INSTALLATION_LIMIT: stored[CONF_INSTALLATION_LIMIT],
        CONF_EXPERT: expert,
    }
    if CONF_PORTS in stored:
        suggestions[CONF_PORTS] = str(stored[CONF_PORTS])
    more = (
        CONF_SERIAL,
        CONF_INSTALLATION_LIMIT_2,
        CONF_ORDER_LIFETIME,
        CONF_STOP_ON_SHUTDOWN,
    )
    return suggestions | {
        key: stored[key] for key in more if stored.get(key) is not None
    }


def confirm_row(protocol: Protocol, charger: ConfigSubentryData) -> str:
    """Return a new charger as a row of the table that is confirmed last."""
    data = charger["data"]
    limits = [f"{data[key]:g} A" for key in PORT_LIMITS if key in data]
    cells = [
        charger["title"].replace("|", "/"),
        ADDRESSES[protocol.key].show(data[CONF_ADDRESS]) or NO,
        " + ".join(limits),
        f"{data[CONF_FAIL_SAFE_CURRENT]:g} A",
    ]
    if CONF_FAIL_SAFE_TIMEOUT in data:
        cells.append(f"{data[CONF_FAIL_SAFE_TIMEOUT]} s")
    if CONF_STOP_ON_SHUTDOWN in data:
        lifetime = data[CONF_ORDER_LIFETIME]
        cells.append(NO if lifetime is None else f"{lifetime:g} min")
        cells.append(YES if data[CONF_STOP_ON_SHUTDOWN] else NO)
    return f"| {' | '.join(cells)} |"
