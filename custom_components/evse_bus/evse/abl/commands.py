"""What an ABL box can be told beside its orders, each as one conversation.

Register 0x0005 is never written twice for one wish: after a lost answer the state is
read, and decides. What a conversation has changed on its way (E0, E2) it changes
back, also when something fails.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, assert_never

from ..exchange import Talk
from ..model import (
    Command,
    DuplicateAddressError,
    EvseError,
    ExchangeError,
    ExchangeRefusedError,
    NotAvailableError,
    NotConfirmedError,
    Persistence,
    RefusedOrderError,
    ReplyTimeoutError,
)
from ..turns import Turns
from .duty import PAUSE, is_within
from .exchanges import configure, read, set_state
from .registers import (
    ADDRESSES,
    INFO,
    SERIAL,
    Reading,
    StateCode,
    decode_serial,
    limit_duty,
)
from .states import A1, B2, E0, E2, state_of

if TYPE_CHECKING:
    from .charger import AblCharger

WAKE_PAUSE: Final = 3.0
"""Time without a pilot signal that wakes a car (PROTOCOLS.md, 2), s."""
SETUP_PAUSE: Final = 0.5
"""Pause between the writes of a set-up (PROTOCOLS.md, 2), s."""
BOOT_PAUSE: Final = 0.6
"""Pause between two looks for a box that has been reset, s."""
BOOT_LOOKS: Final = 10
RETRY_PAUSE: Final = 0.4
"""Pause after a first request that a sleeping box has lost, s."""
VERIFY_PAUSE: Final = 0.3
LOOKS: Final = 4
"""How often a state is looked at until it must have been reached."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Setup:
    """What is to be set in register 0x002C; ``None``: stays as it is."""

    device_id: int | None = None
    upstream_timeout: bool | None = None
    needs_enable: bool | None = None


