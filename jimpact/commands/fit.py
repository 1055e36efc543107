"""`jimpact fit`: the study's fit, its yardsticks, a report, a picture."""

from dataclasses import replace
from typing import Any

import numpy as np

from jimpact import plot
from jimpact.cli import FitCommand
from jimpact.commands.output import Answer, picture_path
from jimpact.fits.fitting import Fit
from jimpact.laws import Newton
from jimpact.laws.lzb import LZB
from jimpact.records import as_data, table
from jimpact.study import Study, read_study

RAW, CORRECTED, YARDSTICK, ALL_FREE = "as measured", "momentum corrected", "Newton", "all free"


def run(given: FitCommand) -> Answer:
    """Fit."""
    path = picture_path(given)
    study = read_study(given.study, given.law)
    fits = _all_fits(study, {"method": given.method, "starts": given.starts, "seed": given.seed})
    others = {"Newton fitted": fits[YARDSTICK]} if YARDSTICK in fits else None
    picture = plot.fit(fits[RAW], others, study.title)
    text = "\n".join([*_summary(fits), "", str(fits[RAW]), ""])
    return Answer(study.title, as_data({"fits": fits}), text, {path: picture})


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


def _summary(fits: dict[str, Fit]) -> list[str]:
    """A line a parameter of each fit, and what the data see of all parameters."""
    rows = []
    for what, fit in fits.items():
        data = "corrected" if what == CORRECTED else RAW
        last = [f"{fit.rms:.4f}", f"{fit.rank} of {len(fit.names)}"]
        for i, name in enumerate(fit.names):
            first = [type(fit.law).__name__, data] if i == 0 else ["", ""]
            rows.append([*first, name, _value(fit, i), *(last if i == 0 else ["", ""])])
    heads = ["law", "data", "parameter", "value", "rms [m/s]", "rank"]
    lines = table(heads, rows, left=["data", "parameter", "value"])
    if CORRECTED in fits:
        lines.append("corrected: changed as little as possible so that momentum is conserved")
    if everything := fits.get(ALL_FREE):
        names = everything.names
        lines.append(f"With {', '.join(names)} free the rank is {everything.rank} of {len(names)}.")
        lines += everything.identifiability
    return lines


def _value(fit: Fit, i: int) -> str:
    error = fit.standard_error[i]
    if fit.at_bound[i]:
        return f"{fit.value[i]:.5g} (bound)"
    spread = "unseen" if np.isinf(error) else "± unknown" if np.isnan(error) else f"± {error:.2g}"
    return f"{fit.value[i]:.5g} {spread}"
