"""`jimpact advise`: the simplest law that a scene needs, with the evidence and a picture."""

import sys
from json import dumps
from pathlib import Path
from typing import Any

import jax

from jimpact.commands.compare import velocities
from jimpact.commands.output import picture_path, save_picture
from jimpact.methods.advice import advise
from jimpact.methods.advice_report import Advice
from jimpact.study import Study, read_study

PICTURE = "jimpact-advise.png"
_TAKEN = ("restitution", "stiffness", "exponent")  # of the study's parameters


def run(
    study: Path,
    velocity: tuple[float, ...] | None,
    shot: int,
    tolerance: float,
    stiffness_range: tuple[float, float] | None,
    samples: int,
    seed: int,
    out: Path,
    json: bool,
) -> int:
    """Run the command with the options of `AdviseCommand`; told in one line on stderr: 2 for bad
    input, 1 where the reference law fails on the scene.
    """
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets nothing
    try:
        path = picture_path(out, PICTURE)
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
        _draw(found, given.title, path)
    except (ValueError, TypeError, OSError) as error:
        print(f"jimpact advise: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"jimpact advise: {error}", file=sys.stderr)
        return 1
    if json:
        told = {"title": given.title, "velocity": before.tolist()} | found.to_dict()
        print(dumps(told | {"picture": str(path)}, indent=2))
    else:
        before_told = ", ".join(f"{v:g}" for v in before)
        print(f"{given.title}: v- = ({before_told}) m/s\n{found}\n\nPicture: {path}")
    return 0


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
