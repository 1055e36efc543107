"""Studies of motions: system, base, law, initial state and data, of a checked TOML
file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jimpact.cli.study_file import check_tables, fit_arguments, law_of, without_none
from jimpact.core.law import Law
from jimpact.fits.parameters import default_free
from jimpact.motion.record import Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.study import run_of, system_of
from jimpact.motion.system import System
from jimpact.shots.shots_file import UNEVENNESS, Positions, read_positions
from jimpact.tools.study_tables import check_keys, check_kind

if TYPE_CHECKING:
    from jimpact.fits.report import Fit


@dataclass(frozen=True)
class MotionStudy:
    """A study that `read_study` read; `run` simulates it, `fit` fits it to its data.

    Attributes:
        title: of pictures and reports.
        system: what moves, under its loads.
        law: with the study's values.
        arguments: of `simulate`, by name.
        measured: times, positions and their errors of `[data]`, else None.
        free: names -> masks of the parameters that `fit` fits.
        bounds: names -> (low, high).
        priors: names -> (mean, standard deviation).
        options: of `fit_motion`, by name.
    """

    title: str
    system: System
    law: Law
    arguments: dict[str, Any]
    measured: Positions | None = None
    free: dict[str, Any] = field(default_factory=dict)
    bounds: dict[str, Any] = field(default_factory=dict)
    priors: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def fit(self, **options: Any) -> "Fit":
        """`fit_motion` with the study's options, or with those that are passed and not
        None.
        """
        from jimpact.fits.fitting_motion import MOTION_SEARCH, fit_motion

        if self.measured is None:
            raise ValueError(
                "a study of a motion must have a [data] table to be fitted."
            )
        start, _ = self.arguments["t_end"]
        times, q, sigma = self.measured
        if abs(times[0] - start) > UNEVENNESS * (times[1] - times[0]):
            raise ValueError(
                f"`t` in [data] must begin at {start:g} s, but begins at {times[0]:g} "
                f"s."
            )
        arguments = {key: x for key, x in self.arguments.items() if key != "samples"}
        arguments["t_end"] = start, float(times[-1])
        arguments |= fit_arguments(self.options | without_none(options), MOTION_SEARCH)
        arguments |= {"free": self.free, "bounds": self.bounds, "priors": self.priors}
        return fit_motion(self.system, self.law, q, sigma=sigma, **arguments)

    def run(
        self,
        t_end: float | None = None,
        samples: int | None = None,
        progress: float | None = None,
    ) -> Motion:
        """`simulate` with the study's arguments, or with those that are passed and not
        None.
        """
        start, end = self.arguments["t_end"]
        changes = {
            "t_end": (start, end if t_end is None else t_end),
            "samples": samples,
            "method": replace(self.arguments["method"], progress=progress),
        }
        return simulate(
            self.system, self.law, **(self.arguments | without_none(changes))
        )


def motion_study_of(
    tables: Mapping[str, Any], path: Path, law_name: str | None
) -> MotionStudy:
    """Study of a motion from the tables of the file `path`, checked.

    `law_name`: a law in the place of the study's, None: its own.
    """
    check_tables(tables, ("system", "law", "motion"), ("base", "fit", "data"))
    law, _, fitted = law_of(tables, law_name, path.parent)
    motion = tables["motion"]
    arguments = run_of(motion)
    return MotionStudy(
        str(tables.get("title", path.stem)),
        system_of(tables["system"], tables.get("base"), motion.get("friction")),
        law,
        arguments=arguments,
        measured=_measured(tables["data"], path) if "data" in tables else None,
        free=fitted.free or dict.fromkeys(default_free(law)[:1], True),
        bounds=fitted.bounds,
        priors=fitted.priors,
        options=fitted.options,
    )


def _measured(table: Mapping[str, Any], study: Path) -> Positions:
    """Times, positions and their errors in the file of the table [data]; `study`: path
    of it.
    """
    check_keys("[data]", table, ("file",), ("file",))
    check_kind("[data]", "file", table["file"], str, "a path")
    return read_positions(study.parent / table["file"])
