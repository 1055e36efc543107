"""`jimpact advise`: the simplest law that a scene needs, with the evidence and a picture."""

from typing import Any

from jimpact import plot
from jimpact.cli import AdviseCommand
from jimpact.commands.output import Answer, picture_path, save_picture, titled, velocities
from jimpact.methods.advice import advise
from jimpact.study import Study, read_study

_TAKEN = ("restitution", "stiffness", "exponent")  # of the study's parameters


def run(given: AdviseCommand) -> Answer:
    """Advise."""
    path = picture_path(given.out, given.name)
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
    save_picture(plot.advice(found, study.title), path)
    data = {"title": study.title, "velocity": before.tolist(), "picture": str(path)}
    text = f"{titled(study, before)}\n{found}\n\nPicture: {path}"
    return Answer(data | found.to_dict(), text)


def _parameters(study: Study) -> dict[str, Any]:
    """Of the study's law what LZB has too."""
    rheology = study.parameters.get("rheology", "bistiffness")
    if rheology != "bistiffness":
        raise ValueError(
            f"the study must have bistiffness contacts, but has rheology {rheology!r}: of viscous "
            "contacts only the compliant law knows."
        )
    return {key: value for key, value in study.parameters.items() if key in _TAKEN}
