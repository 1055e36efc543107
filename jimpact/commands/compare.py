"""`jimpact compare`: every law on one scene; a table, a picture."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from jimpact.audits import nothing_approaches
from jimpact.commands.output import Answer, command, console_for, save_picture
from jimpact.comparison import (
    Comparison,
    compare,
    dispersion_index,
    energy_ratio,
    registered_laws,
    verdict,
)
from jimpact.fits.fitting import Fit
from jimpact.study import Study, read_study


@command("compare")
def run(
    study: Path, velocity: tuple[float, ...] | None, shot: int, fit: bool, picture: Path
) -> Answer:
    """Compare with the options of `CompareCommand`."""
    given = read_study(study)
    before, measured = velocities(given, velocity, shot)
    laws, left_out = registered_laws(given.parameters)
    found = replace(compare(given.scene, before, laws), left_out=left_out)
    fits = _fits(given) if fit else {}
    _draw(found, measured, given.title, picture)
    data: dict[str, Any] = {"title": given.title, "velocity": before.tolist()}
    data |= {"laws": found.to_dict(), "fits": {n: f.to_dict() for n, f in fits.items()}}
    data |= {"left_out": found.left_out, "picture": str(picture)}
    return Answer(data, lambda: _print(given, found, measured, fits, picture))


def velocities(
    study: Study, velocity: tuple[float, ...] | None, shot: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """Velocities before the impact, and after it where they were measured."""
    if velocity is not None:
        return np.asarray(velocity, float), None
    data = study.experiments
    if data is None:
        raise ValueError("--velocity must be given, because the study has no [data].")
    if not 1 <= shot <= len(data.shots):
        raise ValueError(f"--shot must lie in [1, {len(data.shots)}], but is {shot}.")
    return np.asarray(data.pre[shot - 1]), np.asarray(data.post[shot - 1])


def _fits(study: Study) -> dict[str, Fit]:
    """Every law with restitution coefficients at its best, one for all contacts and one each."""
    start = {**study.parameters, "restitution": 0.9}
    each = {**start, "restitution": np.full(study.scene.contacts, 0.9)}
    fits = {}
    for label, values in (("one e", start), ("e per contact", each)):
        for name, law in registered_laws(values)[0].items():
            if hasattr(law, "restitution") and (label == "one e" or study.scene.contacts > 1):
                own = replace(study, law=law, free={"restitution": True}, bounds={})
                fits[f"{name}, {label}"] = own.run()
    return fits


def _draw(found: Comparison, measured: np.ndarray | None, title: str, path: Path) -> None:
    from jimpact import plot  # matplotlib, late

    save_picture(plot.comparison(found, measured, title), path)


def _print(
    study: Study,
    found: Comparison,
    measured: np.ndarray | None,
    fits: dict[str, Fit],
    path: Path,
) -> None:
    tables = [_table(study, found, measured), *([_fit_table(fits)] if fits else [])]
    console = console_for(*tables)
    before = ", ".join(f"{v:g}" for v in found.velocity)
    console.print(f"[bold]{escape(study.title)}[/bold]: v- = ({before}) m/s", soft_wrap=True)
    console.print(*tables)
    quiet = nothing_approaches(found.scene, found.velocity)
    if quiet is not None:
        console.print(f"[bold]No impact:[/bold] {escape(quiet)}.", soft_wrap=True)
    for name, reason in found.left_out.items():
        console.print(f"{escape(name)} is left out: it {escape(reason)}.", soft_wrap=True)
    values = ", ".join(f"{key} = {value}" for key, value in study.parameters.items())
    console.print(f"Parameters: {escape(values)}.", soft_wrap=True)
    console.print(
        "Dispersion: 0 all energy in one body, 1 equal shares. Time: one compiled call, its "
        "argument checks included.",
        soft_wrap=True,
    )
    console.print(f"Picture: {escape(str(path))}", soft_wrap=True)


def _table(study: Study, found: Comparison, measured: np.ndarray | None) -> Table:
    table = Table("law", box=box.SIMPLE_HEAD, pad_edge=False)
    for i in range(study.scene.size):
        table.add_column(f"v{i + 1}+", justify="right")
    for title in ("T+/T-", "dispersion", "µs"):
        table.add_column(title, justify="right")
    table.add_column("audit")
    for name, entry in found.entries.items():
        v = [f"{x:.4f}" for x in np.asarray(entry.outcome.velocity)]
        numbers = [f"{entry.energy_ratio:.4f}", f"{entry.dispersion_index:.3f}"]
        table.add_row(name, *v, *numbers, f"{1e6 * entry.time:.0f}", verdict(entry))
    if measured is not None:
        whole = bool(np.isfinite(measured).all())
        v = [f"{x:.4f}" if np.isfinite(x) else "" for x in measured]
        ratio = f"{float(energy_ratio(study.scene, found.velocity, measured)):.4f}" if whole else ""
        spread = f"{float(dispersion_index(study.scene, measured)):.3f}" if whole else ""
        table.add_row("measured", *v, ratio, spread, "", "", style="bold")
    return table


def _fit_table(fits: dict[str, Fit]) -> Table:
    table = Table("fitted law", "restitution", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("rms [m/s]", justify="right")
    for name, fit in fits.items():
        table.add_row(name, ", ".join(f"{x:.4f}" for x in fit.value), f"{fit.rms:.4f}")
    return table
