"""Derivatives: against held values, between modes, at touching contacts and at the edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jimpact as ji

BALLS, V = ji.chain([1.0, 1.0, 1.0]), jnp.array([1.0, 0.0, 0.0])

# d v+ / d (kappa, e1, e2) at eta = 1 and d v+ / d (eta, kappa, e1, e2) at eta = 1.5; e = 0.9
LINEAR = np.array(
    [
        [-0.12283533377629, 0.14545764544136, -0.022622311665065],
        [-0.64376648585348, 0.23257752345323, 0.41118896240025],
        [-1.2503440488269e-6, -0.4064937970789, 0.40649504742295],
    ]
)
HERTZ = np.array(
    [
        [0.081076619093299, -0.083883554615527, 0.0028069355222283],
        [-0.066928813512993, 0.068799893104474, -0.0018710795914811],
        [-0.61311351473699, 0.16549672267969, 0.4476167920573],
        [-3.3628027004369e-7, -0.44470679947149, 0.44470713575176],
    ]
)


def outcome(exponent, kappa, e1, e2, **options):
    law = ji.LZB(jnp.stack([e1, e2]), jnp.stack([1.0, kappa]), exponent, **options)
    return ji.impact(law, BALLS, V).velocity


def test_held_derivatives():
    got = jax.jit(jax.jacrev(lambda *a: outcome(1.0, *a), argnums=(0, 1, 2)))(1.0, 0.9, 0.9)
    np.testing.assert_allclose(got, LINEAR, rtol=0, atol=1e-7)
    got = jax.jit(jax.jacrev(outcome, argnums=(0, 1, 2, 3)))(1.5, 1.0, 0.9, 0.9)
    np.testing.assert_allclose(got, HERTZ, rtol=0, atol=1e-7)


def test_elastic_derivatives_at_the_default_tolerance():
    # from rtol = 1e-12, confirmed by fourth-order differences to 3e-12
    expected = [
        (-0.082349731119, 0.095566227547, -0.013216496428),
        (0.087622672930, -0.101685435831, 0.014062762901),
    ]
    got = jax.jit(jax.jacfwd(outcome, argnums=(1, 0)))(1.5, 1.0, 1.0, 1.0)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("method", "atol"), [("propagator", 1e-12), ("impulse", 1e-3)])
def test_other_methods(method, atol):
    f = jax.jit(jax.jacrev(lambda *a: outcome(1.0, *a, method=method), argnums=(0, 1, 2)))
    np.testing.assert_allclose(f(1.0, 0.9, 0.9), LINEAR, rtol=0, atol=atol)


def everything(law, masses, v):
    out = ji.impact(law, ji.chain(masses, wall=True), v)
    weights = jnp.arange(1.0, out.velocity.shape[0] + 1)
    return weights @ out.velocity + 0.3 * out.energy_change + jnp.sum(out.impulse)


@pytest.mark.slow
def test_forward_equals_reverse_in_every_parameter():
    law = ji.LZB(
        jnp.array([0.8, 0.6, 0.9]),
        jnp.array([1.0, 0.5, 2.0]),
        jnp.array([1.5, 1.3, 1.0]),
        jnp.array([0.01, 0.02, 0.03]),
    )
    args = (law, jnp.array([1.0, 2.0, 1.5]), jnp.array([1.0, 0.1, -0.2]))
    reverse = jax.jit(jax.jacrev(everything, argnums=(0, 1, 2)))(*args)
    forward = jax.jit(jax.jacfwd(everything, argnums=(0, 1, 2)))(*args)
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(reverse)):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    # and both equal central differences of the tightened solve
    tight = jax.jit(lambda law, m, v: everything(law, m, v))
    flat, rebuild = ravel_pytree(args)
    sharp = ji.LZB(law.restitution, law.stiffness, law.exponent, law.initial_energy, rtol=1e-12)

    def value(x):
        _, m, v = rebuild(x)
        at = rebuild(x)[0]
        fine = jax.tree.unflatten(jax.tree.structure(sharp), jax.tree.leaves(at))
        return tight(fine, m, v)

    step = 1e-5
    differences = [
        (value(flat + step * d) - value(flat - step * d)) / (2 * step) for d in jnp.eye(flat.size)
    ]
    exact, _ = ravel_pytree(reverse)
    np.testing.assert_allclose(exact, differences, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_dense_scene_differentiates_in_normals_and_mass():
    def f(normals, mass):
        return ji.impact(ji.LZB(0.8), ji.Scene(mass, normals), jnp.array([0.3, -1.0])).velocity

    normals, mass = jnp.array([[1.0, 0.2], [0.5, -0.9]]), jnp.array([[2.0, 0.3], [0.3, 1.0]])
    forward = jax.jit(jax.jacfwd(f, argnums=(0, 1)))(normals, mass)
    reverse = jax.jit(jax.jacrev(f, argnums=(0, 1)))(normals, mass)
    for a, b in zip(forward, reverse):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
        assert np.isfinite(np.asarray(a)).all()
        assert np.abs(a).max() > 0.01


@pytest.mark.parametrize(
    "exponent",
    [1.0, 1.5, *(pytest.param(eta, marks=pytest.mark.slow) for eta in (2.0, 1.3))],
)
@pytest.mark.parametrize("e", [0.0, 1e-9, 0.5, 1.0])
def test_single_contact_equals_newton_with_its_derivatives(e, exponent):
    def f(law_of):
        def g(e, masses, v):
            return ji.impact(law_of(e), ji.chain(masses), v).velocity

        args = (jnp.asarray(e), jnp.array([1.0, 3.0]), jnp.array([2.0, 0.5]))
        return jax.jacrev(g, argnums=(0, 1, 2))(*args)

    a, b = f(lambda e: ji.LZB(e, 7.0, exponent)), f(ji.Newton)
    for x, y in zip(a, b):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13)


@pytest.mark.slow
def test_derivative_at_zero_restitution_is_the_one_sided_limit():
    scene, v = ji.chain([3.0, 1.0, 2.0]), [1.0, 0.0, -0.5]

    def f(e):
        return ji.impact(ji.LZB(jnp.stack([0.95, e]), [1.0, 3.0], rtol=1e-12), scene, v).velocity

    run = jax.jit(f)
    slope = (-3 * run(0.0) + 4 * run(1e-4) - run(2e-4)) / 2e-4  # second-order one-sided
    np.testing.assert_allclose(jax.jacfwd(f)(0.0), slope, atol=2e-6)
    np.testing.assert_allclose(jax.jacrev(f)(0.0), slope, atol=2e-6)


@pytest.mark.parametrize("e", [0.0, 0.05, 1.0])
@pytest.mark.parametrize(
    "v", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.5, -1.0], [1.0, 0.0, -1.0]]
)
def test_no_nan_at_the_edges(e, v):
    grads = jax.jit(jax.grad(everything, argnums=(0, 1, 2)))(
        ji.LZB(jnp.full(3, e), jnp.ones(3)), jnp.ones(3), jnp.array(v)
    )
    assert all(np.isfinite(np.asarray(g)).all() for g in jax.tree.leaves(grads))


def test_newby_kink_has_two_slopes():
    """k2/k1 = 6.1713: both contacts of the linear chain open together; left slope 0, right 0.0293."""
    kink = 6.171292729553324410933

    def v3(kappa):
        law = ji.LZB(1.0, jnp.stack([1.0, kappa]), 1.0, method="propagator")
        return ji.impact(law, BALLS, V).velocity[2]

    slope = jax.jit(jax.grad(v3))
    assert float(slope(kink + 1e-7)) == pytest.approx(0.029329005, abs=1e-4)
    assert float(slope(kink - 1e-7)) == pytest.approx(0.0, abs=2e-2)  # -> 0 like |d|^(1/3)
    assert float(slope(kink - 1e-10)) == pytest.approx(0.0, abs=2e-3)


@pytest.mark.slow
def test_second_derivatives():
    f = jax.jit(lambda e: outcome(1.5, 1.0, e, e, rtol=1e-11)[2])
    step = 1e-3
    difference = (f(0.9 + step) - 2 * f(0.9) + f(0.9 - step)) / step**2
    second = jax.jit(jax.jacfwd(jax.jacrev(f)))(0.9)
    np.testing.assert_allclose(second, difference, rtol=1e-4)


@pytest.mark.slow
def test_batched_gradients_equal_single_ones():
    kappas = jnp.array([0.05, 0.3, 1.0, 4.0, 20.0])
    grad = jax.grad(lambda kappa: outcome(1.5, kappa, 0.9, 0.8)[1])
    batched = jax.jit(jax.vmap(grad))(kappas)
    np.testing.assert_allclose(batched, [jax.jit(grad)(k) for k in kappas], rtol=1e-9)


@pytest.mark.slow
def test_history_is_differentiable():
    def duration(k):
        return ji.history(ji.LZB(1.0, k, 1.0), ji.chain([1.0], wall=True), [1.0]).duration

    expected = -np.pi / 2 * 2.0**-1.5
    assert float(jax.jacfwd(duration)(2.0)) == pytest.approx(expected, abs=1e-7)
    assert float(jax.grad(duration)(2.0)) == pytest.approx(expected, abs=1e-7)


@pytest.mark.slow
def test_gradient_descent_learns_a_restitution():
    optax = pytest.importorskip("optax")
    measured = ji.impact(ji.LZB(0.83), BALLS, V).velocity

    def loss(law):
        return jnp.sum((ji.impact(law, BALLS, V).velocity - measured) ** 2)

    law, rule = ji.LZB(0.5), optax.sgd(0.5)
    state = rule.init(law)
    update = jax.jit(lambda law, state: _descend(law, state, rule, jax.grad(loss)(law)))
    for _ in range(40):
        law, state = update(law, state)
    assert float(law.restitution) == pytest.approx(0.83, abs=1e-4)


def _descend(law, state, rule, gradient):
    optax = pytest.importorskip("optax")
    only_e = jax.tree.map(jnp.zeros_like, gradient)
    object.__setattr__(only_e, "restitution", gradient.restitution)
    updates, state = rule.update(only_e, state)
    return optax.apply_updates(law, updates), state


@pytest.mark.parametrize(
    "law",
    [
        ji.LZB(0.8, [1.0, 1.0]),
        pytest.param(ji.Compliant(ji.Bistiffness(1.0, 1.5, 0.8)), marks=pytest.mark.slow),
        pytest.param(ji.Compliant(ji.LinearSpring(1.0)), marks=pytest.mark.slow),
        pytest.param(ji.Compliant(ji.KelvinVoigt(1.0, 0.1)), marks=pytest.mark.slow),
    ],
    ids=["lzb", "bistiffness", "linear", "kelvin-voigt"],
)
def test_events_that_coincide(law):
    """A symmetric impact, in which every event happens at both contacts at once."""
    masses, v = jnp.array([0.25, 1.0, 0.25]), jnp.array([1.0, 0.0, -1.0])
    gapped = isinstance(law, ji.Compliant)

    @jax.jit
    def outcome(shift):  # of ball 1: earlier, later; of its speed where geometry is frozen
        if not gapped:
            return ji.impact(law, ji.chain(masses), v.at[0].add(shift)).velocity
        return ji.impact(law, ji.chain(masses, gaps=jnp.stack([0.5 + shift, 0.5])), v).velocity

    step = 1e-4
    expected = (outcome(step) - outcome(-step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(outcome))(0.0), expected, atol=2e-5)
