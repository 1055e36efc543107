"""Writes `docs/validation.md` from the rows: `python tests/validation/page.py`."""

import math
import sys
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "validation.md"
HEAD = """# Comparison with published results

Closed forms and published constants, and the values that jimpact computes. Written by
`python tests/validation/page.py`; a test compares the page with the rows of `tests/validation/rows.py`.
The error is relative to 1 or to the number, whichever is larger, and rounded up to a power of ten.
"""


def decade(error):
    """Rounded up to a power of ten; differences within rounding are 0."""
    if error < 1e-14:
        return "0"
    return f"1e{math.ceil(math.log10(error)):+03d}"


def lines(case, rows):
    """Markdown of a case."""
    text = [f"## {case.title}", "", f"{case.source}.", ""]
    if case.note:
        text[-1:] = ["", case.note, ""]
    text += ["| | published | jimpact | error |", "|---|---|---|---|"]
    for row in rows:
        theirs, ours = (f"{x:.{row.digits}f}" for x in (row.theirs, row.ours))
        text.append(f"| {row.what} | {theirs} | {ours} | {decade(row.error)} |")
    return [*text, ""]


def page(computed):
    """The whole page of (case, rows)."""
    parts = [HEAD, *("\n".join(lines(case, rows)) for case, rows in computed)]
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(Path(__file__).parent))
    import rows as numbers

    PAGE.write_text(
        page([(case, case.rows()) for case in numbers.CASES]), encoding="utf-8"
    )
    print(f"written: {PAGE}")
