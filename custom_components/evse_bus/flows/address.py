"""Form fields for the addresses of chargers, and their validation. Pure."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from homeassistant.helpers.selector import (
    Selector,
    SelectSelector,
    SelectSelectorConfig,
    SelectSelectorMode,
    TextSelector,
    TextSelectorConfig,
)
import probatio as vol

from ..const import CONF_SERIAL
from ..evse.address import NumberAddress

if TYPE_CHECKING:
    from ..evse.address import AddressForm
    from ..evse.scan import Address

type Errors = dict[str, str]
"""Keys of error texts, by the key of the form field."""


def numbers(form: AddressForm) -> range:
    """Return the addresses of a form with few numbers; of another one none."""
    if form.is_serial or not isinstance(form, NumberAddress):
        return range(0)
    return range(form.lowest, form.highest + 1)


def address_field(
    form: AddressForm, *, multiple: bool = False, only: Sequence[int] | None = None
) -> Selector[Any]:
    """Return the form field for one address or several.

    A serial number is typed; other numbers are few, and chosen from a list. ``only``:
    the numbers to choose from, if they are not all.
    """
    choices = numbers(form) if only is None else only
    if form.is_serial or not isinstance(form, NumberAddress):
        return TextSelector(TextSelectorConfig(multiple=multiple))
    config = SelectSelectorConfig(
        options=[str(one) for one in choices],
        multiple=multiple,
        mode=SelectSelectorMode.DROPDOWN,
    )
    if form.labelled:
        config["translation_key"] = form.key
    return SelectSelector(config)


def manual_form(
    form: AddressForm, *, multiple: bool, known: Iterable[str] = ()
) -> vol.Schema:
    """Return the form for the addresses of chargers that were not searched for.

    ``known``: addresses of unknown boxes that are connected, to choose from.
    """
    if options := list(known):
        chosen = SelectSelector(
            SelectSelectorConfig(
                options=options, custom_value=True, mode=SelectSelectorMode.DROPDOWN
            )
        )
        return vol.Schema({vol.Required(form.key): chosen})
    key = form.plural if multiple else form.key
    return vol.Schema({vol.Required(key): address_field(form, multiple=multiple)})


def another_form(form: AddressForm, *, known: Iterable[str] = ()) -> vol.Schema:
    """Return the form for the serial number of a box that replaces another.

    ``known``: as in `manual_form`.
    """
    if not form.is_serial:
        field = {vol.Optional(CONF_SERIAL): TextSelector()} if form.has_serial else {}
        return vol.Schema(field)
    if form.optional:
        return vol.Schema({vol.Optional(form.key): address_field(form)})
    return manual_form(form, multiple=False, known=known)


def typed_addresses(
    form: AddressForm, typed: Mapping[str, Any], taken: Iterable[Address] = ()
) -> tuple[list[Address], Errors]:
    """Return the addresses typed into a form, and the errors."""
    key = form.plural if form.plural in typed else form.key
    texts = typed[key] if key == form.plural else [typed.get(key, "")]
    try:
        addresses = [form.parse(text) for text in texts if str(text).strip()]
    except ValueError:
        return [], {key: form.error}
    taken = set(taken)
    if not addresses:
        any_box = [form.any] if form.optional and form.any is not None else []
        return any_box, {} if any_box else {key: "no_address"}
    if len(set(addresses)) < len(addresses):
        return [], {key: "address_twice"}
    if taken.intersection(addresses):
        return [], {key: "address_taken"}
    everyone = taken.union(addresses)
    if form.any in everyone and len(everyone) > 1:
        return [], {key: "any_not_alone"}
    return addresses, {}
