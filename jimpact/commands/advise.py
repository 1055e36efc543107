"""`jimpact advise`: the simplest law that a scene needs, with the evidence and a picture."""

from typing import Any

from jimpact import plot
from jimpact.cli import AdviseCommand
from jimpact.commands.output import Answer, picture_path, titled, velocities
from jimpact.methods.advice import advise
from jimpact.study import Study, read_study

_TAKEN = ("restitution", "stiffness", "exponent")  # of the study's parameters


def run(given: AdviseCommand) -> Answer:
    """Advise."""
    path = picture_path(given)
    study = read_study(given.study)
    before, _ = velocities(study, given)
    found = advise(
        study.scene,
        before,
        given.tolerance,
        stiffness_range=given.stiffness_range,
        samples=given.samples,
        seed=given.seed,
        **_parameters(study),
    )
    picture = plot.advice(found, study.title)
    return Answer(titled(study, before), found.to_dict(), str(found), {path: picture})


def _parameters(study: Study) -> dict[str, Any]:
    """Of the study's law what LZB has too."""
    rheology = study.parameters.get("rheology", "bistiffness")
    if rheology != "bistiffness":
        raise ValueError(
            f"the study must have bistiffness contacts, but has rheology {rheology!r}: of viscous "
            "contacts only the compliant law knows."
        )
    return {key: value for key, value in study.parameters.items() if key in _TAKEN}
