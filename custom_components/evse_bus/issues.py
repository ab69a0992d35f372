"""Repair issues: what only a person can put right; gone when it is."""

from typing import TYPE_CHECKING, Final

from homeassistant.helpers import issue_registry as ir

from .const import DOMAIN
from .evse.model import Fault, Orders
from .evse.safety import INTERVALS_PER_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet

    from homeassistant.config_entries import ConfigEntry
    from homeassistant.core import HomeAssistant

    from .unit import ChargerUnit

NOT_STORED: Final = "orders_not_stored"
LOST: Final = "orders_lost"
SUPPLY_LOST: Final = "supply_lost"
TIMEOUT_RAISED: Final = "timeout_raised"
SECOND_MASTER: Final = "second_master"

WRONG_CHARGER: Final = "wrong_charger"
DUPLICATE_ADDRESS: Final = "duplicate_address"
SHARED_ADDRESS: Final = "shared_address"
NO_SUCH_PORT: Final = "no_such_port"
UNKNOWN_FIRMWARE: Final = "unknown_firmware"
UNSUPPORTED_FIRMWARE: Final = "unsupported_firmware"


class BusIssues:
    """The issues of one config entry."""

    def __init__(self, hass: HomeAssistant, entry: ConfigEntry) -> None:
        """Start with none."""
        self._hass = hass
        self._entry = entry
        self._open: dict[str, dict[str, str]] = {}

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
            unit.key,
            present=True,
            placeholders={
                "charger": unit.name,
                "current": f"{orders.limit.current:g}",
            },
        )

    def orders_renewed(self, unit: ChargerUnit) -> None:
        """Note that somebody has given a charger orders again."""
        self._set(LOST, unit.key, present=False)

    def supply_lost(self, current: float) -> None:
        """Note that the stored order about a bus's supply was not there."""
        self._set(
            SUPPLY_LOST,
            self._entry.entry_id,
            present=True,
            placeholders={"bus": self._entry.title, "current": f"{current:g}"},
        )

    def supply_renewed(self) -> None:
        """Note that somebody has said again what a bus shares."""
        self._set(SUPPLY_LOST, self._entry.entry_id, present=False)

    def check_bus(self, noticed: AbstractSet[Fault]) -> None:
        """Note what was noticed of the whole bus."""
        self._set(
            SECOND_MASTER,
            self._entry.entry_id,
            present=Fault.SECOND_MASTER in noticed,
            placeholders={"bus": self._entry.title},
        )

    def check(self, unit: ChargerUnit) -> None:
        """Note what a charger told, or what was noticed of it."""
        charger = unit.charger
        config = charger.config
        twice = Fault.DUPLICATE_ADDRESS in charger.faults
        noticed = {
            # Of a box with several ports, once.
            WRONG_CHARGER: Fault.WRONG_CHARGER in charger.faults and unit.leads,
            NO_SUCH_PORT: Fault.NO_SUCH_PORT in charger.faults,
            DUPLICATE_ADDRESS: twice and not charger.shares_address,
            SHARED_ADDRESS: twice and charger.shares_address,
        }
        for key, present in noticed.items():
            self._set(
                key,
                unit.key,
                present=present,
                placeholders={
                    "charger": unit.name,
                    "address": str(config.address),
                    "expected": config.serial or "-",
                },
            )
        self._check_firmware(unit)
        self._check_timeout(unit)

    def _check_firmware(self, unit: ChargerUnit) -> None:
        """Note a firmware that is not known, or that this bus cannot use."""
        charger = unit.charger
        present = Fault.UNSUPPORTED_FIRMWARE in charger.faults
        firmware = charger.info.firmware if charger.info is not None else None
        for key in (UNKNOWN_FIRMWARE, UNSUPPORTED_FIRMWARE):
            self._set(
                key,
                unit.key,
                present=present and (key == UNKNOWN_FIRMWARE) == (firmware is None),
                placeholders={
                    "charger": unit.name,
                    "address": str(charger.config.address),
                    "firmware": firmware or "-",
                },
            )

    def _check_timeout(self, unit: ChargerUnit) -> None:
        """Note a fail-safe time-out that is longer than ordered."""
        charger = unit.charger
        reading = charger.reading
        told = reading.minimum_interval if reading else None
        # The interval that counts before one is told is a guess: no news.
        if told is None:
            return
        ordered = charger.effective_orders.fail_safe_timeout
        if ordered >= INTERVALS_PER_TIMEOUT * told:
            self._set(TIMEOUT_RAISED, unit.key, present=False)
            return
        used = charger.setpoint.fail_safe_timeout
        self._set(
            TIMEOUT_RAISED,
            unit.key,
            present=used > ordered,
            placeholders={
                "charger": unit.name,
                "interval": f"{told:g}",
                "ordered": str(ordered),
                "used": str(used),
            },
        )

    def forget(self, unit: ChargerUnit) -> None:
        """Delete the issues of a charger that is no more."""
        for issue in [one for one in self._open if one.endswith(unit.key)]:
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
        shown = placeholders or {}
        if self._open.get(issue) == shown:
            return
        self._open[issue] = shown
        ir.async_create_issue(
            self._hass,
            DOMAIN,
            issue,
            is_fixable=False,
            severity=ir.IssueSeverity.ERROR,
            translation_key=key,
            translation_placeholders=shown,
        )

    def _delete(self, issue: str) -> None:
        self._open.pop(issue, None)
        ir.async_delete_issue(self._hass, DOMAIN, issue)
