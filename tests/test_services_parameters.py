"""Actions for the parameters of an EWS-Box; what is secret stays so."""

import json
import logging
from typing import Any
from unittest.mock import patch

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
import pytest

from custom_components.evse_bus.actions.parameters import BLOCKS, READABLE
from custom_components.evse_bus.diagnostics import async_get_config_entry_diagnostics
from tests.virtual import Car
from tests.virtual.ews_box import EwsBox
from tests.virtual.ews_parameters import SystemMode

from .services import ADMIN_PASSWORD, CARD_PIN, USER_PASSWORD, WRITERS, scene

# -- Reading ---------------------------------------------------------------------


async def test_system_parameters_are_read(hass: HomeAssistant) -> None:
    box = EwsBox(rfid=True, fixed_cable=True, mode1=(False, True), max_current=20)
    box.system.lock_type = 2
    async with scene(hass, box) as here:
        assert await here.ask("read_parameters", block="system") == {
            "ports": 2,
            "server_mode": True,
            "rs232_server": True,
            "card_authentication": True,
            "manual_keys_and_leds": False,
            "exclusive_ports": False,
            "maximum_current": 20,
            "fixed_cable": True,
            "mode_1_port_1": False,
            "mode_1_port_2": True,
            "lock_type": "fct_high",
            "ventilation": False,
            "restart_after_power_failure": False,
            "pulses_per_kwh": 1000,
            "codes": {"mode": 0x07, "lock_type": 2, "cable_mode": 0x05},
            "secrets": {"admin_password": "shown", "card_pin": "shown"},
        }


