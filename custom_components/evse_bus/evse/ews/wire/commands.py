"""Commands to an EWS-Box: one function for each, which returns a `Request`.

Source: manual, 3.2.4. Values come from people and programs: one that does not fit is
refused, never cut or wrapped. Cards and parameters have modules of their own.
"""

from datetime import datetime
from enum import IntEnum
from typing import Final

from ...errors import RefusedOrderError
from ...fields import Number
from ...safety import Setpoint
from ...structs import Struct, coded, pair, part, record
from .fields import Moment
from .frames import MAXIMUM_PARAMETERS, CommandId, Request
from .states import StartStop, check_order, check_unlock
from .status import PortStatus

PORTS: Final = (1, 2)
"""Numbers of the ports; the manual calls them cars."""
CONFIRMED: Final = frozenset(
    {
        CommandId.SET_METER,
        CommandId.ACTIVATE_FIRMWARE,
        CommandId.ACCEPT_CARD,
        CommandId.ERASE_ROM,
        CommandId.WRITE_ROM,
        CommandId.SET_CLOCK,
        CommandId.SET_LEDS,
        CommandId.WRITE_CARDS,
        CommandId.WRITE_INSTALLATION,
        CommandId.START_STOP,
        CommandId.WRITE_SYSTEM,
        CommandId.SET_LIMIT,
        CommandId.WRITE_USER,
        CommandId.WRITE_EXTRA,
    }
)
"""Commands that are answered by one byte (`answers.confirmed`)."""
READS: Final = frozenset(
    {
        CommandId.READ_FIRMWARE_ID,
        CommandId.READ_PORTS,
        CommandId.READ_DETAILS,
        CommandId.READ_CARDS,
        CommandId.READ_DHCP,
        CommandId.READ_INSTALLATION,
        CommandId.READ_SYSTEM,
        CommandId.READ_BOX,
        CommandId.READ_USER,
        CommandId.READ_EXTRA,
    }
)

_PORT: Final = Number(name="port", width=1, valid=PORTS)


def read(command: CommandId) -> Request:
    """Return a command that only reads; raises RefusedOrderError for others."""
    if command not in READS:
        message = f"{command} does not only read"
        raise RefusedOrderError(message)
    return Request(command)


def reset() -> Request:
    """Return the command that restarts the box, once its answer has left (``zz``)."""
    return Request(CommandId.RESET)


# -- sl: start and stop; st: the limit ---------------------------------------------


def start_stop(
    port: int, order: StartStop, status: PortStatus, *, paused: bool = False
) -> Request:
    """Return an order to a port (``sl``) with this status.

    An order has other effects in other states: ``status`` is from an ``rc`` in the same
    turn of the bus. ``paused``: the port is in a pause of ours, or may be. Raises
    NotAvailableError where the order may not be sent.
    """
    check_order(order, status.state, paused=paused)
    return Request(CommandId.START_STOP, _PORT.encode(port) + bytes((order,)))


def unlock(port: int, status: PortStatus) -> Request:
    """Return the order that unlocks a plug without a charge (``sl`` 6, 3.1.8).

    The same order pauses a charge: ``status`` is from an ``rc`` in the same turn of the
    bus. Raises NotAvailableError where it would not unlock.
    """
    check_unlock(status)
    return Request(CommandId.START_STOP, _PORT.encode(port) + bytes((StartStop.PAUSE,)))


MINIMUM_LIMIT: Final = 6
"""A (3.1.8)."""
_LIMIT: Final = Number(name="limit", width=1, unit="A", valid=range(MINIMUM_LIMIT, 81))


def set_limit(port: int, setpoint: Setpoint) -> Request:
    """Return the limit of a port in whole amperes (``st``).

    0 would switch the limit off, so that the car gets all there is: a pause is
    `StartStop.PAUSE`. Raises RefusedOrderError for a set-point that is a pause, or no
    whole number from 6 A.
    """
    current = setpoint.current
    if not current.is_integer():
        message = f"a limit of {current} A is not in whole amperes"
        raise RefusedOrderError(message)
    if setpoint.paused or current == 0:
        raise RefusedOrderError("a limit of 0 A would switch the limit off")
    return Request(
        CommandId.SET_LIMIT, _PORT.encode(port) + _LIMIT.encode(int(current))
    )


# -- cr, sc: meter and clock -------------------------------------------------------

_TOTAL: Final = Number(name="meter total", width=4, unit="Wh")
_CLOCK: Final = Moment(name="clock")
_YEARS: Final = range(2000, 2100)


def set_meter(port: int, total: int) -> Request:
    """Return the command that sets a port's meter total, Wh (``cr``)."""
    return Request(CommandId.SET_METER, _PORT.encode(port) + _TOTAL.encode(total))


def set_clock(clock: datetime) -> Request:
    """Return the command that sets the clock (``sc``).

    ``clock``: without a zone, it is the time in the zone of the box, as in ``rs`` (in
    the manual for ``rs`` only). Raises RefusedOrderError otherwise.
    """
    if clock.year not in _YEARS:
        message = f"{clock.year} is no year from 2000 to 2099"
        raise RefusedOrderError(message)
    return Request(CommandId.SET_CLOCK, _CLOCK.encode(clock))


