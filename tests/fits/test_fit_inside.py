"""Fits with a closed form, recovery of known parameters, honesty about what cannot be known."""

import jax.numpy as jnp
import numpy as np
import pytest
from fit_cases import BALLS, PAIR, PRE_3, SHOTS, THREE, Coupled, simulated, two_thirds
from refusals import argument
from scipy import optimize

import jimpact as ji
from jimpact.fits.parameters import (
    LawInScene,
    bounds_of,
    checked_ties,
    free_parameters,
    tied,
)
from jimpact.fits.report import Fit
from jimpact.fits.solve import Damping
from jimpact.tools.records import with_error


def test_entries_are_named_as_in_the_report():
    """`free` and `bounds` take the names that a fit prints: the same groups as with masks."""
    law = ji.Newton([0.8, 0.7, 0.6])
    named, _ = free_parameters(law, ("restitution[2]", "restitution[1=3]"))
    assert named.names == ("restitution[1=3]", "restitution[2]")
    assert named.groups == ((0, 2), (1,))
    but_one, _ = free_parameters(law, {"restitution": True, "restitution[2]": False})
    assert but_one.names == ("restitution[1]", "restitution[3]")
    low, high = bounds_of(but_one, law, {"restitution[3]": (0.5, 0.9)})
    np.testing.assert_array_equal([low, high], [[0.0, 0.5], [1.0, 0.9]])
    matrix, _ = free_parameters(Coupled(jnp.eye(2)), "matrix[2,1]")
    assert (matrix.names, matrix.groups) == (("matrix[2,1]",), ((2,),))
    for free, message in (
        (
            "restitution[4]",
            r"`free` must name entries that the field has.*of shape \(3,\)",
        ),
        ({"restitution[1]": 2}, "must map `restitution.1.` to True or False"),
        ("friction[1]", "must name parameters of Newton"),
    ):
        with pytest.raises(ValueError, match=message):
            free_parameters(law, free)
    with pytest.raises(ValueError, match=argument("free")):
        free_parameters(ji.Newton(0.8), "restitution[1]")


