"""Reasons for which the library refuses a command in a state."""

import ast
from pathlib import Path
import re

from custom_components.evse_bus.evse import errors


def reason_keys() -> set[str]:
    """Return the translation keys that the sources give to `NotAvailableError`."""
    names = re.compile(r"(abl|ews|smartevse)_[a-z_]+")
    sources = (Path(errors.__file__).parent).rglob("*.py")
    return {
        one.value
        for source in sources
        for call in ast.walk(ast.parse(source.read_text()))
        if isinstance(call, ast.Call)
        and getattr(call.func, "id", "") in ("NotAvailableError", "refuse_in", "Rule")
        for one in call.args
        if isinstance(one, ast.Constant) and isinstance(one.value, str)
        if names.fullmatch(one.value)
    }
