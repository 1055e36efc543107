"""One suite for every law: what it promises holds, and what can fail is flagged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import LAWS
from hypothesis import given, settings, strategies as st

import jimpact as ji

SCENES = {
    "chain": lambda: (ji.chain(jnp.array([1.0, 2.0, 0.7])), jnp.array([1.0, 0.1, -0.4])),
    "wall": lambda: (ji.chain(jnp.array([1.0, 2.0]), wall=True), jnp.array([1.0, 0.3])),
    "plane": lambda: (
        ji.Scene(jnp.array([[2.0, 0.3], [0.3, 1.0]]), jnp.array([[1.0, 0.2], [-0.3, 0.9]])),
        jnp.array([-1.0, -0.6]),
    ),
}
E, K = jnp.array([0.9, 0.6]), jnp.array([1.0, 2.5])


def once_a_law():
    """Every law once; its further methods and orders, which share its code, are slow tests."""
    seen = set()
    for name, (law, *_) in LAWS.items():
        yield pytest.param(name, id=name, marks=[pytest.mark.slow] if law in seen else [])
        seen.add(law)


@pytest.fixture(params=once_a_law())
def row(request):
    name, make, accuracy, slope_accuracy = LAWS[request.param]
    return ji.REGISTRY[name], make, accuracy, slope_accuracy


@pytest.fixture(params=SCENES, ids=list(SCENES))
def scene(request):
    return SCENES[request.param]()


def failed(out):
    return ji.STATUS[int(out.status)].failure


def check_promises(entry, law, scene, v, accuracy):
    """Every property: promised, or else the status says that it fails."""
    out = ji.impact(law, scene, v)
    found = ji.audit(scene, v, out)
    size = float(jnp.abs(jnp.asarray(v)).max()) or 1.0
    assert np.isfinite(out.velocity).all()
    assert bool(found.momentum)
    signs = {
        "impulse_sign": bool(found.kinetic),
        "gap_velocity_sign": bool(found.kinematic),
        "energy": bool(found.energetic),
    }
    for name, holds in signs.items():
        assert holds or (name not in entry.promises and failed(out)), (name, out)
    if "velocity_scaling" in entry.promises:
        fast = ji.impact(law, scene, 1e3 * jnp.asarray(v))
        np.testing.assert_allclose(fast.velocity / 1e3, out.velocity, atol=2 * accuracy * size)
    if "mass_scaling" in entry.promises:
        heavy = jax.tree.map(lambda x: x, scene)
        object.__setattr__(heavy, "mass", scene.mass * 1e-4)
        same = ji.impact(law, heavy, v)
        np.testing.assert_allclose(same.velocity, out.velocity, atol=2 * accuracy * size)


def test_promises(row, scene):
    entry, make, accuracy, _ = row
    check_promises(entry, make(E, K), *scene, accuracy)


def test_single_contact_is_newton(row):
    _, make, accuracy, _ = row
    chain, v = ji.chain(jnp.array([1.0, 3.0])), jnp.array([2.0, 0.5])
    out = ji.impact(make(jnp.array(0.7), jnp.array(5.0)), chain, v)
    expected = ji.impact(ji.Newton(0.7), chain, v)
    np.testing.assert_allclose(out.velocity, expected.velocity, atol=accuracy)
    np.testing.assert_allclose(out.impulse, expected.impulse, atol=2 * accuracy)


def test_nothing_happens(row):
    _, make, _, _ = row
    out = ji.impact(make(E, K), ji.chain(jnp.ones(3)), jnp.array([0.0, 0.0, 1.0]))
    assert int(out.status) == 0
    assert np.array_equal(out.velocity, [0.0, 0.0, 1.0])
    assert not np.asarray(out.impulse).any()


def test_open_contacts_take_no_part(row):
    entry, make, accuracy, _ = row
    if entry.law.uses_gaps:
        pytest.skip("its open contacts may close: tested with the law")
    v = jnp.array([1.0, 0.0, -0.5])
    gapped = ji.impact(make(E, K), ji.chain(jnp.ones(3), gaps=jnp.array([0.0, 1e-3])), v)
    alone = ji.impact(make(E[0], K[0]), ji.chain(jnp.ones(2)), v[:2])
    np.testing.assert_allclose(gapped.velocity[:2], alone.velocity, atol=accuracy)
    assert float(gapped.velocity[2]) == -0.5
    assert float(gapped.impulse[1]) == 0.0
    assert "open" in ji.summary(gapped, ji.chain(jnp.ones(3), gaps=jnp.array([0.0, 1e-3])), v)


def test_permutation(row):
    _, make, accuracy, _ = row
    if getattr(make(E, K), "order", "fastest") not in ("fastest", "earliest"):
        pytest.skip("its order is by number of the contact")
    scene, v = SCENES["plane"]()
    swapped = ji.Scene(scene.mass, scene.normals[:, ::-1])
    a = ji.impact(make(E, K), scene, v)
    b = ji.impact(make(E[::-1], K[::-1]), swapped, v)
    np.testing.assert_allclose(a.velocity, b.velocity, atol=2 * accuracy)
    np.testing.assert_allclose(a.impulse, b.impulse[::-1], atol=2 * accuracy)


def test_bilateral_constraints_reduce_the_scene(row):
    """Four balls, the middle two welded together: three balls, in every law."""
    _, make, accuracy, _ = row
    four = jnp.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]])
    welded = ji.Scene(
        jnp.array([1.0, 2.0, 0.5, 0.7]), four, constraints=jnp.array([[0.0], [-1], [1], [0]])
    )
    three = ji.Scene(jnp.array([1.0, 2.5, 0.7]), jnp.array([[-1.0, 0], [1, -1], [0, 1]]))
    out = ji.impact(make(E, K), welded, jnp.array([1.0, 0.1, 0.1, -0.4]))
    same = ji.impact(make(E, K), three, jnp.array([1.0, 0.1, -0.4]))
    np.testing.assert_allclose(out.velocity[jnp.array([0, 1, 3])], same.velocity, atol=2 * accuracy)
    np.testing.assert_allclose(out.velocity[1], out.velocity[2], atol=1e-14)
    np.testing.assert_allclose(out.impulse, same.impulse, atol=2 * accuracy)
    np.testing.assert_allclose(out.energy_change, same.energy_change, atol=2 * accuracy)


def test_chain_equals_dense_scene(row):
    _, make, accuracy, _ = row
    chain, v = SCENES["wall"]()
    a = ji.impact(make(E, K), chain, v)
    b = ji.impact(make(E, K), ji.Scene(chain.mass, chain.normals), v)
    np.testing.assert_allclose(a.velocity, b.velocity, atol=2 * accuracy)


def test_jit_equals_eager_and_vmap_equals_loop(row):
    _, make, accuracy, _ = row
    chain, v = SCENES["chain"]()
    law = make(E, K)
    one = ji.impact(law, chain, v)
    jitted = jax.jit(ji.impact)(law, chain, v)
    np.testing.assert_allclose(jitted.velocity, one.velocity, atol=1e-12)
    batch = jnp.stack([v, 0.5 * v, jnp.zeros_like(v)])
    many = jax.jit(jax.vmap(lambda w: ji.impact(law, chain, w)))(batch)
    for i, w in enumerate(batch):
        single = ji.impact(law, chain, w)
        np.testing.assert_allclose(many.velocity[i], single.velocity, atol=max(accuracy, 1e-12))
        assert int(many.status[i]) == int(single.status)


def test_dtype_is_kept(row):
    _, make, _, _ = row
    scene = SCENES["chain"]()
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (make(E, K), *scene))
    out = ji.impact(*single)
    assert {x.dtype for x in jax.tree.leaves(out)} == {jnp.dtype("float32"), jnp.dtype("int32")}
    double = ji.impact(make(E, K), *scene)
    np.testing.assert_allclose(out.velocity, double.velocity, atol=5e-3)


def test_forward_equals_reverse(row):
    _, make, _, _ = row
    chain, v = SCENES["chain"]()

    def f(e, k, m, v):
        return ji.impact(make(e, k), ji.chain(m), v).velocity

    args = (E, K, chain.mass, v)
    forward = jax.jit(jax.jacfwd(f, argnums=(0, 1, 2, 3)))(*args)
    reverse = jax.jit(jax.jacrev(f, argnums=(0, 1, 2, 3)))(*args)
    for a, b in zip(forward, reverse):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
        assert np.isfinite(np.asarray(a)).all()


def test_gradient_is_that_of_the_value(row):
    """At a generic state, against differences of the value; both laws' tables say how close."""
    _, make, accuracy, slope_accuracy = row
    chain, v = SCENES["chain"]()

    @jax.jit
    def f(e):
        return ji.impact(make(jnp.stack([e, e]), K), chain, v).velocity

    step = max(1e-4, 3 * accuracy ** (1 / 3))
    slope = (f(0.8 + step) - f(0.8 - step)) / (2 * step)
    allowed = slope_accuracy + 5 * step**2 + 2 * accuracy / step
    np.testing.assert_allclose(jax.jacfwd(f)(0.8), slope, atol=allowed)


