"""Stored data for Home Assistant's first start: owner, finished onboarding, port.

Written through Home Assistant's own classes, so that the formats are its own. A `http:`
section in the configuration is no way: Home Assistant takes it over on trial, and stops
after some minutes unless a user confirms it.
"""

import asyncio
from datetime import timedelta
import json
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from .settings import HOST, PASSWORD, ROOT, USER, Settings

OWNER: Final = "Demo"
TOKEN_NAME: Final = "EVSE Bus demo"  # noqa: S105 - a name, not a secret
TOKEN_LIFE: Final = timedelta(days=3650)

CONFIGURATION: Final = """\
# Written by scripts/demo at each start. Only what works without internet.
automation: !include automations.yaml
config:
energy:
frontend:
history:
logbook:
recorder:
  commit_interval: 1
usb:
logger:
  default: warning
  logs:
    custom_components.evse_bus: info
    # Logs a package that must be downloaded; requirements_demo.txt lists them all.
    homeassistant.util.package: info
    # Comes with the frontend, and misses programs that no charger needs.
    haffmpeg: critical
    homeassistant.components.camera.img_util: critical
"""


def prepare(settings: Settings) -> None:
    """Write the files that are missing or have changed; keep all others."""
    config = settings.config
    (config / "custom_components").mkdir(parents=True, exist_ok=True)
    _link(
        config / "custom_components" / "evse_bus",
        ROOT / "custom_components" / "evse_bus",
    )
    write_configuration(config)
    if not settings.token.exists() or _stored_port(config) != settings.port:
        # Not on Home Assistant's own event loop, which handles signals.
        asyncio.run(_write(settings))


def write_configuration(config: Path) -> None:
    """Write the YAML files; that of automations only if there is none yet."""
    (config / "configuration.yaml").write_text(CONFIGURATION, encoding="utf-8")
    automations = config / "automations.yaml"
    if not automations.exists():
        automations.write_text("[]\n", encoding="utf-8")


def _link(link: Path, target: Path) -> None:
    if link.is_symlink():
        if link.readlink() == target:
            return
        link.unlink()
    link.symlink_to(target, target_is_directory=True)


def _stored_port(config: Path) -> int | None:
    try:
        text = (config / ".storage" / "http").read_text(encoding="utf-8")
        port = json.loads(text)["data"]["stable"]["server_port"]
    except OSError, ValueError, KeyError:
        return None
    return port if isinstance(port, int) else None


async def _write(settings: Settings) -> None:
    # Importing Home Assistant takes a second or two, which later starts save.
    from homeassistant.auth import auth_manager_from_config  # noqa: PLC0415
    from homeassistant.config_entries import ConfigEntries  # noqa: PLC0415
    from homeassistant.core import HomeAssistant  # noqa: PLC0415
    from homeassistant.helpers import (  # noqa: PLC0415
        device_registry as dr,
        entity_registry as er,
    )

    token = None
    hass = HomeAssistant(str(settings.config))
    hass.config_entries = ConfigEntries(hass, {})
    try:
        await hass.config_entries.async_initialize()
        dr.async_setup(hass)
        await asyncio.gather(dr.async_load(hass), er.async_load(hass))
        await _write_http(hass, settings.port)
        if not settings.token.exists():
            hass.auth = await auth_manager_from_config(
                hass, [{"type": "homeassistant"}], []
            )
            token = await _create_owner(hass)
            await _finish_onboarding(hass)
    finally:
        # Also writes data that are saved with a delay, such as the users. It was never
        # started, and does not stop without force.
        await hass.async_stop(force=True)
    if token is not None:
        # Last: a token means that everything before it is complete.
        new = settings.token.with_suffix(".new")
        new.unlink(missing_ok=True)
        new.touch(mode=0o600)
        new.write_text(token + "\n", encoding="utf-8")
        new.replace(settings.token)


async def _write_http(hass: Any, port: int) -> None:  # noqa: ANN401 - see _write
    from homeassistant.components.http import config as http  # noqa: PLC0415
    from homeassistant.helpers.storage import Store  # noqa: PLC0415
    from homeassistant.util import dt as dt_util  # noqa: PLC0415

    store: Store[dict[str, Any]] = Store(
        hass,
        http.STORAGE_VERSION,
        http.STORAGE_KEY,
        minor_version=http.STORAGE_MINOR_VERSION,
        private=True,
        atomic_writes=True,
    )
    confirmed = http.HTTP_STORAGE_SCHEMA({"server_host": [HOST], "server_port": port})
    await store.async_save(
        {
            http.KEY_STABLE: {
                **confirmed,
                http.HTTP_CONFIG_CREATED_AT: dt_util.utcnow().isoformat(),
                http.HTTP_CONFIG_ERROR: None,
                http.HTTP_CONFIG_ERROR_MESSAGE: None,
            },
            http.KEY_PENDING: None,
            http.KEY_YAML_MIGRATION_DONE: True,
        }
    )


async def _create_owner(hass: Any) -> str:  # noqa: ANN401 - see _write
    """Create the user unless an interrupted start has done so; return a token."""
    from homeassistant.auth.const import GROUP_ID_ADMIN  # noqa: PLC0415
    from homeassistant.auth.models import (  # noqa: PLC0415
        TOKEN_TYPE_LONG_LIVED_ACCESS_TOKEN,
    )

    provider = hass.auth.auth_providers[0]
    await provider.async_initialize()
    if not any(user["username"] == USER for user in provider.data.users):
        await provider.async_add_auth(USER, PASSWORD)
    login = await provider.async_get_or_create_credentials({"username": USER})
    user = await hass.auth.async_get_user_by_credentials(login)
    if user is None:
        user = await hass.auth.async_create_user(OWNER, group_ids=[GROUP_ID_ADMIN])
        await hass.auth.async_link_user(user, login)
    for old in list(user.refresh_tokens.values()):
        hass.auth.async_remove_refresh_token(old)
    refresh = await hass.auth.async_create_refresh_token(
        user,
        client_name=TOKEN_NAME,
        token_type=TOKEN_TYPE_LONG_LIVED_ACCESS_TOKEN,
        access_token_expiration=TOKEN_LIFE,
    )
    token: str = hass.auth.async_create_access_token(refresh)
    return token


async def _finish_onboarding(hass: Any) -> None:  # noqa: ANN401 - see _write
    from homeassistant.components import onboarding  # noqa: PLC0415
    from homeassistant.components.onboarding.const import STEPS  # noqa: PLC0415
    from homeassistant.helpers.storage import Store  # noqa: PLC0415

    store: Store[dict[str, Any]] = Store(
        hass, onboarding.STORAGE_VERSION, onboarding.STORAGE_KEY, private=True
    )
    await store.async_save({"done": list(STEPS)})
    await hass.config.async_update(
        location_name="EVSE Bus demo",
        country="NL",
        currency="EUR",
        language="en",
        latitude=52.37,
        longitude=4.89,
        time_zone=_time_zone(),
        unit_system="metric",
    )


def _time_zone(localtime: Path = Path("/etc/localtime")) -> str:
    """Return this machine's time zone, by the link that most systems have."""
    _, found, name = str(localtime.resolve()).partition("/zoneinfo/")
    try:
        ZoneInfo(name)
    except OSError, ValueError, ZoneInfoNotFoundError:
        return "UTC"
    # Debian's "no time zone" is called Etc/UTC.
    return name if found else "UTC"
