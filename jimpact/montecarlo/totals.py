"""The statistics of a run, chunk by chunk, always in the order of their numbers."""

import numpy as np

from jimpact.montecarlo import histograms
from jimpact.montecarlo.chunks import LISTED, OUTCOMES, Chunk, named
from jimpact.montecarlo.moments import Moments, merged
from jimpact.montecarlo.plans import Run
from jimpact.montecarlo.results import BadSample, MonteCarlo


class Totals:
    """Sums over the chunks 0 .. `chunks` - 1."""

    def __init__(self, run: Run):
        self.run = run
        self.chunks = 0
        self.resumed = 0
        self.moments: Moments | None = None
        self.statuses = np.zeros(len(OUTCOMES), np.int64)
        self.bad: list[BadSample] = []

    def add(self, chunk: Chunk, resumed: bool) -> None:
        """The next chunk."""
        assert chunk.number == self.chunks  # floating-point sums depend on the order
        if self.moments is None:
            self.moments, self.ends = chunk.moments, chunk.ends
            self.low, self.high, self.counts = chunk.low, chunk.high, chunk.counts
            self.first = chunk.without_samples().samples
        else:
            self.moments = merged(self.moments, chunk.moments)
            self.low, self.high = np.minimum(self.low, chunk.low), np.maximum(self.high, chunk.high)
            self.counts = self.counts + chunk.counts
        self.statuses = self.statuses + chunk.statuses
        self.resumed += chunk.count if resumed else 0
        self._list_bad(chunk)
        self.chunks += 1

    def _list_bad(self, chunk: Chunk) -> None:
        room = max(LISTED - len(self.bad), 0)
        for i, lane in enumerate(chunk.bad["lane"][:room]):
            self.bad.append(
                BadSample(
                    index=chunk.number * self.run.plan.size + int(lane),
                    status=OUTCOMES[int(chunk.bad["status"][i])].name,
                    gaps=chunk.bad["gaps"][i],
                    velocity=chunk.bad["velocity_before"][i],
                )
            )

    def result(self, rate: float, description: str, gap_scale: np.ndarray | None) -> MonteCarlo:
        """What is known of the run."""
        assert self.moments is not None
        n = len(self.ends)
        covariance = self.moments.covariance
        return MonteCarlo(
            samples=self.run.samples,
            count=self.moments.count,
            mean=self.moments.mean[:n],
            covariance=covariance[:n, :n],
            minimum=self.low,
            maximum=self.high,
            gap_mean=self.moments.mean[n:],
            gap_covariance=covariance[n:, n:],
            cross_covariance=covariance[:n, n:],
            edges=histograms.edges(self.ends, self.run.plan.bins),
            counts=self.counts,
            statuses=named(self.statuses),
            bad=tuple(self.bad),
            first=self.first,
            gap_scale=gap_scale,
            rate=rate,
            resumed=self.resumed,
            description=description,
            run=self.run,
        )
