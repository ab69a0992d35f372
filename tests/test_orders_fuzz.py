"""Orders on a disk that is full, read-only, lost, or loses its power at any step.

The oracle: after a restart never more current, nor more permission, than the user's
last order. The disk is one of the test's own; it shares no code with the integration.
"""

import asyncio
from collections.abc import Awaitable
from dataclasses import dataclass, field, replace
import json
from typing import Any
from unittest.mock import patch

from homeassistant.core import HomeAssistant
from hypothesis import example, given, strategies as st

from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from custom_components.evse_bus.evse.safety import cautious
from custom_components.evse_bus.stores import orders as module
from custom_components.evse_bus.stores.orders import (
    KNOWN_KEY,
    ORDERS_KEY,
    OrderStore,
    SupplyOrder,
    allows_more,
    stopped,
)

SERIAL = "serial:abl_1"
RANK = {False: 0, None: 1, True: 2}


class PowerFailure(BaseException):
    """Home Assistant is killed here."""


@dataclass
class Disk:
    files: dict[str, str] = field(default_factory=dict)
    full: bool = False
    late: bool = False
    """A write that fails has replaced the file all the same."""
    read_only: bool = False
    latency: float = 0.0
    """s"""
    steps_left: int | None = None
    """Steps until the power fails."""

    def step(self) -> None:
        if self.steps_left is not None:
            self.steps_left -= 1
            if self.steps_left < 0:
                raise PowerFailure

    async def read(self, key: str) -> dict[str, Any] | None:
        await asyncio.sleep(self.latency)
        text = self.files.get(key)
        return None if text is None else dict(json.loads(text))

    async def write(self, key: str, data: dict[str, Any]) -> Exception | None:
        await asyncio.sleep(self.latency)
        self.step()
        refused = self.full or self.read_only
        if not refused or (self.late and not self.read_only):
            self.files[key] = json.dumps(data)
        self.step()
        return OSError(28, "No space left on device") if refused else None

    async def remove(self, key: str) -> None:
        await asyncio.sleep(self.latency)
        self.step()
        if self.read_only:
            raise OSError(30, "Read-only file system")
        self.files.pop(key, None)
        self.step()


class DiskFile:
    """Stands in for a file in the storage folder of Home Assistant."""

    disk: Disk

    def __init__(self, _hass: HomeAssistant, key: str) -> None:
        self.key = key

    async def async_load(self) -> dict[str, Any] | None:
        return await self.disk.read(self.key)

    async def async_write(self, data: dict[str, Any]) -> Exception | None:
        return await self.disk.write(self.key, data)

    async def async_remove(self) -> None:
        await self.disk.remove(self.key)


