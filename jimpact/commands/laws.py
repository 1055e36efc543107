"""`jimpact laws`: the registry as a table, as JSON or as references."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from jimpact.cli import LawsCommand
from jimpact.commands.output import Answer
from jimpact.laws import REGISTRY
from jimpact.study import import_laws

COLUMNS = ("parameters", "summary", "right_when", "fails_when", "source")


def run(given: LawsCommand) -> Answer:
    """Print the registry."""
    if given.module is not None:
        import_laws(given.module, Path())
    rows = {name: {k: getattr(row, k) for k in COLUMNS} for name, row in REGISTRY.items()}
    if given.bibtex:
        entries = dict.fromkeys(row.bibtex for row in REGISTRY.values())
        return Answer("", rows, "\n\n".join(entries), {})
    table = Table()
    for title in ("law", "parameters", "says", "right when", "fails when"):
        table.add_column(title, overflow="fold")
    for name, row in REGISTRY.items():
        parameters = ", ".join(row.parameters)
        table.add_row(name, parameters, row.summary, row.right_when, row.fails_when)
    console = Console()
    with console.capture() as text:
        console.print(table)
    return Answer("", rows, text.get().rstrip(), {})
