"""What is wrong with the data or with a fit, in words."""

from collections.abc import Sequence
from typing import NamedTuple


class Finding(NamedTuple):
    """A line of the warnings, and what a sentence that quotes the fit has to say about it."""

    line: str
    reservation: str = ""


def share(count: int, total: int) -> str:
    """So many of all shots, in words.

    >>> from jimpact.fits.findings import share
    >>> share(1, 1), share(6, 6), share(2, 6)
    ('this shot', 'all 6 shots', '2 of 6 shots')
    """
    if count == total < 3:
        return "this shot" if total == 1 else "both shots"
    return f"all {total} shots" if count == total else f"{count} of {total} shots"


def joined_words(parts: Sequence[str]) -> str:
    """Parts of a sentence, the last one after an "and".

    >>> from jimpact.fits.findings import joined_words
    >>> joined_words(["a"]), joined_words(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    return " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else "".join(parts)
