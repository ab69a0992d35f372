"""Setting an ABL box up: device-ID and what it keeps through a power failure.

Register 0x002C takes them in state E2, and they hold after a reset. The box must have
been told from all others by its serial number before (PROTOCOLS.md, 2).
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from ..conversation import rest
from ..errors import (
    DuplicateAddressError,
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from .dialogue import BOOT_LOOKS, Dialogue
from .exchanges import configure, read
from .reader import Debt
from .registers import INFO, SERIAL, Reading, StateCode
from .states import A1, E0, E2


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What is to be set in register 0x002C; ``None``: stays as it is."""

    device_id: int | None = None
    upstream_timeout: bool | None = None
    needs_enable: bool | None = None


class SetUp(Dialogue):
    """The conversation that sets a box up."""

    async def run(self, settings: Settings, turn: Turn) -> None:
        """Set device-ID or settings: E2, 0x002C, reset; then see that it is so."""
        charger = self._charger
        await self._reach(turn)
        old = charger.config.address
        new = old if settings.device_id is None else settings.device_id
        if settings.device_id == old:
            return
        before = self._state()
        serial = self._check_ready(before)
        if new != old:
            await self._make_sure_free(turn, new)
        was_disabled = before.state == E0
        charger.owes = Debt(StateCode.E0) if was_disabled else Debt(StateCode.A1, E2)
        try:
            await self._write(turn, settings, new)
        except EvseError:
            # Out of the set-up mode again, whatever went wrong.
            with suppress(EvseError):
                await self._give_back(turn)
            raise
        charger.forget()
        await self._move(turn, new, serial)
        await self._after_reset(turn, was_disabled=was_disabled)
        await charger.read_flags(turn)
        self._check_settings(settings)

    def _check_ready(self, reading: Reading) -> str:
        """Return the serial number of a box that can be set up now.

        Raises NotAvailableError.
        """
        if reading.state not in (A1, E0):
            raise self._refuse_in(reading, "only in A1 and E0 can it be set up")
        if (serial := self._charger.serial) is None:
            message = (
                f"{self._charger.config.name} tells no serial number: it cannot be "
                "told from another box with the same device-ID"
            )
            raise NotAvailableError(message)
        return serial

    async def _make_sure_free(self, turn: Turn, address: int) -> None:
        """Raise DuplicateAddressError when somebody has that address already."""
        bus = self._charger.bus
        others = bus.chargers.values() if bus is not None else ()
        taken = any(other.config.address == address for other in others)
        for ask in range(2):
            if taken:
                break
            with suppress(ReplyTimeoutError):
                await read(turn, address, INFO)
                taken = True
            if not ask:
                # A box asleep loses the first request.
                await rest(self.pauses.retry)
        if taken:
            message = f"device-ID {address} is taken already"
            raise DuplicateAddressError(message)

    async def _write(self, turn: Turn, settings: Settings, new: int) -> None:
        self._hold_polls(turn)
        await self._reach_state(turn, StateCode.E2, lambda now: now.state == E2)
        self._hold_polls(turn)
        await rest(self.pauses.setup)
        self._hold_polls(turn)
        write = partial(
            configure,
            turn,
            self._charger.config.address,
            new,
            upstream_timeout=settings.upstream_timeout,
            needs_enable=settings.needs_enable,
        )
        try:
            await write()
        except ReplyTimeoutError:
            # It cannot be read before the reset; the same value twice is the same.
            await write()
        await rest(self.pauses.setup)
        self._hold_polls(turn)
        if not await self._say(turn, StateCode.RESET):
            with suppress(ReplyTimeoutError):
                if (await self._charger.look(turn)).state == E2:
                    await self._say(turn, StateCode.RESET)

    async def _move(self, turn: Turn, new: int, serial: str) -> None:
        """Find the box at its new address, by its serial number; then go there."""
        charger = self._charger
        if new == charger.config.address:
            return
        for _ in range(BOOT_LOOKS):
            self._hold_polls(turn)
            await rest(self.pauses.boot)
            self._hold_polls(turn)
            with suppress(ReplyTimeoutError):
                found = await read(turn, new, SERIAL)
                if found.number == serial:
                    charger.move(new)
                    return
        message = (
            f"{charger.config.name} was not found at device-ID {new}; "
            f"it is still expected at {charger.config.address}"
        )
        raise NotConfirmedError(message)

    def _check_settings(self, settings: Settings) -> None:
        """Raise NotConfirmedError when a setting is not as it was set."""
        charger = self._charger
        options = charger.info.options if charger.info is not None else {}
        wanted = {
            "upstream_timeout": settings.upstream_timeout,
            "enable_after_power_cycle": (
                None if settings.needs_enable is None else not settings.needs_enable
            ),
        }
        for name, value in wanted.items():
            if value is not None and options.get(name) is not value:
                message = f"{charger.config.name} did not take {name} = {value}"
                raise NotConfirmedError(message)
