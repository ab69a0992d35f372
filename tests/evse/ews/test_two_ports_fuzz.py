"""Two ports, and any events at both of them: the safety rules hold.

The box is the oracle. Beside the events of `test_orders_fuzz`: the configuration
changes, orders expire, the box and the library restart, plugs are locked and unlocked.
"""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field, replace

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import Command, OrderChange

from .scene import EwsScene, play

JUMPER = 32
START, WAITING = 3, 0x30
PORTS = st.sampled_from((1, 2))
WAITS = st.sampled_from((0.0, 0.05, 0.3, 1.0, 3.0, 8.0, 35.0))
GONE = st.sampled_from((0.0, 1.0, 5.0))
"""Time for which the line is gone, s."""
ACTS = st.one_of(
    st.tuples(st.just("off"), st.none()),
    st.tuples(st.just("limit"), st.sampled_from((0.0, 6.0, 10.0, 16.0, 32.0, 80.0))),
    st.tuples(st.just("installation"), st.sampled_from((6.0, 13.0, 25.0))),
    st.tuples(st.just("lifetime"), st.sampled_from((None, 20.0))),
    st.tuples(st.just("fail_safe"), st.sampled_from((0.0, 6.0, 10.0))),
    st.tuples(st.just("car"), st.sampled_from(("come", "leave", "ask", "finish"))),
    st.tuples(st.just("key"), st.just(2)),
    st.tuples(st.just("optimise"), st.booleans()),
    st.tuples(st.just("lock"), st.none()),
    st.tuples(st.just("lose"), st.sampled_from(("rc", "rd", "rs", "sl", "st", "rp"))),
    st.tuples(st.just("deaf"), st.sampled_from(("rc", "sl", "st", "sc"))),
    st.tuples(st.just("line"), GONE),
    st.tuples(st.just("anew"), st.none()),
    st.tuples(st.just("cycle"), st.none()),
    st.tuples(st.just("reset"), st.none()),
)
ON = st.tuples(st.just("on"), st.none())
UNLOCK = st.tuples(st.just("unlock"), st.none())
BEFORE = {"off": OrderChange(allowed=False), "no current": OrderChange(current=0.0)}
BEGINS = st.sampled_from(("free", "charging", *BEFORE))
type Act = tuple[tuple[str, object], int, float]


def acts_of(
    *more: st.SearchStrategy[tuple[str, object]],
) -> st.SearchStrategy[list[Act]]:
    return st.lists(st.tuples(st.one_of(ACTS, *more), PORTS, WAITS), max_size=14)


