"""Energy totals that grow only by measured consumption, and their storage.

The recorder counts every rise of a total as consumption. The value of a meter may
jump for other reasons: a box was exchanged, or another module took its address. Then
the total continues from its old value, with the new meter. What has flowed while
nothing was read counts as far as it can have flowed in that time.

Restored entity states may be minutes old after a crash. The recorder would take a total
that falls for a meter that was reset, and count its energy again. So totals have a file
of their own, written once `STEP` is new, at most once in `INTERVAL`, and at stop.
"""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Final

from homeassistant.core import HomeAssistant, callback
from homeassistant.util.hass_dict import HassKey

from .const import DOMAIN, LOGGER
from .evse.listeners import Observable
from .evse.meter import HIGHEST_CURRENT, most_energy
from .stores.file import UNREADABLE, PlannedWrite, StoredFile

TOTALS_KEY: Final = f"{DOMAIN}.totals"
"""File name in the storage folder of Home Assistant."""
STEP: Final = 100.0
"""Energy that is written as soon as it is new, Wh."""
INTERVAL: Final = 60.0
"""Shortest time between two writes, s."""

PATIENCE: Final = 900.0
"""Time in which the clock of a computer that has just started may be corrected, s."""


@dataclass(frozen=True, slots=True)
class MeterRecord:
    """The total of a meter as it is stored."""

    total: float
    """Wh"""
    meter: float | None
    """Value of the meter that belongs to it, Wh; ``None``: that of another meter."""
    wall: float
    """Wall-clock time of that value, s since 1970."""
    monotonic: float | None = None
    """Monotonic time of it, s; ``None``: of an earlier run, or not comparable."""


@dataclass(frozen=True, slots=True)
class Clocks:
    """The time by both clocks."""

    monotonic: float
    """s"""
    wall: float
    """s since 1970; may be wrong, and be corrected, after the computer has started."""

    def since(self, record: MeterRecord) -> float:
        """Return the time since a record, s; by the wall clock after a restart."""
        if record.monotonic is not None:
            return self.monotonic - record.monotonic
        return self.wall - record.wall


class MeterTotal:
    """The total of a charger's own meter."""

    def __init__(self, stored: MeterRecord | None = None) -> None:
        """Continue a stored total."""
        self.total = stored.total if stored is not None else None
        """Wh; equal to the value of the first meter as long as that stays."""
        self.not_counted: float | None = None
        """Change of the meter in an absence that is more than can have flowed, Wh."""
        self._stored = stored
        self._meter = 0.0
        self._generation: int | None = None
        self._offsets: dict[int, float] = {}
        """Offset of the total to each generation of the meter, Wh."""
        self._gap: float | None = None
        """Change of the meter in an absence, not counted yet, Wh."""
        self._began = 0.0

    def update(
        self,
        meter: float,
        generation: int,
        clocks: Clocks,
        current: float = HIGHEST_CURRENT,
    ) -> float:
        """Return the total for a value of the meter, both in Wh.

        ``current``: the highest phase current behind the meter, A.
        """
        total = self.total
        stored = self._stored
        if self._generation is None and stored and stored.meter is not None:
            self._gap = meter - stored.meter
            self._began = clocks.monotonic
        offset = self._offsets.get(generation)
        if offset is None and self._gap is not None and stored and stored.meter:
            # The meter that was read first was perhaps not yet itself: this one
            # may continue the stored total.
            self._gap = meter - stored.meter
        if offset is None:
            # Another meter: what it has counted before is no consumption.
            offset = 0.0 if total is None else total - meter
        if total is not None and offset + meter < total:
            offset = total - meter
        self._offsets[generation] = offset
        self._generation = generation
        self._meter = meter
        self.total = offset + meter if total is None else max(offset + meter, total)
        self._judge_gap(clocks, current)
        return self.total

    def _judge_gap(self, clocks: Clocks, current: float) -> None:
        """Count the energy of an absence, or drop it, as soon as this can be decided.

        The computer may have started with a wrong time, and a meter may begin at 0
        and be back at its total soon: what is too much for the absence by the wall
        clock, or has fallen, waits for `PATIENCE`.
        """
        gap, stored = self._gap, self._stored
        if gap is None or stored is None or self.total is None:
            return
        running = clocks.monotonic - self._began
        away = clocks.since(stored) - running
        if 0 <= gap <= most_energy(away, current):
            self.total += gap
            self._offsets = {one: by + gap for one, by in self._offsets.items()}
        elif running < PATIENCE:
            return
        else:
            self.not_counted = gap
        self._gap = None

    def record(self, clocks: Clocks) -> MeterRecord | None:
        """Return the total to store; ``None``: there is none.

        As long as the energy of an absence waits, the next run can decide about it.
        """
        if self.total is None or self._generation is None:
            return self._stored
        if self._gap is not None and self._stored is not None:
            stored = self._stored
            meter = self._meter - self._gap
            return MeterRecord(self.total, meter, stored.wall, stored.monotonic)
        return MeterRecord(self.total, self._meter, clocks.wall, clocks.monotonic)


