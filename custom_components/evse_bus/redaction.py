"""Serial numbers in frames: where they pass on the wire, and how to hide them. Pure."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
import re
from typing import Final


@dataclass(frozen=True, slots=True, kw_only=True)
class _Serials:
    """How one protocol says serial numbers."""

    encode: Callable[[str], bytes]
    """Return a serial number as it passes on the wire."""
    in_frame: re.Pattern[bytes]
    """Where one stands in a frame, also where the frame was cut off."""
    rest: re.Pattern[bytes]
    """What a piece without its beginning may begin with."""
    unmistakable: bool = True
    """What looks like a known one is one; short ones only count in pieces."""


_WORD: Final = 0xFFFF


def _word(serial: str) -> bytes:
    """Return a number as a Modbus register says it; nothing for what is none."""
    number = int(serial) if serial.isdecimal() else 0
    return number.to_bytes(2, "big") if 0 < number <= _WORD else b""


_SMARTEVSE: Final = _Serials(
    encode=_word,
    # Later dialects: the last of twelve registers. The checksum behind it would tell.
    in_frame=re.compile(rb"(?s)(?<=\A.\x04\x18.{22}).{1,4}"),
    rest=re.compile(rb"(?!)"),
    unmistakable=False,
)

_EWS: Final = _Serials(
    encode=str.encode,
    # What tells it (`rs`) is not kept at all: it tells of cards, too.
    in_frame=re.compile(rb"(?!)"),
    rest=re.compile(rb"(?!)"),
)

_SERIALS: Final[Mapping[str, _Serials]] = {
    "evbox": _Serials(
        encode=lambda serial: serial.zfill(8).encode(),
        # Eight digits behind command 68; fewer where a frame was cut off.
        in_frame=re.compile(rb"(?<=68)[0-9]{8}|(?<=A08068|80A068)[0-9]{1,8}"),
        rest=re.compile(rb"\A[0-9]{1,8}"),
    ),
    "abl": _Serials(
        encode=lambda serial: serial.encode().hex().upper().encode(),
        # The answer to a read of register 0x50, whose first byte repeats the 50.
        in_frame=re.compile(rb"(?<=03[0-9A-F]{2}50)[0-9A-F]+"),
        rest=re.compile(rb"\A[0-9A-F]+"),
    ),
    "smartevse": _SMARTEVSE,
    "smartevse_master": _SMARTEVSE,
    "ews": _EWS,
    "ews_network": _EWS,
}


def on_wire(protocol: str, serials: Iterable[str | None]) -> list[bytes]:
    """Return the serial numbers that are known, as they pass on the wire."""
    encode = _SERIALS[protocol].encode
    return [data for serial in serials if serial and (data := encode(serial))]


def without_serial(
    protocol: str,
    data: bytes,
    serials: Iterable[bytes] = (),
    *,
    whole: bool = True,
) -> bytes:
    """Return bytes as they passed, serial numbers replaced by asterisks.

    ``serials`` are hidden wherever they stand, also in a damaged frame. A piece
    that is not ``whole`` may begin in the middle of one.
    """
    known = _SERIALS[protocol]
    if known.unmistakable or not whole:
        for serial in serials:
            data = data.replace(serial, b"*" * len(serial))
    data = known.in_frame.sub(_hide, data)
    return data if whole else known.rest.sub(_hide, data)


def _hide(found: re.Match[bytes]) -> bytes:
    return b"*" * len(found.group())
