"""What the host refuses: one clear error, a ValueError or TypeError of one line."""

import re

import pytest


def argument(name, value=""):
    """Pattern of an error that names an argument first, then perhaps a value that it has.

    Its words are free: `test_errors_of_checks_inside.py` holds those of the usual checks.
    """
    return rf"^Arguments? .*`{re.escape(name)}`.*{re.escape(str(value))}"


def refused(call, message):
    """The call is refused with this message, which shows no array as code and no tracer."""
    with pytest.raises((ValueError, TypeError), match=message) as error:
        call()
    text = str(error.value)
    assert text.count("\n") == 0
    assert "Array(" not in text
    assert "Traced" not in text
