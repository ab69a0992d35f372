"""Events at a virtual EWS-Box from outside: by a person, the house or the mains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .device import Device, on_bus_thread
from .ews_frames import DEBUG, Bcc, frame
from .ews_rfid import Card

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from .ews_io import UserInterface
    from .ews_parameters import (
        CardList,
        ExtraConfiguration,
        Masking,
        SystemParameters,
        UserInfo,
        UserParameters,
    )
    from .ews_port import EwsPort
    from .ews_records import EwsCommand, EwsInfo, EwsLimit, InfoMix
    from .ews_rfid import Reader

ROM_SIZE = 3 * 0x10000


class EwsInteraction(Device):
    """The part of a box that is operated from outside, from any thread."""

    ports: tuple[EwsPort, EwsPort]
    user_interface: UserInterface
    reader: Reader
    firmware: bytes
    system: SystemParameters
    user: UserParameters
    user_info: UserInfo
    extra: ExtraConfiguration
    cards: CardList
    masking: Masking
    bcc: Bcc

    def __init__(self, name: str) -> None:
        """Make a box that is switched on."""
        super().__init__(name)
        self.on_power: Callable[[bool], None] = lambda _on: None
        self.powered = True
        self.restarted = True
        self.restarts = 0
        self.server_timeouts = 0
        # Sectors 0 to 2 of the temp ROM; the manual does not give their size.
        self.rom = bytearray(b"\xff" * ROM_SIZE)
        self.activated: list[bytes] = []
        self.commands: list[EwsCommand] = []
        self.writes: list[EwsCommand] = []
        self.currents_set: list[EwsLimit] = []
        self.infos: list[EwsInfo] = []
        self._mixes: list[InfoMix] = []
        self._false_lengths: list[int] = []
        self._power_on_at: float | None = None
        self._rest: tuple[asyncio.TimerHandle, bytes] | None = None

    def _lose_power(self, *, mains: bool) -> None:
        raise NotImplementedError

    def _boot(self) -> None:
        raise NotImplementedError

    @on_bus_thread
    def press_key(self, port: int, key: int, seconds: float = 0.3) -> None:
        """Press key 1 to 4 of a port for so many (device) seconds."""
        self.user_interface.press(port, key, self.now(), seconds)
        self.step()

    @on_bus_thread
    def key_down(self, port: int, key: int) -> None:
        """Press a key and hold it."""
        self.user_interface.key_down(port, key, self.now())
        self.step()

    @on_bus_thread
    def key_up(self, port: int, key: int) -> None:
        """Release it."""
        self.user_interface.key_up(port, key, self.now())
        self.step()

    @on_bus_thread
    def present_card(self, card: Card | None = None) -> None:
        """Present a card to the reader."""
        self.user_interface.present_card(card or Card(), self.now())
        self.step()

    @on_bus_thread
    def remove_card(self) -> None:
        """Remove the card."""
        self.reader.remove_card()

    @on_bus_thread
    def start_on_web_page(self, port: int) -> None:
        """Press start on the box's own web page."""
        self.user_interface.start_on_web_page(self.ports[port - 1])
        self.step()

    @on_bus_thread
    def stop_on_web_page(self, port: int) -> None:
        """Press stop on the box's own web page."""
        self.user_interface.stop_on_web_page(self.ports[port - 1])
        self.step()

    @on_bus_thread
    def trip_rcd(self, port: int, *, tripped: bool = True) -> None:
        """Let a port's residual-current device trip, or switch it on again."""
        self.ports[port - 1].rcd_tripped = tripped
        self.step()

    @on_bus_thread
    def power_off(self) -> None:
        """Switch the mains off: contactors and locks open, the limit of `st` is lost."""
        self._lose_power(mains=True)
        self.on_power(False)  # noqa: FBT003 - a callback

    @on_bus_thread
    def power_on(self) -> None:
        """Switch the mains on."""
        if not self.powered:
            self._boot()

    @on_bus_thread
    def power_cycle(self, seconds: float = 0.0) -> None:
        """Lose power for so many (device) seconds."""
        self.power_off()
        self._power_on_at = self.now() + seconds
        self.step()

    # Other frames of a box

    @on_bus_thread
    def send_raw(self, data: bytes) -> None:
        """Send bytes as they are."""
        if self.bus is not None and self.powered and not self.faults.dead:
            self._send_rest()
            self.bus.send_at(self, data, self.bus.time())

    def _send_cut(self, first: bytes, rest: bytes, pause: float) -> None:
        """Send the first part, and the second one after a pause."""
        if self.bus is None or not self.powered or self.faults.dead:
            return
        self._send_rest()
        self.bus.send_at(self, first, self.bus.time())
        if rest:
            wait = len(first) * self.bus.byte_time + pause
            timer = self.bus.loop.call_later(wait, self._send_rest)
            self._rest = (timer, rest)

    def _send_rest(self) -> None:
        """Send the pending rest; at once, if other bytes are to be sent."""
        rest, self._rest = self._rest, None
        if rest is not None and self.bus is not None:
            rest[0].cancel()
            self.bus.send_at(self, rest[1], self.bus.time())

    def send_debug(self, text: bytes = b"debug") -> None:
        """Send a 'D' message, which a server ignores."""
        self.send_raw(frame(DEBUG, text, self.bcc))

    def send_application(self, msgid: int = 0x80, parameters: bytes = b"\x02") -> None:
        """Send a message of an application of its own (0x80 and above)."""
        self.send_raw(frame(bytes((msgid,)), parameters, self.bcc))

    @on_bus_thread
    def mix_info(self, *mixes: InfoMix) -> None:
        """Mix an info record into the next answers, one mix each."""
        self._mixes += mixes

    @on_bus_thread
    def false_length_once(self, difference: int) -> None:
        """Send the next answer with a wrong length and a correct BCC."""
        self._false_lengths.append(difference)
