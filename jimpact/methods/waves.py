"""Waves in chains: the pulse that travels through a history, and trains of balls that collide."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_whole, check_kind
from jimpact.files.records import fields_as_data, table
from jimpact.impacts import impact
from jimpact.laws.histories import History
from jimpact.laws.lzb import LZB
from jimpact.scene import chain
from jimpact.status import STATUS

# The force of a long wave in a chain of Hertz contacts is cos^6(sqrt(2/5) s), s in contacts: from
# end to end it is this many times as long as where it is above half of its largest.
_WHOLE = np.pi / (2 * np.arccos(0.5 ** (1 / 6)))


@dataclass(frozen=True)
class Pulses:
    """The largest pulse at each contact of a chain; arrays (m,) over contacts, from the first.

    `arrival` [s] of the largest force, `amplitude` [N], `duration` [s] above half of it, `impulse`
    [N s] of the whole impact; `speed` (m - 1,) [contacts/s] from each contact to the next, and
    `attenuation` (m - 1,), the ratio of amplitudes.
    """

    arrival: np.ndarray
    amplitude: np.ndarray
    duration: np.ndarray
    impulse: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """From each contact to the next (m - 1,) [contacts/s]; negative: it comes back."""
        return 1 / np.diff(self.arrival)

    @property
    def attenuation(self) -> np.ndarray:
        """Amplitude at each contact over that at the one before (m - 1,)."""
        return self.amplitude[1:] / self.amplitude[:-1]

    @property
    def width(self) -> np.ndarray:
        """Length (m - 2,) [contacts] of the pulse from end to end, at inner contacts.

        Of a pulse cos^6 that is above half of its amplitude for as long; Nesterenko's has 4.967.
        """
        across = (self.arrival[2:] - self.arrival[:-2]) / 2
        return _WHOLE * self.duration[1:-1] / across

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""
        return fields_as_data(self)

    def __str__(self) -> str:
        """A row for each contact."""
        heads = ["contact", "arrival [s]", "force [N]", "duration [s]", "impulse [N s]"]
        columns = self.arrival, self.amplitude, self.duration, self.impulse
        rows = [
            [str(j + 1), *(f"{x:.4g}" for x in row)]
            for j, row in enumerate(zip(*columns, strict=True))
        ]
        return "\n".join(table(heads, rows))


def pulses(history: History) -> Pulses:
    """Arrival, amplitude, duration and impulse of the force at every contact of a chain.

    A parabola through the three samples around the largest force gives its time and height,
    straight lines between samples the times of half of it: take 20 or more samples in a pulse.

    Args:
        history: what `ji.history` returned, of one impact.

    Returns:
        `Pulses`; NaN at contacts that are never pressed.

    Raises:
        TypeError: something else. ValueError: a batch of impacts.

    Host function, not differentiable.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0, 2.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0])
    >>> p = ji.pulses(h)  # half a sine: pi / (2 w), v w, 2/3 of pi / w
    >>> [round(float(x[0]), 3) for x in (p.arrival, p.amplitude, p.duration)]
    [1.111, 1.414, 1.481]
    """
    check_kind("history", history, History)
    if np.ndim(history.status):
        raise ValueError(
            "Argument `history` must be of one impact, but is a batch: pick one of it."
        )
    time, force = np.asarray(history.time), np.asarray(history.force)
    arrival, amplitude, duration = np.array([_pulse(time, row) for row in force.T]).T
    return Pulses(arrival, amplitude, duration, np.asarray(history.impulse[-1]))


def _pulse(time: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
    """Time and height of the largest force, and how long it is above half of that."""
    top = int(np.clip(force.argmax(), 1, len(time) - 2))
    if not force[top] > 0:
        return np.nan, np.nan, np.nan
    left, middle, right = force[top - 1 : top + 2]
    step = time[top + 1] - time[top]
    bend, slope = left - 2 * middle + right, (right - left) / 2
    shift = -slope / bend if bend < 0 else 0.0
    height = middle + slope * shift / 2
    below = np.flatnonzero(force < height / 2)
    before, after = below[below < top], below[below > top]
    start, end = time[0], time[-1]
    if len(before):
        i = before[-1]
        start = np.interp(height / 2, force[i : i + 2], time[i : i + 2])
    if len(after):
        i = after[0]
        end = np.interp(-height / 2, -force[i - 1 : i + 1], time[i - 1 : i + 1])
    return time[top] + shift * step, height, end - start


@dataclass(frozen=True)
class Trains:
    """M balls that touch hit N that touch: rows (c,) over M.

    `hitting` M (c,), `velocity` (c, M + N) over that before, `status` (c,) codes.
    """

    hitting: np.ndarray
    velocity: np.ndarray
    status: np.ndarray

    @property
    def resting(self) -> np.ndarray:
        """N (c,)."""
        return self.velocity.shape[1] - self.hitting

    @property
    def forward(self) -> np.ndarray:
        """How many balls move forward (c,)."""
        return (self.velocity > 0).sum(axis=1)

    @property
    def forward_energy(self) -> np.ndarray:
        """Their share of the energy before (c,)."""
        return (np.maximum(self.velocity, 0.0) ** 2).sum(axis=1) / self.hitting

    @property
    def glued(self) -> np.ndarray:
        """Velocities (c, 2) of the two trains if each were glued, e = 1, over that before."""
        m, n = self.hitting, self.resting
        return np.stack([(m - n) / (m + n), 2 * m / (m + n)], axis=-1)

    @property
    def glued_forward_energy(self) -> np.ndarray:
        """Share of the energy (c,) that glued trains which move forward have."""
        masses = np.stack([self.hitting, self.resting], axis=-1)
        return (masses * np.maximum(self.glued, 0.0) ** 2).sum(axis=1) / self.hitting

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""
        return fields_as_data(self) | {"status": [STATUS[code].name for code in self.status]}

    def __str__(self) -> str:
        """A row for each M."""
        heads = ["M : N", "balls forward", "their energy", "fastest", "glued: v1+", "v2+", "energy"]
        numbers = zip(self.forward_energy, self.velocity.max(axis=1), *self.glued.T, strict=True)
        rows = [
            [f"{m} : {n}", str(k), *(f"{x:.4f}" for x in row), f"{energy:.4f}"]
            for m, n, k, row, energy in zip(
                self.hitting, self.resting, self.forward, numbers, self.glued_forward_energy,
                strict=True,
            )
        ]  # fmt: skip
        return "\n".join(table(heads, rows))


def colliding_trains(
    balls: int, hitting: Any = None, restitution: float = 1.0, exponent: float = 1.5
) -> Trains:
    """M of a row of equal balls hit the other N, all contacts touching, by LZB; and if glued.

    Args:
        balls: M + N >= 2.
        hitting: M, one or several whole numbers of 1 to M + N - 1; None: all of them.
        restitution: e in [0, 1] of every contact.
        exponent: eta >= 1: 1 linear, 1.5 Hertz.

    Returns:
        `Trains`; `print` gives a table.

    Raises:
        ValueError: fewer than two balls, an M or N of 0, e or eta out of range.

    Status: as of `LZB`, one for each M.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.1.1.4.

    >>> import jimpact as ji
    >>> ji.colliding_trains(5, hitting=5)
    Traceback (most recent call last):
    ...
    ValueError: Argument `hitting` must lie in [1, 4], but is 5: no ball is hit.
    """
    as_whole("balls", balls, 2)
    rows = range(1, balls) if hitting is None else np.atleast_1d(hitting).tolist()
    for m in rows:
        as_whole("hitting", m, 1)
        if m >= balls:
            raise ValueError(
                f"Argument `hitting` must lie in [1, {balls - 1}], but is {m}: no ball is hit."
            )
    scene, law = chain(np.ones(balls)), LZB(restitution, np.ones(balls - 1), exponent)
    count = np.asarray(rows)
    before = (np.arange(balls)[None] < count[:, None]).astype(float)
    out = eqx.filter_jit(jax.vmap(lambda v: impact(law, scene, v)))(jnp.asarray(before))
    return Trains(count, np.asarray(out.velocity), np.asarray(out.status))
