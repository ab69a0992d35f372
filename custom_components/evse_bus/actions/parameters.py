"""Actions for what is set in an EWS-Box: one table for each block of parameters.

A table says by which names people change what stands in a block. Bits have names of
their own; those that are not named stay as they are, whatever the box has made of
them meanwhile. Passwords go to the box and never come back.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Final

from ..errors import ActionError, wrong_action
from ..evse.ews.parameters import (
    EXTRA_BLOCK,
    INSTALLATION_BLOCK,
    SOURCE_PORTS,
    SYSTEM_BLOCK,
    USER_BLOCK,
    Block,
    CableMode,
    LockType,
    SystemMode,
    TimeZone,
)
from .fields import (
    Check,
    address,
    limit,
    netmask,
    option,
    pin,
    secret,
    switch,
    text,
    whole,
)

if TYPE_CHECKING:
    from homeassistant.util.json import JsonObjectType, JsonValueType

    from ..evse.ews import EwsPort
    from ..evse.ews.box import Dhcp

CONF_BLOCK: Final = "block"
SECRETS: Final = "secrets"
"""Where a response says whether passwords were told: never the passwords."""
DHCP: Final = "dhcp"

LOCK_TYPES: Final = {kind.name.lower(): kind for kind in LockType}
TIME_ZONES: Final = {zone.name.lower(): zone for zone in TimeZone}
_PASSWORD_LENGTH: Final = 12
_PULSES: Final = 0xFFFFFFFF
_WORD: Final = 0xFFFF
_BYTE: Final = 0xFF


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One field of an action, and where it stands in the box."""

    key: str
    """Its name in the action, and in the library unless `name` says otherwise."""
    check: Check[Any]
    name: str = ""
    bit: IntFlag | None = None
    """The one bit of the library's field that it is."""
    show: Callable[[Any], JsonValueType] | None = None
    """What a response says; ``None``: the value as it is."""

    @property
    def within(self) -> str:
        """Return the library's field that it is, or is a bit of."""
        return self.name or self.key

    def response(self, told: object) -> JsonValueType:
        """Return what a block that was read says of it."""
        value: Any = getattr(told, self.within)
        if self.bit is not None:
            return self.bit in value
        return value if self.show is None else self.show(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionBlock[T]:
    """One block of parameters, as actions read and write it."""

    block: Block[T]
    parameters: tuple[Parameter, ...]
    codes: tuple[str, ...] = ()
    """The library's fields of which a response tells the number as well.

    A box may know more of them than its manual.
    """

    def changes(
        self, given: Mapping[str, object]
    ) -> Callable[[T], Mapping[str, object]]:
        """Return what makes the changes that are meant, of what stands in the box.

        Raises ServiceValidationError for what cannot be meant.
        """
        whole_fields: dict[str, object] = {}
        bits: dict[str, dict[IntFlag, bool]] = {}
        for parameter in self.parameters:
            if parameter.key not in given:
                continue
            value = parameter.check(parameter.key, given[parameter.key])
            if parameter.bit is None:
                whole_fields[parameter.within] = value
            else:
                bits.setdefault(parameter.within, {})[parameter.bit] = value
        if not whole_fields and not bits:
            raise wrong_action(ActionError.NOTHING_TO_CHANGE)
        return lambda told: (
            whole_fields
            | {
                name: _with_bits(getattr(told, name), changed)
                for name, changed in bits.items()
            }
        )

    def response(self, told: T) -> JsonObjectType:
        """Return a block that was read, without its secrets."""
        secrets = self.block.secrets_told(told)
        response: JsonObjectType = {
            parameter.key: parameter.response(told)
            for parameter in self.parameters
            if parameter.within not in self.block.secrets
        }
        if self.codes:
            response["codes"] = {name: int(getattr(told, name)) for name in self.codes}
        if secrets:
            response[SECRETS] = {name: how.value for name, how in secrets.items()}
        return response


def _with_bits(flags: IntFlag, changed: Mapping[IntFlag, bool]) -> IntFlag:
    """Return flags with some bits changed, those that nobody knows kept."""
    # With plain numbers, because `flags & ~bit` drops what is no member.
    value = int(flags)
    for bit, on in changed.items():
        value = value | int(bit) if on else value & ~int(bit)
    return type(flags)(value)


def _word_for(options: Mapping[str, int]) -> Callable[[int], str | None]:
    """Return what names a number; ``None`` for one that is not in the manual."""
    words = {int(value): word for word, value in options.items()}
    return words.get


SYSTEM: Final = ActionBlock(
    block=SYSTEM_BLOCK,
    codes=("mode", "lock_type", "cable_mode"),
    parameters=(
        Parameter(key="admin_password", check=secret(_PASSWORD_LENGTH)),
        Parameter(key="card_pin", check=pin),
        Parameter(key="ports", check=whole(1, 2)),
        Parameter(key="server_mode", check=switch, name="mode", bit=SystemMode.SERVER),
        Parameter(key="rs232_server", check=switch, name="mode", bit=SystemMode.RS232),
        Parameter(
            key="card_authentication", check=switch, name="mode", bit=SystemMode.CARDS
        ),
        Parameter(
            key="manual_keys_and_leds",
            check=switch,
            name="mode",
            bit=SystemMode.MANUAL_IO,
        ),
        Parameter(
            key="exclusive_ports", check=switch, name="mode", bit=SystemMode.EXCLUSIVE
        ),
        Parameter(key="maximum_current", check=limit),
        Parameter(
            key="fixed_cable",
            check=switch,
            name="cable_mode",
            bit=CableMode.FIXED_CABLE,
        ),
        Parameter(
            key="mode_1_port_1",
            check=switch,
            name="cable_mode",
            bit=CableMode.PORT_1_MODE_1,
        ),
        Parameter(
            key="mode_1_port_2",
            check=switch,
            name="cable_mode",
            bit=CableMode.PORT_2_MODE_1,
        ),
        Parameter(
            key="lock_type", check=option(LOCK_TYPES), show=_word_for(LOCK_TYPES)
        ),
        Parameter(key="ventilation", check=switch),
        Parameter(key="restart_after_power_failure", check=switch),
        Parameter(key="pulses_per_kwh", check=whole(1, _PULSES)),
    ),
)
NETWORK: Final = ActionBlock(
    block=USER_BLOCK,
    codes=("zone_code",),
    parameters=(
        Parameter(key="user_password", check=secret(_PASSWORD_LENGTH)),
        Parameter(key="address", check=address, show=str),
        Parameter(key="netmask", check=netmask, show=str),
        Parameter(key="gateway", check=address, show=str),
        Parameter(key="server", check=address, show=str),
        Parameter(key="server_port", check=whole(0, _WORD)),
        Parameter(key="source_port", check=whole(0, _WORD + 1 - SOURCE_PORTS)),
        Parameter(
            key="time_zone",
            check=option(TIME_ZONES),
            name="zone_code",
            show=_word_for(TIME_ZONES),
        ),
        Parameter(key="language", check=whole(0, _BYTE)),
    ),
)
INSTALLATION: Final = ActionBlock(
    block=INSTALLATION_BLOCK,
    parameters=(
        Parameter(key="name", check=text(30)),
        Parameter(key="street", check=text(30)),
        Parameter(key="town", check=text(30)),
        Parameter(key="telephone", check=text(20)),
        Parameter(key="customer_number", check=text(20)),
    ),
)
EXTRA: Final = ActionBlock(
    block=EXTRA_BLOCK,
    parameters=(
        Parameter(key="maximum_current_2", check=limit),
        Parameter(key="pulses_per_kwh_2", check=whole(0, _PULSES)),
        Parameter(key="voltage_1", check=whole(0, _WORD)),
        Parameter(key="voltage_2", check=whole(0, _WORD)),
        Parameter(key="compatible_1", check=switch),
        Parameter(key="compatible_2", check=switch),
    ),
)
BLOCKS: Final[Mapping[str, ActionBlock[Any]]] = {
    "system": SYSTEM,
    "network": NETWORK,
    "installation": INSTALLATION,
    "extra": EXTRA,
}
READABLE: Final = (*BLOCKS, DHCP)
"""What `read_parameters` offers."""


def keys_of(block: str) -> tuple[str, ...]:
    """Return the fields of the action that writes a block."""
    return tuple(parameter.key for parameter in BLOCKS[block].parameters)


async def read_parameters(port: EwsPort, given: Mapping[str, object]) -> JsonObjectType:
    """Return one block of parameters, without its secrets."""
    asked = option({block: block for block in READABLE})(CONF_BLOCK, given[CONF_BLOCK])
    if asked == DHCP:
        return _dhcp(await port.services.read_dhcp())
    chosen = BLOCKS[asked]
    return chosen.response(await port.services.read_parameters(chosen.block))


def _dhcp(told: Dhcp) -> JsonObjectType:
    return {
        "address": str(told.address),
        "netmask": str(told.netmask),
        "gateway": str(told.gateway),
        "server": str(told.server),
        "server_real": str(told.server_real),
        "lease": told.lease,
        "lease_left": told.lease_left,
    }


async def write_parameters(
    block: str, port: EwsPort, given: Mapping[str, object]
) -> None:
    """Change what is named of a block; the rest stays as it is."""
    chosen = BLOCKS[block]
    await port.services.change_parameters(chosen.block, chosen.changes(given))
