"""One charger as the integration sees it."""

from homeassistant.config_entries import ConfigSubentry
from homeassistant.core import CALLBACK_TYPE

from .evse.charger import Charger
from .evse.readings import ConnectorReading


class ChargerUnit:
    """One charger and what the integration knows about it."""

    def __init__(self, subentry: ConfigSubentry, charger: Charger) -> None:
        """Start with nothing shown."""
        self.subentry_id = subentry.subentry_id
        self.subentry = subentry
        self.charger = charger
        """The library's charger; another one after the set-up was changed."""
        self.device_id = ""
        self.split = False
        """Its connectors are devices of their own."""
        self.added: set[tuple[str, str]] = set()
        """Platform and unique id of the entities that exist."""
        self.connectors: dict[int, ConnectorReading] = {}
        """As last told to listeners; empty: the charger is not available."""
        self.numbers: set[int] = set()
        """Connectors seen since the start."""
        self.shape: object = None
        """What entities have been made for: capabilities, connectors and the like."""
        self.unsubscribe: CALLBACK_TYPE = lambda: None

    @property
    def name(self) -> str:
        """Return what the user calls it."""
        return self.charger.config.name

    def connector(self, number: int) -> ConnectorReading | None:
        """Return what is known of a connector now."""
        reading = self.charger.reading
        if reading is None or not self.charger.available:
            return None
        return reading.connectors.get(number)
