"""What the host refuses: one clear error, a ValueError or TypeError of one line."""

import pytest


def refused(call, message):
    """The call is refused with this message, which shows no array as code and no tracer."""
    with pytest.raises((ValueError, TypeError), match=message) as error:
        call()
    text = str(error.value)
    assert text.count("\n") == 0
    assert "Array(" not in text
    assert "Traced" not in text
