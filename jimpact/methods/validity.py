"""Validity map: for which stiffness ratios Moreau's law, or binary collisions, are
right.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.impacts import impact
from jimpact.core.scene import Scene, as_velocity
from jimpact.laws.binary import Binary
from jimpact.laws.kinematic import Moreau
from jimpact.laws.lzb import LZB
from jimpact.methods.points import relative_error, varied_impacts
from jimpact.theory.dispersion import dispersion_index
from jimpact.tools.checks import as_axis, as_numbers, check_choice, check_values
from jimpact.tools.records import Column, Table, Tabular, fields_as_data
from jimpact.tools.status import STATUS

RATIOS = (1e-3, 1e3, 121)  # default ratios: from, to, how many


@dataclass(frozen=True)
class ValidityMap(Tabular):
    """Outcomes of LZB over exponents (x,) and stiffness ratios (r,), next to others.

    `scene` and v- `before` (n,) [m/s] as passed; `velocity` (x, r, n) [m/s],
    `dispersion` and `status` (x, r) over `exponents` (x,) and `ratios` (r,); `laws`
    holds v+ (n,) of Moreau's law and of binary collisions, `law_dispersion` their
    indices.
    """

    scene: Scene
    before: np.ndarray
    ratios: np.ndarray
    exponents: np.ndarray
    velocity: np.ndarray
    dispersion: np.ndarray
    status: np.ndarray
    laws: dict[str, np.ndarray]
    law_dispersion: dict[str, float]

    picture = "validity_map"

    def error(self, law: str) -> np.ndarray:
        """Error of v+ of a law, 'moreau' or 'binary', against LZB (x, r), relative to
        max |v-|.
        """
        check_choice("law", law, self.laws)
        fastest = np.abs(self.before).max()
        return relative_error(self.velocity, self.laws[law], fastest)

    def limit(self, law: str, tolerance: float = 1e-2) -> np.ndarray:
        """Stiffness ratios (x,) that bound the range in which a law is within
        `tolerance`.

        Moreau's law is right from this ratio to the largest of the map, binary
        collisions from the smallest to this one; NaN: not even there.
        """
        check_values("tolerance", tolerance, low=0.0, open_low=True)
        inside = self.error(law) <= tolerance
        if law == "moreau":
            order = slice(None, None, -1)
        else:
            order = slice(None)
        # number of ratios from that end of the map that are all within
        all_within = np.logical_and.accumulate(inside[:, order], axis=1)
        run = all_within.sum(axis=1)
        at = self.ratios[order][np.maximum(run - 1, 0)]
        return np.where(run > 0, at, np.nan)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as a JSON file can hold it."""
        status = [[STATUS[code].name for code in row] for row in self.status]
        return fields_as_data(self, "scene") | {"status": status}

    @property
    def table(self) -> Table:
        """Table: the stiffness ratios for which each law is within 1 %, by exponent."""
        columns = (
            Column("exponent", ".3g"),
            Column("binary_up_to", _range("<="), "binary within 1 %"),
            Column("moreau_from", _range(">="), "Moreau within 1 %"),
        )
        limits = self.limit("binary"), self.limit("moreau")
        return Table(columns, [*zip(self.exponents, *limits)])


def _range(sign: str) -> Callable[[Any], str]:
    """Format of a stiffness ratio that bounds a range: "ratio <= 0.1"; NaN:
    "nowhere".
    """
    return lambda ratio: "nowhere" if np.isnan(ratio) else f"ratio {sign} {ratio:.3g}"


def validity_map(
    scene: Scene,
    velocity: Any,
    ratios: Any = None,
    exponents: Any = (1.0, 1.5, 2.0, 3.0),
    restitution: Any = 1.0,
) -> ValidityMap:
    """Dispersion and v+ of LZB against the stiffness ratio, next to other laws.

    Equation: `k_j = ratio^(j - 1)`: with two contacts ratio = k2/k1, with more the
    stiffness rises (ratio > 1) or falls from each contact to the next.

    Args:
        scene: n coordinates, m >= 2 contacts without gaps.
        velocity: v- (n,) [m/s], not at rest.
        ratios: (r,) > 0, rising; default: 121 from 1e-3 to 1e3.
        exponents: (x,) >= 1.
        restitution: e in [0, 1], scalar or (m,).

    Returns:
        `ValidityMap`; `ji.plot.validity_map` draws it, `print` says where which law
        holds.

    Raises:
        ValueError: shapes or ranges, at rest, one contact, gaps, ratios that do not
            rise.

    Source: the kind of Brogliato, Nonsmooth Mechanics (2016), figure 6.9.

    >>> import jimpact as ji
    >>> balls = ji.chain([1.0, 1.0, 1.0])
    >>> result = ji.validity_map(
    ...     balls, [1.0, 0.0, 0.0], [1e-3, 1.0, 1e3], exponents=[1.0]
    ... )
    >>> result.velocity[0, :, 1:].round(3).tolist()  # binary, dispersed, Moreau
    [[0.0, 1.0], [0.15, 0.98], [0.666, 0.667]]
    """
    v = as_velocity(scene, velocity, finite=True)
    if not np.asarray(v).any():
        raise ValueError(
            "Argument `velocity` must not be zero: nothing happens at rest."
        )
    closed = np.asarray(scene.closed)
    if scene.contacts < 2 or not closed.all():
        raise ValueError(
            "Argument `scene` must have two or more contacts, all closed, but has "
            f"{scene.contacts}, {int(np.asarray(scene.closed).sum())} of them closed."
        )
    if ratios is None:
        over = np.geomspace(*RATIOS)
    else:
        over = ratios
    ratio = as_axis("ratios", over).astype(v.dtype)
    eta = as_axis("exponents", exponents).astype(v.dtype)
    check_values("ratios", ratio, low=0.0, open_low=True)
    check_values("exponents", eta, low=1.0)
    steps = np.diff(np.asarray(ratio))
    if (steps <= 0).any():
        raise ValueError("Argument `ratios` must rise, but does not.")
    e = as_numbers(
        "restitution", restitution, low=0.0, high=1.0, contacts=scene.contacts
    )
    shape = len(eta), len(ratio)
    # one impact for each exponent and ratio; k (x r, m) = ratio^(j - 1)
    grid = jnp.meshgrid(eta, ratio, indexing="ij")
    exponents, ratios = (x.ravel() for x in grid)
    place = jnp.arange(scene.contacts).astype(v.dtype)
    k = ratios[:, None] ** place[None, :]
    law = LZB(e.astype(v.dtype), k[0], eta[0])
    out = varied_impacts(law, scene, v, {"stiffness": k, "exponent": exponents})
    spread = jax.vmap(partial(dispersion_index, scene))(out.velocity)
    laws = {"moreau": Moreau(e), "binary": Binary(e)}
    after = {name: impact(law, scene, v).velocity for name, law in laws.items()}
    return ValidityMap(
        scene=scene,
        before=np.asarray(v),
        ratios=np.asarray(ratio),
        exponents=np.asarray(eta),
        velocity=np.asarray(out.velocity).reshape(*shape, -1),
        dispersion=np.asarray(spread).reshape(shape),
        status=np.asarray(out.status).reshape(shape),
        laws={name: np.asarray(x) for name, x in after.items()},
        law_dispersion={
            name: float(dispersion_index(scene, x)) for name, x in after.items()
        },
    )
