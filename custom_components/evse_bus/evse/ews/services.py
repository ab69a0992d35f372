"""Services of an EWS-Box beside charging: cards, meter, LEDs, clock, parameters.

All but the meter belong to the box, and any of its ports carries them out. Nothing is
logged: the data contain names, cards and passwords.
"""

from collections.abc import Awaitable, Callable, Mapping
from datetime import tzinfo
from math import inf
from typing import Final

from ..conversation import rest
from ..errors import NotConfirmedError, RefusedOrderError, ReplyTimeoutError
from ..exchange import Turn
from .port import BoxPort
from .timing import LOOK_AGAIN
from .wire.answers import confirmed, decode_card_reader
from .wire.box_status import Dhcp, decode_dhcp
from .wire.cards import (
    AcceptedCard,
    CardEntry,
    CardList,
    accept_card,
    decode_cards,
    write_cards,
)
from .wire.commands import (
    PortLeds,
    ReaderTarget,
    card_reader,
    set_leds,
    set_meter,
)
from .wire.frames import CommandId, Request
from .wire.parameters import Block, Shown

READS: Final = 5
"""How often written data are read back at most."""
LONGEST_READER_TIMEOUT: Final = 10
"""Longest time-out of the card reader, s: the box needs its next command in time."""


class Services:
    """The services of one box, carried out in the turns of one of its ports.

    Each may raise RefusedOrderError for an impossible value, EwsRefusedError,
    NotConfirmedError for a lost reply, and what `Charger.run` raises.
    """

    def __init__(self, port: BoxPort) -> None:
        """Take the port that sends."""
        self._port = port

    # -- Cards ---------------------------------------------------------------------

    async def accept_card(self, card: AcceptedCard) -> None:
        """Accept a card that is not in the box's list, or log a user in (``ma``)."""
        await self.send(accept_card(card))

    async def read_cards(self) -> CardList:
        """Return the box's own list of cards (``rf``)."""
        return await self._run(self._read_cards)

    async def write_cards(self, changes: Mapping[int, CardEntry]) -> CardList:
        """Replace some entries (0 to 63), and nothing else; return the list (``sf``).

        Raises NotConfirmedError when another list is read back.
        """
        written: list[CardList] = []

        async def write(turn: Turn) -> None:
            cards = (await self._read_cards(turn)).with_entries(changes)
            written.append(cards)
            await self._write(turn, write_cards(cards))

        return await self._write_and_read(
            write,
            self._read_cards,
            lambda cards: cards == written[-1],
            lambda: "its card list",
        )

    async def _read_cards(self, turn: Turn) -> CardList:
        return await self._read(turn, CommandId.READ_CARDS, decode_cards)

    async def card_reader(
        self, target: ReaderTarget, patience: int, data: bytes
    ) -> bytes:
        """Pass a command on to the card reader; return its reply (``mc``).

        ``patience``: the reader's time-out, up to 10 s.
        """
        if patience not in range(LONGEST_READER_TIMEOUT + 1):
            message = f"a time-out of {patience} s is not 0 to {LONGEST_READER_TIMEOUT}"
            raise RefusedOrderError(message)
        request = card_reader(target, patience, data)
        return await self._exchange(request, decode_card_reader, patience=patience)

    # -- Meter, LEDs, clock, network -------------------------------------------------

    async def set_meter(self, total: int) -> None:
        """Set the meter total of this port, Wh (``cr``).

        Raises NotAvailableError for a port that the box does not have.
        """
        port = self._port
        request = set_meter(port.number, total)

        async def write(turn: Turn) -> None:
            await port.read_status(turn)
            # Also if its reply is lost: the total may have been set.
            port.box.meters[port.number - 1].expect(total)
            await port.box.send_command(turn, CommandId.SET_METER, lambda: request)

        await self._run(write)
        port.hurry()

    async def set_leds(self, first: PortLeds, second: PortLeds) -> None:
        """Set the LEDs of both ports; only a box with manual keys and LEDs (``se``)."""
        await self.send(set_leds(first, second))

    async def set_clock(self, zone: tzinfo) -> None:
        """Set the clock to the time in this zone, however wrong it is (``sc``)."""
        await self._run(lambda turn: self._port.box.set_clock(turn, zone))

    async def read_dhcp(self) -> Dhcp:
        """Return the network settings that the box got by DHCP (``rg``)."""
        return await self._run(
            lambda turn: self._read(turn, CommandId.READ_DHCP, decode_dhcp)
        )

    # -- Parameters ------------------------------------------------------------------

    async def read_parameters[T](self, block: Block[T]) -> T:
        """Return a block of parameters, with its passwords (``rp ru ri rz``)."""
        return await self._run(lambda turn: self._read(turn, block.read, block.decode))

    async def change_parameters[T](
        self,
        block: Block[T],
        changes: Mapping[str, object] | Callable[[T], Mapping[str, object]],
    ) -> T:
        """Change fields of a block, and nothing else; return it (``sp su si sz``).

        It is read, changed and written in one turn, then read back. ``changes`` may be
        a function of the block as it was read, to change single bits of a field.
        Raises HiddenSecretError where a password would be erased that the box hides,
        and NotConfirmedError when a field is read back with another value (over the
        network a box keeps its server mode), or when a secret that the box hides was
        not confirmed by a reply.
        """
        box = self._port.box
        written: dict[str, object] = {}
        answered = False

        async def write(turn: Turn) -> None:
            nonlocal answered
            raw = await self._read(turn, block.read, bytes)
            written.update(
                changes if isinstance(changes, Mapping) else changes(block.decode(raw))
            )
            answered = await self._write(turn, block.change(raw, written))

        def is_written(found: T) -> bool:
            secrets = block.shown_secrets(found)
            return all(
                # A hidden secret is confirmed by the reply to the write alone.
                (answered and secrets.get(name, Shown.SHOWN) is not Shown.SHOWN)
                or getattr(found, name) == _as_read(value)
                for name, value in written.items()
            )

        try:
            return await self._write_and_read(
                write,
                lambda turn: self._read(turn, block.read, block.decode),
                is_written,
                lambda: ", ".join(sorted(written)),
            )
        finally:
            # Also after a failure: some fields may have been written.
            box.parameters_due = -inf

    # -- Conversations -----------------------------------------------------------------

    async def _read[T](
        self, turn: Turn, command: CommandId, decode: Callable[[bytes], T]
    ) -> T:
        """Read until two replies are equal; what follows has the turn of the last."""
        value, _ = await self._port.box.read_confirmed(turn, command, decode)
        return value

    async def send(self, request: Request, *, patience: float = 0.0) -> None:
        """Send a command that is confirmed by one byte; return when it was OK.

        ``patience``: additional time for the reply, s.
        """
        decode = confirmed(request.command)
        await self._exchange(request, decode, patience=patience)

    async def _exchange[T](
        self, request: Request, decode: Callable[[bytes], T], *, patience: float = 0.0
    ) -> T:
        return await self._run(
            lambda turn: self._port.box.exchange(
                turn, request.command, lambda: request, decode, patience=patience
            ),
            patience=patience,
        )

    async def _run[T](
        self, work: Callable[[Turn], Awaitable[T]], *, patience: float = 0.0
    ) -> T:
        """Have a conversation with the box, once it is identified."""
        port = self._port

        async def conversation(turn: Turn) -> T:
            if patience:
                await rest(worst_case=self._worst_case(patience))
            await port.ready(turn)
            try:
                return await work(turn)
            except ReplyTimeoutError as error:
                raise NotConfirmedError(str(error)) from error

        return await port.run(conversation)

    def _worst_case(self, patience: float) -> float | None:
        bus = self._port.bus
        return None if bus is None else bus.worst_case(self._port) + patience

    async def _write(self, turn: Turn, request: Request) -> bool:
        """Write; return whether it was answered.

        A lost reply decides nothing: the data read back do.
        """
        box = self._port.box
        try:
            await box.send_command(turn, request.command, lambda: request)
        except ReplyTimeoutError:
            return False
        return True

    async def _write_and_read[T](
        self,
        write: Callable[[Turn], Awaitable[None]],
        read: Callable[[Turn], Awaitable[T]],
        is_written: Callable[[T], bool],
        name: Callable[[], str],
    ) -> T:
        """Write in one turn, then read until the data are right; return them.

        ``name``: of the data, for the message. Raises NotConfirmedError when they
        stay wrong.
        """
        port = self._port

        async def conversation(turn: Turn) -> T:
            await port.ready(turn)
            await write(turn)
            for _ in range(READS):
                await rest(LOOK_AGAIN)
                await port.ready(turn)
                try:
                    found = await read(turn)
                except ReplyTimeoutError:
                    continue
                if is_written(found):
                    return found
            message = f"{port.config.name} did not take {name()}"
            raise NotConfirmedError(message)

        return await port.run(conversation)


def _as_read(value: object) -> object:
    """Return a value as it is read back: texts come without spaces around them."""
    return value.strip() if isinstance(value, str) else value