def test_functions_cannot_be_saved(tmp_path):
    observed = ji.FitProblem.from_observable(
        ji.Newton(0.9), lambda law: law.restitution, 0.5
    )
    for problem, message in (
        (observed, "must be to shots to be saved"),
        (ji.FitProblem.from_shots(ji.Newton([0.5, 0.5]), BALLS, THREE, ties={"restitution[2]": two_thirds}), "must have no ties"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            Fit.save(Saved(problem), tmp_path / "fit.json")


class Saved:
    """What `Fit.save` looks at first."""

    def __init__(self, problem):
        self.problem, self.experiments = problem, problem.experiments


def test_a_mass_with_a_prior_is_fitted_with_the_law():
    """Against scipy on the closed form `v1 = (1 - e m) v / (1 + m)`, `v2 = (1 + e) v / (1 + m)`."""
    heavier, speed, prior, sigma = 2.05, SHOTS[:, 0] - SHOTS[:, 1], (2.0, 0.05), 0.02
    post = simulated(ji.Newton(0.6), ji.chain([1.0, heavier]), SHOTS, noise=sigma)
    data = ji.Experiments(SHOTS, post, sigma)

    def residual(x):
        e, m = x
        after = SHOTS[:, 1:] + np.array([1 - e * m, 1 + e]) * speed[:, None] / (1 + m)
        return np.append((after - post) / sigma, (m - prior[0]) / prior[1])

    best = optimize.least_squares(residual, [0.7, 2.0], jac="3-point", xtol=1e-12)
    error = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    choice = {"free": ("restitution", "mass[2]"), "priors": {"mass[2]": prior}}
    found = ji.fit(ji.Newton(0.9), PAIR, data, **choice)
    np.testing.assert_allclose(found.value, best.x, rtol=1e-6)
    np.testing.assert_allclose(found.standard_error, error, rtol=1e-5)
    np.testing.assert_allclose(found.chi_squared, 2 * best.cost, rtol=1e-8)
    np.testing.assert_allclose(found.scene.mass, [1.0, found.value[1]])
    assert type(found.law) is type(found.problem.to_law(found.value)) is ji.Newton
    np.testing.assert_allclose(
        found.predict(SHOTS).velocity, found.predicted, atol=1e-12
    )
    with pytest.raises(ValueError, match=argument("scene")):
        found.predict(SHOTS, BALLS)


def test_parts_of_a_scene_move_it():
    """A tilt of pi / 2 makes the tangent the normal; gaps and masses take the place of the old."""
    wall = ji.Scene(
        [1.0, 2.0, 0.5], [[0.0], [1.0], [0.2]], [[1.0], [0.0], [0.5]], gaps=[0.1]
    )
    parts = LawInScene(
        ji.Newton(0.5), mass=[3.0, 4.0, 5.0], gaps=[0.2], tilt=[np.pi / 2]
    )
    moved = parts.in_scene(wall)
    np.testing.assert_allclose(moved.normals, wall.tangents, atol=1e-15)
    np.testing.assert_allclose(moved.tangents, -wall.normals, atol=1e-15)
    np.testing.assert_array_equal([*moved.gaps, *moved.mass], [0.2, 3.0, 4.0, 5.0])


def test_ties_follow_and_pass_their_errors_on():
    """e2 = 2/3 e1 by a tie, and by linear regression: v+ of Newton's law is linear in both."""
    post = simulated(ji.Newton([0.9, 0.6]), BALLS, PRE_3, noise=0.01)
    corners = [simulated(ji.Newton(e), BALLS, PRE_3) for e in ([0.0, 0.0], [0.9, 0.6])]
    x, y = (corners[1] - corners[0]).ravel() / 0.9, (post - corners[0]).ravel()
    data, ties = ji.Experiments(PRE_3, post, 0.01), {"restitution[2]": two_thirds}
    found = ji.fit(ji.Newton([0.5, 0.5]), BALLS, data, ties=ties, starts=1)
    e, error = x @ y / (x @ x), 0.01 / np.sqrt(x @ x)
    assert found.names == ("restitution[1]",)
    np.testing.assert_allclose(found.law.restitution, [e, e * 2 / 3], rtol=1e-9)
    np.testing.assert_allclose(
        found.tied["restitution[2]"], [e * 2 / 3, error * 2 / 3], rtol=1e-6
    )
    np.testing.assert_allclose(found.standard_error, [error], rtol=1e-6)
    assert f"restitution[2] = {with_error(e * 2 / 3, error * 2 / 3)} is tied" in str(
        found
    )
    further = found.predict(2 * PRE_3)
    slope = 2 * x.reshape(PRE_3.shape)
    np.testing.assert_allclose(further.standard_error, error * np.abs(slope), atol=1e-9)


def test_ties_reach_across_fields_in_any_order():
    law = ji.LZB([0.5, 0.5, 0.5], [1.0, 1.0, 1.0])
    ties = (
        ("stiffness[3]", lambda p: p["stiffness[2]"] + p["restitution"][1]),
        ("stiffness[2]", lambda p: 2 * p["stiffness[1]"]),
        ("restitution[2]", lambda p: p["restitution[1]"] / 2),
    )
    for order in (ties, ties[::-1]):
        checked = checked_ties(law, dict(order))
        np.testing.assert_array_equal(tied(law, checked).stiffness, [1.0, 2.0, 2.25])
    chosen, _ = free_parameters(law, ("restitution", "stiffness"), ties=checked)
    assert chosen.names == (
        "restitution[1]",
        "restitution[3]",
    )  # stiffness[1]: only ratios matter


@pytest.mark.slow
def test_masks_groups_and_held_contacts():
    truth = ji.LZB([0.9, 0.9], [3.0, 6.0])
    data = ji.Experiments(PRE_3, simulated(truth, BALLS, PRE_3))
    start = ji.LZB([0.8, 0.9], [3.0, 5.0])
    tied = ji.fit(start, BALLS, data, {"restitution": [1, 1], "stiffness": True})
    assert tied.names == ("restitution", "stiffness[2]")
    np.testing.assert_allclose(tied.law.restitution, [0.9, 0.9], rtol=1e-6)
    np.testing.assert_allclose(tied.law.stiffness, [3.0, 6.0], rtol=1e-6)
    law = ji.Newton([0.5, 0.9])
    data = ji.Experiments(PRE_3, simulated(ji.Newton([0.7, 0.9]), BALLS, PRE_3))
    masked = ji.fit(law, BALLS, data, {"restitution": [True, False]})
    assert masked.names == ("restitution[1]",)
    np.testing.assert_allclose(masked.law.restitution, [0.7, 0.9], rtol=1e-9)


def test_damping_follows_the_gain_ratio():
    """Nielsen's rule: a third of mu after a step that gains all that was promised, mu
    itself after one that gains half of it; 2 mu, then 2 * 4 mu after steps that fail.
    """
    mu = 0.3
    promised = 1.0
    damping = Damping(*jnp.asarray([mu, 2.0, promised]))
    all_of_it, half, loss = jnp.asarray([promised, 0.5 * promised, -1.0])
    np.testing.assert_allclose(damping.after(all_of_it).value, mu / 3)
    np.testing.assert_allclose(damping.after(half).value, mu)
    failed = damping.after(loss)
    np.testing.assert_allclose(failed.value, 2 * mu)
    failed_again = failed.after(loss)
    np.testing.assert_allclose(failed_again.value, 2 * 4 * mu)
    np.testing.assert_allclose(failed_again.growth, 8.0)


def test_a_kink_is_a_minimum_but_not_a_standard_error():
    """|x| + x / 2 falls nowhere from 0, although the derivative on each side promises more."""

    def bend(law):
        x = law.restitution - 0.4
        return jnp.stack([jnp.abs(x) + 0.5 * x + 1.0, 1.0 + 0 * x])

    problem = ji.FitProblem.from_observable(ji.Newton(0.5), bend, [0.0, 1.0], 0.1)
    found = ji.fit(problem, starts=1, profiles=False)
    np.testing.assert_allclose(found.value, 0.4, atol=1e-3)
    assert found.found("kink")


def test_a_time_limit_ends_a_search():
    data = ji.Experiments(SHOTS, simulated(ji.Newton(0.6), PAIR, SHOTS, noise=0.02))
    stopped = ji.fit(
        ji.Newton(0.9), PAIR, data, starts=1, search=ji.Search("adam", limit=0.0)
    )
    assert stopped.verdict.startswith("No answer")
    assert stopped.steps <= 8


def test_as_many_starts_as_stated():
    data = ji.Experiments(SHOTS, simulated(ji.Newton(0.6), PAIR, SHOTS, noise=0.02))
    assert [
        ji.fit(ji.Newton(0.9), PAIR, data, starts=n).start_count for n in (1, 3)
    ] == [1, 3]
