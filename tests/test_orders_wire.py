"""Orders through restarts, as an EVBox gets them: its first frame imposes them.

The oracle is the wire: no frame ever has more current than the user's last order, and
none has any after "stop", whatever happens to the disk. Library, store and ChargePoint
run in simulated time, the planned retries included.
"""

import asyncio
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

from homeassistant.core import HomeAssistant
from hypothesis import example, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxCharger, EvboxConfig
from custom_components.evse_bus.evse.evbox.frames import EvboxFramer
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from custom_components.evse_bus.stores import orders as module
from custom_components.evse_bus.stores.orders import ORDERS_KEY, OrderStore, stopped
from tests.evse.evbox.scene import EvboxLine
from tests.simulated_time import simulate
from tests.test_orders_fuzz import Disk, DiskFile
from tests.virtual import EvboxChargePoint

KEY = "serial:evbox_1923054"
FIRST = Orders(limit=CurrentLimit(current=7.0), fail_safe=CurrentLimit(current=7.0))
CONFIG = EvboxConfig(
    key="box",
    name="box",
    address=1923054,
    installation_limit=32.0,
    poll_interval=5.0,
)


def effective(orders: Orders) -> float:
    """Return the current that orders allow, A."""
    return 0.0 if orders.allowed is False else orders.limit.current


@dataclass(frozen=True)
class Running:
    """One life of Home Assistant."""

    store: OrderStore
    line: EvboxLine
    bus: Bus
    charger: EvboxCharger


class House:
    def __init__(self) -> None:
        self.hass = HomeAssistant("")
        self.box = EvboxChargePoint(1923054, 1, min_interval=0)
        self.disk = DiskFile.disk = Disk(latency=0.02)
        self.life: Running | None = None
        self.word = FIRST
        self.allowed = effective(FIRST)
        """The highest current that the last orders of the user allow, A."""

    async def start(self) -> None:
        store = OrderStore(self.hass)
        await store.async_load()
        orders = await store.async_begin((KEY,), FIRST, stopped(FIRST))
        if orders is None:
            store._next_write.cancel()
            return
        assert effective(orders) <= self.allowed
        self.word = orders
        self.allowed = effective(orders)
        line = EvboxLine(self.box)
        bus = Bus(line, EvboxFramer(), PROTOCOL.timing, "simulated")
        charger = EvboxCharger(CONFIG, orders)
        charger.standing_orders.commit = lambda orders: store.async_commit(KEY, orders)
        bus.add(charger)
        self.life = Running(store, line, bus, charger)
        await bus.start()

    async def crash(self) -> None:
        """Kill Home Assistant: what it was writing does not reach the disk."""
        if self.life is None:
            return
        # The old life keeps the old disk, whose power is gone.
        dead, self.disk = self.disk, copy(self.disk)
        dead.steps_left = 0
        for file in (self.life.store._orders_file, self.life.store._known_file):
            file.disk = dead  # type: ignore[attr-defined]
        DiskFile.disk = self.disk
        self.disk.files = dict(dead.files)
        self.life.store._next_write.cancel()
        self.check()
        life, self.life = self.life, None
        await life.bus.stop()

    def check(self) -> None:
        """Compare all frames since the last check with the user's last order."""
        assert self.life is not None
        for sent in self.life.line.sent:
            assert max(sent.order.limits) <= self.allowed
        self.life.line.sent.clear()

    async def order(
        self,
        *,
        gives_up_after: float | None,
        **change: Any,  # noqa: ANN401 - fields of an `OrderChange`
    ) -> None:
        if self.life is None:
            return
        self.check()
        before = self.allowed
        self.word = OrderChange(**change).apply(self.word)
        self.allowed = max(effective(self.word), before)
        action = asyncio.create_task(self._order(self.life, OrderChange(**change)))
        await asyncio.wait({action}, timeout=gives_up_after)
        if action.done():
            action.result()
            # From its return on the order counts, and nothing else.
            self.life.line.sent.clear()
            self.allowed = effective(self.word)
        else:
            await self.crash()
            action.cancel()
            await asyncio.wait({action})

    async def _order(self, life: Running, change: OrderChange) -> None:
        with suppress(EvseError):
            await life.charger.change_orders(change)

    async def wait(self, seconds: float) -> None:
        await asyncio.sleep(seconds)
        if self.life is not None:
            self.check()

    async def set_disk(self, state: str) -> None:
        self.disk.full = state in ("full", "late")
        self.disk.late = state == "late"

    async def stop(self) -> None:
        if self.life is not None:
            await self.life.store.async_flush()
            await self.crash()

    async def lose(self) -> None:
        await self.crash()
        self.disk.files.pop(ORDERS_KEY, None)


