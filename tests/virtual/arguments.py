"""The arguments of `scripts/virtual-chargers`, in groups; `--help` is for people."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, get_args

from . import commands, ews_cli
from .adapter import GatewayKind
from .car import CarLife
from .faults import DAMAGES
from .smartevse_registers import DIALECTS
from .strangers import KINDS

if TYPE_CHECKING:
    from collections.abc import Callable

DESCRIPTION = (
    "Virtual chargers on a virtual bus, at the line's real pace, from the manuals and"
    " from what real boxes show. Prints `ready <protocol> <url>` when a client may open"
    " it. `virtual-chargers <protocol> --help` has all that can be shown."
)


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the table of commands as it is, and uses one width."""

    def __init__(self, prog: str) -> None:
        """Use 88 columns, as everything here."""
        super().__init__(prog, max_help_position=32, width=88)


class _OneOrTwo(argparse.Action):
    """Takes one number or two."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,  # noqa: ANN401 - of argparse
        option_string: str | None = None,
    ) -> None:
        """Keep them; more are an error."""
        if len(values) > 2:
            parser.error(f"{option_string} takes one number or two")
        setattr(namespace, self.dest, values)


def parser() -> argparse.ArgumentParser:
    """Return the parser of all protocols."""
    made = argparse.ArgumentParser(prog="virtual-chargers", description=DESCRIPTION)
    kinds = made.add_subparsers(dest="protocol", required=True)
    for name, about, own in (
        ("abl", "ABL EVCC2/3 boxes", _abl),
        ("evbox", "EVBox ChargePoints (Protocol Max v4)", _evbox),
        ("smartevse", "SmartEVSE boxes", _smartevse),
        ("ews", "P-CHARGE EWS-Boxes (MCS binary)", ews_cli.add_arguments),
    ):
        kind = kinds.add_parser(
            name,
            help=about,
            description=f"Virtual {about}.",
            formatter_class=_Formatter,
            usage=f"virtual-chargers {name} [options]",
            epilog="commands of --control, one a line on stdin; the reply is `ok`,"
            f" or `error ...`:\n{commands.text(name)}",
        )
        own(kind.add_argument_group("chargers").add_argument)
        _common(kind)
    _strangers(
        kinds.add_parser(
            "strangers",
            help="clients that dial a listener for EWS-Boxes, and are none",
            formatter_class=_Formatter,
            usage="virtual-chargers strangers --dial HOST:PORT [options]",
        )
    )
    return made


def _abl(add: Callable[..., object]) -> None:
    add(
        "--ids",
        type=int,
        nargs="+",
        default=[1],
        metavar="ID",
        help="device-IDs; an ID twice: two boxes, as new ones are",
    )
    add("--default-current", type=float, default=16.0, metavar="A", help="Idefault")
    add(
        "--default-duty",
        type=lambda text: int(text, 0),
        metavar="CODE",
        help="Idefault as real boxes report it: 0x10B on those of 16 A",
    )
    add("--no-icmax", action="store_true", help="register 0x0F is not answered")
    add(
        "--effect-delay",
        type=float,
        default=0.0,
        metavar="S",
        help="time from a write of a limit or a pause to its effect",
    )
    add(
        "--above-default",
        choices=["clipped", "unchanged", "stored", "refused"],
        default="clipped",
        help="what becomes of a limit above Idefault (no source settles it)",
    )
    add(
        "--pause-in-ic",
        action="store_true",
        help="a pause shows in the Ic of 0x2E too; real boxes show Idefault there",
    )
    add(
        "--low-codes",
        action="store_true",
        help="codes 50 to 79 are taken: a 5 %% pilot, which can end a car's session",
    )
    add(
        "--e0-after-pause",
        type=float,
        metavar="S",
        help="goes to E0 by itself after a pause of S seconds",
    )
    add(
        "--pause-forced-after",
        type=float,
        metavar="S",
        help="a car that ignores a pause is cut off after S seconds; never by default",
    )
    add("--sleep", type=float, metavar="S", help="asleep after S seconds of silence")
    add(
        "--lost-asleep",
        type=int,
        default=1,
        metavar="N",
        help="requests lost in each sleep",
    )
    add(
        "--wakes-on",
        choices=["any", "own"],
        default="any",
        help="any traffic, or its own ID only",
    )
    add(
        "--stray",
        type=bytes.fromhex,
        default=b"",
        metavar="HEX",
        help="bytes before the first reply after a sleep",
    )
    add(
        "--upstream-timeout",
        type=float,
        metavar="S",
        help="F4 after S seconds without polling",
    )
    add("--no-meter", action="store_true", help="currents read 0x3E8")
    add(
        "--meter-bit",
        action="store_true",
        help="with --no-meter: bit 5 of 0x02 promises a meter all the same",
    )
    add(
        "--idle-floor",
        type=int,
        default=0,
        metavar="N",
        help="the meter's floor on idle phases, 0.1 A; 1 on real boxes",
    )
    add("--l1-first", action="store_true", help="L1 in the first word, not the third")
    add(
        "--offered-zero",
        action="store_true",
        help="word 4 of 0x0F is 0, as once seen",
    )
    add("--extra-registers", action="store_true", help="register 0x04 can be read too")
    add("--turn-round", type=float, default=0.002, metavar="S", help="before a reply")
    add("--boot-time", type=float, default=0.3, metavar="S", help="deaf after a reset")
    add(
        "--id-at-once",
        action="store_true",
        help="a new ID counts before the reset too",
    )
    add(
        "--reset-answer",
        choices=["before", "after", "never"],
        default="before",
        help="when a reset is confirmed",
    )


def _evbox(add: Callable[..., object]) -> None:
    add(
        "--serials",
        type=int,
        nargs="+",
        default=[1923054],
        metavar="N",
        help="serial numbers, of one ChargePoint each",
    )
    add(
        "--modules",
        type=int,
        nargs="+",
        default=[1],
        metavar="N",
        help="for each ChargePoint; 0 occurs",
    )
    add(
        "--max-current",
        type=float,
        default=35.0,
        metavar="A",
        help="maximum of the connection",
    )
    add(
        "--min-current",
        type=float,
        default=6.0,
        metavar="A",
        help="minimum required by each module; 12 occurs",
    )
    add(
        "--min-interval",
        type=int,
        default=1,
        metavar="S",
        help="requests sooner than that are ignored; 20 in the manual",
    )
    add(
        "--commands",
        type=int,
        nargs="+",
        default=[68, 69],
        choices=[68, 69],
        help="those it knows",
    )
    add("--ignore-limit", action="store_true", help="takes orders without effect")


def _setting(text: str) -> tuple[str, int]:
    """Return name and value of a stored setting."""
    name, _, value = text.partition("=")
    return name, int(value)


def _smartevse(add: Callable[..., object]) -> None:
    add(
        "--dialect",
        nargs="+",
        choices=list(DIALECTS),
        default=["2.17"],
        metavar="FIRMWARE",
        help="for each box, of %(choices)s; 2.30+: the development version after 2.30;"
        " 3.00 to 3: five lines of 3.x, of which 3 is the newest",
    )
    add(
        "--load-balance",
        type=int,
        nargs="+",
        default=[0],
        metavar="N",
        help="for each box: 0 off (polled), 1 master, 2 to 8 slaves or nodes; also its"
        " address. A 3.x answers as a node only",
    )
    add(
        "--unit",
        type=int,
        metavar="N",
        help="address with load balancing off, if not the default",
    )
    add(
        "--cables",
        type=int,
        nargs="+",
        default=[16],
        choices=[13, 16, 32, 63],
        help="A, for each box",
    )
    add("--fixed-cable", action="store_true", help="no socket: --max-current counts")
    add("--max-current", type=int, default=13, metavar="A", help="its setting MAX")
    add("--min-current", type=int, default=6, metavar="A", help="its setting MIN")
    add("--mode", type=int, choices=[0, 1, 2], default=0, help="normal, smart, solar")
    add(
        "--serial",
        type=int,
        default=1,
        metavar="N",
        help="of the first box; from 2.30 on",
    )
    add("--no-override", action="store_true", help="takes a current without effect")
    add(
        "--set",
        type=_setting,
        nargs="+",
        default=[],
        metavar="NAME=N",
        help="other stored settings, as in the menu: mains_meter=1 lets a 3.x with load"
        " balancing off ask its meter every 2 s",
    )
    add("--turn-round", type=float, default=0.01, metavar="S", help="before a reply")


def _common(kind: argparse.ArgumentParser) -> None:
    """Add what all kinds of chargers have."""
    add = kind.add_argument_group("cars").add_argument
    add(
        "--cars",
        choices=["auto", "plugged", "none"],
        default="none",
        help="auto: they come and go by themselves",
    )
    for name, about, usual in (
        ("away", "seconds between two visits", CarLife.away),
        ("wants", "energy of a visit, Wh", CarLife.wants_wh),
    ):
        add(
            f"--{name}",
            type=float,
            nargs=2,
            default=usual,
            metavar=("MIN", "MAX"),
            help=about,
        )
    add(
        "--time-scale",
        type=float,
        default=1.0,
        metavar="X",
        help="pace of cars and time-outs, never of the wire",
    )
    add("--seed", type=int, default=0, metavar="N", help="of everything at random")
    add = kind.add_argument_group("port and line").add_argument
    add(
        "--pty", nargs="?", const="", metavar="LINK", help="a pseudo-terminal (default)"
    )
    add("--tcp", type=int, metavar="PORT", help="a TCP port of this machine; 0 = any")
    add("--baud", type=int, metavar="N", help="other than the protocol's")
    add("--parity", choices=["N", "E", "O"], help="other than the protocol's")
    add(
        "--granularity",
        type=float,
        default=0.002,
        metavar="S",
        help="a reply comes in pieces of so many seconds",
    )
    _adapter(kind.add_argument_group("adapter", "what lies between client and wire"))
    _errors(kind.add_argument_group("errors on the line"))
    add = kind.add_argument_group("this program").add_argument
    add(
        "--control",
        action="store_true",
        help="read commands from stdin; they are listed below",
    )
    _program(add)


def _adapter(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "--delay",
        type=float,
        nargs="+",
        default=[0.0],
        action=_OneOrTwo,
        metavar=("S", "S"),
        help="slow: seconds to the chargers, and back; one number: each way",
    )
    add(
        "--jitter",
        type=float,
        default=0.0,
        metavar="S",
        help="each piece up to so much later, in order",
    )
    add(
        "--idle-timeout",
        type=float,
        metavar="S",
        help="closes a connection without traffic",
    )
    add(
        "--gateway",
        choices=get_args(GatewayKind),
        help="expects Modbus TCP in place of passing bytes; what it does with others; "
        "mute: no answer to Modbus TCP either",
    )
    add("--echo", action="store_true", help="echoes the client's bytes")


def _errors(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "--error-rate",
        type=float,
        default=0.0,
        metavar="P",
        help="probability that a byte is damaged, in both directions",
    )
    add(
        "--damage",
        nargs="+",
        choices=DAMAGES,
        default=["flip"],
        help="how: one bit flips, another byte is in its place, it is lost, a byte"
        " comes before it; several: at random",
    )
    for name, about in (
        ("--lose-rate", "probability that a reply is lost"),
        ("--late-rate", "probability that a reply is late"),
    ):
        add(name, type=float, default=0.0, metavar="P", help=about)
    add("--late-by", type=float, default=0.5, metavar="S", help="by how much")
    add(
        "--noise-rate",
        type=float,
        default=0.0,
        metavar="N",
        help="noise bytes per second",
    )
    add(
        "--dead",
        type=int,
        nargs="+",
        default=[],
        metavar="ID",
        help="chargers that answer nothing: IDs, units or serial numbers",
    )


def _program(add: Callable[..., object]) -> None:
    add("--duration", type=float, metavar="S", help="end after S seconds")
    add("--stats", metavar="FILE", help="write the counters as JSON at the end")
    add("--verbose", action="store_true", help="print the state every 5 s")


def _strangers(kind: argparse.ArgumentParser) -> None:
    add = kind.add_argument
    add("--dial", required=True, metavar="HOST:PORT", help="the listener")
    add("--count", type=int, default=12, metavar="N", help="connections at once")
    add(
        "--rate",
        type=float,
        metavar="N",
        help="a crowd: N new connections a second, also beyond --count; the oldest go",
    )
    add(
        "--kind",
        choices=KINDS,
        default="silent",
        help="; ".join(f"{name}: {about}" for name, about in KINDS.items()),
    )
    add("--seed", type=int, default=0, metavar="N", help="of everything at random")
    _program(add)
