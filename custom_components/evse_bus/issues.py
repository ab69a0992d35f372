"""Repair issues: what only a person can put right; gone when it is."""

from typing import TYPE_CHECKING, Final

from homeassistant.helpers import issue_registry as ir

from .const import DOMAIN
from .evse.model import Fault, Orders

if TYPE_CHECKING:
    from collections.abc import Mapping

    from homeassistant.config_entries import ConfigEntry
    from homeassistant.core import HomeAssistant

    from .coordinator import ChargerUnit

NOT_STORED: Final = "orders_not_stored"
LOST: Final = "orders_lost"

_FAULT_KEYS: Final[Mapping[Fault, str]] = {
    Fault.WRONG_CHARGER: "wrong_charger",
    Fault.DUPLICATE_ADDRESS: "duplicate_address",
}


class BusIssues:
    """The issues of one config entry."""

    def __init__(self, hass: HomeAssistant, entry: ConfigEntry) -> None:
        """Start with none."""
        self._hass = hass
        self._entry = entry
        self._open: set[str] = set()

    def orders_written(self, error: Exception | None) -> None:
        """Note how writing the orders went."""
        self._set(
            NOT_STORED,
            self._entry.entry_id,
            present=error is not None,
            placeholders={"bus": self._entry.title, "error": str(error)},
        )

    def orders_lost(self, unit: ChargerUnit, orders: Orders) -> None:
        """Note that a charger's stored orders were not there."""
        self._set(
            LOST,
            unit.subentry_id,
            present=True,
            placeholders={
                "charger": unit.name,
                "current": f"{orders.limit.current:g}",
            },
        )

    def orders_renewed(self, unit: ChargerUnit) -> None:
        """Note that somebody has given a charger orders again."""
        self._set(LOST, unit.subentry_id, present=False)

    def check(self, unit: ChargerUnit) -> None:
        """Note what a charger told, or what was noticed of it."""
        faults = unit.charger.faults
        config = unit.charger.config
        for fault, key in _FAULT_KEYS.items():
            self._set(
                key,
                unit.subentry_id,
                present=fault in faults,
                placeholders={
                    "charger": unit.name,
                    "address": str(config.address),
                    "expected": config.serial or "-",
                },
            )

    def forget(self, unit: ChargerUnit) -> None:
        """Delete the issues of a charger that is no more."""
        for issue in [one for one in self._open if one.endswith(unit.subentry_id)]:
            self._delete(issue)

    def clear(self) -> None:
        """Delete all issues of this bus."""
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
        if issue in self._open:
            return
        self._open.add(issue)
        ir.async_create_issue(
            self._hass,
            DOMAIN,
            issue,
            is_fixable=False,
            severity=ir.IssueSeverity.ERROR,
            translation_key=key,
            translation_placeholders=placeholders,
        )

    def _delete(self, issue: str) -> None:
        self._open.discard(issue)
        ir.async_delete_issue(self._hass, DOMAIN, issue)
