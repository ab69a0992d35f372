"""Repair issues: problems that only the user can fix; deleted once they are."""

from collections.abc import Mapping, Set as AbstractSet
from typing import Final

from homeassistant.config_entries import ConfigEntry
from homeassistant.core import HomeAssistant
from homeassistant.helpers import issue_registry as ir

from .const import DOMAIN
from .evse.model import Fault, Orders
from .evse.safety import INTERVALS_PER_TIMEOUT
from .identity import Holder
from .managed_charger import ManagedCharger

NOT_STORED: Final = "orders_not_stored"
LOST: Final = "orders_lost"
SUPPLY_LOST: Final = "supply_lost"
TIMEOUT_RAISED: Final = "timeout_raised"
ENERGY_NOT_COUNTED: Final = "energy_not_counted"
SECOND_MASTER: Final = "second_master"
SET_UP_TWICE: Final = "set_up_twice"

WRONG_CHARGER: Final = "wrong_charger"
DUPLICATE_ADDRESS: Final = "duplicate_address"
SHARED_ADDRESS: Final = "shared_address"
NO_SUCH_PORT: Final = "no_such_port"
UNKNOWN_FIRMWARE: Final = "unknown_firmware"
UNSUPPORTED_FIRMWARE: Final = "unsupported_firmware"


def report_orders_written(hass: HomeAssistant, error: Exception | None) -> None:
    """Report that orders cannot be stored; ``None``: they can, clear the report."""
    if error is None:
        ir.async_delete_issue(hass, DOMAIN, NOT_STORED)
    else:
        _create(hass, NOT_STORED, NOT_STORED, {"error": str(error)})


def _create(
    hass: HomeAssistant, issue: str, key: str, placeholders: dict[str, str]
) -> None:
    ir.async_create_issue(
        hass,
        DOMAIN,
        issue,
        is_fixable=False,
        severity=ir.IssueSeverity.ERROR,
        translation_key=key,
        translation_placeholders=placeholders,
    )


class BusIssues:
    """The repair issues of one config entry."""

    def __init__(self, hass: HomeAssistant, entry: ConfigEntry) -> None:
        """Start without issues."""
        self._hass = hass
        self._entry = entry
        self._open: dict[str, dict[str, str]] = {}

    def orders_lost(self, managed: ManagedCharger, orders: Orders) -> None:
        """Report that a charger's stored orders are missing."""
        self._set(
            LOST,
            managed.key,
            present=True,
            placeholders={
                "charger": managed.name,
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
            placeholders={"charger": managed.name, "energy": f"{energy / 1000:+.1f}"},
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
        self._set(
            SECOND_MASTER,
            self._entry.entry_id,
            present=Fault.SECOND_MASTER in noticed,
            placeholders={"bus": self._entry.title},
        )

    def check(self, managed: ManagedCharger) -> None:
        """Report or clear the faults of a charger."""
        charger = managed.charger
        config = charger.config
        is_duplicate = Fault.DUPLICATE_ADDRESS in charger.faults
        faults = {
            # Once for a box with several ports.
            WRONG_CHARGER: Fault.WRONG_CHARGER in charger.faults
            and managed.is_primary_port,
            NO_SUCH_PORT: Fault.NO_SUCH_PORT in charger.faults,
            DUPLICATE_ADDRESS: is_duplicate and not charger.shares_address,
            SHARED_ADDRESS: is_duplicate and charger.shares_address,
        }
        for key, present in faults.items():
            self._set(
                key,
                managed.key,
                present=present,
                placeholders={
                    "charger": managed.name,
                    "address": str(config.address),
                    "expected": config.serial or "-",
                },
            )
        self._check_firmware(managed)
        self._check_timeout(managed)

    def _check_firmware(self, managed: ManagedCharger) -> None:
        """Report a firmware that is unknown, or that this protocol does not support."""
        charger = managed.charger
        present = Fault.UNSUPPORTED_FIRMWARE in charger.faults
        firmware = charger.info.firmware if charger.info is not None else None
        for key in (UNKNOWN_FIRMWARE, UNSUPPORTED_FIRMWARE):
            self._set(
                key,
                managed.key,
                present=present and (key == UNKNOWN_FIRMWARE) == (firmware is None),
                placeholders={
                    "charger": managed.name,
                    "address": str(charger.config.address),
                    "firmware": firmware or "-",
                },
            )

    def _check_timeout(self, managed: ManagedCharger) -> None:
        """Report a fail-safe time-out in use that is longer than the one ordered."""
        charger = managed.charger
        reading = charger.reading
        interval = reading.minimum_interval if reading else None
        # Until the charger reports its interval, the one in use is an assumption.
        if interval is None:
            return
        ordered = charger.effective_orders.fail_safe_timeout
        if ordered >= INTERVALS_PER_TIMEOUT * interval:
            self._set(TIMEOUT_RAISED, managed.key, present=False)
            return
        used = charger.setpoint.fail_safe_timeout
        self._set(
            TIMEOUT_RAISED,
            managed.key,
            present=used > ordered,
            placeholders={
                "charger": managed.name,
                "interval": f"{interval:g}",
                "ordered": str(ordered),
                "used": str(used),
            },
        )

    def forget(self, managed: ManagedCharger) -> None:
        """Delete the issues of a charger."""
        for issue in [one for one in self._open if one.endswith(managed.key)]:
            self._delete(issue)

    def clear(self) -> None:
        """Delete all issues of this entry."""
        for issue in tuple(self._open):
            self._delete(issue)

    def _set(
        self,
        key: str,
        owner: str,
        *,
        present: bool,
        placeholders: dict[str, str] | None = None,
    ) -> None:
        issue = f"{key}_{owner}"
        if not present:
            if issue in self._open:
                self._delete(issue)
            return
        shown = placeholders or {}
        if self._open.get(issue) == shown:
            return
        self._open[issue] = shown
        _create(self._hass, issue, key, shown)

    def _delete(self, issue: str) -> None:
        self._open.pop(issue, None)
        ir.async_delete_issue(self._hass, DOMAIN, issue)
