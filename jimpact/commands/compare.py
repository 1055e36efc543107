"""`jimpact compare`: every law on one scene; a table, a picture."""

from dataclasses import replace

import numpy as np

from jimpact import plot
from jimpact.cli import CompareCommand
from jimpact.commands.output import Answer, picture_path, titled, velocities
from jimpact.comparison import compare, registered_laws
from jimpact.fits.fitting import Fit
from jimpact.records import as_data, table
from jimpact.study import Study, read_study


def run(given: CompareCommand) -> Answer:
    """Compare."""
    path = picture_path(given)
    study = read_study(given.study)
    before, measured = velocities(study, given)
    laws, left_out = registered_laws(study.parameters)
    found = compare(study.scene, before, laws)
    found = replace(found, left_out=left_out, measured=measured)
    fits = _fits(study) if given.fit else {}
    values = ", ".join(f"{key} = {value}" for key, value in study.parameters.items())
    lines = [
        str(found),
        *(_table(fits) if fits else []),
        f"Parameters: {values}.",
        "Dispersion: 0 all energy in one body, 1 equal shares. Time: one compiled call, its "
        "argument checks included.",
    ]
    data = {"velocity": before, "laws": found, "fits": fits, "left_out": left_out}
    picture = plot.comparison(found, measured, study.title)
    return Answer(titled(study, before), as_data(data), "\n".join(lines), {path: picture})


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


def _table(fits: dict[str, Fit]) -> list[str]:
    rows = [
        [name, ", ".join(f"{x:.4f}" for x in fit.value), f"{fit.rms:.4f}"]
        for name, fit in fits.items()
    ]
    return table(["fitted law", "restitution", "rms [m/s]"], rows, left=["restitution"])
