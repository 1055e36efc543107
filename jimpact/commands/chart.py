"""`jimpact chart`: speed against accuracy on one scene; a table, a picture."""

from pathlib import Path

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from jimpact.commands.compare import velocities
from jimpact.commands.output import Answer, command, console_for, save_picture
from jimpact.laws import REGISTRY
from jimpact.laws.lzb import LZB
from jimpact.methods.chart import work_precision
from jimpact.methods.chart_record import Point, Timing, WorkPrecision
from jimpact.methods.contenders import METHODS
from jimpact.study import Study, read_study

SLOW_TO_COMPILE = ("tsit5", "kvaerno5")  # left to --full


@command("chart")
def run(
    study: Path,
    velocity: tuple[float, ...] | None,
    shot: int,
    methods: tuple[str, ...] | None,
    full: bool,
    no_gradients: bool,
    batch: int,
    repeats: int,
    picture: Path,
) -> Answer:
    """Measure with the options of `ChartCommand`."""
    given = read_study(study)
    law = _law(given)
    before, _ = velocities(given, velocity, shot)
    names = methods or _able(law, given, full)
    found = work_precision(
        given.scene, before, law, names, batch=batch, repeats=repeats, gradients=not no_gradients
    )
    _draw(found, given.title, picture)
    data = {"title": given.title} | found.to_dict() | {"picture": str(picture)}
    return Answer(data, lambda: _print(given, found, picture))


def _law(study: Study) -> LZB:
    """The study's law, or LZB with what the study says of its parameters (restitution: 1)."""
    if isinstance(study.law, LZB):
        return study.law
    known = {"restitution": 1.0} | study.parameters
    return LZB(**{key: known[key] for key in REGISTRY["lzb"].parameters if key in known})


def _able(law: LZB, study: Study, full: bool) -> tuple[str, ...]:
    """Methods that can solve the study's impact, without those that compile for long."""
    left_out = () if full else SLOW_TO_COMPILE
    return tuple(
        name
        for name, method in METHODS.items()
        if name not in left_out and method.supports(law, study.scene) is None
    )


def _draw(found: WorkPrecision, title: str, path: Path) -> None:
    from jimpact import plot  # matplotlib, late

    save_picture(plot.work_precision(found, title), path)


def _print(study: Study, found: WorkPrecision, path: Path) -> None:
    table = _table(found)
    console = console_for(table)
    before = ", ".join(f"{v:g}" for v in found.velocity)
    console.print(f"[bold]{escape(study.title)}[/bold]: v- = ({before}) m/s", soft_wrap=True)
    console.print(table)
    uncertain = ", ".join(
        f"{name} {value:.0e}" for name, value in found.reference.uncertainty.items()
    )
    console.print(f"Reference: {found.reference.how}; uncertain by {uncertain}.", soft_wrap=True)
    console.print(
        f"Errors: relative, the largest of {found.sample} impacts with stiffness spread over a "
        f"factor {found.spread:g}; of a law its model error. Times: medians of {found.repeats} in "
        f"turns, µs per impact: alone, in a batch of {found.batch} (quartiles), with gradient.",
        soft_wrap=True,
    )
    for name, why in (found.left_out | found.without_gradient).items():
        console.print(f"{name}: {why}.", soft_wrap=True)
    console.print(f"Picture: {escape(str(path))}", soft_wrap=True)


def _table(found: WorkPrecision) -> Table:
    table = Table("method", box=box.SIMPLE_HEAD, pad_edge=False)
    titles = ("setting", "v+", "impulse", "energy", "time", "gradient", "evals", "alone", "batch")
    for title in (*titles, "gradient", "compile s"):
        table.add_column(title, justify="right")
    table.add_column("status")
    for name, row in found.points.items():
        for number, point in enumerate(row):
            compiled = sum(found.compile_time[name].values())
            seconds = f"{compiled:.1f}" if compiled and number == 0 else ""
            table.add_row(*_cells(point, number == 0), seconds, point.status)
    return table


def _cells(point: Point, first: bool) -> list[str]:
    errors = ["" if np.isnan(e) else f"{e:.0e}" for e in point.error.values()]
    count = "" if np.isnan(point.evaluations) else f"{point.evaluations:.0f}"
    setting = "" if point.setting is None else f"{point.setting:g}"
    b = point.batched
    batched = f"{1e6 * b.median:.3g} ({1e6 * b.low:.3g}-{1e6 * b.high:.3g})"
    return [
        point.name if first else "",
        setting,
        *errors,
        count,
        _microseconds(point.single),
        batched,
        _microseconds(point.gradient),
    ]


def _microseconds(timing: Timing | None) -> str:
    return "" if timing is None else f"{1e6 * timing.median:.3g}"
