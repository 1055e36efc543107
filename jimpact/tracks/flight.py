"""The model of a flight between two impacts: acceleration, drag of the air, force of
spin.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jimpact.tracks.drag import bent, bent_slopes, straightened
from jimpact.tracks.frames import Frames

# Acceleration (..., n) of velocity (..., n) at times (...), of flights with these ends.
Force = Callable[[np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]


@dataclass(frozen=True)
class Flight:
    """Accelerations of all flights: `a - k |v| v + f(v)`.

    Fields: acceleration a (n,), `unknown` (n,) where it is to be found; drag k [1/m],
    and whether it is unknown; `force` f, of velocities (..., n) and times; None: none.
    """

    acceleration: np.ndarray
    unknown: np.ndarray
    drag: float = 0.0
    drag_unknown: bool = False
    force: Force | None = None

    @property
    def bends(self) -> bool:
        """True where acceleration depends on velocity: flights are no parabolas."""
        return self.drag != 0 or self.drag_unknown or self.force is not None

    @property
    def columns(self) -> np.ndarray:
        """Indices of what is unknown among acceleration (n) and drag (1)."""
        return np.flatnonzero([*self.unknown, self.drag_unknown])

    @classmethod
    def of(cls, acceleration: np.ndarray, drag: float = 0.0) -> "Flight":
        """A model of which all is known."""
        return cls(acceleration, np.zeros(len(acceleration), bool), drag)

    def with_values(self, acceleration: np.ndarray, drag: float) -> "Flight":
        """The same model with other values of acceleration and drag."""
        return replace(self, acceleration=acceleration, drag=drag)

    def without_common(self, own: np.ndarray) -> "Flight":
        """The same model without an unknown acceleration in coordinates (n,) in which
        all flights have their own.
        """
        own = own & self.unknown
        acceleration = np.where(own, 0.0, self.acceleration)
        return replace(self, acceleration=acceleration, unknown=self.unknown & ~own)

    def moved(self, change: np.ndarray) -> "Flight":
        """The same model after a change of what is unknown, in the order of
        `columns`.
        """
        whole = np.zeros(len(self.acceleration) + 1)
        whole[self.columns] = change
        return self.with_values(
            self.acceleration + whole[:-1], self.drag + float(whole[-1])
        )

    @property
    def known_acceleration(self) -> np.ndarray:
        """Acceleration (n,) that is given; 0 where it is found from the frames."""
        return np.where(self.unknown, 0.0, self.acceleration)

    def air(self, drag: float) -> Force:
        """Acceleration that velocity makes, at a drag: `f(v) - k |v| v`."""

        def accelerations(
            v: np.ndarray, t: np.ndarray, ends: np.ndarray | None = None
        ) -> np.ndarray:
            """Acceleration (..., n) of velocities (..., n) at times (...)."""
            slowing = -drag * np.linalg.norm(v, axis=-1, keepdims=True) * v
            if self.force is None:
                return slowing
            return slowing + self.force(v, t, ends)

        return accelerations

    def deviation(
        self, x: np.ndarray, tau: np.ndarray, places: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Deviation D (F, n) of a flight from its parabola at times x (F,), D' at its
        ends (2, n).

        tau: times of both ends (2,); places: there (2, n); own: acceleration of its own
        (n,).
        """
        acceleration = self.acceleration + own
        values = (tau[None], places[None], acceleration[None], np.array([self.drag]))
        D, rates = bent(x, *values, self.force)
        return D[0], rates[0]

    def deviation_slopes(
        self, x: np.ndarray, tau: np.ndarray, places: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (F, n, P) of D and (2, n, P) of D', P = 3 n + 3, see
        `bent_slopes`.
        """
        return bent_slopes(
            x, tau, places, self.acceleration + own, self.drag, self.force
        )

    def straight(self, frames: Frames) -> Frames:
        """Frames as they were without drag and force, up to a line in each flight."""
        if not self.bends:
            return frames
        return frames.with_places(straightened(frames.t, frames.q, self.air(self.drag)))

    def fitted_to(self, frames: Frames, flights: list[np.ndarray]) -> "Flight":
        """The model with what is unknown by least squares in flights that have a line
        each.

        Equation: `y = q - a t^2 / 2 - k s`, all without the line of each flight, in
        sigma; s is what a drag of 1/m adds to the places.
        """
        columns = self.columns
        if not columns.size:
            return self
        n = len(self.acceleration)
        known = np.where(self.unknown, 0.0, self.acceleration)
        places = frames.q
        if self.force is not None:
            places = straightened(frames.t, frames.q, self.air(0.0))
        added = frames.q - straightened(
            frames.t, frames.q, replace(self, force=None).air(1.0)
        )
        normal = np.zeros((n + 1, n + 1))
        right = np.zeros(n + 1)
        for some in flights:
            for c in range(n):
                ok = some[np.isfinite(frames.q[some, c])]
                if len(ok) < 3:
                    continue
                x = frames.t[ok] - frames.t[ok].mean()
                curve = x**2 / 2
                terms = np.zeros((len(ok), n + 2))
                terms[:, c] = curve
                terms[:, n] = added[ok, c]
                terms[:, -1] = places[ok, c] - known[c] * curve
                rest = without_polynomial(x, terms, 2) / frames.sigma[c]
                square = rest.T @ rest
                normal += square[:-1, :-1]
                right += square[:-1, -1]
        if not self.drag_unknown:
            right -= normal[:, -1] * self.drag
        found = (
            np.linalg.pinv(normal[np.ix_(columns, columns)], hermitian=True)
            @ right[columns]
        )
        values = np.append(known, 0.0 if self.drag_unknown else self.drag)
        values[columns] = found
        return self.with_values(values[:-1], float(values[-1]))


def without_polynomial(x: np.ndarray, y: np.ndarray, terms: int) -> np.ndarray:
    """Residual of y (F,) or (F, k) by least squares of polynomials of so many terms in
    x (F,).
    """
    basis = np.linalg.qr(np.vander(x, terms))[0]
    return np.asarray(y - basis @ (basis.T @ y))