@dataclass
class Run:
    scene: EwsScene
    lost: list[str] = field(default_factory=list)
    deaf: list[str] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    allowed: dict[int, bool] = field(default_factory=dict)
    """The last permission given by the user to each port."""
    _sent: int = 0

    def __post_init__(self) -> None:
        self.scene.line.mute = lambda name: self._take(self.lost, name)
        self.scene.line.deaf = lambda name: self._take(self.deaf, name)
        self._sent = len(self.scene.line.sent)
        self.scene.watchers.append(self._watch)

    @staticmethod
    def _take(names: list[str], name: str) -> bool:
        if name not in names:
            return False
        names.remove(name)
        return True

    def _watch(self) -> None:
        """Check each order sent since, for the time at which it was sent."""
        sent = self.scene.line.sent
        for one in sent[self._sent :]:
            if one.name == "st":
                self.judge(*one.parameters)
            elif one.name == "sl" and one.parameters[1] == START:
                self.judge_start(one.parameters[0])
        self._sent = len(sent)

    def judge(self, port: int, current: int) -> None:
        most = min(JUMPER, self.scene.charger(port).config.installation_limit)
        if not 6 <= current <= most:
            self.wrong.append(f"port {port}: {current} A, not 6 to {most} A")

    def judge_start(self, port: int) -> None:
        allowed = self.allowed.get(port)
        if allowed is False:
            self.wrong.append(f"port {port} is started, and must not charge")
        elif allowed is None and self.scene.status(port) == WAITING:
            self.wrong.append(f"port {port}: this car has no permission")

    def go(
        self, port: int, act: OrderChange | Command, *, value: object = None
    ) -> None:
        async def say() -> None:
            charger = self.scene.charger(port)
            with suppress(EvseError):
                if isinstance(act, OrderChange):
                    await charger.change_orders(act)
                else:
                    await charger.command(act, value)  # type: ignore[arg-type]

        self.tasks.append(asyncio.ensure_future(say()))

    def act(self, act: str, value: object, port: int) -> None:  # noqa: C901, PLR0912 - a table
        scene = self.scene
        charger, car = scene.charger(port), scene.cars[port - 1]
        match act, value:
            case (("on" | "off"), _):
                self._watch()
                self.allowed[port] = act == "on"
                self.go(port, OrderChange(allowed=act == "on"))
            case "limit", float():
                self.go(port, OrderChange(current=value))
            case "fail_safe", float():
                self.go(port, OrderChange(fail_safe_current=value))
            case "installation", float():
                self._watch()
                charger.reconfigure(replace(charger.config, installation_limit=value))
            case "lifetime", (None | float()) as lifetime:
                charger.reconfigure(replace(charger.config, order_lifetime=lifetime))
            case "car", str():
                names = {"come": car.plug_in, "leave": car.leave}
                names |= {"ask": car.request, "finish": car.finish}
                names[value]()
            case "key", int():
                scene.box.press_key(port, value)
            case "optimise", bool():
                self.go(port, Command.SET_OPTIMISED, value=value)
            case (("lock" | "unlock" | "reset"), _):
                self.go(port, Command[act.upper()])
            case (("lose" | "deaf"), str()):
                (self.lost if act == "lose" else self.deaf).append(value)
            case "line", float():
                scene.unplug(value)
            case "anew", _:
                self.tasks.append(asyncio.ensure_future(self._anew(port)))
            case "cycle", _:
                scene.box.power_cycle(2.0)

    async def _anew(self, port: int) -> None:
        """Restart the library: orders and configuration are all it knows."""
        scene = self.scene
        old = scene.charger(port)
        new = type(old)(old.config, old.orders)
        # Without an await: a port without its charger would get no orders.
        scene.bus._drop_jobs(old, begun=True)
        scene.bus.add(new)
        old.bus = None
        new.on_line_open()


async def begin_as(scene: EwsScene, begin: str, port: int) -> None:
    if begin != "free":
        await scene.charge(port)
    if begin in BEFORE:
        await scene.charger(port).change_orders(BEFORE[begin])


def judged(acts: list[Act], *, pause_status: int, flag: str, begin: str) -> EwsScene:
    async def happens(scene: EwsScene) -> None:
        for port in scene.box.ports:
            port.pause_status = pause_status  # type: ignore[assignment]
            await begin_as(scene, begin, port.number)
        begun = [len(scene.starts(port)) for port in (1, 2)]
        run = Run(scene)
        if begin == "off":
            run.allowed = {1: False, 2: False}
        for (act, value), port, wait in acts:
            run.act(act, value, port)
            await asyncio.sleep(wait)
        run.lost.clear()
        run.deaf.clear()
        await asyncio.sleep(90)
        assert not run.wrong
        names = [act for (act, _), *_ in acts]
        for number, port in enumerate(scene.box.ports, start=1):
            assert not port.history.unlocked_under_power
            unlocked = [one for one in scene.unlocked(number) if one == "sl 6"]
            if "unlock" not in names:
                assert not unlocked
                assert "sl 1" not in scene.unlocked(number)
            if "on" not in names and begin == "free":
                assert len(scene.starts(number)) == begun[number - 1]
            charger = scene.charger(number)
            if charger.setpoint.paused:
                assert port.status not in (0x40, 0x41)
            else:
                assert port.limit == charger.setpoint.current
        await asyncio.gather(*run.tasks)

    options = {"restart_flag_until": flag}
    return play(EwsScene(installation=25.0, options=options, fail_safe=0.0), happens)


PAUSES = st.sampled_from((0x50, 0x42))
FLAGS = st.sampled_from(("read", "clock", "never"))


@pytest.mark.slow
@settings(max_examples=40)
@given(acts=acts_of(ON), pause_status=PAUSES, flag=FLAGS, begin=BEGINS)
def test_nothing_is_unlocked_without_an_order(
    acts: list[Act], pause_status: int, flag: str, begin: str
) -> None:
    judged(acts, pause_status=pause_status, flag=flag, begin=begin)


@pytest.mark.slow
@settings(max_examples=40)
@given(acts=acts_of(UNLOCK), pause_status=PAUSES, flag=FLAGS)
def test_nothing_is_started_without_an_order(
    acts: list[Act], pause_status: int, flag: str
) -> None:
    judged(acts, pause_status=pause_status, flag=flag, begin="free")
