"""Repair issues: problems that only the user can fix; deleted once they are."""

from collections.abc import Mapping, Set as AbstractSet
from math import floor
from typing import Final

from homeassistant.config_entries import ConfigEntry
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr, issue_registry as ir

from .chargers.kinds import Member, find_mix
from .chargers.managed import ManagedCharger
from .configuration import protocol_of
from .const import (
    CONF_ENTRY,
    CONF_SERIAL,
    CONF_SUBENTRY,
    DOMAIN,
    SUBENTRY_CHARGER,
)
from .evse.bus import Bus
from .evse.load import Overload
from .evse.model import Fault, Orders, Setting
from .evse.round_trip import RoundTrip
from .evse.safety import INTERVALS_PER_TIMEOUT
from .identity import Holder, another_box_texts, holder

NOT_STORED: Final = "orders_not_stored"
LOST: Final = "orders_lost"
SUPPLY_LOST: Final = "supply_lost"
TIMEOUT_RAISED: Final = "timeout_raised"
ENERGY_NOT_COUNTED: Final = "energy_not_counted"
SECOND_MASTER: Final = "second_master"
MIXED_FIRMWARE: Final = "mixed_firmware"
MODBUS_TCP: Final = "modbus_tcp"
REPLIES_TOO_LATE: Final = "replies_too_late"
LINE_TOO_SLOW: Final = "line_too_slow"
SET_UP_TWICE: Final = "set_up_twice"

WRONG_CHARGER: Final = "wrong_charger"
REPLACED: Final = "replaced"
"""Text of the same where the box may have been replaced by another."""
BEGINS_ABOVE_LIMIT: Final = "begins_above_limit"
LOWER_MAXIMUM: Final = "lower_maximum"
"""Text of the same where the box's own maximum can be lowered from here."""
_FIXABLE: Final = {WRONG_CHARGER: REPLACED, BEGINS_ABOVE_LIMIT: LOWER_MAXIMUM}
"""Texts of the issues that a flow can fix."""
_WARNINGS: Final = frozenset({BEGINS_ABOVE_LIMIT, LOWER_MAXIMUM})
"""Texts of what does not keep anything from working."""
DUPLICATE_ADDRESS: Final = "duplicate_address"
SHARED_ADDRESS: Final = "shared_address"
NO_SUCH_PORT: Final = "no_such_port"
UNKNOWN_FIRMWARE: Final = "unknown_firmware"


type Fix = dict[str, str | int | float | None]
"""Data from which `repairs.py` makes a flow."""


def report_orders_written(hass: HomeAssistant, error: Exception | None) -> None:
    """Report that orders cannot be stored; ``None``: they can, clear the report."""
    if error is None:
        ir.async_delete_issue(hass, DOMAIN, NOT_STORED)
    else:
        _create(hass, NOT_STORED, NOT_STORED, {"error": str(error)})


def forget_energy(hass: HomeAssistant, key: str) -> None:
    """Delete the issues about energy of a charger, also those of an earlier run.

    ``key``: of the charger, or the id of its subentry.
    """
    for domain, issue in tuple(ir.async_get(hass).issues):
        prefix, _, rest = issue.partition(f"{ENERGY_NOT_COUNTED}_")
        owner = rest.partition("_")[2]
        if domain == DOMAIN and not prefix and f"{owner}_".startswith(f"{key}_"):
            ir.async_delete_issue(hass, DOMAIN, issue)


def _create(
    hass: HomeAssistant,
    issue: str,
    key: str,
    placeholders: dict[str, str],
    fix: Fix | None = None,
) -> None:
    ir.async_create_issue(
        hass,
        DOMAIN,
        issue,
        data=fix,
        is_fixable=fix is not None,
        # Found once only: it stays until the user ignores it.
        is_persistent=key == ENERGY_NOT_COUNTED,
        severity=(
            ir.IssueSeverity.WARNING if key in _WARNINGS else ir.IssueSeverity.ERROR
        ),
        translation_key=key,
        translation_placeholders=placeholders,
    )


def speed_texts(trip: RoundTrip) -> dict[str, str]:
    """Return the speed of a line as placeholders of texts."""
    return {"round_trip": f"{trip.mean or 0:.1f}", "longest": f"{trip.longest:g}"}


def load_texts(overload: Overload) -> dict[str, str]:
    """Return a deadline that cannot be kept as placeholders of texts."""
    return {"needed": f"{overload.needed:.0f}", "within": f"{overload.within:g}"}


