"""What this library raises on purpose.

This module imports nothing of the project and nothing of Home Assistant.
"""


class EvseError(Exception):
    """Anything that this library raises on purpose."""


class LineError(EvseError):
    """The serial line cannot be used."""


class PortMissingError(LineError):
    """There is no such port, or the network address does not answer."""


class PortBusyError(LineError):
    """Another program has the port open."""


class PortPermissionError(LineError):
    """The port exists, and we may not open it."""


class PortSettingsError(LineError):
    """The port or its URL does not take these settings."""


class LineLostError(LineError):
    """The port was open and is gone (unplugged adapter, closed connection)."""


class LineBusyError(LineError):
    """Others kept talking: no silence to speak in."""


class ExchangeError(EvseError):
    """A request did not get a good answer."""


class ReplyTimeoutError(ExchangeError):
    """Nobody answered in time."""


class GarbledReplyError(ReplyTimeoutError):
    """Something answered, and no good frame could be made of it."""


class ExchangeRefusedError(ExchangeError):
    """The charger answered that it will not."""

    def __init__(self, message: str, code: int | None = None) -> None:
        """Keep the charger's own code beside the message."""
        super().__init__(message)
        self.code = code


class ImplausibleReplyError(ExchangeError):
    """A frame with good checksums that says what cannot be; held back."""


class WrongChargerError(EvseError):
    """Another charger answers at this address; nothing was written."""

    def __init__(self, message: str, *, expected: str | None, found: str) -> None:
        """Keep both identities for the message to the user."""
        super().__init__(message)
        self.expected = expected
        self.found = found


class DuplicateAddressError(EvseError):
    """Two chargers answer at one address; nothing was written."""


class SharedAddressError(DuplicateAddressError):
    """Others on the bus hear what is said to this charger; nothing was written."""


class NotConfirmedError(EvseError):
    """A command was sent and the charger never confirmed it."""


class SupersededError(EvseError):
    """A newer command took the place of this one before it was sent."""


class RefusedOrderError(EvseError, ValueError):
    """A wish that is not a usable number, or out of what may be asked."""


class NotAvailableError(EvseError):
    """The charger does not answer, or is not in a state for this command."""
