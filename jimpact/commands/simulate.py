"""`jimpact simulate`: a whole motion; a report, a picture, an animation."""

import jax
from rich.console import Console

from jimpact import plot
from jimpact.cli import SimulateCommand
from jimpact.commands.output import Answer, picture_path, save_picture
from jimpact.motion.record import Motion, raise_on_failed_motion
from jimpact.motion.study_motion import read_motion_study


def run(given: SimulateCommand) -> Answer:
    """Simulate; a motion that does not reach its end is drawn and printed as far as it goes."""
    path = picture_path(given.out, given.name)
    if given.portrait is not None:
        picture_path(given.portrait, "", "--portrait")
    if given.gif is not None and given.gif.suffix != ".gif":
        raise ValueError(f"--gif must end in .gif, but is '{given.gif}'.")
    study = read_motion_study(given.study)
    terminal = Console(stderr=True)  # where a spinner turns: nobody knows how long it will take
    with terminal.status("compiling and simulating ..."):
        motion = jax.block_until_ready(study.run(t_end=given.t_end, samples=given.samples))
    with terminal.status("drawing ..."):
        save_picture(plot.motion(motion, study.title), path)
        if given.portrait is not None:
            portrait = plot.phase_portrait(motion, given.coordinate - 1, study.title)
            save_picture(portrait, given.portrait)
        if given.gif is not None:
            plot.animation(study.system, motion, given.gif, title=study.title)
    pictures = {"picture": path, "portrait": given.portrait, "animation": given.gif}
    written = {name: str(file) for name, file in pictures.items() if file is not None}
    files = "\n".join(f"{name.capitalize()}: {file}" for name, file in written.items())
    data = {"title": study.title} | motion.to_dict() | written
    return Answer(data, f"{study.title}\n{motion}\n{files}", _failure(motion))


def _failure(motion: Motion) -> str:
    try:
        raise_on_failed_motion(motion)
    except RuntimeError as error:
        return str(error)
    return ""
