"""`jimpact advise`: the simplest law that a scene needs, with the evidence and a picture."""

from pathlib import Path
from typing import Any

from jimpact.commands.compare import velocities
from jimpact.commands.output import Answer, command, save_picture
from jimpact.methods.advice import advise
from jimpact.methods.advice_report import Advice
from jimpact.study import Study, read_study

_TAKEN = ("restitution", "stiffness", "exponent")  # of the study's parameters


@command("advise")
def run(
    study: Path,
    velocity: tuple[float, ...] | None,
    shot: int,
    tolerance: float,
    stiffness_range: tuple[float, float] | None,
    samples: int,
    seed: int,
    picture: Path,
) -> Answer:
    """Advise with the options of `AdviseCommand`."""
    given = read_study(study)
    before, _ = velocities(given, velocity, shot)
    found = advise(
        given.scene,
        before,
        tolerance,
        stiffness_range=stiffness_range,
        samples=samples,
        seed=seed,
        **_parameters(given),
    )
    _draw(found, given.title, picture)
    data = {"title": given.title, "velocity": before.tolist()} | found.to_dict()
    v = ", ".join(f"{x:g}" for x in before)
    text = f"{given.title}: v- = ({v}) m/s\n{found}\n\nPicture: {picture}"
    return Answer(data | {"picture": str(picture)}, lambda: print(text))


def _parameters(study: Study) -> dict[str, Any]:
    """Of the study's law what LZB has too."""
    rheology = study.parameters.get("rheology", "bistiffness")
    if rheology != "bistiffness":
        raise ValueError(
            f"the study must have bistiffness contacts, but has rheology {rheology!r}: of viscous "
            "contacts only the compliant law knows."
        )
    return {key: value for key, value in study.parameters.items() if key in _TAKEN}


def _draw(found: Advice, title: str, path: Path) -> None:
    from jimpact import plot  # matplotlib, late

    save_picture(plot.advice(found, title), path)
