"""Fits of a restitution matrix that stay admissible: all data simulated from known matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from matrix_fit_cases import (
    CHAIN,
    E_TRUE,
    OUTSIDE,
    PROBLEM,
    PUSHED,
    START,
    fitted,
    shots,
)
from refusals import argument

import jimpact as ji
from jimpact import RestitutionMatrix, fit, read_study


def test_one_shot_is_always_reproduced():
    """Prop. 6.1; and one shot leaves one number a row of E unseen."""
    rng = np.random.default_rng(0)
    for _ in range(3):
        v = np.array([1.0, 0.2, -0.3])
        post = np.linalg.solve(  # any gap velocities after, with the momentum before
            np.vstack([np.diff(np.eye(3), axis=0), [1.0, 2.0, 3.0]]),
            np.append(rng.normal(size=2), v @ [1.0, 2.0, 3.0]),
        )
        data = ji.Experiments(np.tile(v, (4, 1)), np.tile(post, (4, 1)))
        law = RestitutionMatrix(START, admissible=False)
        found = fit(law, CHAIN, data, {"matrix": True}, starts=1)
        np.testing.assert_allclose(found.residual, 0, atol=1e-8)
        assert found.rank == 2
        assert "rms residual   0 (the values are reproduced)" in str(found)
        assert found.found("matrix_free")


@pytest.mark.slow
def test_all_entries_are_free_by_default():
    data = shots(E_TRUE)
    found = fit(RestitutionMatrix(START), CHAIN, data, starts=2)
    assert found.names == ("matrix[1,1]", "matrix[1,2]", "matrix[2,1]", "matrix[2,2]")
    np.testing.assert_allclose(found.law.matrix, E_TRUE, atol=1e-9)


@pytest.mark.slow
def test_a_study_of_a_matrix_needs_no_more_than_its_data(tmp_path):
    (tmp_path / "shots.csv").write_text(
        "pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s]\n1,0,0.25,0.75\n2,0,0.5,1.5\n"
    )
    text = (
        '[scene]\nmasses_kg = [1, 1]\n[law]\nname = "%s"\n[data]\nfile = "shots.csv"\n'
    )
    for name, other in (
        ("restitution_matrix", None),
        ('newton"\nrestitution = 0.7 #', "restitution_matrix"),
    ):
        (tmp_path / "study.toml").write_text(text % name)
        found = read_study(tmp_path / "study.toml", other).run(starts=1)
        assert found.names == ("matrix[1,1]",)
        np.testing.assert_allclose(found.value, 0.5, atol=1e-9)


@pytest.mark.slow
def test_too_few_shots_say_which_entries_are_undetermined():
    """Only contact 1 approaches: the second column of E has no effect."""
    data = shots(E_TRUE, pre=np.tile([1.0, 0.0, 0.0], (4, 1)))
    found = fitted(data)
    np.testing.assert_allclose(found.residual, 0, atol=1e-8)
    assert found.rank == 2
    for name in ("matrix[1,2]", "matrix[2,2]"):
        assert any(f"cannot see {name}:" in line for line in found.identifiability)
    np.testing.assert_allclose(
        np.asarray(found.law.matrix)[:, 0], E_TRUE[:, 0], atol=1e-8
    )
    assert np.isinf(found.standard_error[[1, 3]]).all()
    # of exact data
    assert np.isnan(found.standard_error[[0, 2]]).all()


@pytest.mark.slow
def test_several_simulated_shots_recover_the_matrix():
    found = fitted(shots(E_TRUE))
    np.testing.assert_allclose(found.law.matrix, E_TRUE, atol=1e-9)
    assert found.rank == 4
    assert found.converged
    assert not any("edge" in line for line in found.warnings)
    assert found.names == ("matrix[1,1]", "matrix[1,2]", "matrix[2,1]", "matrix[2,2]")


@pytest.mark.slow
def test_a_sparsity_pattern_is_kept():
    sparse = np.array([[0.3, 0.0], [0.5, 0.4]])
    found = fitted(shots(sparse), free=np.array([[True, False], [True, True]]))
    assert float(found.law.matrix[0, 1]) == 0.0
    np.testing.assert_allclose(found.law.matrix, sparse, atol=1e-9)
    assert not any("edge" in line for line in found.warnings)  # held zeros are no edge


@pytest.mark.release
def test_descent_with_projected_gradients_ends_at_the_best_matrix():
    """From a matrix that creates energy; adam with the gradient itself slides away."""
    best, rate, adam = fitted(PUSHED, start=START), 0.2, optax.adam(0.02)

    def squares(x):
        return jnp.sum(PROBLEM.residual(x) ** 2)

    def step(carry, _):
        x, state = carry
        gradients = jax.vmap(jax.grad(squares))(x)
        inward = (x - jax.vmap(PROBLEM.project)(x - rate * gradients)) / rate
        with jax.numpy_dtype_promotion("standard"):  # which optax needs
            update, state = adam.update(jnp.stack([gradients[0], inward[1]]), state)
        moved = jnp.stack(
            [x[0] + update[0], x[1] + update[1], x[2] - rate * gradients[2]]
        )
        return (jax.vmap(PROBLEM.project)(moved), state), None

    start = jnp.asarray(np.tile(OUTSIDE, (3, 1)))
    run = jax.jit(lambda x: jax.lax.scan(step, (x, adam.init(x[:2])), length=500)[0][0])
    plain, projected, sgd = run(start)
    for x in (projected, sgd):
        np.testing.assert_allclose(x, best.value, atol=1e-5)
    assert squares(plain) > 1.01 * best.starts[0].sum_of_squares


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([[0.3, -0.1], [0.0, 0.3]], "E >= 0 fails by 0.1"),
        ([[0.3, 0.0], [1.3, 0.3]], r"copositive \(energy\) fails"),
    ],
)
def test_a_start_that_is_not_admissible(start, message):
    with pytest.raises(ValueError, match=message):
        fitted(shots(E_TRUE), start=np.array(start))


def test_a_start_whose_impulses_would_pull():
    """e I on two contacts with a kinetic angle above pi/2."""
    scene = ji.Scene([1.0, 1.0], [[1.0, 0.5], [0.0, 1.0]])
    data = ji.Experiments([[-1.0, -1.0]], [[0.5, 0.5]])
    with pytest.raises(ValueError, match=r"G\^-1 \(I \+ E\) >= 0 fails"):
        fit(RestitutionMatrix(START), scene, data, {"matrix": True})


def test_scenes_without_an_admissible_set():
    redundant = ji.Scene([1.0, 1.0], [[1.0, 1.0], [0.0, 0.0]])
    data = ji.Experiments([[-1.0, 0.0]], [[0.5, 0.0]])
    with pytest.raises(ValueError, match=argument("scene")):
        fit(RestitutionMatrix(START), redundant, data, {"matrix": True})
    eight = ji.Experiments([[1.0, 0, 0, 0, 0, 0, 0, 0]], [[0.0, 0, 0, 0, 0, 0, 0, 1.0]])
    with pytest.raises(ValueError, match=argument("law")):
        fit(
            RestitutionMatrix(0.1 * np.eye(7)),
            ji.chain(jnp.ones(8)),
            eight,
            {"matrix": True},
        )


def test_held_entries_that_leave_no_room():
    """Elastic first column: any entry more in the second would gain energy somewhere."""
    elastic = np.eye(2)
    with pytest.raises(ValueError, match=argument("free")):
        fitted(
            shots(E_TRUE), start=elastic, free=np.array([[False, True], [False, False]])
        )
