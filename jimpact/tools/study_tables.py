"""Tables of a study: their keys, the types of their values, and the arguments that they
are.
"""

from collections.abc import Mapping
from typing import Any

from jimpact.tools.checks import suggestion


def check_keys(
    where: str, table: Any, allowed: Any, required: tuple[str, ...] = ()
) -> None:
    """Raise a ValueError for unknown or missing keys of a table."""
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} must be a table, but is {table!r}.")
    for key in required:
        if key not in table:
            raise ValueError(
                f"{where} must have the key `{key}`, but has "
                f"{', '.join(table) or 'none'}."
            )
    for key in table:
        if key not in allowed:
            raise ValueError(
                f"{where} may have the keys {', '.join(allowed)}, but has `{key}`."
                f"{suggestion(key, allowed)}"
            )


def check_kind(where: str, key: str, value: Any, kind: Any, words: str) -> None:
    """Raise a ValueError unless the value of a key is of a Python type, which `words`
    name.
    """
    if not isinstance(value, kind):
        raise ValueError(f"`{key}` in {where} must be {words}, but is {value!r}.")


def arguments_of(table: Mapping[str, Any], keys: Mapping[str, str]) -> dict[str, Any]:
    """Values of a table by name of the argument, `keys` mapping its keys to
    arguments.
    """
    return {name: table[key] for key, name in keys.items() if key in table}