@dataclass(slots=True)
class SummedTotal:
    """The total of an energy that the library sums up from its start on."""

    total: float = 0.0
    """Wh"""
    counted: float = 0.0
    """Sum of the library at the last update, Wh."""
    source: object = None
    """Object that sums up; another one starts at 0."""

    def update(self, summed: float, source: object) -> float:
        """Return the total for a sum of the library, both in Wh."""
        if source is not self.source or summed < self.counted:
            self.source = source
            self.counted = 0.0
        self.total += summed - self.counted
        self.counted = summed
        return self.total


# -- The store -------------------------------------------------------------------


class TotalStore(Observable):
    """The stored totals, by the unique id of their entity.

    Listeners are called after each successful write.
    """

    def __init__(self, hass: HomeAssistant) -> None:
        """Read nothing yet."""
        super().__init__()
        self._hass = hass
        self._file = StoredFile(hass, TOTALS_KEY)
        self._records: dict[str, MeterRecord] = {}
        self._on_disk: dict[str, MeterRecord] = {}
        self._loaded = False
        self._failed = False
        self._written_at: float | None = None
        self._next_write = PlannedWrite(hass, self.async_flush)
        self._busy = asyncio.Lock()

    async def async_load(self) -> None:
        """Read the file, once; an unreadable one is treated as missing."""
        async with self._busy:
            if self._loaded:
                return
            stored: dict[str, Any] = {}
            try:
                stored = dict(await self._file.async_load() or {})
            except UNREADABLE as error:
                LOGGER.error("The stored energy totals cannot be read: %s", error)
            for key, record in stored.items():
                try:
                    self._records[key] = decode(record)
                except UNREADABLE as error:
                    LOGGER.error("A stored energy total cannot be used: %s", error)
            self._on_disk = dict(self._records)
            self._loaded = True

    def get(self, key: str) -> MeterRecord | None:
        """Return the newest record of a total; ``None``: there is none."""
        return self._records.get(key)

    def stored(self, key: str) -> MeterRecord | None:
        """Return the record on disk; ``None``: there is none."""
        return self._on_disk.get(key)

    @callback
    def put(self, key: str, record: MeterRecord) -> None:
        """Take a record; write it soon if `STEP` is new, at once for another meter."""
        self._records[key] = record
        stored = self._on_disk.get(key)
        if stored is None or (
            record.total - stored.total >= STEP
            or abs(_offset(record) - _offset(stored)) >= 1
        ):
            self._write_soon(
                at_once=stored is None or _offset(record) != _offset(stored)
            )

    async def async_hand_over(self, old: str, new: str) -> None:
        """Continue the totals of a box with the meters of the one that replaces it."""
        await self.async_load()
        for key, record in tuple(self._records.items()):
            if key.startswith(f"{old}_"):
                self._records[f"{new}{key.removeprefix(old)}"] = replace(
                    record, meter=None
                )
        await self.async_flush()

    async def async_forget(self, identity: str) -> None:
        """Delete the totals of a box."""
        keys = [key for key in self._records if key.startswith(f"{identity}_")]
        for key in keys:
            del self._records[key]
        if keys:
            await self.async_flush()

    # -- Writing -----------------------------------------------------------------

    async def async_flush(self) -> None:
        """Write all records now, if any has changed."""
        async with self._busy:
            self._next_write.cancel()
            records = dict(self._records)
            if records == self._on_disk:
                return
            self._written_at = self._hass.loop.time()
            error = await self._file.async_write(
                {key: encode(record) for key, record in records.items()}
            )
            if error is not None:
                if not self._failed:
                    LOGGER.error("Energy totals cannot be stored: %s", error)
                self._failed = True
                self._write_soon()
                return
            self._failed = False
            self._on_disk = records
        self.updated()

    def _write_soon(self, *, at_once: bool = False) -> None:
        pause = 0.0
        if self._written_at is not None and not at_once:
            pause = self._written_at + INTERVAL - self._hass.loop.time()
        self._next_write.plan(max(pause, 0.0))


TOTALS: Final[HassKey[TotalStore]] = HassKey(TOTALS_KEY)


def _offset(record: MeterRecord) -> float:
    return record.total - (record.meter or 0.0)


def encode(record: MeterRecord) -> dict[str, float | None]:
    """Return the stored form of a record; a monotonic time ends with its run."""
    return {"total": record.total, "meter": record.meter, "wall": record.wall}


def decode(stored: Mapping[str, Any]) -> MeterRecord:
    """Return a record from its stored form.

    Raises TypeError, KeyError or ValueError for a record of another shape.
    """
    total, meter, wall = (stored[name] for name in ("total", "meter", "wall"))
    for value in (total, wall, 0.0 if meter is None else meter):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            message = f"{value!r} is no number"
            raise TypeError(message)
        if not isfinite(value):
            message = f"{value!r} is not finite"
            raise ValueError(message)
    return MeterRecord(total, meter, wall)