class CommandSet:
    """The commands of one charger; one at a time."""

    def __init__(self, charger: AblCharger) -> None:
        """Take the charger, for its identity, its readings and its limit."""
        self._charger = charger
        self._busy: Command | None = None

    def conversation(
        self, command: Command, value: object
    ) -> tuple[Callable[[Talk], Turns], Persistence]:
        """Return what carries out a command, and how often it may be begun.

        Raises RefusedOrderError for a value that the command cannot have.
        """
        turns, persistence = self._turns(command, value)
        return self._one_at_a_time(command, turns), persistence

    def _turns(
        self, command: Command, value: object
    ) -> tuple[Callable[[Talk], Turns], Persistence]:
        match command:
            case Command.RESET:
                return self._reset, Persistence.ONCE
            case Command.WAKE:
                return self._wake, Persistence.ONCE
            case Command.SET_OUTLET:
                turns = partial(self._set_outlet, _on_or_off(command, value))
                # It begins with a look at the state: twice does what once does.
                return turns, Persistence.REPEATABLE
            case Command.SET_ADDRESS:
                setup = _Setup(device_id=_device_id(value))
            case Command.SET_UPSTREAM_TIMEOUT:
                setup = _Setup(upstream_timeout=_on_or_off(command, value))
            case Command.SET_ENABLE_AFTER_POWER_CYCLE:
                setup = _Setup(needs_enable=not _on_or_off(command, value))
            case _:
                assert_never(command)
        return partial(self._set_up, setup), Persistence.ONCE

    def _one_at_a_time(
        self, command: Command, turns: Callable[[Talk], Turns]
    ) -> Callable[[Talk], Turns]:
        async def conversation(talk: Talk) -> Turns:
            if self._busy is not None:
                message = f"{self._charger.config.name} is busy: {self._busy}"
                raise NotAvailableError(message)
            token = self._charger.begin()
            self._busy = command
            try:
                async for pause in turns(talk):
                    yield pause
            finally:
                self._busy = None
                self._charger.end(token)
                self._charger.updated()

        return conversation

    # -- Parts -------------------------------------------------------------------

    async def _reach(self, talk: Talk) -> Turns:
        """Wake the box itself: nothing has been written, so asking again is safe."""
        for last in (False, False, True):
            try:
                await self._charger.identify(talk)
                await self._charger.look(talk)
            except ReplyTimeoutError:
                if last:
                    raise
            else:
                return
            yield RETRY_PAUSE

    def _state(self) -> Reading:
        """Return the last reading."""
        if self._charger.raw is None:
            message = f"{self._charger.config.name} has told no state"
            raise NotAvailableError(message)
        return self._charger.raw

    async def _say(self, talk: Talk, code: StateCode) -> bool:
        """Write a state code, once; return whether it was confirmed."""
        try:
            await set_state(talk, self._charger.config.address, code)
        except ReplyTimeoutError:
            return False
        return True

    def _hold_polls(self, talk: Talk) -> None:
        """Let no regular exchange come between: the box is off or moving."""
        slot = self._charger.slot
        slot.ready = max(slot.ready, talk.now + 2 * BOOT_PAUSE)

    def _refuse_in(self, reading: Reading, what: str) -> NotAvailableError:
        name = self._charger.config.name
        state = state_of(reading.state).name
        return NotAvailableError(f"{name} is in state {state}: {what}")

    # -- Outlet ------------------------------------------------------------------

    async def _set_outlet(self, enabled: bool, talk: Talk) -> Turns:  # noqa: FBT001
        async for pause in self._reach(talk):
            yield pause
        reading = self._state()
        if enabled:
            if state_of(reading.state).outlet_enabled is not True:
                if reading.state not in (E0, E2):
                    raise self._refuse_in(reading, "only E0 and E2 can be left")
                async for pause in self._enable(talk):
                    yield pause
        elif reading.state != E0:
            async for pause in self._reach_state(
                talk, StateCode.E0, lambda now: now.state == E0
            ):
                yield pause

    async def _enable(self, talk: Talk) -> Turns:
        """Enable the outlet, with the limit that stands."""
        charger = self._charger
        paused = self._state().duty == PAUSE
        if not is_within(self._state().duty, limit_duty(charger.setpoint)):
            # First the limit: enabled, a car may begin at once.
            async for pause in charger.enforce(talk, lambda: charger.setpoint):
                yield pause
        async for pause in self._reach_state(
            talk, StateCode.A1, lambda now: now.state not in (E0, E2)
        ):
            yield pause
        charger.owes_a1 = False
        if not paused and self._state().duty < limit_duty(charger.setpoint) != PAUSE:
            # Limits raised while the outlet was disabled have only been stored.
            async for pause in charger.enforce(talk, lambda: charger.setpoint):
                yield pause

    async def _reach_state(
        self, talk: Talk, code: StateCode, reached: Callable[[Reading], bool]
    ) -> Turns:
        """Write a state code and see that it works; again only if it was lost."""
        confirmed = await self._say(talk, code)
        for _ in range(LOOKS):
            if reached(await self._charger.look(talk)):
                return
            if not confirmed:
                confirmed = await self._say(talk, code)
            yield VERIFY_PAUSE
        if reached(await self._charger.look(talk)):
            return
        message = f"{self._charger.config.name} does not follow {code.name}"
        raise NotConfirmedError(message)

    # -- Waking a car ------------------------------------------------------------

    async def _wake(self, talk: Talk) -> Turns:
        async for pause in self._reach(talk):
            yield pause
        charger = self._charger
        reading = self._state()
        if reading.state != B2:
            raise self._refuse_in(reading, "only a car that may charge can be woken")
        if reading.duty == PAUSE or charger.setpoint.paused:
            raise self._refuse_in(reading, "charging is paused, waking would not help")
        charger.owes_a1 = True
        try:
            confirmed = await self._say(talk, StateCode.E0)
        except ExchangeRefusedError:
            charger.owes_a1 = False
            raise
        if not confirmed:
            # If the state is not told either, E0 must be assumed.
            with suppress(ReplyTimeoutError):
                if (await charger.look(talk)).state != E0:
                    charger.owes_a1 = False
                    message = f"{charger.config.name} did not take E0"
                    raise NotConfirmedError(message)
        yield WAKE_PAUSE
        async for pause in self._enable_again(talk):
            yield pause

    def enable_again(self, talk: Talk) -> Turns:
        """Give back an outlet that we disabled and could not enable again."""
        return self._one_at_a_time(Command.WAKE, self._enable_again)(talk)

    async def _enable_again(self, talk: Talk) -> Turns:
        charger = self._charger
        for _ in range(LOOKS):
            # It must end with the outlet enabled: a lost exchange is tried again.
            with suppress(ExchangeError):
                if (await charger.look(talk)).state != E0:
                    charger.owes_a1 = False
                    return
                await self._say(talk, StateCode.A1)
                if (await charger.look(talk)).state != E0:
                    charger.owes_a1 = False
                    return
            yield VERIFY_PAUSE
        message = f"{charger.config.name}: the outlet is still disabled"
        raise NotConfirmedError(message)

    # -- Reset -------------------------------------------------------------------

    async def _reset(self, talk: Talk) -> Turns:
        async for pause in self._reach(talk):
            yield pause
        before = self._state()
        self._hold_polls(talk)
        confirmed = await self._say(talk, StateCode.RESET)
        async for pause in self._after_reset(talk, was_disabled=before.state == E0):
            yield pause
        after = self._state()
        if not confirmed and (after.state, after.duty) == (before.state, before.duty):
            message = (
                f"{self._charger.config.name}: the answer to the reset was lost, and "
                "nothing shows whether it happened; it was not repeated"
            )
            raise NotConfirmedError(message)

    async def _after_reset(self, talk: Talk, *, was_disabled: bool) -> Turns:
        """Wait for a box to come back; then nothing may be open that was closed.

        A reset ends in A1 with Idefault: neither the limit nor E0 has survived it.
        """
        charger = self._charger
        charger.forget()
        for look in range(BOOT_LOOKS):
            self._hold_polls(talk)
            yield BOOT_PAUSE
            self._hold_polls(talk)
            try:
                await charger.identify(talk)
                await charger.look(talk)
                break
            except ReplyTimeoutError:
                if look == BOOT_LOOKS - 1:
                    raise
        if not is_within(self._state().duty, limit_duty(charger.setpoint)):
            async for pause in charger.enforce(talk, lambda: charger.setpoint):
                yield pause
        if was_disabled and self._state().state != E0:
            async for pause in self._reach_state(
                talk, StateCode.E0, lambda now: now.state == E0
            ):
                yield pause

    # -- Set-up ------------------------------------------------------------------

    async def _set_up(self, setup: _Setup, talk: Talk) -> Turns:
        """Set device-ID or settings: E2, 0x002C, reset; then see that it is so."""
        charger = self._charger
        async for pause in self._reach(talk):
            yield pause
        old = charger.config.address
        new = old if setup.device_id is None else setup.device_id
        if setup.device_id == old:
            return
        before = self._state()
        serial = self._check_ready(before)
        if new != old:
            async for pause in self._make_sure_free(talk, new):
                yield pause
        try:
            async for pause in self._write_setup(talk, setup, new):
                yield pause
        except EvseError:
            # Out of the set-up mode again, whatever went wrong.
            with suppress(EvseError):
                back = StateCode.E0 if before.state == E0 else StateCode.A1
                await set_state(talk, old, back)
            raise
        charger.forget()
        async for pause in self._move(talk, new, serial):
            yield pause
        async for pause in self._after_reset(talk, was_disabled=before.state == E0):
            yield pause
        await charger.read_flags(talk)
        self._check_settings(setup)

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

    async def _make_sure_free(self, talk: Talk, address: int) -> Turns:
        """Raise DuplicateAddressError when somebody has that address already."""
        bus = self._charger.bus
        others = bus.chargers.values() if bus is not None else ()
        taken = any(other.config.address == address for other in others)
        for ask in range(2):
            if taken:
                break
            with suppress(ReplyTimeoutError):
                await read(talk, address, INFO)
                taken = True
            if not ask:
                # A box asleep loses the first request.
                yield RETRY_PAUSE
        if taken:
            message = f"device-ID {address} is taken already"
            raise DuplicateAddressError(message)

    async def _write_setup(self, talk: Talk, setup: _Setup, new: int) -> Turns:
        self._hold_polls(talk)
        async for pause in self._reach_state(
            talk, StateCode.E2, lambda now: now.state == E2
        ):
            yield pause
        self._hold_polls(talk)
        yield SETUP_PAUSE
        self._hold_polls(talk)
        write = partial(
            configure,
            talk,
            self._charger.config.address,
            new,
            upstream_timeout=setup.upstream_timeout,
            needs_enable=setup.needs_enable,
        )
        try:
            await write()
        except ReplyTimeoutError:
            # It cannot be read before the reset; the same value twice is the same.
            await write()
        yield SETUP_PAUSE
        self._hold_polls(talk)
        if not await self._say(talk, StateCode.RESET):
            with suppress(ReplyTimeoutError):
                if (await self._charger.look(talk)).state == E2:
                    await self._say(talk, StateCode.RESET)

    async def _move(self, talk: Talk, new: int, serial: str) -> Turns:
        """Find the box at its new address, by its serial number; then go there."""
        charger = self._charger
        if new == charger.config.address:
            return
        for _ in range(BOOT_LOOKS):
            self._hold_polls(talk)
            yield BOOT_PAUSE
            self._hold_polls(talk)
            with suppress(ReplyTimeoutError):
                found = decode_serial(await read(talk, new, SERIAL))
                if found == serial:
                    charger.config = replace(charger.config, address=new)
                    return
        message = (
            f"{charger.config.name} was not found at device-ID {new}; "
            f"it is still expected at {charger.config.address}"
        )
        raise NotConfirmedError(message)

    def _check_settings(self, setup: _Setup) -> None:
        """Raise NotConfirmedError when a setting is not as it was set."""
        charger = self._charger
        options = charger.info.options if charger.info is not None else {}
        wanted = {
            "upstream_timeout": setup.upstream_timeout,
            "enable_after_power_cycle": (
                None if setup.needs_enable is None else not setup.needs_enable
            ),
        }
        for name, value in wanted.items():
            if value is not None and options.get(name) is not value:
                message = f"{charger.config.name} did not take {name} = {value}"
                raise NotConfirmedError(message)


def _on_or_off(command: Command, value: object) -> bool:
    if not isinstance(value, bool):
        message = f"{command} takes on or off, not {value!r}"
        raise RefusedOrderError(message)
    return value


def _device_id(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value not in ADDRESSES:
        message = f"a device-ID is 1 to 16, not {value!r}"
        raise RefusedOrderError(message)
    return value
