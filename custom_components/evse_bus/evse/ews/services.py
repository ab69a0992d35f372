"""What an EWS-Box can do beside charging: cards, meter, LEDs, clock, parameters.

All of it belongs to the box; any of its ports may carry it out. Nothing is logged: the
blocks have names, cards and passwords in them.
"""

from collections.abc import Awaitable, Callable, Mapping
from datetime import tzinfo
from typing import TYPE_CHECKING, Final

from ..conversation import rest
from ..errors import NotConfirmedError, RefusedOrderError, ReplyTimeoutError
from ..exchange import Turn
from .timing import LOOK_AGAIN
from .wire.answers import decode_card_reader
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

if TYPE_CHECKING:
    from .reader import EwsReader

LOOKS: Final = 5
"""How often something written is read back until it must stand there."""
LONGEST_READER_TIMEOUT: Final = 10
"""The box must hear the next command in time, s."""


class Services:
    """The services of one box, carried out in the turns of one of its ports."""

    def __init__(self, port: EwsReader) -> None:
        """Take the port."""
        self._port = port

    # -- Cards ---------------------------------------------------------------------

    async def accept_card(self, card: AcceptedCard) -> None:
        """Accept a card that the box does not know, or log somebody in (``ma``).

        Raises RefusedOrderError, EwsRefusedError, NotConfirmedError (a lost answer),
        and what `Charger.run` raises; so do all others here.
        """
        request = accept_card(card)
        await self.in_a_turn(
            lambda turn: self._port.box.tell(
                turn, CommandId.ACCEPT_CARD, lambda: request
            )
        )

    async def read_cards(self) -> CardList:
        """Return the box's own list of cards (``rf``)."""
        return await self.in_a_turn(self._read_cards)

    async def write_cards(self, changes: Mapping[int, CardEntry]) -> CardList:
        """Replace some entries (0 to 63), and nothing else; return the list (``sf``).

        Raises NotConfirmedError when the list is not read back so.
        """
        wanted: list[CardList] = []

        async def write(turn: Turn) -> None:
            cards = (await self._read_cards(turn)).with_entries(changes)
            wanted.append(cards)
            await self._tell(turn, CommandId.WRITE_CARDS, write_cards(cards))

        return await self._write_and_read(
            write,
            self._read_cards,
            lambda cards: cards == wanted[-1],
            lambda: "its card list",
        )

    async def _read_cards(self, turn: Turn) -> CardList:
        return await self._port.box.read(turn, CommandId.READ_CARDS, decode_cards)

    async def card_reader(
        self, target: ReaderTarget, patience: int, data: bytes
    ) -> bytes:
        """Hand a command to the card reader; return its answer (``mc``).

        ``patience``: the reader's time-out, up to 10 s.
        """
        if patience not in range(LONGEST_READER_TIMEOUT + 1):
            message = f"a time-out of {patience} s is not 0 to {LONGEST_READER_TIMEOUT}"
            raise RefusedOrderError(message)
        request = card_reader(target, patience, data)
        return await self.in_a_turn(
            lambda turn: self._port.box.ask(
                turn,
                CommandId.CARD_READER,
                lambda: request,
                decode_card_reader,
                patience=patience,
            ),
            patience=patience,
        )

    # -- Meter, LEDs, clock, network -------------------------------------------------

    async def set_meter(self, total: int) -> None:
        """Set the meter total of this port, Wh (``cr``).

        Raises NotAvailableError for a port that the box does not have.
        """
        port = self._port
        request = set_meter(port.port, total)

        async def write(turn: Turn) -> None:
            await port.look(turn)
            await port.box.tell(turn, CommandId.SET_METER, lambda: request)

        await self.in_a_turn(write)
        port.hurry()

    async def set_leds(self, first: PortLeds, second: PortLeds) -> None:
        """Set the LEDs of both ports; only a box with manual keys and LEDs (``se``)."""
        request = set_leds(first, second)
        await self.in_a_turn(
            lambda turn: self._port.box.tell(turn, CommandId.SET_LEDS, lambda: request)
        )

    async def set_clock(self, zone: tzinfo) -> None:
        """Set the clock to the time in this zone, however wrong it is (``sc``)."""
        await self.in_a_turn(lambda turn: self._port.box.set_clock(turn, zone))

    async def read_dhcp(self) -> Dhcp:
        """Return what DHCP gave the box (``rg``)."""
        return await self.in_a_turn(
            lambda turn: self._port.box.read(turn, CommandId.READ_DHCP, decode_dhcp)
        )

    # -- Parameters ------------------------------------------------------------------

    async def read_parameters[T](self, block: Block[T]) -> T:
        """Return a block of parameters (``rp ru ri rz``); passwords are in it."""
        return await self.in_a_turn(
            lambda turn: self._port.box.read(turn, block.read, block.decode)
        )

    async def change_parameters[T](
        self,
        block: Block[T],
        changes: Mapping[str, object] | Callable[[T], Mapping[str, object]],
    ) -> T:
        """Change fields of a block, and nothing else; return it (``sp su si sz``).

        It is read, changed and written in one turn, then read back. ``changes`` may
        be made of what stands there, for single bits of a field. Raises
        HiddenSecretError where a password would be erased that the box hides,
        NotConfirmedError when a field is not read back so (over the network a box
        keeps its server mode), or when a secret that the box hides got no answer.
        """
        box = self._port.box
        wanted: dict[str, object] = {}
        answered = False

        async def write(turn: Turn) -> None:
            nonlocal answered
            raw = await box.read(turn, block.read, bytes)
            wanted.update(
                changes if isinstance(changes, Mapping) else changes(block.decode(raw))
            )
            answered = await self._tell(turn, block.write, block.change(raw, wanted))

        def stands(told: T) -> bool:
            secrets = block.secrets_told(told)
            return all(
                # What is hidden has only the answer for a witness.
                (answered and secrets.get(name, Shown.SHOWN) is not Shown.SHOWN)
                or getattr(told, name) == _as_read(value)
                for name, value in wanted.items()
            )

        try:
            return await self._write_and_read(
                write,
                lambda turn: box.read(turn, block.read, block.decode),
                stands,
                lambda: ", ".join(sorted(wanted)),
            )
        finally:
            # Also where not all of it was taken: some of it may stand there.
            box.parameters_due = float("-inf")

    # -- Turns -----------------------------------------------------------------------

    async def in_a_turn[T](
        self, work: Callable[[Turn], Awaitable[T]], *, patience: float = 0.0
    ) -> T:
        """Do something in one turn of the bus, the box being known.

        ``patience``: longer than a reply usually takes, s.
        """
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
        if bus is None or not patience:
            return None
        return bus.worst_case(self._port) + patience

    async def _tell(self, turn: Turn, command: CommandId, request: Request) -> bool:
        """Write; return whether it was answered.

        A lost answer decides nothing, what is read back does.
        """
        try:
            await self._port.box.tell(turn, command, lambda: request)
        except ReplyTimeoutError:
            return False
        return True

    async def _write_and_read[T](
        self,
        write: Callable[[Turn], Awaitable[None]],
        read: Callable[[Turn], Awaitable[T]],
        stands: Callable[[T], bool],
        what: Callable[[], str],
    ) -> T:
        """Write in one turn, then read until it stands there.

        Raises NotConfirmedError when it does not.
        """
        port = self._port

        async def conversation(turn: Turn) -> T:
            await port.ready(turn)
            await write(turn)
            for _ in range(LOOKS):
                await rest(LOOK_AGAIN)
                await port.ready(turn)
                try:
                    found = await read(turn)
                except ReplyTimeoutError:
                    continue
                if stands(found):
                    return found
            message = f"{port.config.name} did not take {what()}"
            raise NotConfirmedError(message)

        return await port.run(conversation)


def _as_read(value: object) -> object:
    """Return a value as it is read back: texts come without spaces around them."""
    return value.strip() if isinstance(value, str) else value
