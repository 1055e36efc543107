"""Result of `monte_carlo`, and its report in words."""

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from jimpact.core.law import Law, with_option
from jimpact.core.scene import Scene, velocity_unit
from jimpact.laws.gap_scale import DELTA_C
from jimpact.montecarlo.samples import Run
from jimpact.montecarlo.statistics import (
    IN_MEMORY,
    OUTCOMES,
    Chunk,
    bin_edges,
    binned_quantiles,
    named,
    part,
)
from jimpact.tools.checks import as_float_array, check_values
from jimpact.tools.records import (
    Column,
    Table,
    Tabular,
    as_data,
    counted,
    fields_as_data,
)

REPORTED = (0.05, 0.5, 0.95)  # quantiles in the report
_OUTCOMES = {row.name: row for row in OUTCOMES}


@dataclass(frozen=True, eq=False)
class BadSample:
    """A failed sample: its number from 0, status, gaps (m,) [m] and velocities v- (n,)
    [m/s].

    Gaps or velocities that are the same for all samples are empty here.
    """

    index: int
    status: str
    gaps: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True, eq=False)
class MonteCarlo(Tabular):
    """Statistics of the velocities after an impact; `print` gives a report.

    Attributes:
        samples: how many were drawn.
        count: how many of them did not fail: only these enter.
        mean: of the velocities after (n,) [m/s].
        covariance: likewise (n, n) [m^2/s^2].
        minimum: (n,) [m/s].
        maximum: (n,) [m/s].
        gap_mean: of the random gaps (m,) [m]; m = 0 where gaps are not random.
        gap_covariance: (m, m) [m^2].
        cross_covariance: of velocities with gaps (n, m) [m^2/s].
        edges: of the histograms (n, bins + 1) [m/s].
        counts: (n, bins + 2); the first and the last are the samples outside the edges.
        statuses: number of samples by status.
        bad: the first failed samples; `replay(sample.index)` gives one to run again.
        first: the first samples, for pictures: gaps, velocity_before, velocity, status.
        gap_scale: delta_c (m,) [m], the indentation of a contact
            (`ji.theory.gap_scale`), or None.
        rate: samples computed a second [1/s], without compiling.
        resumed: samples that were read from the folder.
        rtol: tolerance of the impacts; None: the law's own, or it needs none.
        rtol_error: estimated error of the means and deviations by a tolerance above the
            law's default, in standard errors, the largest; 0: it is the default, and
            nothing finer was tried, so that its own error is not estimated.
        description: law, scene and distributions, in words.
        run: the requested run; `replay` needs it.
    """

    samples: int
    count: int
    mean: np.ndarray
    covariance: np.ndarray
    minimum: np.ndarray
    maximum: np.ndarray
    gap_mean: np.ndarray
    gap_covariance: np.ndarray
    cross_covariance: np.ndarray
    edges: np.ndarray
    counts: np.ndarray
    statuses: dict[str, int]
    bad: tuple[BadSample, ...]
    first: dict[str, np.ndarray] = field(repr=False)
    gap_scale: np.ndarray | None
    rate: float
    resumed: int
    rtol: float | None
    rtol_error: float
    description: str
    run: Run = field(repr=False)

    picture = "monte_carlo"

    @property
    def standard_error(self) -> np.ndarray:
        """Standard error of the mean, `std / sqrt(count)` (n,) [m/s]."""
        variance = np.diag(self.covariance)
        return np.sqrt(variance / max(self.count, 1))

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (n,) [m/s]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def quantile_resolution(self) -> np.ndarray:
        """Width of a histogram bin (n,) [m/s]: how far a quantile may be off."""
        return self.edges[:, 1] - self.edges[:, 0]

    def quantile(self, q: Any) -> np.ndarray:
        """Quantiles (..., n) [m/s] of the velocities after, from the histograms; q in
        [0, 1].
        """
        q = np.asarray(as_float_array("q", q))
        check_values("q", q, low=0.0, high=1.0)
        ends = self.edges[:, [0, -1]]
        return binned_quantiles(q, ends, self.counts, self.minimum, self.maximum)

    @property
    def unit(self) -> str:
        """Unit of the velocities, for tables and pictures."""
        return velocity_unit(self.run.scene)

    def replay(self, index: int) -> tuple[Law, Scene, jax.Array]:
        """Law, scene and velocity of sample `index`:
        `ji.impact(*result.replay(index))`.

        The law integrates as finely as in the run.
        """
        if not 0 <= index < self.samples:
            raise ValueError(
                f"Argument `index` must lie in [0, {self.samples - 1}], but has value "
                f"{index}."
            )
        law, scene, velocity = self.run.sample(index)
        if self.rtol_error:
            law = with_option(law, "rtol", self.rtol)
        return law, scene, velocity

    def to_dict(self) -> dict[str, Any]:
        """Everything but samples and run, as a JSON file can hold it."""
        quantiles = {f"{q:g}": self.quantile(q) for q in REPORTED}
        derived = {"standard_error": self.standard_error, "quantiles": quantiles}
        derived |= {"quantile_resolution": self.quantile_resolution}
        return fields_as_data(self, "first", "run", "description") | as_data(derived)

    @property
    def table(self) -> Table:
        """Table: mean, its error, std, quantiles and range of each velocity v+, with
        notes.
        """
        columns = (
            Column("coordinate", head=f"[{self.unit}]"),
            Column("mean", ".6f"),
            Column("standard_error", ".1g", "std. error"),
            Column("std", ".5f"),
            *(Column(f"quantile_{q:g}", ".5f", f"{100 * q:g} %") for q in REPORTED),
            Column("minimum", ".5f"),
            Column("maximum", ".5f"),
        )
        names = [f"v{i + 1}+" for i in range(len(self.mean))]
        quantiles = self.quantile(REPORTED)
        values = self.std, *quantiles, self.minimum, self.maximum
        rows = [*zip(names, self.mean, self.standard_error, *values)]
        head = [
            f"{counted(self.samples, 'sample')} of {self.description}",
            self._rate(),
        ]
        head += [*self._tolerance_lines(), ""]
        right = (
            f"Quantiles are right to {self.quantile_resolution.max():.2g} {self.unit}"
        )
        notes = [f"{right}; std. error: of the mean, std: of one impact.", ""]
        notes += [*self._gap_lines(), *self._status_lines()]
        return Table(columns, rows, head, notes)

    def _rate(self) -> str:
        """Phrase: samples a second, and the number of samples that were read from the
        folder.
        """
        if self.resumed == self.samples:
            return "all read from the folder"
        rate = f"{self.rate:,.0f}"
        text = f"{rate} {'sample' if rate == '1' else 'samples'}/s"
        return text + (
            f", {self.resumed:,} read from the folder" if self.resumed else ""
        )

    def _tolerance_lines(self) -> list[str]:
        """Line on the tolerance of the impacts: of the run, or the law's; none if there
        is none.
        """
        if self.rtol is None:
            return []
        if not self.rtol_error:
            return [
                (
                    f"integrated to rtol = {self.rtol:g}, whose error in means was not "
                    f"estimated"
                )
            ]
        text = (
            f"integrated to rtol = {self.rtol:g}: its error in means and deviations is "
            f"at most"
        )
        return [f"{text} {self.rtol_error:.1g} standard errors"]

    def _gap_lines(self) -> list[str]:
        """Lines on mean and standard deviation of each random gap, in m and over
        delta_c.
        """
        lines = []
        for j, mean in enumerate(self.gap_mean):
            std = np.sqrt(self.gap_covariance[j, j])
            lines.append(f"gap {j + 1}: mean {mean:.4g} m, std {std:.4g} m")
            if self.gap_scale is not None:
                scale = self.gap_scale[j]
                lines[-1] += f"; in units of delta_c = {scale:.3g} m: "
                lines[-1] += f"{mean / scale:.3g} and {std / scale:.3g}"
        if lines and self.gap_scale is not None:
            return [*lines, DELTA_C]
        return lines

    def _status_lines(self) -> list[str]:
        """Lines on the number of samples of each status, and on the first failed
        samples.
        """
        lines = []
        for name, count in self.statuses.items():
            if _OUTCOMES[name].failure:
                left_out = ", left out"
            else:
                left_out = ""
            lines.append(f"{name}: {count:,}{left_out} ({_OUTCOMES[name].message})")
        for bad in self.bad[:5]:
            if bad.gaps.size:
                gaps = f", gaps {np.array2string(bad.gaps, precision=6)} m"
            else:
                gaps = ""
            lines.append(
                f"  sample {bad.index}: {bad.status}{gaps}; replay({bad.index})"
            )
        return lines


