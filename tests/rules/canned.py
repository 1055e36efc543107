"""Results as if they had been computed, for tests of reports and pictures."""

import jax.numpy as jnp
import numpy as np

import jimpact as ji
from jimpact.fits.findings import Finding
from jimpact.fits.report import Fit
from jimpact.fits.search import FitMinimum, Solution
from jimpact.fits.uncertainty import Uncertainty
from jimpact.laws.histories import History
from jimpact.motion.record import KIND_CODE, Motion, no_events, with_row


def canned(shots, value=(0.6, 2.0), **change):
    """A fit of two parameters to a pair of balls, as if found."""
    rng = np.random.default_rng(0)
    pre = np.stack([rng.uniform(1, 2, shots), np.zeros(shots)], axis=1)
    predicted = np.stack([0.2 * pre[:, 0], 0.8 * pre[:, 0]], axis=1)
    post = predicted + 0.01 * rng.normal(size=predicted.shape)
    if shots > 1:
        post[0, 0] = np.nan
    given = {
        "law": ji.LZB([0.6], [2.0]),
        "method": "levenberg-marquardt",
        "names": ("restitution[1]", "stiffness[1]"),
        "bounds": (np.zeros(2), np.array([1.0, np.inf])),
        "known_findings": (Finding("energy_gain", "The data gain energy."),),
        "known_profiles": (),
        "problem": ji.FitProblem.from_shots(
            ji.LZB([0.6], [2.0], exponent=jnp.asarray(1.5)),
            ji.chain([1.0, 1.0]),
            ji.Experiments(pre, post),
            ("restitution", "exponent"),
        ),
        "jacobian": np.stack([[-0.5, 0.5] * pre[:, :1], np.zeros_like(pre)], axis=2),
    }
    search = {
        "starts": (start(value, 3), start((0.4, 2.0), 5)),
        "predicted": predicted,
        "status": np.zeros(shots, int),
        "converged": True,
        "at_bound": np.array([False, False]),
        "steps": 17,
        "lost_starts": 0,
    }
    errors = {
        "rank": 1,
        "singular_values": np.array([3.0, 0.0]),
        "degrees_of_freedom": 2 * shots - 2,
        "noise": 0.0101,
        "covariance": np.array([[1e-4, np.nan], [np.nan, np.inf]]),
        "correlation": np.eye(2),
        "standard_error": np.array([0.01, np.inf]),
        "identifiability": (
            "The data cannot see stiffness[1]: no measured velocity depends on it.",
        ),
    }
    change = {
        f"known_{x}" if x in ("findings", "profiles") else x: change[x] for x in change
    }
    for part in (search, errors):
        part |= {name: change.pop(name) for name in part if name in change}
    parts = {"search": Solution(**search), "errors": Uncertainty(**errors)}
    return Fit(**(given | parts | change))


def start(value, count):
    fields = {name: None for name in FitMinimum.__annotations__}
    known = {"value": np.array(value), "sum_of_squares": 1e-4, "count": count}
    return FitMinimum(**(fields | {k: v for k, v in known.items() if k in fields}))


def rocked(base=None):
    """A dimer and its motion as if simulated: contact 1 strikes at 0.25 s, between two samples."""
    body = ji.Dimer(radius=0.1, length=1.0)
    system = ji.System(body, gravity=True, base=base)
    time, zero = np.linspace(0.0, 0.5, 6), np.zeros(6)
    q = np.stack([zero, 0.2 + 0.01 * time, 0.3 - time], axis=1)
    before, after = np.array([0.0, -1.0, -2.0]), np.array([0.0, 1.0, 3.0])
    velocity = np.where((time < 0.25)[:, None], before, after)
    row = {
        "time": 0.25,
        "kind": KIND_CODE["impact"],
        "contacts": np.array([True, False]),
        "q": np.array([0.0, 0.2, 0.05]),
        "velocity_before": before,
        "velocity_after": after,
    }
    events = with_row(
        no_events(4, jnp.asarray(q[0]), jnp.asarray(before), 2), jnp.array(True), row
    )
    work = np.zeros((6, 2, 2))
    work[3:, 0, 0] = -0.5
    record = Motion(
        *(time, q, velocity, 1 + zero, 2 - 0.5 * (time > 0.25)),
        *(zero, zero, work, np.full((6, 2), 0.1), events, jnp.int32(9), jnp.int32(0)),
    )
    return system, record


def impact_history():
    t = np.linspace(0, 1, 9)[:, None]
    rows = np.sin(np.pi * t) * np.array([1.0, 0.5])
    none = np.zeros((9, 0))
    return History(
        *(
            37e-6 * t[:, 0],
            900 * rows,
            rows,
            0.5 * rows**2,
            rows,
            rows - 0.5,
            0.6 * rows + 0.4 * t,
        ),
        np.zeros((9, 3)),
        *(none, none, none, none, np.float64(37e-6), rows.max(axis=0), np.int32(0)),
    )
