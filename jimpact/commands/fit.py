"""`jimpact fit`: the study's fit, its yardsticks, a report, a picture."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from jimpact.commands.output import Answer, command, console_for, save_picture
from jimpact.fits.fitting import Fit
from jimpact.laws import Newton
from jimpact.laws.lzb import LZB
from jimpact.study import Study, read_study

RAW, CORRECTED, YARDSTICK, ALL_FREE = "as measured", "momentum corrected", "Newton", "all free"


@command("fit")
def run(
    study: Path,
    law: str | None,
    method: str | None,
    starts: int | None,
    seed: int | None,
    picture: Path,
) -> Answer:
    """Fit with the options of `FitCommand`."""
    given = read_study(study, law)
    fits = _all_fits(given, {"method": method, "starts": starts, "seed": seed})
    _draw(given, fits, picture)
    found = {name: fit.to_dict() for name, fit in fits.items()}
    data = {"title": given.title, "fits": found, "picture": str(picture)}
    return Answer(data, lambda: _print_report(given, fits, picture))


def _draw(study: Study, fits: dict[str, Fit], path: Path) -> None:
    from jimpact import plot  # matplotlib, late: bad input is told sooner

    others = {"Newton fitted": fits[YARDSTICK]} if YARDSTICK in fits else None
    save_picture(plot.fit(fits[RAW], others, study.title), path)


def _all_fits(study: Study, options: dict[str, Any]) -> dict[str, Fit]:
    """The study's fit and its yardsticks; fits of one law share one compiled program."""
    own, everything = _per_contact(study)
    fits = {RAW: own.run(**options)}
    if any("break momentum" in line for line in fits[RAW].warnings):
        assert study.experiments is not None  # it was fitted
        data = study.experiments.momentum_corrected(study.scene)
        fits[CORRECTED] = replace(own, experiments=data).run(**options)
    if not isinstance(study.law, Newton):
        newton = replace(study, law=Newton(0.5), free={"restitution": True}, bounds={})
        fits[YARDSTICK] = newton.run(**options)
    if everything is not None:
        fits[ALL_FREE] = everything.run(**options)
    return fits


def _per_contact(study: Study) -> tuple[Study, Study | None]:
    """The study of an LZB law with one value per contact, tied where it had one for all.

    And the study with every e and stiffness ratio free, None where that is no LZB or no more.
    """
    law, contacts = study.law, study.scene.contacts
    fields = ("restitution", "stiffness")
    if not isinstance(law, LZB) or contacts < 2 or not set(study.free) <= set(fields):
        return study, None
    tied = {}
    for name in fields:
        choice = np.asarray(study.free.get(name, False))
        one_each = np.arange(1, contacts + 1) if np.ndim(getattr(law, name)) else 1
        labels = np.where(choice, one_each, 0) if choice.dtype == bool else choice
        tied[name] = np.broadcast_to(labels, (contacts,))
    e, k = (np.broadcast_to(getattr(law, name), (contacts,)) for name in fields)
    law = LZB(e, k, exponent=law.exponent, initial_energy=law.initial_energy)
    own = replace(study, law=law, free=tied)
    if len(np.unique(tied["restitution"])) == contacts and tied["stiffness"].all():
        return own, None
    return own, replace(own, free=dict.fromkeys(fields, True))


def _print_report(study: Study, fits: dict[str, Fit], path: Path) -> None:
    table = _table(fits)
    console = console_for(table)
    console.print(f"[bold]{escape(study.title)}[/bold]")
    console.print(table)
    if CORRECTED in fits:
        console.print("corrected: changed as little as possible so that momentum is conserved")
    everything = fits.get(ALL_FREE)
    if everything is not None:
        names, count = ", ".join(everything.names), len(everything.names)
        console.print(
            f"With {escape(names)} free the rank is {everything.rank} of {count}.", soft_wrap=True
        )
        for line in everything.identifiability:
            console.print(escape(line), soft_wrap=True)
    console.print()
    console.print(escape(str(fits[RAW])), soft_wrap=True)
    console.print(f"\nPicture: {escape(str(path))}", soft_wrap=True)


def _table(fits: dict[str, Fit]) -> Table:
    table = Table("law", "data", "parameter", "value", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("rms [m/s]", justify="right")
    table.add_column("rank", justify="right")
    for name, fit in fits.items():
        data = "corrected" if name == CORRECTED else RAW
        values = "\n".join(_value(fit, i) for i in range(len(fit.names)))
        rank = f"{fit.rank} of {len(fit.names)}"
        names = escape("\n".join(fit.names))
        table.add_row(type(fit.law).__name__, data, names, values, f"{fit.rms:.4f}", rank)
    return table


def _value(fit: Fit, i: int) -> str:
    error = fit.standard_error[i]
    if fit.at_bound[i]:
        return f"{fit.value[i]:.5g} (bound)"
    spread = "unseen" if np.isinf(error) else "± unknown" if np.isnan(error) else f"± {error:.2g}"
    return f"{fit.value[i]:.5g} {spread}"
