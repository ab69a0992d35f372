"""Errors of the library as translated errors of Home Assistant."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
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

# The first class that matches counts, so subclasses come before their base.
_PORT_KEYS: Final[tuple[tuple[type[LineError], str], ...]] = (
    (PortMissingError, "port_missing"),
    (PortBusyError, "port_busy"),
    (PortPermissionError, "port_permission"),
    (PortSettingsError, "port_settings"),
    (LineError, "port_failed"),
)
_LISTEN_KEYS: Final[tuple[tuple[type[LineError], str], ...]] = (
    (PortMissingError, "listen_missing"),
    (PortBusyError, "listen_busy"),
    (PortPermissionError, "listen_permission"),
    (LineError, "listen_failed"),
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


class ActionError(StrEnum):
    """Translation keys of invalid action data and of failed actions."""

    NOT_EWS_BOX = "not_ews_box"
    CHOOSE_PORT = "choose_port"
    NOTHING_TO_CHANGE = "nothing_to_change"
    NOT_READ = "not_read"
    PARAMETERS_NOT_TAKEN = "parameters_not_taken"
    CARDS_NOT_TAKEN = "cards_not_taken"
    CARD_ENTRIES = "card_entries"
    CARD_ENTRY_TWICE = "card_entry_twice"
    CARD_TWICE = "card_twice"
    CARD_ENTRY_NUMBERS = "card_entry_numbers"
    LED_TIMES = "led_times"
    FIELD_NUMBER = "field_number"
    FIELD_WHOLE_NUMBER = "field_whole_number"
    FIELD_CURRENT = "field_current"
    FIELD_TEXT = "field_text"
    FIELD_SIGNS = "field_signs"
    FIELD_PIN = "field_pin"
    FIELD_TAG = "field_tag"
    FIELD_ADDRESS = "field_address"
    FIELD_NETMASK = "field_netmask"
    FIELD_SWITCH = "field_switch"
    FIELD_OPTION = "field_option"


def wrong_action(key: ActionError, **placeholders: object) -> ServiceValidationError:
    """Return the error for invalid action data."""
    return ServiceValidationError(
        translation_domain=DOMAIN,
        translation_key=key.value,
        translation_placeholders=_as_texts(placeholders),
    )


def failed_action(key: ActionError, **placeholders: object) -> HomeAssistantError:
    """Return the error for an action that could not be carried out."""
    return HomeAssistantError(
        translation_domain=DOMAIN,
        translation_key=key.value,
        translation_placeholders=_as_texts(placeholders),
    )


def _as_texts(placeholders: Mapping[str, object]) -> dict[str, str]:
    return {name: str(value) for name, value in placeholders.items()}


def not_ready(
    error: LineError, port: str, *, listens: bool = False
) -> ConfigEntryNotReady:
    """Return the error for a port that cannot be opened; setup is retried later.

    ``listens``: the port is that of a listener.
    """
    keys = _LISTEN_KEYS if listens else _PORT_KEYS
    return ConfigEntryNotReady(
        translation_domain=DOMAIN,
        translation_key=next(key for kind, key in keys if isinstance(error, kind)),
        translation_placeholders={"port": port, "error": str(error)},
    )


@contextmanager
def translated_errors(charger: str, port: str) -> Iterator[None]:
    """Translate the errors of a command.

    Raises ServiceValidationError for an invalid order and HomeAssistantError for one
    that could not be carried out.
    """
    try:
        yield
    except EvseError as error:
        placeholders = {"charger": charger, "port": port, "error": str(error)}
        key = error.text_key or next(
            key for kind, key in _COMMAND_KEYS if isinstance(error, kind)
        )
        kind = (
            ServiceValidationError
            if isinstance(error, RefusedOrderError)
            else HomeAssistantError
        )
        raise kind(
            translation_domain=DOMAIN,
            translation_key=key,
            translation_placeholders=placeholders | error.details,
        ) from error
