"""The two buses of the demo: what is on them, and how a person would add them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

type Answer = Mapping[str, Any] | Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""What to fill into a step, or how to tell from what the step shows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoBus:
    """One virtual bus and its chargers."""

    protocol: str
    title: str
    virtual: tuple[str, ...]
    """Arguments of scripts/virtual-chargers."""
    names: Mapping[str, str]
    """Name of a charger by its address, as the config flow shows it."""
    currents: Mapping[str, float]
    """Charging current to begin with by name, A."""
    connectors: int
    search: Mapping[str, Answer]
    """Steps of the config flow from the port to the chargers found."""

    def answers(self, port: str) -> dict[str, Answer]:
        """Return what to answer in the config flow."""
        return {
            "user": {"protocol": self.protocol},
            "port": {"device": port},
            **self.search,
            "charger": self._name,
            f"confirm_{self.protocol}": {},
        }

    def _name(self, step: Mapping[str, Any]) -> Mapping[str, Any]:
        address = step["description_placeholders"]["address"]
        return {"name": self.names[address]}


_LIFE: Final = (
    *("--cars", "auto"),
    # Little batteries, so that there is something to see every minute.
    *("--away", "10", "60", "--wants", "50", "400"),
)

BUSES: Final = (
    DemoBus(
        protocol="evbox",
        title="EVBox bus",
        virtual=(
            *("evbox", "--serials", "1923054", "1923055", "--modules", "2", "4"),
            *("--seed", "4"),
            *_LIFE,
        ),
        names={"01923054": "Car park north", "01923055": "Car park south"},
        currents={"Car park north": 32.0, "Car park south": 32.0},
        connectors=6,
        search={
            "impose": {"next_step_id": "search_addresses"},
            "search_addresses": {
                "serial_numbers": ["1923054", "1923055"],
                "installation_limit": 32,
                "confirm": True,
            },
            "select": {"installation_limit": 32},
        },
    ),
    DemoBus(
        protocol="abl",
        title="ABL bus",
        virtual=("abl", "--ids", "1", "2", "3", "--seed", "1", *_LIFE),
        names={"1": "Garage", "2": "Carport", "3": "Guests"},
        currents={"Garage": 16.0, "Carport": 10.0, "Guests": 13.0},
        connectors=3,
        search={"select": {"installation_limit": 16}},
    ),
)
