"""The errors that this library raises on purpose.

This module imports nothing of the project and nothing of Home Assistant.
"""

from typing import override


class EvseError(Exception):
    """Base class of all errors that this library raises on purpose."""

    text_key: str | None = None
    """Key of a translated message of its own; ``None``: the class has one."""

    @property
    def details(self) -> dict[str, str]:
        """Return values that a translated message can contain, by name."""
        return {}


class LineError(EvseError):
    """The serial line cannot be used."""


class PortMissingError(LineError):
    """There is no such port, or the network address does not answer."""


class PortBusyError(LineError):
    """Another program has the port open."""


class PortPermissionError(LineError):
    """The port exists, but its permissions forbid opening it."""


class PortSettingsError(LineError):
    """The port or its URL does not support these settings."""


class LineLostError(LineError):
    """The port was open and is gone (unplugged adapter, closed connection)."""


class LineBusyError(LineError):
    """The line was never quiet for long enough to send."""


class ExchangeError(EvseError):
    """A request did not get a good reply."""


class ReplyTimeoutError(ExchangeError):
    """No reply came in time."""


class GarbledReplyError(ReplyTimeoutError):
    """Bytes came in reply, but no good frame."""


class ExchangeRefusedError(ExchangeError):
    """The charger refused the request."""

    def __init__(self, message: str, code: int | None = None) -> None:
        """Keep the charger's own code beside the message."""
        super().__init__(message)
        self.code = code

    @property
    @override
    def details(self) -> dict[str, str]:
        return {"code": "-" if self.code is None else str(self.code)}


class ImplausibleReplyError(ExchangeError):
    """A frame with good checksums and impossible content; not used."""


class WrongChargerError(EvseError):
    """Another charger answers at this address; nothing was written."""

    def __init__(
        self, message: str, *, expected: str | None, found: str | None
    ) -> None:
        """Keep both serial numbers; ``found`` is ``None`` for a box that has none."""
        super().__init__(message)
        self.expected = expected
        self.found = found

    @property
    @override
    def details(self) -> dict[str, str]:
        return {"expected": self.expected or "-", "found": self.found or "-"}


class DuplicateAddressError(EvseError):
    """Two chargers answer at one address; nothing was written."""


class SharedAddressError(DuplicateAddressError):
    """Other chargers obey requests to this address too; nothing was written."""


class NotConfirmedError(EvseError):
    """A command was sent, but the charger did not confirm it."""


class SupersededError(EvseError):
    """A newer command took the place of this one before it was sent."""


class RefusedOrderError(EvseError, ValueError):
    """A requested value that is not a usable number, or out of range."""


class NotAvailableError(EvseError):
    """The charger does not answer, or is not in a state for this command."""

    def __init__(
        self, message: str, text_key: str | None = None, **details: str
    ) -> None:
        """Keep the reason: the key of a translated message, and the values in it."""
        super().__init__(message)
        self.text_key = text_key
        self._details = details

    @property
    @override
    def details(self) -> dict[str, str]:
        return self._details