def test_law_is_a_pytree_and_its_gradient_a_law(row):
    _, make, _, _ = row
    chain, v = SCENES["chain"]()
    law = make(E, K)
    gradient = jax.grad(lambda law: ji.impact(law, chain, v).velocity[1])(law)
    assert type(gradient) is type(law)
    shapes = [jax.tree.map(jnp.shape, jax.tree.leaves(tree)) for tree in (gradient, law)]
    assert shapes[0] == shapes[1]
    batch = jax.vmap(lambda e: make(e, K))(jnp.stack([E, 0.5 * E]))
    assert all(len(x) == 2 for x in jax.tree.leaves(batch))


PAIRS = st.floats(0, 1, width=32)
SPEEDS = st.floats(-1e6, 1e6, width=32)
HARD = st.floats(-6, 6)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    e=st.tuples(PAIRS, PAIRS),
    logk=st.tuples(HARD, HARD),
    logm=st.tuples(HARD, HARD, HARD),
    v=st.tuples(SPEEDS, SPEEDS, SPEEDS),
)
@pytest.mark.parametrize(
    "name",
    [
        "newton",
        "moreau",
        "poisson",
        "restitution-matrix",
        "binary-fastest",
        pytest.param("lzb-hertz", marks=pytest.mark.slow),
    ],
)
def test_extreme_input_is_right_or_flagged(name, e, logk, logm, v):
    make = LAWS[name][1]
    law = make(jnp.array(e), 10.0 ** jnp.array(logk))
    chain, v = ji.chain(10.0 ** jnp.array(logm)), jnp.array(v)
    out = ji.impact(law, chain, v)
    if failed(out):
        return
    assert np.isfinite(out.velocity).all()
    found = ji.audit(chain, v, out)
    assert bool(found.kinetic)
    assert bool(found.energetic)
    assert bool(found.kinematic)
    momentum = ji.momentum(chain, v)
    scale = float(jnp.abs(momentum).sum() + jnp.abs(ji.momentum(chain, out.velocity)).sum())
    lost = float(jnp.sum(ji.momentum(chain, out.velocity) - momentum))
    assert abs(lost) <= 1e-9 * scale + 1e-300
