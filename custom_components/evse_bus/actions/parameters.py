"""Actions for the parameters of an EWS-Box: one table for each block.

A table maps the fields of an action to those of a block. Single bits are fields of
their own; bits that an action does not name keep their current value in the box.
Passwords can be written, but are never returned.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Final

from ..errors import ActionError, wrong_action
from ..evse.ews.wire.parameters import (
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
    from ..evse.ews.wire.box_status import Dhcp

CONF_BLOCK: Final = "block"
SECRETS: Final = "secrets"
"""Key in a response: how the box returned each password, never a password itself."""
DHCP: Final = "dhcp"

LOCK_TYPES: Final = {kind.name.lower(): kind for kind in LockType}
TIME_ZONES: Final = {zone.name.lower(): zone for zone in TimeZone}
_PASSWORD_LENGTH: Final = 12
_PULSES: Final = 0xFFFFFFFF
_WORD: Final = 0xFFFF
_BYTE: Final = 0xFF


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One field of an action, and its place in a block."""

    key: str
    """Its name in the action; in the library, too, unless `name` is set."""
    check: Check[Any]
    name: str = ""
    bit: IntFlag | None = None
    """The bit of the library's field, where it is a single bit."""
    show: Callable[[Any], JsonValueType] | None = None
    """Conversion for a response; ``None``: the value itself."""

    @property
    def field(self) -> str:
        """Return the name of the library's field."""
        return self.name or self.key

    def response(self, values: object) -> JsonValueType:
        """Return its value from a block that was read."""
        value: Any = getattr(values, self.field)
        if self.bit is not None:
            return self.bit in value
        return value if self.show is None else self.show(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionBlock[T]:
    """One block of parameters, as actions read and write it."""

    block: Block[T]
    parameters: tuple[Parameter, ...]
    codes: tuple[str, ...] = ()
    """Fields that a response also contains as numbers.

    A box may use more codes than its manual lists.
    """

    def changes(
        self, given: Mapping[str, object]
    ) -> Callable[[T], Mapping[str, object]]:
        """Return a function from the current values to the changed fields.

        Raises ServiceValidationError for an invalid value, or if nothing changes.
        """
        whole_fields: dict[str, object] = {}
        bits: dict[str, dict[IntFlag, bool]] = {}
        for parameter in self.parameters:
            if parameter.key not in given:
                continue
            value = parameter.check(parameter.key, given[parameter.key])
            if parameter.bit is None:
                whole_fields[parameter.field] = value
            else:
                bits.setdefault(parameter.field, {})[parameter.bit] = value
        if not whole_fields and not bits:
            raise wrong_action(ActionError.NOTHING_TO_CHANGE)
        return lambda current: (
            whole_fields
            | {
                name: _with_bits(getattr(current, name), changed)
                for name, changed in bits.items()
            }
        )

    def response(self, values: T) -> JsonObjectType:
        """Return the values of a block that was read, without its secrets."""
        secrets = self.block.shown_secrets(values)
        response: JsonObjectType = {
            parameter.key: parameter.response(values)
            for parameter in self.parameters
            if parameter.field not in self.block.secrets
        }
        if self.codes:
            response["codes"] = {
                name: int(getattr(values, name)) for name in self.codes
            }
        if secrets:
            response[SECRETS] = {name: state.value for name, state in secrets.items()}
        return response


def _with_bits(flags: IntFlag, changed: Mapping[IntFlag, bool]) -> IntFlag:
    """Return flags with some bits changed; unknown bits keep their value."""
    # As integers: `flags & ~bit` would drop bits that are no member.
    value = int(flags)
    for bit, on in changed.items():
        value = value | int(bit) if on else value & ~int(bit)
    return type(flags)(value)


def _word_for(options: Mapping[str, int]) -> Callable[[int], str | None]:
    """Return a getter for the word of a number; ``None``: not in the manual."""
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
"""Blocks that `read_parameters` offers."""


def keys_of(block: str) -> tuple[str, ...]:
    """Return the fields of the action that writes a block."""
    return tuple(parameter.key for parameter in BLOCKS[block].parameters)


async def read_parameters(port: EwsPort, given: Mapping[str, object]) -> JsonObjectType:
    """Return one block of parameters, without its secrets."""
    name = option({block: block for block in READABLE})(CONF_BLOCK, given[CONF_BLOCK])
    if name == DHCP:
        return _dhcp(await port.services.read_dhcp())
    action_block = BLOCKS[name]
    values = await port.services.read_parameters(action_block.block)
    return action_block.response(values)


def _dhcp(lease: Dhcp) -> JsonObjectType:
    return {
        "address": str(lease.address),
        "netmask": str(lease.netmask),
        "gateway": str(lease.gateway),
        "server": str(lease.server),
        "server_real": str(lease.server_real),
        "lease": lease.lease,
        "lease_left": lease.lease_left,
    }


async def write_parameters(
    block: str, port: EwsPort, given: Mapping[str, object]
) -> None:
    """Change the given fields of a block; the others stay unchanged."""
    action_block = BLOCKS[block]
    await port.services.change_parameters(
        action_block.block, action_block.changes(given)
    )
