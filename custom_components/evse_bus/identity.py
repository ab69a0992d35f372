"""What a box is known by, and where else it is set up.

Unique ids, device identifiers, orders and totals stand on the identity of a box. It is
fixed when the box is added: by its serial number, so that a box which is removed and
added again, at whatever port and in whatever way, finds all of them again; else by the
id of its subentry. A serial number that is read later does not change it.
"""

from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

from homeassistant.const import CONF_ADDRESS
from homeassistant.core import callback
from homeassistant.util.ulid import ulid_now

from .configuration import charger_configs, initial_orders, protocol_of
from .const import (
    CONF_IDENTITY,
    CONF_PROTOCOL,
    CONF_REFUSED,
    CONF_SERIAL,
    DOMAIN,
)

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigEntry, ConfigSubentry
    from homeassistant.core import HomeAssistant

    from .evse.protocol import Protocol
    from .evse.scan import Address


def identity_data(protocol: Protocol, serial: str | None) -> dict[str, str]:
    """Return the identity of a new box as part of its subentry's data."""
    identity = protocol.identity(serial)
    return {} if identity is None else {CONF_IDENTITY: identity}


class AnotherBox(TypedDict):
    """What changes in a subentry whose box was replaced."""

    data: dict[str, Any]
    unique_id: str | None


def another_box(
    protocol: Protocol, subentry: ConfigSubentry, address: Address, serial: str | None
) -> AnotherBox:
    """Return the subentry of a box that takes the place of another."""
    identity = protocol.identity(serial)
    of_the_other = {CONF_REFUSED, *protocol.config.facts}
    data = {
        **{key: one for key, one in subentry.data.items() if key not in of_the_other},
        CONF_ADDRESS: address,
        CONF_SERIAL: serial,
        # Never that of the box before, of which nothing may be known either.
        CONF_IDENTITY: identity or ulid_now(),
    }
    return AnotherBox(data=data, unique_id=identity)


def another_box_texts(protocol: Protocol, subentry: ConfigSubentry) -> dict[str, str]:
    """Return the placeholders of the texts on a box that replaces another."""
    configs = charger_configs({CONF_PROTOCOL: protocol.key}, subentry)
    first = max(initial_orders(subentry, one).limit.current for one in configs)
    return {
        "name": subentry.title,
        "before": subentry.data.get(CONF_SERIAL) or "?",
        "current": f"{first:g}",
    }


def kept_data(protocol: Protocol, subentry: ConfigSubentry) -> dict[str, Any]:
    """Return what the data of a box says of that box, not of its use."""
    names = {CONF_IDENTITY, CONF_REFUSED, *protocol.config.facts} - {CONF_SERIAL}
    return {key: one for key, one in subentry.data.items() if key in names}


def identity_of(subentry: ConfigSubentry) -> str:
    """Return the identity of a box that is set up."""
    identity: str = subentry.data.get(CONF_IDENTITY, subentry.subentry_id)
    return identity


def stands_on_serial(protocol: Protocol, subentry: ConfigSubentry) -> bool:
    """Return whether the identity is that of the box itself: it may come back."""
    return protocol.identity(subentry.data.get(CONF_SERIAL)) == identity_of(subentry)


class Holder(NamedTuple):
    """A subentry with which a box is set up."""

    entry: ConfigEntry
    subentry: ConfigSubentry

    @property
    def name(self) -> str:
        """Return its name and that of its bus."""
        return f"{self.subentry.title} ({self.entry.title})"

    @property
    def age(self) -> tuple[str, str]:
        """Return what orders subentries by age: their ids begin with the time."""
        return self.subentry.subentry_id, self.entry.entry_id

    def is_older(self, other: Holder) -> bool:
        """Return whether it was added before another one."""
        return self.age < other.age


@callback
def holders(hass: HomeAssistant, identity: str) -> list[Holder]:
    """Return all subentries with which a box is set up, the oldest first.

    It may have been added by its serial number, or that was read later.
    """
    found = [
        Holder(entry, subentry)
        for entry in hass.config_entries.async_entries(DOMAIN)
        # An ignored box is an entry, too, without data.
        if CONF_PROTOCOL in entry.data
        for subentry in entry.subentries.values()
        if identity in _identities(protocol_of(entry.data), subentry)
    ]
    return sorted(found, key=lambda one: one.age)


def _identities(protocol: Protocol, subentry: ConfigSubentry) -> set[str | None]:
    serials = (subentry.data.get(key) for key in (CONF_SERIAL, CONF_REFUSED))
    return {identity_of(subentry), *map(protocol.identity, serials)}


@callback
def older_holder(
    hass: HomeAssistant, protocol: Protocol, subentry: ConfigSubentry
) -> Holder | None:
    """Return the oldest subentry of this box; ``None``: it is this one.

    Two of them would be two masters. Which one counts does not depend on the order in
    which entries are set up.
    """
    for identity in filter(None, _identities(protocol, subentry)):
        for one in holders(hass, identity):
            if one.subentry is subentry:
                break
            return one
    return None


@callback
def holder(
    hass: HomeAssistant, identity: str | None, but: ConfigSubentry | None = None
) -> Holder | None:
    """Return where a box is set up already; ``None``: nowhere, or not known.

    ``but`` is the subentry being reconfigured.
    """
    if identity is None:
        return None
    return next(
        (one for one in holders(hass, identity) if one.subentry is not but),
        None,
    )