# -- se: LEDs ----------------------------------------------------------------------

_FOREVER: Final = 0xFFFF


@record
class Led:
    """One LED."""

    on: int = coded(Number(width=2, unit="ms"))
    """ms; 0: dark, 65535: lit, or unchanged if ``off`` is 65535 too."""
    off: int = coded(Number(width=2, unit="ms"))
    """ms"""
    offset: int = coded(Number(width=2, unit="ms"), default=0)
    """Position in its rhythm to begin at, ms."""


_LED: Final = Struct(Led, "3.2.4 se: LED")
LED_OFF: Final = Led(on=0, off=0)
LED_ON: Final = Led(on=_FOREVER, off=0)
LED_UNCHANGED: Final = Led(on=_FOREVER, off=_FOREVER)


def blinking(on: int, off: int, offset: int = 0) -> Led:
    """Return an LED that is lit and dark for so many ms in turn.

    Raises RefusedOrderError if it would be always lit, always dark or unchanged.
    """
    if on not in range(1, _FOREVER) or off not in range(1, _FOREVER + 1):
        message = f"{on} ms on and {off} ms off is no blinking"
        raise RefusedOrderError(message)
    return Led(on=on, off=off, offset=offset)


@record
class PortLeds:
    """The four LEDs of a port."""

    red: Led = coded(part(_LED), default=LED_UNCHANGED)
    green: Led = coded(part(_LED), default=LED_UNCHANGED)
    orange: Led = coded(part(_LED), default=LED_UNCHANGED)
    spare: Led = coded(part(_LED), default=LED_UNCHANGED)


_PORT_LEDS: Final = Struct(PortLeds, "3.2.4 se: port")


@record
class Leds:
    """The LEDs of port 1 and port 2."""

    ports: tuple[PortLeds, PortLeds] = coded(pair(part(_PORT_LEDS)))


LEDS: Final = Struct(Leds, "3.2.4 se")


def set_leds(first: PortLeds, second: PortLeds) -> Request:
    """Return the command that sets LEDs by hand (``se``); times in ms.

    Only a box whose keys and LEDs are set to manual accepts it. Raises
    RefusedOrderError for times that do not fit.
    """
    return Request(CommandId.SET_LEDS, LEDS.encode(Leds(ports=(first, second))))


# -- mc: the card reader -----------------------------------------------------------


class ReaderTarget(IntEnum):
    """Recipient of a command behind the box."""

    READER = 1
    CARD = 2


_READER_HEAD: Final = 4
"""Bytes of parameters before the data: name, target, time-out."""
_TIMEOUT: Final = Number(name="time-out", width=1, unit="s")


def card_reader(target: ReaderTarget, timeout: int, data: bytes) -> Request:
    """Return a command for the card reader, which is passed on unchanged (``mc``).

    ``timeout``: of the reader, s. Raises RefusedOrderError for values that do not fit.
    """
    if target not in ReaderTarget:
        message = f"{target} is neither the reader nor the card"
        raise RefusedOrderError(message)
    if len(data) > MAXIMUM_PARAMETERS - _READER_HEAD:
        message = f"{len(data)} bytes for the card reader do not fit"
        raise RefusedOrderError(message)
    return Request(
        CommandId.CARD_READER, bytes((target,)) + _TIMEOUT.encode(timeout) + data
    )


# -- oe, ow, fw: firmware ----------------------------------------------------------
#
# The procedure of an update is not in the manual (3.2.4.1 is empty): wrong use may
# make a box unusable.

MAXIMUM_ROM_BYTES: Final = 1024
"""Most bytes of one ``ow``."""
_ROM_ADDRESS: Final = Number(name="address", width=4)
_ROM_COUNT: Final = Number(name="count", width=4, unit="bytes")


def erase_rom(start: int, count: int) -> Request:
    """Return the command that erases so many bytes of the temporary memory (``oe``)."""
    return Request(
        CommandId.ERASE_ROM, _ROM_ADDRESS.encode(start) + _ROM_COUNT.encode(count)
    )


def write_rom(start: int, data: bytes) -> Request:
    """Return the command that writes to the temporary memory (``ow``).

    Raises RefusedOrderError for no bytes, and for more than 1024.
    """
    if not 0 < len(data) <= MAXIMUM_ROM_BYTES:
        message = f"{len(data)} bytes, not 1 to {MAXIMUM_ROM_BYTES}"
        raise RefusedOrderError(message)
    return Request(
        CommandId.WRITE_ROM,
        _ROM_ADDRESS.encode(start) + _ROM_COUNT.encode(len(data)) + data,
    )


def activate_firmware() -> Request:
    """Return the command that installs the firmware in the memory (``fw``)."""
    return Request(CommandId.ACTIVATE_FIRMWARE)
