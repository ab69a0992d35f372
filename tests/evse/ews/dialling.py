"""A listener and boxes that dial it, in real time."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
import socket

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.ews.charger import EwsPort
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.ews.network.listener import Listener
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from tests.simulated_time import now, simulate
from tests.virtual.ews_box import EwsBox as VirtualBox
from tests.virtual.ews_dialler import EwsDialler

SERIAL = "012345678901"
RETRY = 0.05
HOST = "127.0.0.1"


def run(scene: Callable[[], object]) -> None:
    simulate(scene())  # type: ignore[arg-type]


async def until(condition: Callable[[], object], patience: float = 8.0) -> None:
    end = now() + patience
    while not condition():
        assert now() < end, "it never happened"
        await asyncio.sleep(0.01)


@asynccontextmanager
async def server(**options: object) -> AsyncIterator[Listener]:
    made = Listener(HOST, 0, **options)  # type: ignore[arg-type]
    await made.start()
    try:
        yield made
    finally:
        await made.stop()


@asynccontextmanager
async def expected(
    made: Listener, serial: str = SERIAL, ports: tuple[int, ...] = (1, 2)
) -> AsyncIterator[Bus]:
    bus = made.register(serial)
    for port in ports:
        bus.add(
            EwsPort(
                EwsPortConfig(
                    key=f"{serial}-{port}",
                    name=f"{serial} {port}",
                    address=port,
                    serial=serial,
                    installation_limit=16.0,
                    poll_interval=0.5,
                ),
                Orders(limit=CurrentLimit(current=16.0)),
            )
        )
    await bus.start()
    try:
        yield bus
    finally:
        await made.unregister(serial)


@contextmanager
def dialling(made: Listener, box: VirtualBox | None = None) -> Iterator[EwsDialler]:
    with EwsDialler(
        box or VirtualBox(serial=SERIAL),
        HOST,
        made.port,
        retry=RETRY,
        source_ports=0,
        own_thread=False,
    ) as dialler:
        yield dialler


def first(bus: Bus) -> EwsPort:
    port = next(iter(bus.chargers.values()))
    assert isinstance(port, EwsPort)
    return port


def has_reading(bus: Bus) -> bool:
    return all(one.available and one.reading for one in bus.chargers.values())


async def goes(client: socket.socket, patience: float = 3.0) -> bool:
    """Return whether the connection is ended by the other end."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(patience):
            while True:
                if not await loop.sock_recv(client, 4096):
                    return True
    except TimeoutError:
        return False
    except OSError:
        return True


@contextmanager
def silent_client(made: Listener) -> Iterator[socket.socket]:
    with socket.create_connection((HOST, made.port)) as client:
        client.setblocking(False)  # noqa: FBT003 - the call takes no keyword
        yield client