class House:
    """One charger, its user, and a Home Assistant that comes and goes."""

    def __init__(self, hass: HomeAssistant, *, has_serial: bool) -> None:
        self.hass = hass
        self.disk = DiskFile.disk = Disk()
        self.store: OrderStore | None = None
        self.owner = "one"
        self.has_serial = has_serial
        self.first = Orders(limit=CurrentLimit(current=6.0))
        self.firsts = [self.first]
        """Of all times it was added: not even those need have been stored."""
        self.orders: Orders | None = None
        """As the charger has them; ``None``: not started."""
        self.requested = self.first
        self.words: list[Orders] = []
        """What the user may have ordered last; empty: the charger was never started.

        More than one after a power failure, or while the disk takes nothing at all.
        """

    @property
    def keys(self) -> tuple[str, ...]:
        own = f"subentry:{self.owner}"
        return (SERIAL, own) if self.has_serial else (own,)

    # -- Home Assistant ----------------------------------------------------------

    async def until_failure(self, action: Awaitable[object]) -> bool:
        """Do something; return whether the power failed in the middle."""
        try:
            await action
        except PowerFailure:
            self.down()
            return True
        return False

    def down(self) -> None:
        if self.store is not None:
            self.store._next_write.cancel()
        self.store = self.orders = None
        self.disk.steps_left = None

    async def start(self, steps_left: int | None = None) -> None:
        self.disk.steps_left = steps_left
        if not await self.until_failure(self._start()):
            self.disk.steps_left = None

    async def _start(self) -> None:
        self.store = OrderStore(self.hass)
        await self.store.async_load()
        await self._begin()

    async def _begin(self) -> None:
        assert self.store is not None
        orders = await self.store.async_begin(
            self.keys, self.first, stopped(self.first), owner=self.owner
        )
        if orders is None:
            # Only what cannot be stored is not started.
            assert self.disk.full or self.disk.read_only
            return
        assert isinstance(orders, Orders)
        self.check(orders, lost=self.store.is_lost(self.keys[0]))
        self.orders = self.requested = orders
        if not self.disk.read_only:
            self.words = []
        self.words.append(orders)

    def check(self, orders: Orders, *, lost: bool) -> None:
        if not self.words:
            assert any(not allows_more(orders, one) for one in self.firsts)
            return
        highest = max(RANK[word.allowed] for word in self.words)
        assert RANK[orders.allowed] <= highest
        if lost:
            assert orders.allowed is False
            return
        assert orders.limit.current <= max(word.limit.current for word in self.words)
        assert orders.fail_safe.current <= max(
            word.fail_safe.current for word in (*self.words, self.first)
        )

    async def crash(self, steps_left: int | None) -> None:
        self.down()
        await self.start(steps_left)

    async def timer(self, steps_left: int | None) -> None:
        """Let a write happen that was planned."""
        if self.store is not None:
            self.disk.steps_left = steps_left
            if not await self.until_failure(self.store.async_flush()):
                self.disk.steps_left = None

    async def set_disk(self, state: str) -> None:
        self.disk.read_only = state == "read-only"
        self.disk.full = state in ("full", "late")
        self.disk.late = state == "late"

    async def lose_orders(self, how: str) -> None:
        self.down()
        self.spoil(ORDERS_KEY, how)
        await self.start()

    async def lose_known(self, how: str) -> None:
        """Lose the other file; never both, on a disk that works otherwise."""
        if self.orders is None or self.store is None:
            return
        await self.set_disk("good")
        await self.store.async_flush()
        self.down()
        self.spoil(KNOWN_KEY, how)
        await self.start()

    def spoil(self, key: str, how: str) -> None:
        if how == "gone":
            self.disk.files.pop(key, None)
        elif key in self.disk.files:
            self.disk.files[key] = how

    async def stop(self) -> None:
        """Stop cleanly; then, on a good disk, nothing is lost."""
        if self.store is None:
            return
        await self.store.async_flush()
        stands = self.orders
        self.down()
        await self.start()
        if stands is not None and not (self.disk.full or self.disk.read_only):
            assert self.orders == stands

    # -- The user ----------------------------------------------------------------

    async def change(
        self, change: OrderChange, *, confirmed: bool, steps_left: int | None
    ) -> None:
        if self.orders is None:
            return
        before = self.words
        self.requested = change.apply(self.requested)
        self.words = [self.requested]
        if self.disk.read_only:
            self.words += before
        self.disk.steps_left = steps_left
        if await self.until_failure(self._change(change, confirmed=confirmed)):
            self.words += before
        self.disk.steps_left = None

    async def _change(self, change: OrderChange, *, confirmed: bool) -> None:
        """Do as a charger of the library does."""
        assert self.orders is not None
        assert self.store is not None
        lowered = cautious(self.orders, change.apply(self.orders))
        if lowered != self.orders:
            self.orders = lowered
            await self.store.async_commit(self.keys[0], lowered)
        if confirmed:
            stands = cautious(change.apply(self.orders), self.requested)
            if stands != self.orders:
                self.orders = stands
                await self.store.async_commit(self.keys[0], stands)

    async def learn_serial(self, steps_left: int | None) -> None:
        if self.orders is None or self.has_serial or self.store is None:
            return
        old = self.keys[0]
        self.has_serial = True
        moved = self.store.move(self.keys, old, self.owner)
        assert moved is not None
        # The box may have been known before, with lower orders.
        assert not allows_more(moved, self.orders)
        self.orders = self.requested = cautious(self.orders, moved)
        self.words.append(self.orders)
        self.disk.steps_left = steps_left
        if not await self.until_failure(self.store.async_flush()):
            self.disk.steps_left = None

    async def add_again(self, fail_safe: float) -> None:
        """Remove the charger and add it again, perhaps on another bus."""
        if self.store is None or not self.has_serial:
            return
        await self.store.async_forget(self.keys)
        self.owner += "+"
        self.first = Orders(
            limit=CurrentLimit(current=fail_safe),
            fail_safe=CurrentLimit(current=fail_safe),
        )
        self.firsts += [
            self.first,
            *(replace(one, fail_safe=self.first.fail_safe) for one in self.firsts),
        ]
        known_before = self.orders
        self.orders = None
        self.words = [
            replace(one, fail_safe=self.first.fail_safe) for one in self.words
        ]
        await self._begin()
        if self.orders is None:
            # The disk has nothing of it: it stays a new charger.
            self.words = []
        elif known_before is not None:
            assert self.orders.limit == known_before.limit
            assert self.orders.allowed == known_before.allowed


