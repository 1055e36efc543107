"""Every law on one scene, side by side."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_values
from jimpact.audits import Audit, audit, nothing_approaches
from jimpact.impacts import Impact, impact
from jimpact.law import Law
from jimpact.laws import REGISTRY
from jimpact.scene import Scene, as_velocity, kinetic_energy, momentum
from jimpact.status import STATUS

_REPEATS = 20  # of the timing; its median is told


def energy_ratio(scene: Scene, before: Any, after: Any) -> jax.Array:
    """Kinetic-energy ratio `T+ / T-`; 1 conserves, NaN where nothing moves before.

    >>> import jimpact as ji
    >>> float(ji.energy_ratio(ji.chain([1.0, 1.0]), [1.0, 0.0], [0.5, 0.5]))
    0.5
    """
    return kinetic_energy(scene, after) / kinetic_energy(scene, before)


def dispersion_index(scene: Scene, velocity: Any) -> jax.Array:
    """How evenly the kinetic energy is spread over the coordinates: 0 all in one, 1 equal shares.

    Equation: `1 - c / sqrt(n - 1)` with c the coefficient of variation (standard deviation over
    mean) of the shares `T_i = v_i (M v)_i / 2`, whose largest value is `sqrt(n - 1)`. For equal
    balls with v- = (1, 0, 0) and no loss: 0 at (0, 0, 1), 2/3 at (-1/3, 2/3, 2/3).
    NaN at rest, and for one coordinate. Not differentiable at equal shares.

    >>> import jimpact as ji
    >>> round(float(ji.dispersion_index(ji.chain([1.0, 1.0, 1.0]), [-1 / 3, 2 / 3, 2 / 3])), 6)
    0.666667
    """
    v = as_velocity(scene, velocity)
    share = 0.5 * v * momentum(scene, v)
    mean = jnp.mean(share)
    square = jnp.mean((share - mean) ** 2)
    deviation = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return 1 - deviation / mean / jnp.sqrt(jnp.asarray(scene.size - 1, v.dtype))


@dataclass(frozen=True)
class Entry:
    """One law's row of a comparison; `time` [s] of one impact, compiled, `compile_time` [s]."""

    law: Law
    outcome: Impact
    audit: Audit
    energy_ratio: float
    dispersion_index: float
    time: float
    compile_time: float

    @property
    def status(self) -> str:
        """Name of the status."""
        return STATUS[int(self.outcome.status)].name


@dataclass(frozen=True)
class Comparison:
    """What `compare` found: `entries[name]`; `left_out[name]` says why; `print` gives a table."""

    scene: Scene
    velocity: np.ndarray
    entries: dict[str, Entry]
    left_out: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""
        return {
            name: {
                "velocity": np.asarray(entry.outcome.velocity).tolist(),
                "impulse": np.asarray(entry.outcome.impulse).tolist(),
                "energy_ratio": entry.energy_ratio,
                "dispersion_index": entry.dispersion_index,
                "status": entry.status,
                "consistent": bool(entry.audit.consistent),
                "time_us": 1e6 * entry.time,
                "compile_time_s": entry.compile_time,
            }
            for name, entry in self.entries.items()
        }

    def __str__(self) -> str:
        head = f"{'law':22s}{'v+ [m/s]':{11 * self.scene.size}s}{'T+/T-':>8s}{'disp.':>7s}"
        lines = [head + f"{'us':>8s}  audit"]
        for name, entry in self.entries.items():
            v = "".join(f"{x:11.5f}" for x in np.asarray(entry.outcome.velocity))
            numbers = f"{entry.energy_ratio:8.4f}{entry.dispersion_index:7.3f}"
            lines.append(f"{name:22s}{v}{numbers}{1e6 * entry.time:8.0f}  {verdict(entry)}")
        lines += [f"{name} is left out: it {reason}" for name, reason in self.left_out.items()]
        quiet = nothing_approaches(self.scene, self.velocity)
        lines += [] if quiet is None else [quiet]
        return "\n".join(lines)


def verdict(entry: Entry) -> str:
    """'ok', or what is violated, and a status that is not ok."""
    names = ("kinematic", "kinetic", "energetic", "momentum")
    broken = [f"{n} violated" for n in names if not bool(getattr(entry.audit, n))]
    words = [] if entry.status == "ok" else [entry.status]
    return ", ".join(broken + words) or "ok"


def registered_laws(values: Mapping[str, Any]) -> tuple[dict[str, Law], dict[str, str]]:
    """One law of each kind of the registry, from parameters by name; and why others are left out.

    >>> from jimpact.comparison import registered_laws
    >>> laws, left_out = registered_laws({"restitution": 0.9})
    >>> sorted(laws), left_out["restitution_matrix"]
    (['binary', 'lzb', 'moreau', 'newton', 'poisson'], 'needs `matrix`')
    """
    laws, left_out = {}, {}
    for name, row in REGISTRY.items():
        missing = [f"`{key}`" for key in row.required if key not in values]
        if missing:
            left_out[name] = f"needs {', '.join(missing)}"
        else:
            laws[name] = row.build(**{key: values[key] for key in row.arguments if key in values})
    return laws, left_out


def compare(
    scene: Scene, velocity: Any, laws: Mapping[str, Law] | None = None, **values: Any
) -> Comparison:
    """Outcomes of several laws on one impact: velocities, energy, dispersion, audit, time.

    Args:
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        laws: by name; default: every law of the registry, with these
        values: parameters by name, `restitution=0.9, stiffness=..., exponent=..., matrix=...`
            (laws that need others are left out, see `left_out`); restitution is 1 where nothing
            is said.

    >>> import jimpact as ji
    >>> table = ji.compare(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0], restitution=1.0)
    >>> [round(float(v), 4) for v in table.entries["moreau"].outcome.velocity]
    [-0.3333, 0.6667, 0.6667]
    """
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    left_out: dict[str, str] = {}
    if laws is None:
        laws, left_out = registered_laws({"restitution": 1.0} | values)
    elif values:
        raise ValueError(
            f"Argument `laws` must be None where parameters are given, but {', '.join(values)} "
            "came with it."
        )
    entries = {name: _entry(law, scene, v) for name, law in laws.items()}
    return Comparison(scene, np.asarray(v), entries, left_out)


def _entry(law: Law, scene: Scene, v: jax.Array) -> Entry:
    begin = time.perf_counter()
    out = jax.block_until_ready(impact(law, scene, v))
    first = time.perf_counter() - begin
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(impact(law, scene, v))
        times.append(time.perf_counter() - begin)
    each = float(np.median(times))
    return Entry(
        law=law,
        outcome=out,
        audit=audit(scene, v, out),
        energy_ratio=float(energy_ratio(scene, v, out.velocity)),
        dispersion_index=float(dispersion_index(scene, out.velocity)),
        time=each,
        compile_time=max(first - each, 0.0),
    )
