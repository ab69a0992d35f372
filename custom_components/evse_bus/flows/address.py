"""Where chargers are, as people type it: device-IDs and serial numbers. Pure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from homeassistant.helpers.selector import (
    Selector,
    SelectSelector,
    SelectSelectorConfig,
    SelectSelectorMode,
    TextSelector,
    TextSelectorConfig,
)
import probatio as vol

from ..evse.scan import Address

if TYPE_CHECKING:
    from ..evse.protocol import Protocol

type Errors = dict[str, str]
"""What is wrong, by the key of a form's field."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AddressForm:
    """How people name a place on a protocol's bus."""

    one: str
    """Key of the form's field for one address."""
    many: str
    """Key of the field for several."""
    error: str
    """Said of anything that is no such address."""
    lowest: int = 0
    highest: int = 0
    text: bool = False
    """It is no number but a text, of `digits` letters and digits at most."""
    any: Address | None = None
    """Address that every box answers to, for a box that is alone on its line."""
    optional: bool = False
    """It may be left out: then the first box that is found is kept."""
    is_serial: bool = False
    """The address is the serial number."""
    tells_serial: bool = True
    """A box has a serial number that it tells, and that can be checked."""
    alone: bool = False
    """There is one box on such a bus, and no second one is added."""
    labels: str | None = None
    """Key of the texts for the addresses to choose from, under ``selector``."""
    digits: int = 1

    def parse(self, text: object) -> Address:
        """Return a typed address; raises ValueError when it is none."""
        typed = str(text).strip()
        if self.text:
            if not (typed.isalnum() and typed.isascii() and len(typed) <= self.digits):
                raise ValueError(typed)
            return typed
        if not typed.isdecimal() or not typed.isascii():
            raise ValueError(typed)
        if not self.lowest <= (address := int(typed)) <= self.highest:
            raise ValueError(typed)
        return address

    def show(self, address: Address) -> str:
        """Return an address as people read it on the box."""
        if isinstance(address, str):
            return address
        return f"{address:0{self.digits}d}"

    def serial(self, address: Address) -> str | None:
        """Return the serial number that an address tells, as the library has it."""
        if not self.is_serial or address == self.any:
            return None
        return str(address)

    @property
    def selector(self) -> Selector[Any]:
        """Return the field for one address."""
        if self.is_serial:
            return TextSelector()
        return SelectSelector(self._choice(multiple=False))

    @property
    def selector_many(self) -> Selector[Any]:
        """Return the field for several."""
        if self.is_serial:
            return TextSelector(TextSelectorConfig(multiple=True))
        return SelectSelector(self._choice(multiple=True))

    def _choice(self, *, multiple: bool) -> SelectSelectorConfig:
        config = SelectSelectorConfig(
            options=[str(one) for one in range(self.lowest, self.highest + 1)],
            multiple=multiple,
            mode=SelectSelectorMode.DROPDOWN,
        )
        if self.labels is not None:
            config["translation_key"] = self.labels
        return config


ADDRESSES: Final[Mapping[str, AddressForm]] = {
    "evbox": AddressForm(
        one="serial_number",
        many="serial_numbers",
        error="bad_serial_number",
        lowest=0,
        highest=99_999_999,
        any=0,
        is_serial=True,
        digits=8,
    ),
    "abl": AddressForm(
        one="device_id",
        many="device_ids",
        error="bad_device_id",
        lowest=1,
        highest=16,
    ),
    # The unit of a SmartEVSE is what its menu says of load balancing.
    "smartevse": AddressForm(
        one="unit",
        many="units",
        error="bad_unit",
        lowest=0,
        highest=1,
        alone=True,
        labels="unit",
    ),
    "smartevse_master": AddressForm(
        one="slave",
        many="slaves",
        error="bad_slave",
        lowest=2,
        highest=4,
        tells_serial=False,
        labels="slave",
    ),
    "ews": AddressForm(
        one="box_serial",
        many="box_serials",
        error="bad_box_serial",
        # The number of a port, where one is needed for a search.
        lowest=1,
        text=True,
        digits=12,
        any="",
        optional=True,
        is_serial=True,
        alone=True,
    ),
    "ews_network": AddressForm(
        one="box_serial",
        many="box_serials",
        error="bad_box_serial",
        text=True,
        digits=12,
        is_serial=True,
    ),
}


def manual_form(
    protocol: Protocol, *, multiple: bool, known: Iterable[str] = ()
) -> vol.Schema:
    """Ask where the chargers are; ``known``: those that wait to be added."""
    address = ADDRESSES[protocol.key]
    if options := list(known):
        chosen = SelectSelector(
            SelectSelectorConfig(
                options=options, custom_value=True, mode=SelectSelectorMode.DROPDOWN
            )
        )
        return vol.Schema({vol.Required(address.one): chosen})
    if multiple:
        return vol.Schema({vol.Required(address.many): address.selector_many})
    return vol.Schema({vol.Required(address.one): address.selector})


def typed_addresses(
    protocol: Protocol, typed: Mapping[str, Any], taken: Iterable[Address] = ()
) -> tuple[list[Address], Errors]:
    """Return the addresses typed into a form, and what is wrong with them."""
    form = ADDRESSES[protocol.key]
    key = form.many if form.many in typed else form.one
    texts = typed[key] if form.many in typed else [typed.get(key, "")]
    try:
        addresses = [form.parse(text) for text in texts if str(text).strip()]
    except ValueError:
        return [], {key: form.error}
    taken = set(taken)
    if not addresses:
        left_out = [] if form.any is None or not form.optional else [form.any]
        return left_out, {} if left_out else {key: "no_address"}
    if len(set(addresses)) < len(addresses):
        return [], {key: "address_twice"}
    if taken.intersection(addresses):
        return [], {key: "address_taken"}
    everyone = taken.union(addresses)
    if form.any in everyone and len(everyone) > 1:
        return [], {key: "any_not_alone"}
    return addresses, {}
