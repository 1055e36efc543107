"""What else than velocities is measured of an impact: forces, times, energies, bounces."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_choice, check_values
from jimpact.bodies.base import STANDARD_GRAVITY
from jimpact.compiling import full_precision
from jimpact.fits.problem import Prediction, meaningless
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.laws.histories import History, history
from jimpact.scene import Scene, with_gaps

QUANTITIES = ("peak_force", "duration", "arrival_time", "energy_ratio", "bounce_height")
_OF_FORCES = QUANTITIES[:3]
_OF_A_CONTACT = ("peak_force", "arrival_time")
FEELS = 0.01  # share of its largest force from which a contact counts as loaded
SAMPLES = 400  # of the forces over an impact; times are interpolated between them
_AWAY = 1.0  # [m] gap to bodies that are not there
_FASTER = 10.0  # times the fastest body: absent ones fly off, and no other meets them


class Observation(NamedTuple):
    """One measured value: what of which contact or body (from 0, -1: of all), in which shot."""

    quantity: str
    place: int
    shot: int
    first: int  # the value to which it is relative, -1: to none

    @property
    def sampled(self) -> bool:
        """Whether it is read off the forces over time."""
        return self.quantity == "arrival_time" or (self.quantity == "duration" and self.place >= 0)


class Observations(eqx.Module):
    """The observable of forces, times, energies and bounces: values (R,) of a law, in SI units.

    `peak_force` [N] of a contact; `duration` [s] of a contact (while its force is above 1 % of its
    largest) or of the whole impact; `arrival_time` [s] of a contact: when its force is largest;
    `energy_ratio` T+/T-; `bounce_height` v^2 / (2 g) [m] of a body that leaves the wall. Forces and
    times ask for an `LZB` or `Compliant` law with stiffnesses in SI units.
    """

    scenes: Scene  # stacked, one for each shot
    pre: jax.Array  # (K, n)
    present: jax.Array  # (K, n) bodies that take part
    up: jax.Array  # () sign of a velocity away from the wall
    rows: tuple[Observation, ...] = eqx.field(static=True)

    @property
    def absolute(self) -> bool:
        """Whether a common factor of all stiffnesses shows."""
        return any(row.quantity in _OF_FORCES and row.first < 0 for row in self.rows)

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the values: what, of which contact or body, and how many bodies took part."""
        present = np.asarray(self.present).sum(axis=1)
        return tuple(
            " ".join(
                [row.quantity.replace("_", " "), *([str(row.place + 1)] if row.place >= 0 else [])]
            )
            + f", {present[row.shot]} bodies"
            for row in self.rows
        )

    @full_precision
    def __call__(self, law: Law) -> Prediction:
        """The values that this law predicts."""
        if any(row.quantity in _OF_FORCES for row in self.rows):
            samples = SAMPLES if any(row.sampled for row in self.rows) else 2

            def run(scene: Scene, v: jax.Array) -> tuple[jax.Array, jax.Array, History | None]:
                h = history(law, scene, v, samples)
                return h.velocity[-1], h.status, h

        else:

            def run(scene: Scene, v: jax.Array) -> tuple[jax.Array, jax.Array, History | None]:
                out = impact(law, scene, v)
                return out.velocity, out.status, None

        velocity, status, histories = jax.vmap(run)(self.scenes, self.pre)
        raw = jnp.stack([self._value(row, velocity, histories) for row in self.rows])
        first = np.array([row.first for row in self.rows])
        values = jnp.where(first < 0, raw, raw / raw[np.maximum(first, 0)])
        fails = meaningless(status)
        shot = np.array([row.shot for row in self.rows])
        bad = fails[shot] | ~jnp.isfinite(values)
        return Prediction(values, bad, status[jnp.argmax(fails)][None])

    def _value(self, row: Observation, velocity: jax.Array, histories: History | None) -> jax.Array:
        """One value."""
        k, j = row.shot, row.place
        scene = jax.tree.map(lambda x: x[k], self.scenes)
        if row.quantity == "energy_ratio":
            v, before = (jnp.where(self.present[k], x[k], 0.0) for x in (velocity, self.pre))
            mass = scene.mass if scene.mass.ndim == 2 else jnp.diag(scene.mass)
            return (v @ mass @ v) / (before @ mass @ before)
        if row.quantity == "bounce_height":
            v = self.up * velocity[k, j]
            return v * jnp.abs(v) / (2 * STANDARD_GRAVITY)
        assert histories is not None
        if row.quantity == "peak_force":
            return histories.maximum_force[k, j]
        if row.quantity == "duration" and j < 0:
            return histories.duration[k]
        time, force = histories.time[k], histories.force[k, :, j]
        return _loaded(time, force) if row.quantity == "duration" else _when_largest(time, force)


def _loaded(time: jax.Array, force: jax.Array) -> jax.Array:
    """How long a sampled force is above a share of its largest, by linear interpolation."""
    over = force - FEELS * jax.lax.stop_gradient(jnp.max(force))
    a, b = over[:-1], over[1:]
    crosses = (a > 0) != (b > 0)
    part = jnp.where(crosses, jnp.maximum(a, b) / jnp.where(crosses, jnp.abs(a - b), 1.0), 1.0)
    return jnp.sum(jnp.where((a > 0) | (b > 0), part, 0.0) * jnp.diff(time))


def _when_largest(time: jax.Array, force: jax.Array) -> jax.Array:
    """When a sampled force is largest, by a parabola."""
    i = jnp.clip(jnp.argmax(force), 1, len(force) - 2)
    below, most, above = force[i - 1], force[i], force[i + 1]
    bend = below - 2 * most + above
    shift = jnp.where(bend < 0, 0.5 * (below - above) / jnp.where(bend < 0, bend, 1.0), 0.0)
    return time[i] + jnp.clip(shift, -1, 1) * (time[i + 1] - time[i])


