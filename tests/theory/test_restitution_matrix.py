"""Restitution matrices: check values, both sizes of E, open contacts, rocking, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import CODE, kinetic_norm
from refusals import argument

import jimpact as ji
from jimpact import RestitutionMatrix
from jimpact.theory import (
    from_quasi_velocities,
    housner_restitution,
    normalized_delassus,
    rocking_matrix,
    rocking_ratios,
    to_quasi_velocities,
)

CHAIN = ji.chain([1.0, 2.0, 3.0])
E2 = jnp.array([[0.7, 0.1], [0.25, 0.6]])
CONSTRAINED = ji.Scene(
    mass=np.diag([2.0, 1.0, 3.0, 0.5, 1.5]) + 0.2,
    normals=np.array([[1.0, 0.2], [-0.4, 1.0], [0.3, -0.5], [0.8, 0.1], [0.0, 0.7]]),
    tangents=np.array([[0.1, 1.0], [0.9, 0.3], [-0.2, 0.6], [0.4, -0.8], [1.0, 0.2]]),
    constraints=np.array([[0.3], [0.5], [-1.0], [0.2], [0.6]]),
)


def block(mass=2.0, height=2.0, width=1.0, theta=0.0):
    """q = (x, y, theta): contact 1 the right corner, contact 2 the left one."""
    inertia = mass * (height**2 + width**2) / 12
    s, c, h, w = np.sin(theta), np.cos(theta), height / 2, width / 2
    return ji.Scene(
        mass=[mass, mass, inertia],
        normals=[[0, 0], [1, 1], [h * s + w * c, h * s - w * c]],
        tangents=[[1, 1], [0, 0], [h * c - w * s, h * c + w * s]],
    )


from_quasi = jax.jit(from_quasi_velocities)
to_quasi = jax.jit(to_quasi_velocities)
kinetic = jax.jit(ji.kinetic_energy)
jump_of = jax.jit(ji.velocity_change)


def velocity_of(scene, qn, qt):
    return from_quasi(scene, jnp.asarray(qn, float), jnp.asarray(qt, float))


def test_check_values():
    v = velocity_of(CHAIN, [-1.0, -0.3], [0.4])
    out = ji.impact(RestitutionMatrix(E2), CHAIN, v)
    qn, qt = to_quasi(CHAIN, out.velocity)
    np.testing.assert_allclose(qn, [0.73, 0.43], atol=1e-14)
    np.testing.assert_allclose(qt, [0.4], atol=1e-14)
    pbar = out.impulse * kinetic_norm(CHAIN)
    np.testing.assert_allclose(
        pbar, [2.57058240589371162, 1.87959940026865904], atol=1e-14
    )
    np.testing.assert_allclose(out.energy_change, -0.224854663778188231, atol=1e-14)
    assert int(out.status) == 0
    contact = ji.Contact(ji.delassus_matrix(CHAIN), ji.gap_velocity(CHAIN, v))
    p, _, code = RestitutionMatrix(E2).impulses(contact)
    np.testing.assert_allclose(p, out.impulse, atol=1e-14)
    assert int(code) == 0


def test_self_adjoint_matrix():
    """E = G S: the energy of (6.50) in its corrected form."""
    g = np.asarray(ji.theory.kinetic_angles(CHAIN))
    g = -np.cos(g)
    e = g @ np.array([[0.5, 0.1], [0.1, 0.3]])
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(e)),
        [0.236018788194505563, 0.474538492705502849],
        atol=1e-14,
    )
    out = ji.impact(
        RestitutionMatrix(e), CHAIN, velocity_of(CHAIN, [-1.0, -0.3], [0.0])
    )
    np.testing.assert_allclose(out.energy_change, -0.735489507379329992, atol=1e-14)


def test_slender_block_pulls():
    """E = e I is not kinetically consistent beyond a kinetic angle of pi/2."""
    scene = block(height=2.0, width=1.0)
    out = ji.impact(
        RestitutionMatrix(0.5 * jnp.eye(2)), scene, velocity_of(scene, [0, -1.0], [0])
    )
    np.testing.assert_allclose(
        out.impulse * kinetic_norm(scene), [-0.4, 1.6], atol=1e-14
    )
    assert int(out.status) == CODE["negative_impulse"]


def test_diagonal_matrix_is_newton():
    v = jnp.array([1.0, 0.0, -0.5])
    a = ji.impact(
        RestitutionMatrix(jnp.diag(jnp.array([0.8, 0.4]))), ji.chain(jnp.ones(3)), v
    )
    np.testing.assert_allclose(a.velocity, [-13 / 30, 11 / 30, 17 / 30], atol=1e-14)
    np.testing.assert_allclose(a.impulse, [43 / 30, 16 / 15], atol=1e-14)


def test_energy_gain_is_flagged():
    out = ji.impact(
        RestitutionMatrix([[0.1, 0], [1.8, 0.5]]), ji.chain(jnp.ones(3)), [1.0, 0, 0]
    )
    assert int(out.status) == CODE["energy_gain"]
    assert float(out.energy_change) > 0


# ------------------------------------------------------------------- tangential blocks


def full_matrix(scene, scale=0.4, seed=0):
    size = scene.size - (0 if scene.constraints is None else scene.constraints.shape[1])
    return jnp.asarray(scale * np.random.default_rng(seed).uniform(size=(size, size)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene", [block(theta=0.1), CONSTRAINED], ids=["block", "constrained"]
)
def test_tangential_blocks(scene):
    """v+ = -E v- in all quasi-velocities; impulses, energy and constraints agree with it."""
    e = full_matrix(scene)
    k = e.shape[0] - 2
    v = velocity_of(scene, [-1.0, -0.2], np.linspace(0.3, 0.8, k))
    out = ji.impact(RestitutionMatrix(e), scene, v)
    before = jnp.concatenate(to_quasi(scene, v))
    after = jnp.concatenate(to_quasi(scene, out.velocity))
    np.testing.assert_allclose(after, -e @ before, atol=1e-13)
    jump = jump_of(scene, out.impulse, out.tangential_impulse)
    np.testing.assert_allclose(out.velocity - v, jump, atol=1e-13)
    change = kinetic(scene, out.velocity) - kinetic(scene, v)
    np.testing.assert_allclose(out.energy_change, change, atol=1e-13)
    if scene.constraints is not None:
        np.testing.assert_allclose(scene.constraints.T @ out.velocity, 0, atol=1e-13)
    # two equal forms where nothing tangential is to change
    plain = ji.impact(RestitutionMatrix(e[:2, :2]), scene, v)
    frictionless = jnp.eye(2 + k).at[:2, :2].set(-e[:2, :2]) * -1.0
    same = ji.impact(RestitutionMatrix(frictionless), scene, v)
    np.testing.assert_allclose(same.velocity, plain.velocity, atol=1e-13)
    np.testing.assert_allclose(same.tangential_impulse, 0, atol=1e-13)
    qn, qt = to_quasi(scene, plain.velocity)
    np.testing.assert_allclose(qn, -e[:2, :2] @ before[:2], atol=1e-13)
    np.testing.assert_allclose(qt, before[2:], atol=1e-13)


def test_least_tangential_impulses():
    """Both corners of a flat block push alike: the share of each is half."""
    scene = block()
    v = velocity_of(scene, [-1.0, -0.3], [0.7])
    out = ji.impact(RestitutionMatrix(full_matrix(scene)), scene, v)
    side = np.asarray(out.tangential_impulse)
    np.testing.assert_allclose(side[0], side[1], atol=1e-14)
    np.testing.assert_allclose(side.sum(), 2.0 * (out.velocity[0] - v[0]), atol=1e-14)


def test_unreachable_tangential_change_is_infeasible():
    """Tangents along the normals cannot change qt."""
    scene = block()
    stuck = ji.Scene(scene.mass, scene.normals, tangents=scene.normals)
    v = velocity_of(scene, [-1.0, -0.3], [0.7])
    e = full_matrix(scene)
    assert int(ji.impact(RestitutionMatrix(e), stuck, v).status) == CODE["infeasible"]
    kept = jnp.array([[0.3, 0.3, 0.0], [0.3, 0.3, 0.0], [0.0, 0.0, -1.0]])  # qt+ = qt-
    assert int(ji.impact(RestitutionMatrix(kept), stuck, v).status) == 0


# ----------------------------------------------------------------- open contacts, singular W


def test_open_contacts_take_no_part():
    e = jnp.array([[0.6, 0.3, 0.1], [0.2, 0.5, 0.4], [0.3, 0.2, 0.7]])
    masses, v = jnp.array([1.0, 2.0, 1.5, 1.0]), jnp.array([1.0, 0.2, -0.5, -1.5])
    gapped = ji.impact(
        RestitutionMatrix(e), ji.chain(masses, gaps=jnp.array([0, 0, 1e-3])), v
    )
    alone = ji.impact(RestitutionMatrix(e[:2, :2]), ji.chain(masses[:3]), v[:3])
    np.testing.assert_allclose(gapped.velocity[:3], alone.velocity, atol=1e-14)
    assert float(gapped.velocity[3]) == -1.5
    assert float(gapped.impulse[2]) == 0.0


def test_redundant_contacts():
    """A ball on two equal walls: G is singular; equal rows of E agree, others contradict."""
    scene = ji.Scene([2.0, 1.0], [[1.0, 1.0], [0.0, 0.0]])
    out = ji.impact(RestitutionMatrix([[0.3, 0.2], [0.1, 0.4]]), scene, [-1.0, 0.3])
    np.testing.assert_allclose(out.velocity, [0.5, 0.3], atol=1e-14)
    np.testing.assert_allclose(out.impulse, [1.5, 1.5], atol=1e-14)
    assert int(out.status) == CODE["impulse_not_unique"]
    out = ji.impact(RestitutionMatrix([[0.3, 0.2], [0.1, 0.6]]), scene, [-1.0, 0.3])
    assert int(out.status) == CODE["infeasible"]


def test_traced_gap_with_tangential_blocks_is_infeasible():
    scene, law = block(), RestitutionMatrix(rocking_matrix(0.5))

    @jax.jit
    def status(gaps, v):
        moved = ji.Scene(scene.mass, scene.normals, scene.tangents, gaps)
        return ji.impact(law, moved, v).status

    v = velocity_of(scene, [-1.0, -0.1], [0.2])
    assert int(status(jnp.array([0.0, 1e-3]), v)) == CODE["infeasible"]
    assert int(status(jnp.zeros(2), v)) == 0


# ------------------------------------------------------------------------------- rocking


@pytest.mark.parametrize("aspect", [1.0, 2.0, 3.0])
def test_rocking(aspect):
    """Rocking about A (contact 2), hitting with B (contact 1), then rocking about B."""
    e = float(housner_restitution(aspect))
    scene = block(height=aspect, width=1.0)
    rate = -0.8  # clockwise about A, at (-width / 2, -height / 2) from the centre
    v = jnp.array([-aspect / 2, 0.5, 1.0]) * rate
    np.testing.assert_allclose(ji.gap_velocity(scene, v), [rate, 0], atol=1e-15)
    out = ji.impact(RestitutionMatrix(rocking_matrix(e)), scene, v)
    np.testing.assert_allclose(
        ji.gap_velocity(scene, out.velocity), [0, -e * rate], atol=1e-14
    )
    np.testing.assert_allclose(out.velocity[0], e * v[0], atol=1e-14)
    np.testing.assert_allclose(out.velocity[2], e * rate, atol=1e-14)
    np.testing.assert_allclose(
        scene.tangents[:, 0] @ out.velocity, 0, atol=1e-14
    )  # no slip at B
    np.testing.assert_allclose(
        out.energy_change, (e**2 - 1) * kinetic(scene, v), atol=1e-14
    )
    # Housner: angular momentum about B is conserved, so A's impulse vanishes
    np.testing.assert_allclose(out.impulse[1], 0, atol=1e-14)
    assert float(out.impulse[0]) > 0
    assert int(out.status) == 0
    # and with less the block would have to be pulled there
    for share, reported in ((1.001, "ok"), (0.999, "negative_impulse")):
        out = ji.impact(RestitutionMatrix(rocking_matrix(share * e)), scene, v)
        assert int(out.status) == CODE[reported]


def test_rocking_ratios_are_a_conversion():
    rows = rocking_ratios()
    assert [row[:3] for row in rows] == [
        (5.0, "concrete", 0.95),
        (5.0, "rubber", 0.67),
        (3.0, "concrete", 0.97),
    ]
    expected = [0.95 * 49 / 52, 0.67 * 49 / 52, 0.97 * 0.85]
    np.testing.assert_allclose([row.restitution for row in rows], expected, rtol=1e-14)
    np.testing.assert_allclose(
        housner_restitution(jnp.array([1.0, 2.0, 3.0])), [0.25, 0.7, 0.85], rtol=1e-15
    )


# ----------------------------------------------------------------------------- gradients


@pytest.mark.slow
@pytest.mark.parametrize("scene", [CHAIN, CONSTRAINED], ids=["chain", "constrained"])
def test_derivatives_in_the_entries(scene):
    """v+ is affine in E: dv+/dE_ij = -M^-1 N diag(1/|grad f|) G^-1 e_i qn_j."""
    n, m = scene.size, scene.contacts
    v = velocity_of(
        scene, [-1.0, -0.3], jnp.ones(to_quasi(scene, jnp.zeros(n))[1].size)
    )
    norm, qn = (
        kinetic_norm(scene),
        np.asarray(ji.theory.normalized_gap_velocity(scene, v)),
    )
    g = normalized_delassus(scene)
    g = np.asarray(g if isinstance(g, jax.Array) else g.as_matrix())
    push = np.stack(
        [jump_of(scene, jnp.asarray(np.linalg.inv(g)[:, i]) / norm) for i in range(m)],
        axis=1,
    )
    expected = -push[:, :, None] * qn[None, None, :]

    def after(e):
        return ji.impact(RestitutionMatrix(e), scene, v).velocity

    np.testing.assert_allclose(jax.jit(jax.jacfwd(after))(E2), expected, atol=1e-13)
    np.testing.assert_allclose(jax.jit(jax.jacrev(after))(E2), expected, atol=1e-13)


def test_derivatives_of_the_full_matrix():
    """v+ = -(n_q G^-1, t_q) E (qn, qt): linear in E."""
    scene = block(theta=0.1)
    qn, qt = jnp.array([-1.0, -0.2]), jnp.array([0.5])
    v, quasi, e = (
        velocity_of(scene, qn, qt),
        jnp.concatenate([qn, qt]),
        full_matrix(scene),
    )
    columns = np.stack(
        [velocity_of(scene, x[:2], x[2:]) for x in np.eye(3)],
        axis=1,
    )
    expected = -columns[:, :, None] * np.asarray(quasi)[None, None, :]

    def after(e):
        return ji.impact(RestitutionMatrix(e), scene, v).velocity

    np.testing.assert_allclose(jax.jit(jax.jacfwd(after))(e), expected, atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.jacrev(after))(e), expected, atol=1e-12)


def test_batch_and_float32():
    batch = RestitutionMatrix(jnp.stack([E2, 0.5 * E2])[0])
    laws = jax.tree.map(lambda x: jnp.stack([x, 0.5 * x]), batch)
    v = jnp.array([1.0, 0.0, -0.2])
    many = jax.vmap(lambda law: ji.impact(law, CHAIN, v).velocity)(laws)
    one = ji.impact(RestitutionMatrix(0.5 * E2), CHAIN, v).velocity
    np.testing.assert_allclose(many[1], one, atol=1e-14)
    scene, law = block(), RestitutionMatrix(rocking_matrix(jnp.float32(0.5)))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), scene)
    out = ji.impact(law, single, jnp.array([0.1, -1.0, 0.3], jnp.float32))
    assert {x.dtype for x in jax.tree.leaves(out)} == {
        jnp.dtype("float32"),
        jnp.dtype("int32"),
    }


# ----------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[0.5, 0.1]], "must be square"),
        (0.5, "must be square"),
        ([[0.5, np.nan], [0.0, 0.5]], r"`matrix` must be finite.*\(0, 1\)"),
        ([["a", "b"], ["c", "d"]], "must be numeric"),
    ],
)
def test_bad_matrix(matrix, message):
    with pytest.raises((ValueError, TypeError), match=message):
        RestitutionMatrix(matrix)


def test_matrix_that_does_not_fit_the_scene():
    with pytest.raises(ValueError, match=r"shape \(2, 2\) or \(3, 3\) for 2 contacts"):
        ji.impact(RestitutionMatrix(jnp.eye(4)), CHAIN, [1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=argument("matrix")):
        ji.impact(RestitutionMatrix(jnp.eye(3)), CHAIN, [1.0, 0.0, 0.0])
    flat = block()
    gapped = ji.Scene(flat.mass, flat.normals, flat.tangents, gaps=[0.0, 1e-3])
    with pytest.raises(ValueError, match=argument("scene")):
        ji.impact(RestitutionMatrix(rocking_matrix(0.5)), gapped, [0.0, -1.0, 0.0])
    with pytest.raises(ValueError, match=argument("restitution", "1.5")):
        rocking_matrix(1.5)
    with pytest.raises(ValueError, match=argument("aspect", "0")):
        housner_restitution(0.0)
