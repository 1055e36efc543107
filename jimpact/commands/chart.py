"""`jimpact chart`: speed against accuracy on one scene; a table, a picture."""

from jimpact import plot
from jimpact.cli import ChartCommand
from jimpact.commands.output import Answer, picture_path, titled, velocities
from jimpact.laws import REGISTRY
from jimpact.laws.lzb import LZB
from jimpact.methods.chart import work_precision
from jimpact.methods.contenders import METHODS
from jimpact.study import Study, read_study

SLOW_TO_COMPILE = ("tsit5", "kvaerno5")  # left to --full


def run(given: ChartCommand) -> Answer:
    """Measure."""
    path = picture_path(given)
    study = read_study(given.study)
    law = _law(study)
    before, _ = velocities(study, given)
    found = work_precision(
        study.scene,
        before,
        law,
        given.methods or _able(law, study, given.full),
        batch=given.batch,
        repeats=given.repeats,
        gradients=not given.no_gradients,
    )
    picture = plot.work_precision(found, study.title)
    return Answer(titled(study, before), found.to_dict(), str(found), {path: picture})


def _law(study: Study) -> LZB:
    """The study's law, or LZB with what the study says of its parameters (restitution: 1)."""
    if isinstance(study.law, LZB):
        return study.law
    known = {"restitution": 1.0} | study.parameters
    return LZB(**{key: known[key] for key in REGISTRY["lzb"].parameters if key in known})


def _able(law: LZB, study: Study, full: bool) -> tuple[str, ...]:
    """Methods that can solve the study's impact, without those that compile for long."""
    left_out = () if full else SLOW_TO_COMPILE
    return tuple(
        name
        for name, method in METHODS.items()
        if name not in left_out and method.supports(law, study.scene) is None
    )
