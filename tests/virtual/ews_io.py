"""Keys, cards and LEDs of a virtual EWS-Box."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from .ews_orders import start_refusal
from .ews_parameters import OK, REFUSED, SystemMode
from .ews_states import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from .ews_parameters import CardList, SystemParameters
    from .ews_port import EwsPort
    from .ews_rfid import Card, Reader

KEYS = 4
START, STOP, OPTIMISED = 1, 2, 3
PRESSED = 255
LONGEST_PRESS = 254
UNCHANGED = 0xFFFF
BLINK = 0.5
LEDS = struct.Struct(">24H")
RED, GREEN, ORANGE, RESERVE = range(4)


class UserInterface:
    """Keys, cards and LEDs; keys depend on the system mode (manual, 3.1.3, 3.1.6).

    `on_event(bits, keys)`: called with events for the info record.
    """

    def __init__(
        self,
        ports: tuple[EwsPort, EwsPort],
        system: SystemParameters,
        reader: Reader,
        cards: CardList,
        on_event: Callable[[int, dict[int, int]], None],
    ) -> None:
        """Connect with the rest of the box."""
        self._ports = ports
        self._system = system
        self._reader = reader
        self._cards = cards
        self._on_event = on_event
        self._down: dict[tuple[int, int], float] = {}
        self._releases: list[tuple[float, int, int]] = []
        self._waits_for_card: EwsPort | None = None
        self._patterns: list[tuple[int, int, int]] = [(0, 0, 0)] * 8
        self._pattern_from = 0.0

    # Keys

    def key_down(self, port: int, key: int, now: float) -> None:
        """Press a key and hold it."""
        self._down[port, key] = now
        if self._system.has(SystemMode.MANUAL_IO):
            self._on_event(0, {(port - 1) * KEYS + key - 1: PRESSED})
            return
        charging_port = self._ports[port - 1]
        if key == START:
            self.press_start(charging_port)
        elif key == STOP:
            self._press_stop(charging_port)
        elif key == OPTIMISED:
            charging_port.optimised = not charging_port.optimised

    def key_up(self, port: int, key: int, now: float) -> None:
        """Release a key."""
        since = self._down.pop((port, key), None)
        if since is None or not self._system.has(SystemMode.MANUAL_IO):
            return
        # 0.1 to 25.4 s in tenths; a shorter press is a press too.
        length = max(1, min(LONGEST_PRESS, round((now - since) * 10)))
        self._on_event(0, {(port - 1) * KEYS + key - 1: length})

    def press(self, port: int, key: int, now: float, seconds: float) -> None:
        """Press a key and release it after so many seconds."""
        self.key_down(port, key, now)
        self._releases.append((now + seconds, port, key))

    def step(self, now: float) -> None:
        """Release the keys that are due."""
        for release in [r for r in self._releases if r[0] <= now]:
            self._releases.remove(release)
            self.key_up(release[1], release[2], release[0])

    def keys_pressed(self, port: int) -> int:
        """Return bits 0 to 3 of the key byte."""
        return sum(1 << key - 1 for at, key in self._down if at == port)

    # Starting and stopping

    def press_start(self, port: EwsPort) -> None:
        """Request a start: from the box itself, the server, or with a card first."""
        if start_refusal(port) or port.active:
            return
        if not self._system.has(SystemMode.RFID):
            self._start(port, "key")
        elif self._reader.valid:
            self._start_with_card(port)
        else:
            self._waits_for_card = port

    def start_on_web_page(self, port: EwsPort) -> None:
        """Press start on the box's web page."""
        if not start_refusal(port) and not port.active:
            self._start(port, "web page")

    def stop_on_web_page(self, port: EwsPort) -> None:
        """Press stop on the box's web page."""
        port.stop("web page")
        self._event_of(port)

    def _start(self, port: EwsPort, cause: str) -> None:
        if self._system.has(SystemMode.SERVER):
            port.start_mode = 1
        else:
            port.release_start(cause)
        self._event_of(port)

    def _start_with_card(self, port: EwsPort) -> None:
        card = self._reader.noted
        if card is None:
            return
        listed = self._cards.allows(card.group, card.number)
        if not (listed or self._reader.accepted or self._system.has(SystemMode.SERVER)):
            return
        self._waits_for_card = None
        port.session.card = card
        if listed or self._reader.accepted:
            port.release_start("card")
        else:
            port.start_mode = 1
        self._event_of(port)

    def _press_stop(self, port: EwsPort) -> None:
        if self._system.has(SystemMode.RFID) and not self._may_stop(port):
            return
        port.stop("stop key")
        self._event_of(port)

    def _may_stop(self, port: EwsPort) -> bool:
        """Return whether the card that started was presented again since."""
        mine, shown = port.session.card, self._reader.noted
        if mine is None:
            return True
        started_at = port.history.starts[-1][0] if port.history.starts else 0.0
        same = shown is not None and (shown.group, shown.number) == (
            mine.group,
            mine.number,
        )
        return same and self._reader.presented_at > started_at

    def _event_of(self, port: EwsPort) -> None:
        port.on_event()

    # Cards

    def present_card(self, card: Card, now: float) -> None:
        """Present a card to the reader."""
        if not self._reader.fitted:
            return
        self._reader.present_card(card, self._system.card_pin, now)
        self._on_event(1, {})
        self.card_is_valid()

    def card_is_valid(self) -> None:
        """Continue a start that waits for a card, if there is a valid one now."""
        if self._waits_for_card is not None and self._reader.valid:
            self._start_with_card(self._waits_for_card)

    # LEDs

    def set_leds(self, parameters: bytes, now: float) -> int:
        """Take `se`; only in manual mode."""
        if len(parameters) != LEDS.size or not self._system.has(SystemMode.MANUAL_IO):
            return REFUSED
        values = LEDS.unpack(parameters)
        for index in range(8):
            pattern = values[3 * index : 3 * index + 3]
            if pattern[:2] != (UNCHANGED, UNCHANGED):
                self._patterns[index] = pattern
        self._pattern_from = now
        return OK

    def leds(self, port: EwsPort, now: float) -> int:
        """Return bits 4 (red) to 7 (reserve) of the LED byte, as lit right now."""
        if self._system.has(SystemMode.MANUAL_IO):
            first = (port.number - 1) * 4
            lit = [self._manual(index, now) for index in range(first, first + 4)]
        else:
            lit = self._automatic(port, now)
        return sum(1 << 4 + index for index, on in enumerate(lit) if on)

    def _manual(self, index: int, now: float) -> bool:
        on, off, offset = self._patterns[index]
        if on in (0, UNCHANGED):
            return on == UNCHANGED
        at = int((now - self._pattern_from) * 1000) + offset
        return at % (on + off) < on

    def _automatic(self, port: EwsPort, now: float) -> list[bool]:
        """Follow the table of 3.1.2; its second row "0x43" is taken as 0x50."""
        blink = int(now / BLINK) % 2 == 0
        status = port.status
        red = green = orange = False
        if status in (Status.INIT, Status.RCD):
            red = green = orange = blink
        elif status in Status.ACTIVE:
            green, orange = True, bool(status & 1)
        elif status == Status.ENDED:
            green = blink and port.server_paused
            orange = blink and port.optimised and port.locked
        elif status == Status.WAITING:
            asked = port.start_mode == 1
            green = asked or blink
            orange = blink and (asked or port.optimised)
        elif status in (Status.NOT_CONNECTED, Status.SEARCHING):
            loose = not port.installation.fixed_cable
            searching = status == Status.SEARCHING and loose
            green = blink and (bool(port.start_mode) or searching)
            orange = blink and port.optimised
        else:
            red = True
        return [red, green, orange, False]
