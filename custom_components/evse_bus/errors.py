"""What went wrong, in the user's words: library errors as Home Assistant's."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from homeassistant.exceptions import (
    ConfigEntryNotReady,
    HomeAssistantError,
    ServiceValidationError,
)

from .const import DOMAIN
from .evse.errors import (
    DuplicateAddressError,
    EvseError,
    ExchangeRefusedError,
    GarbledReplyError,
    ImplausibleReplyError,
    LineBusyError,
    LineError,
    LineLostError,
    NotAvailableError,
    NotConfirmedError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
    PortSettingsError,
    RefusedOrderError,
    ReplyTimeoutError,
    SharedAddressError,
    SupersededError,
    WrongChargerError,
)

# The first class that fits counts, so the special stand before the general.
_PORT_KEYS: Final[tuple[tuple[type[LineError], str], ...]] = (
    (PortMissingError, "port_missing"),
    (PortBusyError, "port_busy"),
    (PortPermissionError, "port_permission"),
    (PortSettingsError, "port_settings"),
    (LineError, "port_failed"),
)

_COMMAND_KEYS: Final[tuple[tuple[type[EvseError], str], ...]] = (
    (RefusedOrderError, "order_refused"),
    (SupersededError, "superseded"),
    (WrongChargerError, "wrong_charger"),
    (SharedAddressError, "shared_address"),
    (DuplicateAddressError, "duplicate_address"),
    (NotConfirmedError, "not_confirmed"),
    (ExchangeRefusedError, "charger_refused"),
    (GarbledReplyError, "garbled_reply"),
    (ReplyTimeoutError, "no_reply"),
    (ImplausibleReplyError, "implausible_reply"),
    (LineBusyError, "line_busy"),
    (LineLostError, "line_lost"),
    (LineError, "port_failed"),
    (NotAvailableError, "not_available"),
    (EvseError, "command_failed"),
)


def port_error_key(error: LineError) -> str:
    """Return the translation key that says why a port cannot be used."""
    return next(key for kind, key in _PORT_KEYS if isinstance(error, kind))


def not_ready(error: LineError, port: str) -> ConfigEntryNotReady:
    """Return why a bus cannot be set up now; Home Assistant tries again later."""
    return ConfigEntryNotReady(
        translation_domain=DOMAIN,
        translation_key=port_error_key(error),
        translation_placeholders={"port": port, "error": str(error)},
    )


@contextmanager
def translated_errors(charger: str, port: str) -> Iterator[None]:
    """Turn what a command raises into what Home Assistant shows.

    Raises ServiceValidationError for a wish that cannot be meant and
    HomeAssistantError for one that could not be carried out.
    """
    try:
        yield
    except EvseError as error:
        key = next(key for kind, key in _COMMAND_KEYS if isinstance(error, kind))
        placeholders = {"charger": charger, "port": port, "error": str(error)}
        if isinstance(error, WrongChargerError):
            placeholders |= {
                "expected": error.expected or "-",
                "found": error.found,
            }
        kind = (
            ServiceValidationError
            if isinstance(error, RefusedOrderError)
            else HomeAssistantError
        )
        raise kind(
            translation_domain=DOMAIN,
            translation_key=key,
            translation_placeholders=placeholders,
        ) from error
