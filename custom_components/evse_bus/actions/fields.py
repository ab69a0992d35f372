"""Checks for the fields of the actions for an EWS-Box. Pure.

A value comes from a form, from YAML or from a template. An invalid one raises
ServiceValidationError, which names the field but never the value: some are passwords.
The library accepts every value that passes here (tested).
"""

from collections.abc import Callable, Mapping
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation
from ipaddress import AddressValueError, IPv4Address
from typing import Final

from homeassistant.helpers import config_validation as cv
import probatio as vol

from ..errors import ActionError, wrong_action
from ..evse.ews.wire.cards import TAG_LENGTH
from ..evse.ews.wire.commands import MINIMUM_LIMIT

type Check[V] = Callable[[str, object], V]
"""Takes the name of a field and its value, returns the converted value."""

HIGHEST_LIMIT: Final = 80
"""Highest current of a control pilot (IEC 61851-1), A."""
PIN_LENGTH: Final = 4
_WATT_HOURS: Final = Decimal(1000)
"""Per kilowatt-hour."""
_HIGHEST_TOTAL: Final = Decimal(0xFFFFFFFF) / _WATT_HOURS
"""kWh; the box has 32 bits for watt-hours."""


# -- Numbers ---------------------------------------------------------------------


def _finite(value: object) -> Decimal | None:
    """Return a number as it was written; ``None``: not a number, or not finite."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        # A float by its shortest digits: 0.1 must not become 0.1000000000000000055.
        number = Decimal(value if isinstance(value, int) else str(value))
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def whole(minimum: int, maximum: int) -> Check[int]:
    """Return the check for a whole number."""

    def check(key: str, value: object) -> int:
        number = _finite(value)
        # The range first: int() of a number with a huge exponent is expensive.
        if number is None or not minimum <= number <= maximum or number != int(number):
            raise wrong_action(
                ActionError.FIELD_WHOLE_NUMBER,
                field=key,
                minimum=minimum,
                maximum=maximum,
            )
        return int(number)

    return check


def limit(key: str, value: object) -> int:
    """Check a maximum current in whole amperes; 0: no limit of its own."""
    number = _finite(value)
    if number is None or number not in (0, *range(MINIMUM_LIMIT, HIGHEST_LIMIT + 1)):
        raise wrong_action(
            ActionError.FIELD_CURRENT,
            field=key,
            minimum=MINIMUM_LIMIT,
            maximum=HIGHEST_LIMIT,
        )
    return int(number)


def meter_total(key: str, value: object) -> int:
    """Check the new value of a meter in kWh; return it in Wh."""
    number = _finite(value)
    if number is None or not 0 <= number <= _HIGHEST_TOTAL:
        raise wrong_action(
            ActionError.FIELD_NUMBER, field=key, minimum=0, maximum=_HIGHEST_TOTAL
        )
    # The value of a template may have lost its last digit to a float.
    return int((number * _WATT_HOURS).to_integral_value(ROUND_HALF_EVEN))


# -- Texts -----------------------------------------------------------------------


def _written(value: object) -> str | None:
    """Return a text; a template turns digits into a number. ``None``: not a text."""
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        return None
    try:
        return str(value)
    except ValueError:
        # str() refuses an integer of thousands of digits.
        return None


def secret(length: int) -> Check[str]:
    """Return the check for a password: as `text`, but spaces at its ends count."""

    def check(key: str, value: object) -> str:
        written = _written(value)
        if written is None or len(written) > length:
            raise wrong_action(ActionError.FIELD_TEXT, field=key, length=length)
        try:
            written.encode("latin-1")
        except UnicodeEncodeError:
            # `from None`: the cause contains the password.
            raise wrong_action(ActionError.FIELD_SIGNS, field=key) from None
        if written and not written.isprintable():
            raise wrong_action(ActionError.FIELD_SIGNS, field=key)
        return written

    return check


def text(length: int) -> Check[str]:
    """Return the check for a text of at most ``length`` Latin-1 characters."""
    check_secret = secret(length)

    def check(key: str, value: object) -> str:
        written = _written(value)
        return check_secret(key, value if written is None else written.strip())

    return check


def pin(key: str, value: object) -> str:
    """Check the PIN of the cards; empty: none."""
    written = _written(value)
    if (
        written is None
        or len(written) not in (0, PIN_LENGTH)
        or not written.isascii()
        or written != written.strip()
        or (written and not written.isprintable())
    ):
        raise wrong_action(ActionError.FIELD_PIN, field=key, length=PIN_LENGTH)
    return written


def tag(key: str, value: object) -> bytes:
    """Check the number of a card's chip, hexadecimal digits."""
    digits = (_written(value) or "").strip()
    # `bytes.fromhex` would accept spaces between the digits.
    if len(digits) == 2 * TAG_LENGTH and digits.isalnum():
        try:
            return bytes.fromhex(digits)
        except ValueError:
            pass
    raise wrong_action(ActionError.FIELD_TAG, field=key, length=2 * TAG_LENGTH)


# -- Addresses -------------------------------------------------------------------


def address(key: str, value: object) -> IPv4Address:
    """Check an IPv4 address."""
    try:
        return IPv4Address(value if isinstance(value, str) else "")
    except AddressValueError:
        raise wrong_action(ActionError.FIELD_ADDRESS, field=key) from None


def netmask(key: str, value: object) -> IPv4Address:
    """Check a netmask: its ones come before its zeros."""
    mask = address(key, value)
    zeros = int(mask) ^ 0xFFFFFFFF
    if zeros & (zeros + 1):
        raise wrong_action(ActionError.FIELD_NETMASK, field=key)
    return mask


# -- Choices ---------------------------------------------------------------------


def switch(key: str, value: object) -> bool:
    """Check an on/off value, as a boolean or a word."""
    if isinstance(value, (bool, str)):
        try:
            return cv.boolean(value)
        except vol.Invalid:
            pass
    raise wrong_action(ActionError.FIELD_SWITCH, field=key)


def option[V](options: Mapping[str, V]) -> Check[V]:
    """Return the check for one of several words."""

    def check(key: str, value: object) -> V:
        if not isinstance(value, str) or value not in options:
            raise wrong_action(
                ActionError.FIELD_OPTION, field=key, options=", ".join(options)
            )
        return options[value]

    return check