class Measured(NamedTuple):
    """Values that were measured, their errors (None: not known), and the observable."""

    value: np.ndarray
    sigma: np.ndarray | None
    observe: Observations


def observations(scene: Scene, tables: Sequence[Mapping[str, Any]]) -> Measured:
    """The observable of a study's `[[observe]]` tables, see `read_study`.

    Raises:
        ValueError: what a table says wrong.
    """
    values, sigmas = [], []
    rows: list[Observation] = []
    shots: list[tuple[Scene, np.ndarray, np.ndarray]] = []
    for number, table in enumerate(tables):
        where = f"[[observe]] {number + 1}"
        value = _numbers(where, "value", table["value"])
        count, quantity = len(value), table["quantity"]
        place = _place(where, scene, table)
        sigma = table.get("sigma")
        if sigma is not None:
            sigmas.append(_each(where, "sigma", sigma, count))
            check_values(f"sigma in {where}", sigmas[-1], low=0.0, open_low=True)
        first = len(rows) if table.get("relative", False) else -1
        rows += [Observation(quantity, place, len(shots) + k, first) for k in range(count)]
        shots += _shots(where, scene, table, count)
        values.append(value)
        if first >= 0 and len(value) > 1:  # the reference of the others is no measurement
            values[-1][0] = np.nan
    if sigmas and len(sigmas) < len(tables):
        raise ValueError("`sigma` must be given in all [[observe]] or in none.")
    if not sigmas and len({row.quantity for row in rows}) > 1:
        raise ValueError("`sigma` must be given where different quantities are measured.")
    scenes, pre, present = zip(*shots)
    up = 1.0 if scene.walls == (True, False) else -1.0
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *scenes)
    dtype = stacked.mass.dtype
    arrays = (jnp.asarray(np.array(pre), dtype), jnp.asarray(np.array(present)))
    observe = Observations(stacked, *arrays, jnp.asarray(up, dtype), tuple(rows))
    return Measured(np.concatenate(values), np.concatenate(sigmas) if sigmas else None, observe)


def _shots(
    where: str, scene: Scene, table: Mapping[str, Any], count: int
) -> list[tuple[Scene, np.ndarray, np.ndarray]]:
    """Scene, velocities before and the bodies that take part, for each value."""
    n, m = scene.size, scene.contacts
    left = scene.walls == (True, False)
    one_wall = scene.walls is not None and sum(scene.walls) == 1
    if ("drop_height_m" in table or "bodies" in table) and not one_wall:
        raise ValueError(f"{where}: `drop_height_m` and `bodies` need a chain with one wall.")
    bodies = _each(where, "bodies", table.get("bodies", n), count).astype(int)
    if (bodies < 1).any() or (bodies > n).any():
        raise ValueError(f"{where}: `bodies` must lie in [1, {n}], but is {table['bodies']}.")
    if "drop_height_m" in table:
        height = _each(where, "drop_height_m", table["drop_height_m"], count)
        check_values(f"drop_height_m in {where}", height, low=0.0, open_low=True)
        speed = (-1.0 if left else 1.0) * np.sqrt(2 * STANDARD_GRAVITY * height)
        velocities = np.repeat(speed[:, None], n, axis=1)
    else:
        velocity = as_float_array("velocity_m_per_s", table["velocity_m_per_s"])
        if velocity.shape != (n,):
            raise ValueError(
                f"{where}: `velocity_m_per_s` must have {n} entries, one for each body, "
                f"but has shape {tuple(velocity.shape)}."
            )
        velocities = np.repeat(np.asarray(velocity)[None], count, axis=0)
    shots = []
    for v, number in zip(velocities, bodies):
        body = np.arange(n)
        present = body < number if left else body >= n - number
        gaps = np.zeros(m) if scene.gaps is None else np.array(scene.gaps, float)
        if number < n:
            gaps[number if left else n - number - 1] = _AWAY
        off = _FASTER * np.abs(v).max() * (1.0 if left else -1.0)
        own_scene = with_gaps(scene, jnp.asarray(gaps, scene.mass.dtype))
        shots.append((own_scene, np.where(present, v, off), present))
    return shots


def _place(where: str, scene: Scene, table: Mapping[str, Any]) -> int:
    """Contact or body, from 0; -1: all."""
    quantity = table["quantity"]
    check_choice(f"quantity in {where}", quantity, QUANTITIES)
    key, most = ("body", scene.size) if quantity == "bounce_height" else ("contact", scene.contacts)
    needed = quantity in (*_OF_A_CONTACT, "bounce_height")
    if key not in table:
        if needed:
            raise ValueError(f"{where}: a {quantity} needs `{key}`, from 1 to {most}.")
        return -1
    if not isinstance(table[key], int) or not 1 <= table[key] <= most:
        raise ValueError(f"{where}: `{key}` must lie in [1, {most}], but is {table[key]!r}.")
    return table[key] - 1


def _numbers(where: str, key: str, value: Any) -> np.ndarray:
    """Numbers of a table, NaN where a value was not measured."""
    numbers = np.atleast_1d(np.asarray(as_float_array(f"{key} in {where}", value), float))
    check_values(f"{key} in {where}", numbers, nan_allowed=True)
    return numbers.copy()


def _each(where: str, key: str, value: Any, count: int) -> np.ndarray:
    """One number for each value; a single number is repeated."""
    numbers = _numbers(where, key, value)
    if len(numbers) not in (1, count):
        raise ValueError(
            f"{where}: `{key}` must be a number or have {count} entries as `value`, "
            f"but has {len(numbers)}."
        )
    return np.resize(numbers, count)
