"""`jimpact simulate`: a whole motion; a report, a picture, an animation."""

import contextlib
import sys
from collections.abc import Iterator
from json import dumps
from pathlib import Path

import jax
from rich.console import Console

from jimpact.commands.output import picture_path, save_picture
from jimpact.motion.record import Motion, raise_on_failed_motion
from jimpact.motion.study_motion import MotionStudy, read_motion_study

PICTURE = "jimpact-simulate.png"


def run(
    study: Path,
    t_end: float | None,
    samples: int | None,
    gif: Path | None,
    portrait: Path | None,
    coordinate: int,
    out: Path,
    json: bool,
) -> int:
    """Run the command with the options of `SimulateCommand`; told on stderr: 2 for bad input, 1
    where the motion does not reach its end (what there is of it is drawn and printed all the same).
    """
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets nothing
    try:
        path = picture_path(out, PICTURE)
        if portrait is not None:
            picture_path(portrait, "", "--portrait")
        if gif is not None and gif.suffix != ".gif":
            raise ValueError(f"--gif must end in .gif, but is '{gif}'.")
        given = read_motion_study(study)
        with _told("compiling and simulating"):
            motion = jax.block_until_ready(given.run(t_end=t_end, samples=samples))
        pictures = {"picture": path, "portrait": portrait, "animation": gif}
        with _told("drawing"):
            _draw(given, motion, pictures, coordinate)
    except (ValueError, TypeError, OSError) as error:
        print(f"jimpact simulate: {error}", file=sys.stderr)
        return 2
    written = {name: str(file) for name, file in pictures.items() if file is not None}
    if json:
        print(dumps({"title": given.title} | motion.to_dict() | written, indent=2))
    else:
        told = "\n".join(f"{name.capitalize()}: {file}" for name, file in written.items())
        print(f"{given.title}\n{motion}\n{told}")
    try:
        raise_on_failed_motion(motion)
    except RuntimeError as error:
        print(f"jimpact simulate: {error}", file=sys.stderr)
        return 1
    return 0


@contextlib.contextmanager
def _told(what: str) -> Iterator[None]:
    """A spinner on stderr, on terminals: nothing is known of how long it will take."""
    with Console(stderr=True).status(f"{what} ..."):
        yield


def _draw(
    study: MotionStudy, motion: Motion, pictures: dict[str, Path | None], coordinate: int
) -> None:
    from jimpact import plot  # matplotlib, late

    path, portrait, gif = (pictures[k] for k in ("picture", "portrait", "animation"))
    assert path is not None
    save_picture(plot.motion(motion, study.title), path)
    if portrait is not None:
        save_picture(plot.phase_portrait(motion, coordinate - 1, study.title), portrait)
    if gif is not None:
        plot.animation(study.system, motion, gif, title=study.title)
