"""Each language says what the English texts say, completely and in the same form.

That the English texts cover what the code names is tested in test_texts.py, and for
the flows in tests/flow.py, which looks up everything that they show.
"""

from functools import cache
import json
from pathlib import Path
import re
from typing import TYPE_CHECKING

from homeassistant.helpers.translation import async_get_translations
import pytest

from custom_components.evse_bus.const import DOMAIN

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

FOLDER = Path(__file__).parents[1] / f"custom_components/{DOMAIN}/translations"
ENGLISH = "en"
LANGUAGES = ("de", "fr", "nl")

PLACEHOLDER = re.compile(r"\{(\w+)\}")
NUMBER = re.compile(r"\d+")
LITERALS = (
    # What is the same in every language because a machine or a label says it.
    *("8N1", "8E1", "F4", "RS-485", "D+", "D-", "/dev/serial/by-id", "dialout"),
    *("A-F", "L1", "L2", "L3", "EVBox", "ABL", "eMH1", "EVCC2/3", "Protocol Max v4"),
    *("SmartEVSE", "LOAD BAL", "Disabled", "MODE", "MAX", "Slave 1", "Slave 2"),
    "Home Assistant",
)
MARKDOWN = ("**", "\n\n", "\n- ", "|", "|---", "`", "#", "<", "](")

SAME_EVERYWHERE = {
    # Names of phases.
    *("L1, L2, L3", "L1, L3, L2", "L2, L1, L3"),
    *("L2, L3, L1", "L3, L1, L2", "L3, L2, L1"),
    # Numbers of stop bits.
    *("1", "2"),
    # Words of a SmartEVSE's menu.
    *("Normal", "Smart", "Solar"),
    # A maker of plug locks.
    "Walther",
    # The name that a box gives.
    "{name}",
}
SAME = {
    # The language has the same word.
    "de": {"Name", "Orange LED", "Port", "Server", "Slave", "Slaves", "Status"},
    "fr": {"Charge", "Message", "Module {number}", "Port", "Ventilation"},
    "nl": {
        *("Even", "Gateway", "Module {number}", "Parameters", "Protocol"),
        *("Server", "Slave", "Slaves", "Status", "Time-outs"),
    },
}

MISSING_NO_BREAK_SPACE = re.compile(
    r"(?<!\u00a0)[;?!»](?!\w)|(?<![\u00a0\w]):(?!\w)|« "
)
"""French has a space that does not break before such a sign, and inside of « »."""


def flat(texts: object, path: str = "") -> dict[str, str]:
    """Return a text for each path."""
    if not isinstance(texts, dict):
        assert isinstance(texts, str), path
        return {path: texts}
    return {
        deeper: text
        for key, value in texts.items()
        for deeper, text in flat(value, f"{path}.{key}" if path else key).items()
    }


@cache
def read(language: str) -> dict[str, str]:
    return flat(json.loads((FOLDER / f"{language}.json").read_text(encoding="utf-8")))


def pairs(language: str) -> list[tuple[str, str, str]]:
    """Return path, English text and translation of each text."""
    translated = read(language)
    return [(path, text, translated[path]) for path, text in read(ENGLISH).items()]


def test_each_language_is_looked_at() -> None:
    assert {file.stem for file in FOLDER.iterdir()} == {ENGLISH, *LANGUAGES}


@pytest.mark.parametrize("language", [ENGLISH, *LANGUAGES])
def test_files_have_one_form(language: str) -> None:
    """No key twice either: only the last would be left of them."""
    written = (FOLDER / f"{language}.json").read_text(encoding="utf-8")
    formed = json.dumps(json.loads(written), indent=2, ensure_ascii=False)
    assert written == f"{formed}\n"


@pytest.mark.parametrize("language", LANGUAGES)
def test_nothing_is_missing_and_nothing_left_over(language: str) -> None:
    # As lists: in the same order, so that two files can be read side by side.
    assert list(read(language)) == list(read(ENGLISH))


@pytest.mark.parametrize("language", [ENGLISH, *LANGUAGES])
def test_texts_are_clean(language: str) -> None:
    for path, text in read(language).items():
        assert text, path
        assert text == text.strip(), path
        assert "  " not in text, path
        # A link belongs into a placeholder, as Home Assistant wants it.
        assert "http" not in text, path
        assert text.count("{") == text.count("}") == len(PLACEHOLDER.findall(text))


@pytest.mark.parametrize("language", LANGUAGES)
def test_placeholders_are_the_same(language: str) -> None:
    for path, english, translated in pairs(language):
        # A language may have to name something twice.
        wanted = set(PLACEHOLDER.findall(english))
        assert set(PLACEHOLDER.findall(translated)) == wanted, path


@pytest.mark.parametrize("language", LANGUAGES)
def test_values_and_names_are_the_same(language: str) -> None:
    """A wrong number of amperes or seconds would be worse than an English text."""
    for path, english, translated in pairs(language):
        wanted = sorted(NUMBER.findall(english))
        assert sorted(NUMBER.findall(translated)) == wanted, path
        for literal in LITERALS:
            assert (literal in translated) == (literal in english), (path, literal)


@pytest.mark.parametrize("language", LANGUAGES)
def test_markdown_is_the_same(language: str) -> None:
    for path, english, translated in pairs(language):
        for sign in MARKDOWN:
            assert translated.count(sign) == english.count(sign), (path, sign)


@pytest.mark.parametrize("language", LANGUAGES)
def test_texts_are_translated(language: str) -> None:
    same = {
        english for _, english, translated in pairs(language) if english == translated
    }
    # Equal: what is allowed and not needed any more has to go, too.
    assert same == SAME_EVERYWHERE | SAME[language]


@pytest.mark.parametrize("language", LANGUAGES)
def test_one_english_text_has_one_translation(language: str) -> None:
    """The same field must not have two names in two places."""
    translations: dict[str, set[str]] = {}
    for _, english, translated in pairs(language):
        translations.setdefault(english, set()).add(translated)
    several = {english for english, found in translations.items() if len(found) > 1}
    # No fault and no parity differ in gender.
    assert several <= {"None"}


def test_french_signs_do_not_stand_alone() -> None:
    for path, text in read("fr").items():
        assert not MISSING_NO_BREAK_SPACE.search(text), path


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(
    "category",
    [
        *("config", "config_subentries", "device", "entity"),
        *("exceptions", "issues", "options", "selector", "services"),
    ],
)
async def test_home_assistant_takes_them(
    hass: HomeAssistant, language: str, category: str
) -> None:
    """It shows the English text instead of one that it cannot fill in."""
    loaded = await async_get_translations(hass, language, category, {DOMAIN})
    prefix = f"component.{DOMAIN}."
    assert {path.removeprefix(prefix): text for path, text in loaded.items()} == {
        path: text
        for path, text in read(language).items()
        if path.startswith(f"{category}.")
    }


@pytest.mark.parametrize("path", sorted(read("en")))
def test_no_state_is_one_of_home_assistants_own(path: str) -> None:
    """A sensor that shows ``unavailable`` as a value is greyed as if it were."""
    assert not path.startswith("entity.") or not path.endswith(
        (".state.unavailable", ".state.unknown")
    )
