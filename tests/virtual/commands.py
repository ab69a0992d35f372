"""The commands of `--control`, as tables: what each does, and to which charger."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, get_args

from .abl import AblBox
from .adapter import GatewayKind, ModbusTcpGateway
from .evbox import EvboxChargePoint
from .ews_box import EwsBox
from .ews_cli import EwsFleet
from .ews_dialler import EwsDialler
from .ews_rfid import Card
from .smartevse import SmartEvse

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .bus import VirtualBus
    from .car import Car
    from .device import Device

Values = list[str]
# Width of the column of usages in the help.
USAGE = 34


@dataclass(frozen=True)
class Command:
    """One command: its arguments after the charger's, its effect, and what does it.

    `run` gets a bus and values, a car and values, or a charger, the number of its
    module or port, and values.
    """

    arguments: str
    about: str
    run: Callable[..., object]


def switch(value: str) -> bool:
    """Return whether it is `on`; raises KeyError for neither `on` nor `off`."""
    return {"on": True, "off": False}[value]


def buses_of(bus: VirtualBus | EwsFleet) -> list[VirtualBus]:
    """Return all buses: each box that dials has one of its own."""
    return [*bus.diallers] if isinstance(bus, EwsFleet) else [bus]


# -- The bus and its adapter -------------------------------------------------------


def _on_adapters(action: Callable[[Any, Values], object]) -> Callable[..., None]:
    def run(bus: VirtualBus, values: Values) -> None:
        for one in buses_of(bus):
            action(one.adapter, values)

    return run


def _on_buses(action: Callable[[VirtualBus, Values], object]) -> Callable[..., None]:
    def run(bus: VirtualBus, values: Values) -> None:
        for one in buses_of(bus):
            action(one, values)

    return run


def _delay(adapter: Any, values: Values) -> None:  # noqa: ANN401 - an adapter
    adapter.delay_out = float(values[0])
    adapter.delay_in = float(values[1] if len(values) > 1 else values[0])


def _gateway(adapter: Any, values: Values) -> None:  # noqa: ANN401 - an adapter
    kind: Any = values[0]
    if kind not in ("no", *get_args(GatewayKind)):
        message = f"{kind} is no kind of gateway"
        raise ValueError(message)
    adapter.gateway = None if kind == "no" else ModbusTcpGateway(kind)


def _setter(name: str, value: Callable[[str], object]) -> Callable[..., None]:
    """Return a function that sets an attribute to its first value."""

    def run(one: object, values: Values) -> None:
        setattr(one, name, value(values[0]))

    return run


def _seconds_or_none(text: str) -> float | None:
    return float(text) or None


def _foreign(bus: VirtualBus, values: Values) -> None:
    if values[0] == "no":
        bus.quiet()
    else:
        bus.foreign_traffic(bytes.fromhex(values[0]), float(values[1]))


BUS: Mapping[str, Command] = {
    "unplug-adapter": Command("", "pull it out", lambda bus, _: bus.unplug()),
    "replug-adapter": Command("", "put it back", lambda bus, _: bus.replug()),
    "stick-adapter": Command(
        "",
        "half-open: this connection is dead, the next one works",
        _on_adapters(lambda one, _: one.stick()),
    ),
    "hang-adapter": Command(
        "on|off",
        "nothing passes on any connection; they stay open",
        _on_adapters(_setter("hung", switch)),
    ),
    "answer-calls": Command(
        "accepts|refuses|ignores",
        "connections from now on; ignores: a black hole (TCP only)",
        _on_buses(lambda one, values: one.answer_calls(values[0])),  # type: ignore[arg-type]
    ),
    "delay": Command("OUT [IN]", "seconds each way", _on_adapters(_delay)),
    "jitter": Command(
        "S", "up to so much more", _on_adapters(_setter("jitter", float))
    ),
    "idle-timeout": Command(
        "S",
        "close a connection without traffic; 0: never",
        _on_adapters(_setter("idle_timeout", _seconds_or_none)),
    ),
    "gateway": Command(
        "no|silent|closes|answers|mute",
        "it expects Modbus TCP in place of passing bytes",
        _on_adapters(_gateway),
    ),
    "error-rate": Command(
        "P",
        "probability that a byte is damaged, both directions",
        _on_buses(
            lambda one, values: _setter("byte_error_rate", float)(one.faults, values)
        ),
    ),
    "cut-cable": Command(
        "on|off",
        "no byte reaches any charger",
        _on_buses(lambda one, values: _setter("dead", switch)(one.faults, values)),
    ),
    "foreign": Command(
        "HEX S | no",
        "another master sends these bytes every S seconds",
        _on_buses(_foreign),
    ),
    "advance": Command(
        "S",
        "the chargers' time: cars, time-outs, sleep",
        lambda bus, values: bus.advance(float(values[0])),
    ),
}


# -- Cars --------------------------------------------------------------------------


def _car(action: Callable[[Car], object]) -> Callable[[Car, Values], object]:
    return lambda car, _: action(car)


CARS: Mapping[str, Command] = {
    "plug": Command("", "arrive and request charge", _car(lambda car: car.plug_in())),
    "request": Command("", "request charge", _car(lambda car: car.request())),
    "finish": Command("", "be full", _car(lambda car: car.finish())),
    "leave": Command("", "unplug and leave", _car(lambda car: car.leave())),
    "greedy": Command(
        "FACTOR", "draw more than offered: 1.2", _setter("greedy", float)
    ),
    "slow": Command(
        "S", "follow a new offer only after S seconds", _setter("reaction", float)
    ),
}


# -- All chargers ------------------------------------------------------------------


def _once(kind: Any) -> Callable[..., None]:  # noqa: ANN401 - a kind of fault
    """Return a function that applies a fault to the next reply."""

    def run(device: Device, _part: int, values: Values) -> None:
        value: Any = None
        if values:
            number = kind in ("late", "truncate", "corrupt")
            value = float(values[0]) if number else bytes.fromhex(values[0])
        device.faults.once(kind, value)

    return run


def _dead(*, dead: bool) -> Callable[..., None]:
    def run(device: Device, _part: int, _values: Values) -> None:
        device.faults.dead = dead

    return run


def _turn_round(device: Any, _part: int, values: Values) -> None:  # noqa: ANN401 - several kinds
    device.turn_round = float(values[0])


def _serial(device: Any, _part: int, values: Values) -> None:  # noqa: ANN401 - several kinds
    kind = type(device.serial)
    device.serial = kind(values[0])


ALL: Mapping[str, Command] = {
    "dead": Command("", "answers nothing", _dead(dead=True)),
    "alive": Command("", "answers again", _dead(dead=False)),
    "power-cycle": Command(
        "", "lose power for a moment", lambda device, *_: device.power_cycle()
    ),
    "serial": Command("TEXT", "another box in its place", _serial),
    "lose": Command("", "the next reply is lost", _once("lose")),
    "late": Command("S", "the next reply is late", _once("late")),
    "turn-round": Command("S", "so long before each of its replies", _turn_round),
    "duplicate": Command("", "the next reply comes twice", _once("duplicate")),
    "truncate": Command("N", "the next reply ends after N bytes", _once("truncate")),
    "corrupt": Command(
        "N", "a bit of byte N of the next reply flips", _once("corrupt")
    ),
    "twin-error": Command(
        "",
        "two bits of it flip; any checksum but a CRC still fits",
        _once("twin"),
    ),
    "replace": Command(
        "HEX", "these bytes in place of the next reply", _once("replace")
    ),
    "noise": Command("HEX", "these bytes just before the next reply", _once("noise")),
}


# -- ABL ---------------------------------------------------------------------------


def _outlet(name: str, value: Callable[[str], object]) -> Callable[..., None]:
    def run(box: AblBox, _part: int, values: Values) -> None:
        setattr(box.outlet, name, value(values[0]))

    return run


ABL: Mapping[str, Command] = {
    "off": Command(
        "",
        "no power; by serial number where two have one ID",
        lambda box, *_: box.switch_off(),
    ),
    "on": Command("", "power again", lambda box, *_: box.switch_on()),
    "others": Command(
        "A",
        "another master sets Icmax; 0: it pauses",
        lambda box, _, values: box.set_by_other_master(float(values[0])),
    ),
    "stop": Command("", "E0, as by a key switch", lambda box, *_: box.stop_locally()),
    "start": Command("", "out of E0 again", lambda box, *_: box.start_locally()),
    "state": Command(
        "NAME",
        "any state, also E0 or A0 by itself",
        lambda box, _, values: box.outlet.go(values[0]),
    ),
    "fail": Command(
        "N", "failure F<N>", lambda box, _, values: box.fail(int(values[0]))
    ),
    "clear": Command("", "out of a failure", lambda box, *_: box.clear_failure()),
    "icmax": Command(
        "on|off",
        "register 0x0F is answered",
        lambda box, _, values: setattr(box, "tells_icmax", switch(values[0])),
    ),
    "ignore": Command(
        "on|off", "takes limits without effect", _outlet("ignore_limit", switch)
    ),
    "hot": Command("on|off", "too hot: reduced (BC5)", _outlet("hot", switch)),
    "meter-failed": Command(
        "on|off", "the meter is broken (BC4)", _outlet("meter_failed", switch)
    ),
}


# -- EVBox -------------------------------------------------------------------------


def _distort(point: EvboxChargePoint, part: int, values: Values) -> None:
    quantity, value, *times = values
    names = {
        "current": "current",
        "voltage": "voltage",
        "cos-phi": "cos_phi",
        "energy": "energy_jump",
    }
    chosen: dict[str, Any] = {names[quantity]: float(value)}
    point.distort(part - 1, times=int(times[0]) if times else None, **chosen)


def _evbox_meter(point: EvboxChargePoint, part: int, values: Values) -> None:
    point.modules[part - 1].energy_wh = float(values[0])


def _evbox_meter_reads(point: EvboxChargePoint, part: int, values: Values) -> None:
    jump = float(values[0]) - point.modules[part - 1].energy_wh
    point.distort(part - 1, times=int(values[1]), energy_jump=jump)


EVBOX: Mapping[str, Command] = {
    "distort": Command(
        "current|voltage|cos-phi|energy VALUE [N]",
        "in N replies, or all: over-current, implausible values; checksums fit",
        _distort,
    ),
    "undistort": Command("", "measured values again", lambda one, *_: one.undistort()),
    "meter": Command("WH", "the meter of a module is set", _evbox_meter),
    "meter-reads": Command(
        "WH N", "it reads so much in N replies, then as before", _evbox_meter_reads
    ),
    "add-module": Command("", "one more module", lambda one, *_: one.add_module()),
    "remove-module": Command(
        "",
        "without this one; the others move up",
        lambda one, part, _: one.remove_module(part - 1),
    ),
    "ignore": Command(
        "on|off",
        "takes limits without effect",
        lambda one, _, values: setattr(one, "ignore_limit", switch(values[0])),
    ),
    "maximum": Command(
        "A",
        "another maximum of the connection",
        lambda one, _, values: setattr(one, "max_current", float(values[0])),
    ),
    "interval": Command(
        "S",
        "another minimum interval",
        lambda one, _, values: setattr(one, "min_interval", int(values[0])),
    ),
}


# -- SmartEVSE ---------------------------------------------------------------------

SMARTEVSE: Mapping[str, Command] = {
    "press": Command("", "its button", lambda box, *_: box.press_access()),
    "menu": Command(
        "SETTING N",
        "in the box's own menu",
        lambda box, _, values: box.set_at_the_box(values[0], int(values[1])),
    ),
    "others": Command(
        "A",
        "another client overrides the current; 0 ends it",
        lambda box, _, values: box.set_by_other_master(float(values[0])),
    ),
    "temperature": Command(
        "C",
        "inside; 65 stops it",
        lambda box, _, values: setattr(box.outlet, "temperature", int(values[0])),
    ),
    "rcd": Command(
        "on|off",
        "tripped",
        lambda box, _, values: setattr(box.outlet, "rcd_tripped", switch(values[0])),
    ),
    "ignore": Command(
        "on|off",
        "takes the current without effect",
        lambda box, _, values: setattr(
            box.controller, "override_works", not switch(values[0])
        ),
    ),
    "ignore-access": Command(
        "on|off",
        "takes access off without effect",
        lambda box, _, values: setattr(
            box.controller, "ignore_access", switch(values[0])
        ),
    ),
}


# -- EWS ---------------------------------------------------------------------------


def _press(box: EwsBox, part: int, values: Values) -> None:
    box.press_key(part, int(values[0]), float(values[1]) if len(values) > 1 else 0.3)


def _card(box: EwsBox, _part: int, values: Values) -> None:
    group, number = [*(int(value) for value in values), 1, 1][:2]
    box.present_card(Card(group, number))


def _jam(box: EwsBox, part: int, values: Values) -> None:
    jammed: Any = {"lock": "lock", "unlock": "unlock", "free": ""}[values[0]]
    box.ports[part - 1].lock.jammed = jammed


def _port(name: str, value: Callable[[str], object]) -> Callable[..., None]:
    def run(box: EwsBox, part: int, values: Values) -> None:
        setattr(box.ports[part - 1], name, value(values[0]))

    return run


def _ews_meter(box: EwsBox, part: int, values: Values) -> None:
    box.ports[part - 1].session.total_wh = float(values[0])


def _ews_meter_reads(box: EwsBox, part: int, values: Values) -> None:
    box.ports[part - 1].meter_reads = [float(values[0])] * int(values[1])


def _dialler(action: Callable[[EwsDialler], object]) -> Callable[..., None]:
    def run(box: EwsBox, _part: int, _values: Values) -> None:
        if not isinstance(box.bus, EwsDialler):
            msg = f"{box.name} does not dial"
            raise TypeError(msg)
        action(box.bus)

    return run


EWS: Mapping[str, Command] = {
    "press": Command("KEY [S]", "a key of the port", _press),
    "card": Command("[GROUP CARD]", "a card at the reader", _card),
    "remove-card": Command("", "take it away", lambda box, *_: box.remove_card()),
    "web-start": Command(
        "", "on its web page", lambda box, part, _: box.start_on_web_page(part)
    ),
    "web-stop": Command(
        "", "on its web page", lambda box, part, _: box.stop_on_web_page(part)
    ),
    "rcd": Command(
        "on|off",
        "tripped",
        lambda box, part, values: box.trip_rcd(part, tripped=switch(values[0])),
    ),
    "fan": Command("on|off", "the car wants ventilation", _port("wants_fan", switch)),
    "cable": Command("A", "another cable", _port("cable", int)),
    "jam": Command("lock|unlock|free", "its lock", _jam),
    "plug-cable": Command(
        "", "without a car", lambda box, part, _: box.ports[part - 1].plug_cable()
    ),
    "pull-cable": Command(
        "", "at the box", lambda box, part, _: box.ports[part - 1].pull_cable()
    ),
    "meter": Command("WH", "its meter is set", _ews_meter),
    "meter-reads": Command(
        "WH N", "it reads so much in N answers, then as before", _ews_meter_reads
    ),
    "clock": Command(
        "YYYY-MM-DDThh:mm:ss",
        "its clock is wrong",
        lambda box, _, values: box.set_clock(datetime.fromisoformat(values[0])),
    ),
    "ignore": Command(
        "on|off",
        "takes limits without effect",
        lambda box, _, values: setattr(box, "ignores_limits", switch(values[0])),
    ),
    "hang-up": Command(
        "", "end its connection; dial again", _dialler(lambda bus: bus.hang_up())
    ),
    "vanish": Command(
        "", "leave it half-open; dial again", _dialler(lambda bus: bus.vanish())
    ),
}

CHARGERS: Mapping[type[Device], Mapping[str, Command]] = {
    AblBox: ABL,
    EvboxChargePoint: EVBOX,
    SmartEvse: SMARTEVSE,
    EwsBox: EWS,
}
"""Commands of one kind of charger."""


def text(protocol: str) -> str:
    """Return the commands for the chargers of a protocol, for `--help`."""
    own = {"abl": ABL, "evbox": EVBOX, "smartevse": SMARTEVSE, "ews": EWS}[protocol]
    part = {"evbox": "ID[.MODULE]", "ews": "ID[.PORT]"}.get(protocol, "ID")
    groups = (
        ("cars", CARS, part),
        ("this kind of charger", own, part),
        ("any charger", ALL, "ID"),
        ("adapter and bus", {**BUS, "status": Command("", "show all", print)}, ""),
    )
    lines: list[str] = []
    for title, commands, subject in groups:
        lines.append(f"  {title}:")
        for name, command in commands.items():
            usage = " ".join(filter(None, (name, subject, command.arguments)))
            if len(usage) > USAGE:
                lines.append(f"    {usage}")
                usage = ""
            lines.append(f"    {usage:<{USAGE}}  {command.about}".rstrip())
    return "\n".join(lines)