async def test_network_parameters_are_read(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        here.box.user.server_ip = bytes((192, 168, 0, 9))
        assert await here.ask("read_parameters", 2, block="network") == {
            "address": "192.168.0.1",
            "netmask": "255.255.255.0",
            "gateway": "0.0.0.0",  # noqa: S104 - none
            "server": "192.168.0.9",
            "server_port": 0,
            "source_port": 20000,
            "time_zone": "cet",
            "language": 0,
            "codes": {"zone_code": 1},
            "secrets": {"user_password": "shown"},
        }


async def test_the_rest_is_read(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        assert await here.ask("read_parameters", block="installation") == {
            "name": "Erika Mustermann",
            "street": "Heidestrasse 17",
            "town": "51147 Koeln",
            "telephone": "0221 123456",
            "customer_number": "4711",
        }
        assert await here.ask("read_parameters", block="extra") == {
            "maximum_current_2": 0,
            "pulses_per_kwh_2": 0,
            "voltage_1": 230,
            "voltage_2": 230,
            "compatible_1": False,
            "compatible_2": False,
        }


async def test_what_dhcp_gave_is_read(hass: HomeAssistant) -> None:
    box = EwsBox()
    box.user.own_ip = bytes(4)
    box.lease = 3600
    async with scene(hass, box) as here:
        dhcp = await here.ask("read_parameters", block="dhcp")
        assert 0 <= dhcp.pop("lease_left") <= 3600
        assert dhcp == {
            "address": "192.168.178.57",
            "netmask": "255.255.255.0",
            "gateway": "192.168.178.1",
            "server": "192.168.178.1",
            "server_real": "192.168.178.1",
            "lease": 3600,
        }


async def test_what_the_manual_does_not_know_is_shown_as_a_number(
    hass: HomeAssistant,
) -> None:
    async with scene(hass) as here:
        here.box.system.lock_type = 9
        here.box.system.mode |= 0x80
        here.box.user.time_zone = 7
        system = await here.ask("read_parameters", block="system")
        assert system["lock_type"] is None
        assert system["codes"]["lock_type"] == 9
        assert system["codes"]["mode"] & 0x80
        network = await here.ask("read_parameters", block="network")
        assert network["time_zone"] is None
        assert network["codes"] == {"zone_code": 7}


async def test_reading_that_fails(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        for block in ("everything", "System", None, 1, ["system"]):
            await here.fails_to_ask("read_parameters", "field_option", block=block)
        for block, command in (("extra", "rz"), ("dhcp", "rg")):
            here.box.unanswered.add(command)
            text = await here.fails_to_ask("read_parameters", "not_read", block=block)
            assert "Yard" in text
            here.box.unanswered.clear()


@pytest.mark.parametrize("masking", ["no", "zeros", "stars"])
async def test_whether_a_box_tells_its_secrets(
    hass: HomeAssistant, masking: str
) -> None:
    how = {"no": "shown", "zeros": "empty", "stars": "masked"}[masking]
    async with scene(hass, EwsBox(masking=masking)) as here:
        system = await here.ask("read_parameters", block="system")
        assert system["secrets"] == {"admin_password": how, "card_pin": how}
        network = await here.ask("read_parameters", block="network")
        assert network["secrets"] == {"user_password": how}


# -- Writing ---------------------------------------------------------------------


@pytest.mark.parametrize("block", BLOCKS)
async def test_each_field_is_written_where_it_belongs(
    hass: HomeAssistant, subtests: pytest.Subtests, block: str
) -> None:
    """One field at a time: it is read back, and all others are as they were."""
    changes = CHANGES[block]
    written = {parameter.key for parameter in BLOCKS[block].parameters}
    assert changes.keys() == written - BLOCKS[block].block.secrets
    async with scene(hass, EwsBox(init_time=0.01)) as here:
        for key, value in changes.items():
            with subtests.test(key=key):
                before = await here.ask("read_parameters", block=block)
                assert before[key] != value
                await here.act(WRITERS[block], **{key: value})
                after = await here.ask("read_parameters", block=block)
                assert {**after, "codes": 0} == {**before, key: value, "codes": 0}
    # What nobody has named is as it was.
    assert here.box.system.admin_password.rstrip(b"\0").decode() == ADMIN_PASSWORD
    assert here.box.system.card_pin.decode() == CARD_PIN
    assert here.box.user.user_password.rstrip(b"\0").decode() == USER_PASSWORD


CHANGES: dict[str, dict[str, object]] = {
    "system": {
        "manual_keys_and_leds": True,
        "card_authentication": True,
        "exclusive_ports": True,
        "maximum_current": 16,
        "fixed_cable": True,
        "mode_1_port_1": True,
        "mode_1_port_2": True,
        "lock_type": "walther",
        "ventilation": True,
        "restart_after_power_failure": True,
        "pulses_per_kwh": 0xFFFFFFFF,
        "ports": 1,
        # At last: then it does not ask us any more.
        "rs232_server": False,
        "server_mode": False,
    },
    "network": {
        "address": "10.0.0.5",
        "netmask": "255.255.254.0",
        "gateway": "10.0.0.1",
        "server": "10.0.0.2",
        "server_port": 65535,
        "source_port": 65526,
        "time_zone": "gmt",
        "language": 255,
    },
    "installation": {
        "name": "Müller & Söhne",
        "street": "",
        "town": "x" * 30,
        "telephone": "0361",
        "customer_number": "ÿ" * 20,
    },
    "extra": {
        "maximum_current_2": 80,
        "pulses_per_kwh_2": 500,
        "voltage_1": 0,
        "voltage_2": 65535,
        "compatible_1": True,
        "compatible_2": True,
    },
}


async def test_several_fields_are_one_write(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        await here.act(
            "write_system_parameters",
            server_mode=True,
            card_authentication="on",
            exclusive_ports="yes",
            mode_1_port_2="true",
            maximum_current="16",
        )
        assert len(here.written("sp")) == 1
        mode = SystemMode.SERVER | SystemMode.RS232
        mode |= SystemMode.RFID | SystemMode.EXCLUSIVE
        assert here.box.system.mode == mode
        assert here.box.system.cable_mode == 0x04
        assert here.box.system.max_current == 16


async def test_a_bit_that_somebody_else_has_changed_is_kept(
    hass: HomeAssistant,
) -> None:
    """The box is read in the same turn: what it said before does not count."""
    async with scene(hass, EwsBox(init_time=0.01)) as here:
        here.box.system.mode |= SystemMode.RFID
        await here.act("write_system_parameters", exclusive_ports=True)
        assert here.box.system.has(SystemMode.RFID)
        assert here.box.system.has(SystemMode.EXCLUSIVE)
        here.box.system.mode &= ~SystemMode.RFID
        await here.act("write_system_parameters", exclusive_ports=False)
        assert not here.box.system.has(SystemMode.RFID)
        assert not here.box.system.has(SystemMode.EXCLUSIVE)


async def test_what_is_read_can_be_written(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        for block, action in WRITERS.items():
            told = await here.ask("read_parameters", block=block)
            told.pop("codes", None)
            told.pop("secrets", None)
            await here.act(action, **told)
            again = await here.ask("read_parameters", block=block)
            assert told.items() <= again.items()


WRONG: dict[str, list[tuple[dict[str, object], str]]] = {
    "system": [
        ({}, "nothing_to_change"),
        ({"ports": 0}, "field_whole_number"),
        ({"ports": 3}, "field_whole_number"),
        ({"ports": float("nan")}, "field_whole_number"),
        ({"maximum_current": 5}, "field_current"),
        ({"maximum_current": 81}, "field_current"),
        ({"maximum_current": -6}, "field_current"),
        ({"maximum_current": 6.5}, "field_current"),
        ({"maximum_current": float("nan")}, "field_current"),
        ({"maximum_current": float("inf")}, "field_current"),
        ({"maximum_current": None}, "field_current"),
        ({"maximum_current": True}, "field_current"),
        ({"pulses_per_kwh": 0}, "field_whole_number"),
        ({"pulses_per_kwh": 1 << 32}, "field_whole_number"),
        ({"pulses_per_kwh": 10**5000}, "field_whole_number"),
        ({"lock_type": "mennekes"}, "field_option"),
        ({"lock_type": 1}, "field_option"),
        ({"server_mode": "perhaps"}, "field_switch"),
        ({"server_mode": 1}, "field_switch"),
        ({"server_mode": float("nan")}, "field_switch"),
        ({"ventilation": None}, "field_switch"),
        ({"admin_password": 13 * "x"}, "field_text"),
        ({"admin_password": None}, "field_text"),
        ({"admin_password": "pass€"}, "field_signs"),
        ({"admin_password": "pass\0"}, "field_signs"),
        ({"card_pin": "123"}, "field_pin"),
        ({"card_pin": "12345"}, "field_pin"),
        ({"card_pin": "12ä4"}, "field_pin"),
        ({"card_pin": "12\n4"}, "field_pin"),
        ({"card_pin": "12 "}, "field_pin"),
        ({"card_pin": "123 "}, "field_pin"),
        ({"card_pin": True}, "field_pin"),
        ({"card_pin": 10**5000}, "field_pin"),
        # With one that is wrong nothing is written.
        ({"ventilation": True, "maximum_current": 5}, "field_current"),
    ],
    "network": [
        ({}, "nothing_to_change"),
        ({"address": "192.168.0.256"}, "field_address"),
        ({"address": "192.168.0"}, "field_address"),
        ({"address": "fe80::1"}, "field_address"),
        ({"address": 3232235521}, "field_address"),
        ({"address": "192.168.0.1/24"}, "field_address"),
        ({"gateway": ""}, "field_address"),
        ({"server": None}, "field_address"),
        ({"netmask": "255.0.255.0"}, "field_netmask"),
        ({"netmask": "192.168.0.1"}, "field_netmask"),
        ({"netmask": "/24"}, "field_address"),
        ({"server_port": 65536}, "field_whole_number"),
        ({"source_port": 65527}, "field_whole_number"),
        ({"language": 256}, "field_whole_number"),
        ({"language": -1}, "field_whole_number"),
        ({"time_zone": "Europe/Berlin"}, "field_option"),
        ({"user_password": 13 * "x"}, "field_text"),
        ({"user_password": "a\tb"}, "field_signs"),
    ],
    "installation": [
        ({}, "nothing_to_change"),
        ({"name": 31 * "x"}, "field_text"),
        ({"customer_number": 21 * "x"}, "field_text"),
        ({"town": "Łódź"}, "field_signs"),
        ({"town": "Erfurt\nJena"}, "field_signs"),
        ({"street": ["Am Weg"]}, "field_text"),
        ({"street": False}, "field_text"),
        ({"telephone": 3.5}, "field_text"),
    ],
    "extra": [
        ({}, "nothing_to_change"),
        ({"maximum_current_2": 5}, "field_current"),
        ({"pulses_per_kwh_2": -1}, "field_whole_number"),
        ({"voltage_1": 65536}, "field_whole_number"),
        ({"voltage_2": float("nan")}, "field_whole_number"),
        ({"voltage_2": 230.5}, "field_whole_number"),
        ({"compatible_1": 2}, "field_switch"),
    ],
}


async def test_what_cannot_be_meant_is_not_written(
    hass: HomeAssistant, subtests: pytest.Subtests
) -> None:
    async with scene(hass) as here:
        for block, wrong in WRONG.items():
            for data, key in wrong:
                with subtests.test(block=block, fields=[*data]):
                    text = await here.refuses(WRITERS[block], key, **data)
                    assert not data or list(data)[-1] in text
        assert not here.written()


async def test_not_while_a_car_charges(hass: HomeAssistant) -> None:
    car = Car(max_current=16)
    async with scene(hass, EwsBox(cars=(car, None))) as here:
        car.plug_in()
        await here.bus.wait_for_async(lambda: here.box.ports[0].status == 0x30)
        await here.switch_on("charging_allowed")
        await here.bus.wait_for_async(lambda: here.box.ports[0].status == 0x40)
        text = await here.refuses(
            "write_system_parameters",
            "ews_system_parameters",
            kind=HomeAssistantError,
            maximum_current=16,
        )
        assert "charges" in text
        assert here.box.system.max_current == 0
        assert here.box.ports[0].status == 0x40


async def test_the_server_mode_over_the_network(hass: HomeAssistant) -> None:
    """The box takes the rest and keeps that; this is told, by our names."""
    async with scene(hass) as here:
        with patch.object(here.box, "network", new=True):
            text = await here.refuses(
                "write_system_parameters",
                "parameters_not_taken",
                kind=HomeAssistantError,
                server_mode=False,
                ventilation=True,
            )
        assert "server_mode" in text
        assert "ventilation" in text
        assert here.box.system.has(SystemMode.SERVER)


# -- Secrets ---------------------------------------------------------------------


@pytest.mark.parametrize("masking", ["zeros", "stars"])
async def test_a_hidden_secret_has_to_be_given(
    hass: HomeAssistant, masking: str
) -> None:
    async with scene(hass, EwsBox(masking=masking)) as here:
        for data, missing in (
            ({}, {"admin_password", "card_pin"}),
            ({"admin_password": "new"}, {"card_pin"}),
            ({"card_pin": "1234"}, {"admin_password"}),
        ):
            text = await here.refuses(
                "write_system_parameters",
                "ews_secret_hidden",
                ventilation=True,
                **data,
            )
            for name in ("admin_password", "card_pin"):
                assert (name in text) == (name in missing)
        await here.refuses(
            "write_network_parameters", "ews_secret_hidden", server_port=1
        )
        assert not here.written()
        # With them it goes; and what has none needs none.
        await here.act(
            "write_system_parameters",
            ventilation=True,
            admin_password="new",  # noqa: S106 - the test's
            card_pin=1234,
        )
        assert here.box.system.admin_password == b"new".ljust(12, b"\0")
        assert here.box.system.card_pin == b"1234"
        assert here.box.system.fan == 1
        await here.act("write_extra_parameters", voltage_1=240)
        assert here.box.extra.voltage_1 == 240


async def test_secrets_are_written_as_they_are(hass: HomeAssistant) -> None:
    async with scene(hass) as here:
        await here.act(
            "write_network_parameters",
            user_password="ümläut",  # noqa: S106 - the test's
        )
        assert here.box.user.user_password.rstrip(b"\0") == "ümläut".encode("latin-1")
        await here.act("write_system_parameters", admin_password="", card_pin="")
        assert here.box.system.admin_password == bytes(12)
        assert here.box.system.card_pin == bytes(4)


NEW_PASSWORD = "freshsecret"  # noqa: S105 - the test's
NEW_PIN = "Qz3w"
SECRETS = (ADMIN_PASSWORD, CARD_PIN, USER_PASSWORD, NEW_PASSWORD, NEW_PIN)


async def test_secrets_are_nowhere_to_be_read(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    """Not in the log at its finest, nor in a response, a message or diagnostics."""
    caplog.set_level(logging.DEBUG)
    shown: list[str] = []
    async with scene(hass) as here:
        shown += [
            json.dumps(await here.ask("read_parameters", block=block))
            for block in READABLE
        ]
        await here.act(
            "write_system_parameters", admin_password=NEW_PASSWORD, card_pin=NEW_PIN
        )
        await here.act("write_network_parameters", user_password=NEW_PASSWORD)
        assert here.box.user.user_password.startswith(NEW_PASSWORD.encode())
        # Those that fail as well.
        here.box.unanswered.add("su")
        here.box.masking = "stars"
        shown += [
            await here.refuses(
                "write_network_parameters",
                "parameters_not_taken",
                kind=HomeAssistantError,
                user_password=NEW_PASSWORD,
            ),
            await here.refuses(
                "write_system_parameters",
                "field_text",
                admin_password=2 * NEW_PASSWORD,
            ),
            await here.refuses(
                "write_system_parameters",
                "field_signs",
                admin_password=f"{NEW_PASSWORD}€",
            ),
            await here.refuses(
                "write_system_parameters", "field_pin", card_pin=f"{NEW_PIN}0"
            ),
            await here.refuses(
                "write_system_parameters", "ews_secret_hidden", card_pin=NEW_PIN
            ),
        ]
        told = await async_get_config_entry_diagnostics(hass, here.entry)
        shown.append(json.dumps(told, default=str))
        # The frames are among them, so this could have failed.
        assert hidden_frames(told, b"Csp")
    logged = [
        f"{record.getMessage()} {record.exc_text or ''}"
        for record in caplog.records
        # The library for serial ports logs each byte of each line, when told to.
        if not record.name.startswith("serialx")
    ]
    assert any("evse_bus" in record.name for record in caplog.records)
    for text in (*shown, *logged):
        for secret in SECRETS:
            assert secret not in text
            assert secret.encode().hex() not in text.replace(" ", "").lower()


def hidden_frames(told: dict[str, Any], name: bytes) -> bool:
    """Return whether diagnostics tell of a command."""
    return name.hex() in json.dumps(told, default=str).replace(" ", "").lower()


async def test_a_wrong_secret_does_not_come_back_in_an_error(
    hass: HomeAssistant,
) -> None:
    async with scene(hass) as here:
        with pytest.raises(HomeAssistantError) as told:
            await here.act("write_system_parameters", admin_password=f"{NEW_PASSWORD}€")
        error: BaseException | None = told.value
        while error is not None:
            assert NEW_PASSWORD not in repr(error)
            error = error.__cause__ or (
                None if error.__suppress_context__ else error.__context__
            )
