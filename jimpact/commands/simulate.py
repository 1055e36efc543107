"""`jimpact simulate`: a whole motion; a report, a picture, an animation."""

import jax
from rich.console import Console

from jimpact import plot
from jimpact.cli import SimulateCommand
from jimpact.commands.output import Answer, checked, picture_path
from jimpact.motion.record import Motion, raise_on_failed_motion
from jimpact.motion.study_motion import read_motion_study


def run(given: SimulateCommand) -> Answer:
    """Simulate; a motion that does not reach its end is drawn and printed as far as it goes."""
    path = picture_path(given)
    if given.portrait is not None:
        checked(given.portrait, "--portrait")
    if given.gif is not None and given.gif.suffix != ".gif":
        raise ValueError(f"--gif must end in .gif, but is '{given.gif}'.")
    study = read_motion_study(given.study)
    terminal = Console(stderr=True)  # where a spinner turns: nobody knows how long it will take
    with terminal.status("compiling and simulating ..."):
        motion = jax.block_until_ready(study.run(t_end=given.t_end, samples=given.samples))
    pictures = {path: plot.motion(motion, study.title)}
    if given.portrait is not None:
        pictures[given.portrait] = plot.phase_portrait(motion, given.coordinate - 1, study.title)
    data, text = motion.to_dict(), str(motion)
    if given.gif is not None:
        with terminal.status("drawing ..."):
            plot.animation(study.system, motion, given.gif, title=study.title)
        data["animation"], text = str(given.gif), f"{text}\nAnimation: {given.gif}"
    return Answer(study.title, data, text, pictures, _failure(motion))


def _failure(motion: Motion) -> str:
    try:
        raise_on_failed_motion(motion)
    except RuntimeError as error:
        return str(error)
    return ""