class BusIssues:
    """The repair issues of one config entry."""

    def __init__(self, hass: HomeAssistant, entry: ConfigEntry) -> None:
        """Start without issues."""
        self._hass = hass
        self._entry = entry
        self._open: dict[str, tuple[str, dict[str, str]]] = {}
        """Text and placeholders of each issue."""
        self._protocol = protocol_of(entry.data)

    def orders_lost(self, managed: ManagedCharger, orders: Orders) -> None:
        """Report that a charger's stored orders are missing."""
        self._set(
            LOST,
            managed.key,
            present=True,
            placeholders={
                "charger": self._name(managed),
                "current": f"{orders.limit.current:g}",
            },
        )

    def orders_renewed(self, managed: ManagedCharger) -> None:
        """Clear the report of missing orders: the user has given new ones."""
        self._set(LOST, managed.key, present=False)

    def energy_not_counted(
        self, managed: ManagedCharger, number: int, energy: float
    ) -> None:
        """Report a meter that has changed more in an absence than can have flowed.

        ``energy``: by how much, Wh; negative: it has fallen.
        """
        self._set(
            ENERGY_NOT_COUNTED,
            f"{number}_{managed.key}",
            present=True,
            placeholders={
                "charger": self._name(managed),
                "energy": f"{energy / 1000:+.5g}",
            },
        )

    def set_up_twice(self, duplicates: Mapping[str, Holder]) -> None:
        """Report subentries that are not started: their box is set up already.

        ``duplicates``: where, by the id of the subentry.
        """
        prefix = f"{SET_UP_TWICE}_"
        gone = {one for one in self._open if one.startswith(prefix)}
        for subentry_id, other in duplicates.items():
            gone.discard(f"{prefix}{subentry_id}")
            subentry = self._entry.subentries[subentry_id]
            self._set(
                SET_UP_TWICE,
                subentry_id,
                present=True,
                placeholders={
                    "charger": Holder(self._entry, subentry).name,
                    "other": other.name,
                },
            )
        for issue in gone:
            self._delete(issue)

    def supply_lost(self, current: float) -> None:
        """Report that the stored limit of the shared supply is missing."""
        self._set(
            SUPPLY_LOST,
            self._entry.entry_id,
            present=True,
            placeholders={"bus": self._entry.title, "current": f"{current:g}"},
        )

    def supply_renewed(self) -> None:
        """Clear the report of a missing supply limit: it was set again."""
        self._set(SUPPLY_LOST, self._entry.entry_id, present=False)

    def check_bus(self, noticed: AbstractSet[Fault]) -> None:
        """Report or clear faults of the whole bus."""
        is_mixed = Fault.MIXED_DIALECTS in noticed
        self._set(
            MIXED_FIRMWARE,
            self._entry.entry_id,
            present=is_mixed,
            placeholders={
                "bus": self._entry.title,
                "chargers": self._mix() if is_mixed else "-",
            },
        )
        self._set(
            SECOND_MASTER,
            self._entry.entry_id,
            present=Fault.SECOND_MASTER in noticed,
            placeholders={"bus": self._entry.title},
        )

    def _mix(self) -> str:
        """Return the boxes that cannot have one bus; all, until their facts are kept."""
        boxes = [
            Member.of_stored(one)
            for one in self._entry.get_subentries_of_type(SUBENTRY_CHARGER)
        ]
        return find_mix(self._protocol, boxes) or "\n".join(
            f"- {box.title} ({self._protocol.address.label(box.address)})"
            for box in boxes
        )

    def check_line(self, bus: Bus) -> None:
        """Report or clear what is wrong with the adapter of a bus."""
        self._set(
            MODBUS_TCP,
            self._entry.entry_id,
            present=bus.wire.gateway.detected,
            placeholders={"bus": self._entry.title, "port": bus.line.url},
        )
        shown = {"bus": self._entry.title} | speed_texts(bus.wire.round_trip)
        self._set(
            REPLIES_TOO_LATE,
            self._entry.entry_id,
            present=bus.too_slow,
            placeholders=shown,
        )
        overload = bus.overload
        self._set(
            LINE_TOO_SLOW,
            self._entry.entry_id,
            present=overload is not None and not bus.too_slow,
            placeholders=shown if overload is None else shown | load_texts(overload),
        )

    def check(self, managed: ManagedCharger) -> None:
        """Report or clear the faults of a charger."""
        charger = managed.charger
        # Most updates have none: their texts are not made.
        texts = {"charger": self._name(managed)} if charger.faults else {}
        is_duplicate = Fault.DUPLICATE_ADDRESS in charger.faults
        if managed.is_primary_port:
            # Once for a box with several ports.
            self._check_wrong_charger(managed, texts)
        faults = {
            NO_SUCH_PORT: Fault.NO_SUCH_PORT in charger.faults,
            UNKNOWN_FIRMWARE: Fault.UNSUPPORTED_FIRMWARE in charger.faults,
            DUPLICATE_ADDRESS: is_duplicate and not charger.shares_address,
            SHARED_ADDRESS: is_duplicate and charger.shares_address,
        }
        for key, present in faults.items():
            self._set(
                key,
                managed.key,
                present=present,
                placeholders=texts
                | {"address": self._protocol.address.label(charger.config.address)},
            )
        self._check_timeout(managed)
        self._check_beginning(managed)

    def _check_wrong_charger(
        self, managed: ManagedCharger, texts: dict[str, str]
    ) -> None:
        """Report another box in the place of a charger: exchanged, or swapped."""
        charger = managed.charger
        if Fault.WRONG_CHARGER not in charger.noticed:
            self._set(WRONG_CHARGER, managed.key, present=False)
            return
        found = charger.other_serial
        other = holder(self._hass, self._protocol.identity(found))
        # A box that is set up elsewhere has not replaced this one.
        replaced = found is not None and other is None
        self._set(
            WRONG_CHARGER,
            managed.key,
            present=True,
            placeholders={
                **another_box_texts(self._protocol, managed.subentry),
                **texts,
                "expected": charger.config.serial or "?",
                "found": found or "?",
                "other": "-" if other is None else other.name,
            },
            fix={
                CONF_ENTRY: self._entry.entry_id,
                CONF_SUBENTRY: managed.subentry_id,
                CONF_SERIAL: found,
            }
            if replaced
            else None,
        )

    def _name(self, managed: ManagedCharger) -> str:
        """Return the name of a charger: that of its device, if the user gave it one."""
        device = dr.async_get(self._hass).async_get(managed.device_id)
        given = device.name_by_user if device is not None else None
        if given is None:
            return managed.name
        return given if managed.port_count == 1 else f"{given} {managed.port_number}"

    def _check_timeout(self, managed: ManagedCharger) -> None:
        """Report a fail-safe time-out in use that is longer than the one ordered."""
        charger = managed.charger
        reading = charger.reading
        interval = reading.minimum_interval if reading else None
        # Until the charger reports its interval, the one in use is an assumption.
        if interval is None:
            return
        ordered = charger.valid_orders.fail_safe_timeout
        used = charger.setpoint.fail_safe_timeout
        if ordered >= INTERVALS_PER_TIMEOUT * interval or used <= ordered:
            self._set(TIMEOUT_RAISED, managed.key, present=False)
            return
        self._set(
            TIMEOUT_RAISED,
            managed.key,
            present=True,
            placeholders={
                "charger": self._name(managed),
                "interval": f"{interval:g}",
                "ordered": str(ordered),
                "used": str(used),
            },
        )

    def _check_beginning(self, managed: ManagedCharger) -> None:
        """Report a charger that may begin a charge with more than its wiring carries.

        What it begins with is kept while it is not known, as without a connection.
        """
        charger = managed.charger
        begins, limit = charger.begins_with, charger.config.installation_limit
        if begins is None:
            return
        if begins <= limit:
            self._set(BEGINS_ABOVE_LIMIT, managed.key, present=False)
            return
        stored = charger.reading.settings if charger.reading is not None else {}
        lowered = floor(limit)
        # Below its minimum it could not charge at all.
        can_be_lowered = stored.get(Setting.MINIMUM_CURRENT, lowered) <= lowered
        self._set(
            BEGINS_ABOVE_LIMIT,
            managed.key,
            present=True,
            placeholders={
                "charger": self._name(managed),
                "maximum": f"{begins:g}",
                "minimum": str(stored.get(Setting.MINIMUM_CURRENT, "-")),
                "limit": f"{limit:g}",
                "lowered": str(lowered),
            },
            fix={
                CONF_ENTRY: self._entry.entry_id,
                CONF_SUBENTRY: managed.subentry_id,
            }
            if can_be_lowered
            else None,
        )

    def forget(self, managed: ManagedCharger) -> None:
        """Delete the issues of a charger."""
        for issue in [one for one in self._open if one.endswith(managed.key)]:
            self._delete(issue)
        forget_energy(self._hass, managed.key)

    def clear(self) -> None:
        """Delete the issues of this entry that would be found again."""
        for issue in tuple(self._open):
            if not issue.startswith(ENERGY_NOT_COUNTED):
                self._delete(issue)

    def _set(
        self,
        key: str,
        owner: str,
        *,
        present: bool,
        placeholders: dict[str, str] | None = None,
        fix: Fix | None = None,
    ) -> None:
        """Create, change or delete an issue; ``fix``: data of the flow that fixes it."""
        issue = f"{key}_{owner}"
        if not present:
            if issue in self._open:
                self._delete(issue)
            return
        shown = (_FIXABLE[key] if fix else key, placeholders or {})
        if self._open.get(issue) == shown:
            return
        self._open[issue] = shown
        _create(self._hass, issue, *shown, fix)

    def _delete(self, issue: str) -> None:
        self._open.pop(issue, None)
        ir.async_delete_issue(self._hass, DOMAIN, issue)