async def live(state: str, sequence: list[tuple[str, dict[str, Any]]]) -> None:
    house = House()
    await house.set_disk(state)
    await house.start()
    for name, arguments in sequence:
        await getattr(house, name)(**arguments)
        if house.life is None:
            await house.start()
    # Nobody orders anything more: in time all is stored, and survives a crash.
    await house.set_disk("good")
    if house.life is None:
        await house.start()
    await house.wait(400)
    assert house.life is not None
    stands = house.life.charger.orders
    await house.crash()
    await house.start()
    await house.wait(10)
    assert house.life is not None
    assert house.life.charger.orders == stands
    await house.crash()


times = st.none() | st.sampled_from([0.0, 0.01, 0.03, 0.05, 0.2])
currents = st.sampled_from([0.0, 6.0, 9.0, 12.0, 16.0, 25.0])
operations = st.one_of(
    st.tuples(
        st.just("order"),
        st.fixed_dictionaries({"current": currents, "gives_up_after": times}),
    ),
    st.tuples(
        st.just("order"),
        st.fixed_dictionaries({"allowed": st.booleans(), "gives_up_after": times}),
    ),
    st.tuples(
        st.just("set_disk"),
        st.fixed_dictionaries({"state": st.sampled_from(["good", "full", "late"])}),
    ),
    st.tuples(
        st.just("wait"),
        st.fixed_dictionaries({"seconds": st.sampled_from([0.5, 6.0, 30.0])}),
    ),
    st.tuples(st.just("crash"), st.just({})),
    st.tuples(st.just("stop"), st.just({})),
    st.tuples(st.just("lose"), st.just({})),
)


def order(**change: object) -> tuple[str, dict[str, Any]]:
    return ("order", {"gives_up_after": None, **change})


WAIT = ("wait", {"seconds": 6.0})
FULL = ("set_disk", {"state": "full"})
CRASH: tuple[str, dict[str, Any]] = ("crash", {})


@given(st.sampled_from(["good", "full"]), st.lists(operations, max_size=15))
@settings(max_examples=50)
@example(
    "good", [WAIT, order(current=25.0), WAIT, FULL, order(current=9.0), CRASH, WAIT]
)
@example("good", [WAIT, order(allowed=False), ("lose", {}), WAIT])
@example("full", [order(allowed=False), CRASH, WAIT])
def test_no_frame_ever_has_more_than_the_user_ordered(
    state: str, sequence: list[tuple[str, dict[str, Any]]]
) -> None:
    with patch.object(module, "StoredFile", DiskFile):
        simulate(live(state, sequence))


@pytest.mark.parametrize("pause", [1.0, 20.0])
def test_a_refused_lowering_is_written_by_itself(pause: float) -> None:
    async def scene() -> None:
        house = House()
        await house.start()
        await house.wait(6)
        await house.order(current=25.0, gives_up_after=None)
        await house.wait(6)
        await house.set_disk("full")
        await house.order(current=9.0, gives_up_after=None)
        await house.wait(pause)
        assert ORDERS_KEY not in house.disk.files
        await house.set_disk("good")
        await house.wait(2 * pause + 10)
        assert '"current": 9.0' in house.disk.files[ORDERS_KEY]
        await house.crash()

    with patch.object(module, "StoredFile", DiskFile):
        simulate(scene())