def result_of(
    run: Run, total: Chunk, resumed: int, rate: float, gap_scale: np.ndarray | None
) -> MonteCarlo:
    """Result of a run from `total`, the joined statistics of all its chunks (see
    `statistics.py`).

    `resumed` samples were read, `rate` [1/s] were computed, `gap_scale` is delta_c (m,)
    [m].
    """
    n = len(total["ends"])
    count = int(total["used"])
    bad = part(total, "bad")
    mean = total["mean"]
    rtol, error = total["tolerance"]
    # of n velocities after, then of m gaps
    covariance = total["products"] / (count - 1 if count > 1 else np.nan)
    failed = zip(bad["index"], bad["status"], bad["gaps"], bad["velocity_before"])
    return MonteCarlo(
        samples=run.samples,
        count=count,
        mean=mean[:n],
        covariance=covariance[:n, :n],
        minimum=total["low"],
        maximum=total["high"],
        gap_mean=mean[n:],
        gap_covariance=covariance[n:, n:],
        cross_covariance=covariance[:n, n:],
        edges=bin_edges(total["ends"], run.bins),
        counts=total["counts"],
        statuses=named(total["statuses"]),
        bad=tuple(
            BadSample(int(i), OUTCOMES[code].name, *rest) for i, code, *rest in failed
        ),
        first={name: x[:IN_MEMORY] for name, x in part(total, "raw").items()},
        gap_scale=gap_scale,
        rate=rate,
        resumed=resumed,
        rtol=float(rtol) or None,
        # from standard deviations to standard errors
        rtol_error=float(error * np.sqrt(count)),
        description=run.description,
        run=run,
    )
