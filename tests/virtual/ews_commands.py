"""The command set of a virtual EWS-Box (manual, 3.2.4): parameters in, answer out."""

from __future__ import annotations

from datetime import datetime
import struct
from typing import TYPE_CHECKING

from . import ews_status
from .ews_interaction import ROM_SIZE
from .ews_orders import START, Code, execute
from .ews_parameters import LOWEST_CURRENT, OK, REFUSED
from .ews_states import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from .ews_box import EwsBox

LONGEST_WRITE = 1024
ERASED = 0xFF

# Commands that change something at the box.
WRITING = frozenset(
    {"cr", "fw", "ma", "mc", "oe", "ow", "sc", "se"}
    | {"sf", "si", "sl", "sp", "st", "su", "sz", "zz"}
)


def code(value: int) -> bytes:
    """Return an answer of one byte."""
    return bytes((value,))


def set_meter(box: EwsBox, parameters: bytes) -> bytes:
    """`cr`: set the absolute meter of a port, Wh."""
    if len(parameters) != 5 or parameters[0] not in (1, 2):
        return code(REFUSED)
    number, wh = struct.unpack(">BI", parameters)
    box.ports[number - 1].session.total_wh = float(wh)
    return code(OK)


def accept_card(box: EwsBox, parameters: bytes) -> bytes:
    """`ma`: accept the noted card as valid."""
    answer = box.reader.accept(parameters, box.now())
    if answer == OK:
        box.user_interface.card_is_valid()
    return code(answer)


def erase(box: EwsBox, parameters: bytes) -> bytes:
    """`oe`: erase a part of the temp ROM."""
    if len(parameters) != 8:
        return code(REFUSED)
    start, count = struct.unpack(">II", parameters)
    if start + count > ROM_SIZE:
        return code(REFUSED)
    box.rom[start : start + count] = bytes((ERASED,)) * count
    return code(OK)


def write_rom(box: EwsBox, parameters: bytes) -> bytes:
    """`ow`: write into the temp ROM; only erased flash can be written."""
    if len(parameters) < 8:
        return code(REFUSED)
    start, count = struct.unpack(">II", parameters[:8])
    data = parameters[8:]
    if count != len(data) or count > LONGEST_WRITE or start + count > ROM_SIZE:
        return code(REFUSED)
    if any(byte != ERASED for byte in box.rom[start : start + count]):
        return code(REFUSED)
    box.rom[start : start + count] = data
    return code(OK)


def activate(box: EwsBox, parameters: bytes) -> bytes:
    """`fw`: activate firmware at address 0, if there is any; charges end normally."""
    if parameters or not any(byte != ERASED for byte in box.rom[:LONGEST_WRITE]):
        return code(REFUSED)
    box.activated.append(bytes(box.rom).rstrip(bytes((ERASED,))))
    for port in box.ports:
        if port.active:
            port.stop("firmware")
    box.reset_after_answer()
    return code(OK)


def reset(box: EwsBox, _parameters: bytes) -> bytes:
    """`zz`: reset once the answer was sent."""
    box.reset_after_answer()
    return b""


def read_system_status(box: EwsBox, _parameters: bytes) -> bytes:
    """`rs`."""
    answer = ews_status.rs(box)
    if box.restart_flag_until == "read":
        box.restarted = False
    return answer


def set_clock(box: EwsBox, parameters: bytes) -> bytes:
    """`sc`: local time, as in `rs`."""
    if len(parameters) != ews_status.CLOCK.size:
        return code(REFUSED)
    try:
        now = datetime(*ews_status.CLOCK.unpack(parameters))  # noqa: DTZ001
    except ValueError:
        return code(REFUSED)
    box.set_clock(now)
    if box.restart_flag_until == "clock":
        box.restarted = False
    return code(OK)


def control(box: EwsBox, parameters: bytes) -> bytes:
    """`sl`: car, order."""
    if len(parameters) != 2 or parameters[0] not in (1, 2):
        return code(Code.NO_SUCH_CAR)
    number, order = parameters
    port = box.ports[number - 1]
    answer = execute(port, order, box.user_interface.press_start)
    if order == START and answer == Code.OK and port.session.card is None:
        # "beim Starten auf den aktuellen Ladeport uebertragen" (3.1.6).
        port.session.card = box.reader.noted if box.reader.valid else None
    return code(answer)


def write_system(box: EwsBox, parameters: bytes) -> bytes:
    """`sp`: not while initialising or charging; then the box initialises."""
    if any(p.status == Status.INIT or p.active for p in box.ports):
        return code(REFUSED)
    answer = box.system.write(parameters, network=box.network)
    if answer == OK:
        box.initialise()
    return code(answer)


def limit_current(box: EwsBox, parameters: bytes) -> bytes:
    """`st`: car, amperes; 0 removes the limit."""
    if len(parameters) != 2 or parameters[0] not in (1, 2):
        return code(REFUSED)
    number, amps = parameters
    port = box.ports[number - 1]
    if box.clamps_limits:
        amps = min(amps, port.ceiling)
    accepted = amps == 0 or LOWEST_CURRENT <= amps <= port.ceiling
    box.limit_sent(number, parameters[1], accepted=accepted)
    if not accepted:
        return code(REFUSED)
    if not box.ignores_limits:
        port.limit = amps
    return code(OK)


def write_extra(box: EwsBox, parameters: bytes) -> bytes:
    """`sz`."""
    answer = box.extra.write(parameters)
    box.take_parameters()
    return code(answer)


COMMANDS: dict[str, Callable[[EwsBox, bytes], bytes]] = {
    "cr": set_meter,
    "fw": activate,
    "id": lambda box, _: box.firmware,
    "ma": accept_card,
    "mc": lambda box, p: box.reader.transparent(p),
    "oe": erase,
    "ow": write_rom,
    "rc": lambda box, _: ews_status.rc(box),
    "rd": lambda box, _: ews_status.rd(box),
    "rf": lambda box, _: box.cards.pack(),
    "rg": lambda box, _: ews_status.rg(box),
    "ri": lambda box, _: box.user_info.pack(),
    "rp": lambda box, _: box.system.pack(box.masking),
    "rs": read_system_status,
    "ru": lambda box, _: box.user.pack(box.masking),
    "rz": lambda box, _: box.extra.pack(),
    "sc": set_clock,
    "se": lambda box, p: code(box.user_interface.set_leds(p, box.now())),
    "sf": lambda box, p: code(box.cards.write(p)),
    "si": lambda box, p: code(box.user_info.write(p)),
    "sl": control,
    "sp": write_system,
    "st": limit_current,
    "su": lambda box, p: code(box.user.write(p)),
    "sz": write_extra,
    "zz": reset,
}
