"""The buses of the demo: their chargers, and the steps of the config flow."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from .settings import HOST, Settings

type Answer = Mapping[str, Any] | Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""The values for a step, or a function that makes them from the step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoBus:
    """One virtual bus and its chargers."""

    protocol: str
    """Key of the protocol."""
    key: str = ""
    """In the names of port and log, where another bus has the same protocol."""
    title: str
    virtual: tuple[str, ...]
    """Arguments of scripts/virtual-chargers, without the line."""
    dials: bool = False
    """Its boxes dial Home Assistant; there is no port, and nothing to search."""
    names: Mapping[str, str]
    """Name of a charger by its address, as the config flow shows it."""
    currents: Mapping[str, float]
    """First charging current by name, A; of each port of a box with ports."""
    limits: Mapping[str, float] = field(default_factory=dict)
    """Installation limits in the form of each charger, where not suggested."""
    connectors: int
    choose: Mapping[str, Answer]
    """Steps of the config flow up to the port."""
    search: Mapping[str, Answer] = field(default_factory=dict)
    """Steps from the port to the chargers found."""

    @property
    def name(self) -> str:
        """Return its name for port and log."""
        return self.key or self.protocol

    @property
    def ready(self) -> str:
        """Return the output of the virtual chargers once the port exists."""
        return f"ready {self.virtual[0]} "

    def arguments(self, settings: Settings) -> tuple[str, ...]:
        """Return all arguments of scripts/virtual-chargers."""
        if self.dials:
            return (*self.virtual, "--dial", f"{HOST}:{settings.listen_port}")
        return (*self.virtual, "--pty", str(settings.link(self.name)))

    def answers(self, settings: Settings) -> dict[str, Answer]:
        """Return the values for the steps of the config flow, and of discovered boxes."""
        listen = {"host": HOST, "port": settings.listen_port}
        line: dict[str, Answer] = (
            {"listen": listen, "discovered": {}}
            if self.dials
            else {"port": {"device": str(settings.link(self.name))}}
        )
        return {
            **self.choose,
            **line,
            **self.search,
            "charger": self._charger,
            # The same form, for a charger with ports.
            "box": self._charger,
            f"confirm_{self.protocol}": {},
        }

    def _charger(self, step: Mapping[str, Any]) -> Mapping[str, Any]:
        address = step["description_placeholders"]["address"]
        return {"name": self.names[address], **self.limits}


_LIFE: Final = (
    *("--cars", "auto"),
    # Small batteries, so that there is a change every minute.
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
        choose={"user": {"protocol": "evbox"}},
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
        choose={"user": {"protocol": "abl"}},
        search={"select": {"installation_limit": 16}},
    ),
    DemoBus(
        protocol="smartevse",
        title="SmartEVSE bus, polled",
        virtual=(
            *("smartevse", "--load-balance", "0", "--max-current", "16"),
            *("--seed", "2", *_LIFE),
        ),
        names={"0": "Courtyard"},
        currents={"Courtyard": 16.0},
        connectors=1,
        choose={
            "user": {"protocol": "smartevse"},
            "mode": {"next_step_id": "polled"},
        },
        search={"select": {"installation_limit": 16}},
    ),
    DemoBus(
        protocol="smartevse_master",
        title="SmartEVSE bus, Home Assistant as master",
        virtual=(
            *("smartevse", "--load-balance", "2", "3", "--max-current", "16"),
            *("--seed", "3", *_LIFE),
        ),
        names={
            "Slave 1 / Node 1": "Barn left",
            "Slave 2 / Node 2": "Barn right",
        },
        currents={"Barn left": 16.0, "Barn right": 16.0},
        connectors=2,
        choose={
            "user": {"protocol": "smartevse"},
            "mode": {"next_step_id": "master"},
        },
        search={
            # Less than both could use, so that one car more or less shows.
            "supply": {"supply_limit": 25, "supply_minimum": 6},
            "select": {"installation_limit": 16},
        },
    ),
    DemoBus(
        protocol="smartevse_master",
        key="smartevse_nodes",
        title="SmartEVSE bus, later firmware, Home Assistant as master",
        virtual=(
            *("smartevse", "--dialect", "2.30", "2.30", "3"),
            *("--load-balance", "2", "3", "8", "--max-current", "16"),
            *("--seed", "7", *_LIFE),
        ),
        names={
            "Slave 1 / Node 1": "Office left",
            "Slave 2 / Node 2": "Office right",
            "Node 7": "Office gate",
        },
        currents={"Office left": 16.0, "Office right": 16.0, "Office gate": 13.0},
        connectors=3,
        choose={
            "user": {"protocol": "smartevse"},
            "mode": {"next_step_id": "master"},
        },
        search={
            "supply": {"supply_limit": 32, "supply_minimum": 6},
            "select": {"installation_limit": 16},
        },
    ),
    DemoBus(
        protocol="ews",
        title="EWS-Box on a serial line",
        virtual=(
            *("ews", "--serials", "201609000417", "--drivers", "--seed", "5"),
            *_LIFE,
        ),
        names={"201609000417": "Workshop"},
        currents={"Workshop": 16.0},
        connectors=2,
        choose={
            "user": {"protocol": "ews"},
            "connection": {"next_step_id": "ews_serial"},
        },
        search={"select": {"installation_limit": 16}},
    ),
    DemoBus(
        protocol="ews_network",
        title="EWS-Box on the network",
        virtual=(
            *("ews", "--serials", "201802000093", "--drivers", "--seed", "6"),
            *_LIFE,
        ),
        dials=True,
        names={"201802000093": "Loading bay"},
        currents={"Loading bay": 20.0},
        limits={"installation_limit": 32, "installation_limit_2": 20},
        connectors=2,
        choose={
            "user": {"protocol": "ews"},
            "connection": {"next_step_id": "ews_network"},
        },
    ),
)
