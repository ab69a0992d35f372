"""Kinds of boxes of which a bus may have one only: which boxes are of which. Pure."""

from collections.abc import Iterable, Mapping
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple

from homeassistant.const import CONF_ADDRESS

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentry, ConfigSubentryData

    from ..evse.protocol import Protocol
    from ..evse.scan import Address, FoundCharger


class Member(NamedTuple):
    """A box of a bus, or one that is about to be."""

    address: Address
    facts: Mapping[str, Any]
    title: str | None = None
    """Its name; ``None``: it has none yet."""

    @classmethod
    def of_found(cls, found: FoundCharger) -> Member:
        """Return a box that was found."""
        return cls(found.address, found.facts)

    @classmethod
    def of_stored(cls, one: ConfigSubentry | ConfigSubentryData) -> Member:
        """Return a box from its subentry, or from the data of a new one."""
        if isinstance(one, dict):
            return cls(one["data"][CONF_ADDRESS], one["data"], one["title"])
        return cls(one.data[CONF_ADDRESS], one.data, one.title)


def find_mix(protocol: Protocol, members: Iterable[Member]) -> str | None:
    """Return the boxes of several kinds, for texts; ``None``: they are of one.

    Of two members with one address the last one counts, with the name of the first.
    """
    if (kinds := protocol.kinds) is None:
        return None
    by_address: dict[Address, Member] = {}
    for one in members:
        before = by_address.get(one.address)
        title = one.title or (before.title if before is not None else None)
        by_address[one.address] = one._replace(title=title)
    known = [
        (kind, member)
        for member in by_address.values()
        if (kind := kinds.kind(member.facts)) is not None
    ]
    if len({kind for kind, _ in known}) < 2:  # noqa: PLR2004 - a mix has two
        return None

    def row(member: Member) -> str:
        info = kinds.info(member.facts)
        label = protocol.address.label(member.address)
        name = f"{member.title} ({label})" if member.title else label
        return f"- {name}: {info.model}, firmware {info.firmware}"

    known.sort(key=lambda one: (one[0], str(one[1].address)))
    groups = groupby(known, key=lambda one: one[0])
    return "\n\n".join(
        "\n".join(row(member) for _, member in group) for _, group in groups
    )
