"""Writes `docs/chapter.md` from the rows: `python tests/chapter/chapter_page.py`."""

import sys
from pathlib import Path

import jax
import numpy as np

PAGE = Path(__file__).parents[2] / "docs" / "chapter.md"
HEAD = """# The chapter

The source, section by section: B. Brogliato, *Nonsmooth Mechanics* (3rd ed., Springer 2016), chapter 6. What to
call for each system, law, example and figure, what is printed there, and what comes out. Where the chapter is
wrong, the last column says what is used; [Equations](equations.md) has all errata. Written by
`python tests/chapter/chapter_page.py`; tests run every row. The calls follow these lines:

```python
{before}```

`chapter_figures` is the file `notebooks/chapter_figures.py`; the notebook `16_the_chapter` draws all figures.
"""


def shown(value):
    """A result as the page shows it."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(shown(x) for x in value)
    numbers = np.asarray(value, float) + 0.0
    if numbers.ndim:
        return "(" + ", ".join(shown(x) for x in numbers) + ")"
    near = float(numbers) if abs(float(numbers)) > 1e-6 else 0.0
    return f"{near:.5g}"


def line(cells):
    """A line of a table."""
    return "| " + " | ".join(x.replace("|", r"\|") for x in cells) + " |"


def cells(row, value):
    """The columns of a row."""
    return [
        row.where,
        row.what,
        f"`{row.call}`",
        row.printed,
        shown(value),
        row.erratum,
    ]


def page(sections, before):
    """The whole page: sections of cells."""
    heads = ["chapter", "what", "call", "printed", "ours", "erratum"]
    text = [HEAD.format(before=before)]
    for title, rows in sections.items():
        text += [
            f"## {title}",
            "",
            line(heads),
            line(["---"] * len(heads)),
            *map(line, rows),
            "",
        ]
    return "\n".join(text).rstrip() + "\n"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.path[:0] = [str(Path(__file__).parent), str(PAGE.parents[1] / "notebooks")]
    import chapter_rows as rows

    made = {
        title: [
            row.cells
            if isinstance(row, rows.Figure)
            else cells(row, rows.run(row.call))
            for row in group
        ]
        for title, group in rows.SECTIONS.items()
    }
    PAGE.write_text(page(made, rows.BEFORE), encoding="utf-8")
    print(f"written: {PAGE}")
