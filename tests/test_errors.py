"""Library errors as people see them."""

from unittest.mock import patch

from homeassistant.config_entries import ConfigEntries, ConfigEntryState
from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError, ServiceValidationError
import pytest

from custom_components.evse_bus.errors import not_ready, translated_errors
from custom_components.evse_bus.evse import errors as library
from tests.common import setup_bus
from tests.flow import english
from tests.reasons import reason_keys
from tests.virtual import AblBox, VirtualBus


def all_errors() -> list[type[library.EvseError]]:
    return [
        kind
        for kind in vars(library).values()
        if isinstance(kind, type) and issubclass(kind, library.EvseError)
    ]


def make(kind: type[library.EvseError]) -> library.EvseError:
    if kind is library.WrongChargerError:
        return library.WrongChargerError("other", expected="1111", found="2222")
    return kind("the charger's own reason")


@pytest.mark.parametrize("kind", all_errors())
def test_every_error_is_said_in_words(kind: type[library.EvseError]) -> None:
    with (
        pytest.raises(HomeAssistantError) as said,
        translated_errors("Garage", "/dev/ttyUSB0"),
    ):
        raise make(kind)
    error = said.value
    text = english()["exceptions"][error.translation_key]["message"]
    shown = text.format(**error.translation_placeholders)
    assert "Garage" in shown or "/dev/ttyUSB0" in shown
    assert isinstance(error.__cause__, kind)
    # A wish that cannot be meant is the caller's mistake, all else is not.
    assert isinstance(error, ServiceValidationError) == issubclass(
        kind, library.RefusedOrderError
    )


def test_a_wrong_charger_is_named() -> None:
    with pytest.raises(HomeAssistantError) as said, translated_errors("Garage", "p"):
        raise make(library.WrongChargerError)
    assert said.value.translation_placeholders["found"] == "2222"
    assert said.value.translation_placeholders["expected"] == "1111"


def test_the_chargers_own_reason_is_kept() -> None:
    with pytest.raises(HomeAssistantError) as said, translated_errors("Garage", "p"):
        raise library.ExchangeRefusedError("exception code 3", 3)
    assert said.value.translation_placeholders["error"] == "exception code 3"


def test_a_command_that_cannot_act_now_has_a_translated_reason() -> None:
    keys = reason_keys()
    assert {"abl_outlet_disabled", "ews_start_state", "smartevse_mode_normal"} <= keys
    texts = english()["exceptions"]
    details = {"state": "B2", "minimum": "16", "maximum": "13"}
    for key in keys:
        error = library.NotAvailableError("not now", key, **details)
        with pytest.raises(HomeAssistantError) as said, translated_errors("Garage", ""):
            raise error
        assert said.value.translation_key == key
        shown = texts[key]["message"].format(**said.value.translation_placeholders)
        assert "Garage" in shown


def test_ports_differ() -> None:
    kinds = (
        library.PortMissingError,
        library.PortBusyError,
        library.PortPermissionError,
        library.PortSettingsError,
        library.LineError,
    )
    keys = {not_ready(kind("why"), "/dev/ttyUSB0").translation_key for kind in kinds}
    assert len(keys) == len(kinds)


def test_an_address_to_listen_on_has_words_of_its_own() -> None:
    kinds = (
        library.PortMissingError,
        library.PortBusyError,
        library.PortPermissionError,
        library.LineError,
    )
    errors = [not_ready(kind("why"), "::1", listens=True) for kind in kinds]
    keys = [error.translation_key for error in errors]
    assert keys == [
        f"listen_{one}" for one in ("missing", "busy", "permission", "failed")
    ]
    for error in errors:
        text = english()["exceptions"][error.translation_key]["message"]
        assert "::1" in text.format(**error.translation_placeholders)


async def test_a_platform_that_fails_does_not_keep_the_port(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        with patch.object(
            ConfigEntries, "async_forward_entry_setups", side_effect=RuntimeError
        ):
            entry = await setup_bus(hass, "abl", bus.url)
        assert entry.state is ConfigEntryState.SETUP_ERROR
        await bus.wait_for_async(lambda: not bus.connected)
