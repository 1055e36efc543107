"""`jimpact simulate`: a whole motion; a report, a picture, an animation."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import jax
from rich.console import Console

from jimpact.commands.output import Answer, command, picture_path, save_picture
from jimpact.motion.record import Motion, raise_on_failed_motion
from jimpact.motion.study_motion import MotionStudy, read_motion_study


@command("simulate")
def run(
    study: Path,
    t_end: float | None,
    samples: int | None,
    gif: Path | None,
    portrait: Path | None,
    coordinate: int,
    picture: Path,
) -> Answer:
    """Simulate with the options of `SimulateCommand`; what there is of a motion that does not reach
    its end is drawn and printed all the same.
    """
    if portrait is not None:
        picture_path(portrait, "", "--portrait")
    if gif is not None and gif.suffix != ".gif":
        raise ValueError(f"--gif must end in .gif, but is '{gif}'.")
    given = read_motion_study(study)
    with _spinner("compiling and simulating"):
        motion = jax.block_until_ready(given.run(t_end=t_end, samples=samples))
    pictures = {"picture": picture, "portrait": portrait, "animation": gif}
    with _spinner("drawing"):
        _draw(given, motion, pictures, coordinate)
    written = {name: str(file) for name, file in pictures.items() if file is not None}
    files = "\n".join(f"{name.capitalize()}: {file}" for name, file in written.items())
    text = f"{given.title}\n{motion}\n{files}"
    data = {"title": given.title} | motion.to_dict() | written
    return Answer(data, lambda: print(text), _failure(motion))


def _failure(motion: Motion) -> str:
    try:
        raise_on_failed_motion(motion)
    except RuntimeError as error:
        return str(error)
    return ""


@contextlib.contextmanager
def _spinner(what: str) -> Iterator[None]:
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