amperes = st.sampled_from([0.0, 4.0, 6.0, 8.0, 12.0, 16.0])
steps = st.none() | st.integers(0, 4)
changes = st.builds(
    OrderChange,
    allowed=st.sampled_from([None, None, True, False]),
    current=st.none() | amperes,
    fail_safe_current=st.none() | amperes,
)
states = st.sampled_from(["good", "full", "late", "read-only"])
type Operation = tuple[str, dict[str, Any]]


def operation(name: str, **arguments: Any) -> st.SearchStrategy[Operation]:  # noqa: ANN401
    """Return a strategy for calls of a method of `House`."""
    return st.tuples(st.just(name), st.fixed_dictionaries(arguments))


operations = st.one_of(
    operation("change", change=changes, confirmed=st.booleans(), steps_left=steps),
    operation("set_disk", state=states),
    operation("timer", steps_left=steps),
    operation("stop"),
    operation("crash", steps_left=steps),
    operation("lose_orders", how=st.sampled_from(["gone", "[1]", '{"a": 1}', "{"])),
    operation("lose_known", how=st.sampled_from(["gone", "[1]", "{"])),
    operation("learn_serial", steps_left=steps),
    operation("add_again", fail_safe=amperes),
)


async def live(house: House, state: str, sequence: list[Operation]) -> None:
    await house.set_disk(state)
    await house.start()
    for name, arguments in sequence:
        await getattr(house, name)(**arguments)
        if house.store is None:
            await house.start()
    # In the end everything is stored, and a restart changes nothing.
    await house.set_disk("good")
    if house.orders is None:
        house.down()
        await house.start()
    await house.stop()
    assert house.orders is not None


def order(**change: Any) -> Operation:  # noqa: ANN401
    arguments = {"change": OrderChange(**change), "confirmed": True}
    return ("change", {**arguments, "steps_left": None})


def disk(state: str) -> Operation:
    return ("set_disk", {"state": state})


CRASH: Operation = ("crash", {"steps_left": None})
WRITTEN: Operation = ("timer", {"steps_left": None})
HIGH, LOW = order(current=16.0), order(current=8.0)


@given(
    sequence=st.lists(operations, max_size=25),
    has_serial=st.booleans(),
    state=states,
)
@example(
    sequence=[HIGH, WRITTEN, disk("full"), LOW, disk("good"), ("stop", {})],
    has_serial=True,
    state="good",
)
@example(
    sequence=[HIGH, WRITTEN, disk("full"), LOW, CRASH], has_serial=True, state="good"
)
@example(
    sequence=[disk("late"), HIGH, WRITTEN, disk("full"), LOW, CRASH],
    has_serial=True,
    state="good",
)
@example(sequence=[order(allowed=False), CRASH], has_serial=True, state="full")
@example(
    sequence=[order(allowed=False), ("lose_orders", {"how": "gone"})],
    has_serial=True,
    state="good",
)
def test_a_restart_never_allows_more_than_the_user(
    *, sequence: list[Operation], has_serial: bool, state: str
) -> None:
    async def run() -> None:
        hass = HomeAssistant("")
        await live(House(hass, has_serial=has_serial), state, sequence)

    with patch.object(module, "StoredFile", DiskFile):
        asyncio.run(run())


@given(changes, changes)
def test_what_allows_more_is_what_a_lowering_changes(
    one: OrderChange, two: OrderChange
) -> None:
    start = Orders(limit=CurrentLimit(current=10.0))
    first, second = one.apply(start), two.apply(start)
    expected = (
        first.limit.current > second.limit.current
        or first.fail_safe.current > second.fail_safe.current
        or (second.allowed is False and first.allowed is not False)
    )
    assert allows_more(first, second) == expected
    assert allows_more(SupplyOrder(1.0), first)
