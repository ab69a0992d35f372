"""The charger of the Sextant S6."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final, override

from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.conversation import FollowUp, rest
from custom_components.evse_bus.evse.errors import (
    ExchangeRefusedError,
    NotConfirmedError,
    WrongChargerError,
)
from custom_components.evse_bus.evse.exchange import Request, Turn
from custom_components.evse_bus.evse.framing import Timing
from custom_components.evse_bus.evse.model import (
    Capability,
    ChargerConfig,
    Limits,
    OrderChange,
    Orders,
    Status as ChargerStatus,
)
from custom_components.evse_bus.evse.readings import (
    ChargerInfo,
    ChargerReading,
    ConnectorReading,
)
from custom_components.evse_bus.evse.safety import clamp

from .frames import (
    IDENTITY,
    LAMP,
    LIMIT,
    REFUSED,
    STATUS,
    Identity,
    SextantFrame,
    Status,
    decode_identity,
    decode_status,
    encode,
    encode_limit,
)

TIMING: Final = Timing(reply_timeout=0.2, longest_reply=64)

_STATES: Final = {
    "A": ChargerStatus.AVAILABLE,
    "B": ChargerStatus.PREPARING,
    "C": ChargerStatus.CHARGING,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SextantConfig(ChargerConfig):
    """A Sextant S6; its address is set by a dial on the box."""

    live: ClassVar = ChargerConfig.live | {"lamp"}

    lamp: int = 40
    """Brightness of its lamp, %."""


class SextantRefusedError(ExchangeRefusedError):
    """The box refuses: its key switch is off."""

    def __init__(self, code: str) -> None:
        super().__init__(f"refused: {code}", int(code))
        self.text_key = "sextant_key_switch"


async def ask(turn: Turn, address: int, letter: str, request: Request) -> str:
    """Return the payload of the reply; raises SextantRefusedError."""

    def accept(frame: SextantFrame) -> str | None:
        if frame.address != address:
            return None
        if frame.letter == REFUSED:
            raise SextantRefusedError(frame.payload)
        return frame.payload if frame.letter == letter.lower() else None

    return await turn.exchange(request, accept)


async def read_identity(turn: Turn, address: int) -> Identity:
    return decode_identity(
        await ask(turn, address, IDENTITY, encode(address, IDENTITY))
    )


def charger_info(identity: Identity) -> ChargerInfo:
    return ChargerInfo(
        manufacturer="Sextant",
        model="S6",
        serial=identity.serial,
        firmware=identity.firmware,
        options={"owner": identity.owner},
    )


class SextantCharger(Charger[SextantConfig]):
    """One Sextant S6."""

    timing = TIMING

    def __init__(self, config: SextantConfig, orders: Orders) -> None:
        super().__init__(config, orders)
        self._identity: Identity | None = None

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        return frozenset(
            {
                Capability.STATUS,
                Capability.CURRENT,
                Capability.ENERGY,
                Capability.OFFERED_CURRENT,
            }
        )

    @property
    @override
    def limits(self) -> Limits:
        known = self._identity
        return Limits(
            installation=self.config.installation_limit,
            reports_maximum=True,
            reported=None if known is None else known.maximum_current,
        )

    @property
    @override
    def longest_request(self) -> int:
        return len(encode(1, LIMIT, "9999"))

    @property
    @override
    def exchanges_per_turn(self) -> int:
        return 2

    @override
    def on_line_open(self) -> None:
        self._identity = None

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        await self._check(turn)
        status = await self._read(turn)
        if status.lamp != self.config.lamp or status.limit != self.setpoint.current:
            return FollowUp(self._correct)
        return None

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        await self._check(turn)
        await self._send_limit(turn, lambda: self.order_to_send(change))
        await rest()
        wanted = clamp(self.order_to_send(change), self.limits).current
        if (await self._read(turn)).limit != wanted:
            raise NotConfirmedError(self.config.name)

    async def _check(self, turn: Turn) -> None:
        """Read the identity once; raises WrongChargerError for another box."""
        if self._identity is not None:
            return
        identity = await read_identity(turn, self.config.address)
        if (expected := self.config.serial) not in (None, identity.serial):
            message = f"{identity.serial} answers instead of {expected}"
            raise WrongChargerError(message, expected=expected, found=identity.serial)
        self._identity = identity
        self.info = charger_info(identity)

    async def _read(self, turn: Turn) -> Status:
        address = self.config.address
        status = decode_status(
            await ask(turn, address, STATUS, encode(address, STATUS))
        )
        current = status.current
        self.reading = ChargerReading(
            connectors={
                1: ConnectorReading(
                    status=_STATES[status.state],
                    current=(current, current, current),
                    energy=float(status.energy),
                )
            },
            offered_current=status.limit,
        )
        return status

    async def _correct(self, turn: Turn) -> None:
        address, lamp = self.config.address, str(self.config.lamp)
        await ask(turn, address, LAMP, encode(address, LAMP, lamp))
        await rest()
        await self._send_limit(turn, lambda: self.effective_orders)
        await rest()
        await self._read(turn)
        self.updated()

    async def _send_limit(self, turn: Turn, orders: Callable[[], Orders]) -> None:
        address = self.config.address
        await ask(
            turn,
            address,
            LIMIT,
            lambda: encode_limit(address, clamp(orders(), self.limits)),
        )
