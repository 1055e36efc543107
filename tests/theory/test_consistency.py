"""Copositivity, the audit of restitution matrices (Props. 6.2-6.5), Carnot, friction bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from consistency_cases import HORN, close
from programs import kinetic_norm
from refusals import argument

import jimpact as ji
from jimpact import kinetic_energy, velocity_change
from jimpact.theory import (
    audit_matrix,
    carnot_energy_loss,
    copositivity,
    dissipation_matrix,
    friction_bounds,
    friction_energy_change,
    friction_impulses,
    from_quasi_velocities,
    normalized_delassus,
    quasi_basis,
    to_quasi_velocities,
)


def dense(matrix):
    return np.asarray(matrix.as_matrix() if hasattr(matrix, "as_matrix") else matrix)


def block(mass=2.0, height=1.0, width=1.5):
    inertia = mass * (height**2 + width**2) / 12
    normals = [[0, 0], [1, 1], [width / 2, -width / 2]]
    return ji.Scene(
        [mass, mass, inertia], normals, tangents=[[1, 1], [0, 0], [height / 2] * 2]
    )


def test_largest_size_and_beyond():
    q = np.eye(12) * 2
    q[np.ix_([1, 4, 5, 9], [1, 4, 5, 9])] = -1.0
    found = copositivity(q)
    close(found.margin, -4.0)
    close(np.flatnonzero(found.witness), [1, 4, 5, 9])
    with pytest.raises(ValueError, match=argument("matrix", "13")):
        copositivity(np.eye(13))


def test_answers_and_tolerance():
    assert copositivity(HORN).answer == "boundary"
    assert copositivity(HORN + 1e-6 * np.eye(5)).answer == "yes"
    assert copositivity(HORN - 1e-6 * np.eye(5)).answer == "no"
    assert copositivity(HORN - 1e-6 * np.eye(5), tolerance=1e-5).answer == "boundary"
    assert copositivity(1e-12 * np.eye(2), scale=1.0).answer == "boundary"
    assert [bool(copositivity(s * np.eye(2))) for s in (1, 0, -1)] == [
        True,
        True,
        False,
    ]
    generator = np.random.default_rng(2)
    a = generator.normal(size=(5, 5))
    assert copositivity(a @ a.T + np.abs(generator.normal(size=(5, 5)))).answer == "yes"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: copositivity(np.ones((2, 3))),
            r"`matrix` must have shape \(m, m\).*\(2, 3\)",
        ),
        (lambda: copositivity([1.0, 2.0]), r"`matrix`.*\(2,\)"),
        (
            lambda: copositivity([[np.nan]]),
            r"`matrix` must be finite, but has value nan",
        ),
        (lambda: copositivity([[1.0]], tolerance=-1.0), r"`tolerance`.*-1"),
        (lambda: copositivity([[1.0]], scale=-2.0), r"`scale`.*-2"),
    ],
)
def test_copositivity_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


CHAIN = ji.chain([1.0, 2.0, 3.0])


def changes(g, e, qn):
    """T+ - T- by (6.43), (6.46), (6.47), (6.48), corrected (6.49); and pbar."""
    inverse, one = np.linalg.inv(g), np.eye(len(g))
    plus = -e @ qn
    p = inverse @ (plus - qn)
    xi = plus + e @ qn
    return p, [
        0.5 * plus @ inverse @ plus - 0.5 * qn @ inverse @ qn,
        0.5 * (plus + qn) @ p,
        0.5 * qn @ (e - one).T @ inverse @ (e + one) @ qn,
        0.5 * qn @ (e.T @ inverse @ e - inverse) @ qn,
        0.5 * p @ np.linalg.solve(one + e, 2 * xi - (one - e) @ g @ p),
    ]


def test_energy_change_expressions():
    g = dense(normalized_delassus(CHAIN))
    e, qn = np.array([[0.7, 0.1], [0.25, 0.6]]), np.array([-1.0, -0.3])
    p, found = changes(g, e, qn)
    close(-e @ qn, [0.73, 0.43])
    close(p, [2.57058240589371162, 1.87959940026865904])
    close(found, np.full(5, -0.224854663778188231))
    close(-0.5 * qn @ dissipation_matrix(g, e) @ qn, -0.224854663778188231)
    # the same impact in velocities of the scene
    before = from_quasi_velocities(CHAIN, qn, [0.4])
    after = before + velocity_change(CHAIN, jnp.asarray(p) / kinetic_norm(CHAIN))
    change = kinetic_energy(CHAIN, after) - kinetic_energy(CHAIN, before)
    close(change, -0.224854663778188231)
    # general xi: impulses imposed
    p = np.array([0.9, 0.4])
    plus = qn + g @ p
    xi = plus + e @ qn
    expected = -0.695996894379984858
    close(0.5 * (plus + qn) @ p, expected)
    close(
        0.5 * p @ np.linalg.solve(np.eye(2) + e, 2 * xi - (np.eye(2) - e) @ g @ p),
        expected,
    )
    # self-adjoint E = G S, corrected (6.50)
    e = g @ np.array([[0.5, 0.1], [0.1, 0.3]])
    expected = -0.735489507379329992
    close(0.5 * qn @ (e.T @ e.T - np.eye(2)) @ np.linalg.inv(g) @ qn, expected)
    close(changes(g, e, qn)[1], np.full(5, expected))
    found = audit_matrix(CHAIN, e)
    close(found.spectral_radius, 0.474538492705502849)
    assert found.spectral
    assert found.energetic.answer == "yes"


def test_slender_block_newton_is_kinetically_inconsistent():
    scene = block(1.0, 2.0, 1.0)
    close(normalized_delassus(scene)[0, 1], 0.25)
    found = audit_matrix(scene, 0.5 * np.eye(2))
    assert found.kinematic.holds
    assert not found.kinetic.holds
    assert not found.admissible
    p, _ = changes(
        dense(normalized_delassus(scene)), 0.5 * np.eye(2), found.kinetic.velocity
    )
    close(np.sort(p), [-0.4, 1.6])
    close(found.kinetic.worst, -0.4)
    close(p[found.kinetic.where[0]], -0.4)
    assert found.energetic.answer == "yes"
    assert "would have to pull when only" in str(found)


def random_scene(generator, m):
    n = m + 1
    a = generator.normal(size=(n, n))
    return ji.Scene(a @ a.T + np.eye(n), generator.normal(size=(n, m)))


def test_audit_agrees_with_sampled_velocities():
    generator = np.random.default_rng(5)
    seen = {"yes": 0, "no": 0, "sign": 0, "fine": 0}
    for k in range(24):
        m = (2, 3)[k % 2]
        scene = random_scene(generator, m)
        e = generator.uniform(0.3, 1) * np.eye(m) + 0.2 * generator.uniform(
            -0.2, 1, (m, m)
        )
        found = audit_matrix(scene, e)
        g = dense(normalized_delassus(scene))
        qn = -np.abs(generator.normal(size=(2000, m)))
        qn = np.concatenate([qn * (generator.random(qn.shape) < 0.8), -np.eye(m)])
        qn = qn[qn.any(axis=1)]
        p = -np.linalg.solve(g, (np.eye(m) + e) @ qn.T)
        assert found.kinematic.holds == bool((-e @ qn.T >= -1e-12).all())
        assert found.kinetic.holds == bool((p >= -1e-12).all())
        # least entries, from the approaches of single contacts
        close(found.kinetic.worst, p[:, -m:].min(), 1e-10)
        close(
            p[found.kinetic.where[0], found.kinetic.where[1] - m],
            p[:, -m:].min(),
            1e-10,
        )
        close(found.kinematic.worst, (-e @ qn[-m:].T).min())
        gain = 0.5 * np.sum((qn - qn @ e.T) * p.T, axis=1) / np.sum(qn**2, axis=1)
        assert -0.5 * found.energetic.margin >= gain.max() - 1e-12
        # the witness, in velocities of the scene
        v = found.worst_velocity
        pbar = -np.linalg.solve(g, (np.eye(m) + e) @ found.worst_normal_velocity)
        after = v + velocity_change(scene, pbar / kinetic_norm(scene))
        change = kinetic_energy(scene, after) - kinetic_energy(scene, v)
        close(
            change,
            -0.5 * found.energetic.margin,
            1e-9 * (1 + abs(found.energetic.margin)),
        )
        close(
            ji.theory.normalized_gap_velocity(scene, v),
            found.worst_normal_velocity,
            1e-10,
        )
        assert (found.energetic.answer == "no") == (change > 1e-7)
        seen[found.energetic.answer] += 1
        seen["fine" if found.kinematic.holds and found.kinetic.holds else "sign"] += 1
        if found.singular_values:
            assert found.energetic.answer != "no"
    assert min(seen.values()) >= 2, seen


def test_spectral_radius_not_largest_eigenvalue():
    scene = ji.Scene(np.ones(2), np.eye(2))  # G = I
    found = audit_matrix(scene, np.diag([0.5, -2.0]))
    assert (found.spectral, found.spectral_radius) == (False, 2.0)
    assert found.energetic.answer == "no"
    close(found.worst_normal_velocity, [0, -1])
    assert found.kinematic.where == (1, 1)
    assert not found.kinematic.holds


def test_spectral_radius_of_self_adjoint_matrices():
    generator, seen = np.random.default_rng(6), set()
    for _ in range(16):
        s = generator.normal(size=(2, 2))
        scene = random_scene(generator, 2)
        g = dense(normalized_delassus(scene))
        e = 0.4 * g @ (s + s.T)
        found = audit_matrix(scene, e)
        lowest = np.linalg.eigvalsh(np.linalg.inv(g) - e.T @ np.linalg.inv(g) @ e)[0]
        assert found.spectral == (lowest >= 0)
        assert not found.spectral or found.energetic
        seen.add(found.spectral)
    assert seen == {True, False}


def test_equal_and_unequal_restitution():
    assert audit_matrix(CHAIN, np.eye(2)).energetic.answer == "boundary"
    assert audit_matrix(CHAIN, np.eye(2)).admissible
    assert audit_matrix(CHAIN, 1.001 * np.eye(2)).energetic.answer == "no"
    assert audit_matrix(CHAIN, 0.999 * np.eye(2)).energetic.answer == "yes"
    assert audit_matrix(CHAIN, np.diag([0.8, 0.4])).spectral is None
    assert audit_matrix(CHAIN, 0.8 * np.eye(2)).spectral_radius == pytest.approx(
        0.8, abs=1e-14
    )
    decoupled = ji.Scene(np.ones(2), np.eye(2))
    found = audit_matrix(decoupled, np.eye(2))
    assert found.singular_value == found.singular_value_bound == 1.0
    assert found.singular_values
    # sigma_max at the bound of Prop. 6.5
    g = dense(normalized_delassus(CHAIN))
    bound = np.sqrt(1 / np.linalg.cond(g))
    assert audit_matrix(CHAIN, (bound - 1e-9) * np.eye(2)).singular_values
    assert not audit_matrix(CHAIN, (bound + 1e-9) * np.eye(2)).singular_values


def test_open_contacts_are_left_out():
    scene = ji.chain([1.0, 2.0, 3.0, 1.0], gaps=[0.0, 0.0, 1.0])
    e = np.array([[0.7, 0.1, 9.0], [0.25, 0.6, 9.0], [-9.0, -9.0, -9.0]])
    found, alone = audit_matrix(scene, e), audit_matrix(CHAIN, e[:2, :2])
    assert found.admissible
    close(found.energetic.margin, alone.energetic.margin)
    close(found.worst_normal_velocity[:2], alone.worst_normal_velocity)
    gamma = np.asarray(ji.theory.normalized_gap_velocity(scene, found.worst_velocity))
    close(gamma, found.worst_normal_velocity)


def test_stored_energy_is_not_an_energy_gain():
    """Two balls of 1 kg pressed together by 0.25 J part at 0.5 m/s each; by 0.2 J they cannot."""
    scene, v, half = ji.chain([1.0, 1.0]), [0.0, 0.0], jnp.array([0.5])
    for stored, gain in ((0.25, 0.0), (0.2, 0.05)):
        number = jnp.asarray(stored)
        out = ji.Impact(
            jnp.array([-0.5, 0.5]), half, half[:0], 0.25 + 0 * number, number, 0
        )
        audit = ji.audit(out, scene, v)
        close(audit.energy_gain, gain / (2 * stored))
        assert audit.broken == (["energetic"] if gain else [])


def test_friction_is_part_of_the_momentum():
    """A particle of 1 kg on the ground: p = 1.5 upwards, friction -0.3 against its slip."""
    scene = ji.Scene([1.0, 1.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    v, after, p, zero = (
        [1.0, -1.0],
        jnp.array([0.7, 0.5]),
        jnp.array([1.5]),
        jnp.zeros(()),
    )
    for friction, broken in ((-0.3, []), (0.3, ["momentum"])):
        out = ji.Impact(
            after, p, jnp.array([friction]), zero - 0.63, zero, jnp.int32(0)
        )
        assert ji.audit(out, scene, v).broken == broken


def test_open_contacts_may_approach():
    """Ball 2 flies towards ball 3, which it has not reached."""
    scene, v = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.1]), [1.0, 0.0, 0.0]
    out = ji.Impact(
        *(jnp.array(x) for x in ([0.0, 1.0, 0.0], [1.0, 0.0], [0.0][:0], 0.0, 0.0)),
        jnp.int32(0),
    )
    assert ji.audit(out, scene, v).broken == []


def test_audit_in_words_and_in_float32():
    text = str(audit_matrix(CHAIN, [[1.2, 0.0], [0.0, -0.2]]))
    assert text.splitlines()[0].startswith("restitution matrix: NOT admissible")
    assert "entry (2, 2) is -0.2: contact 2 still approaches when only 2 closes" in text
    assert "NO, energy grows" in text
    assert "not self-adjoint" in text
    assert "conserved for qn- = " in str(audit_matrix(CHAIN, np.eye(2)))
    single = ji.chain(jnp.array([1.0, 2.0, 3.0], jnp.float32))
    assert (
        audit_matrix(single, jnp.eye(2, dtype=jnp.float32)).energetic.answer
        == "boundary"
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: audit_matrix(CHAIN, np.ones((2, 3))),
            r"`matrix` must have shape \(2, 2\)",
        ),
        (lambda: audit_matrix(CHAIN, [0.5, 0.5]), r"`matrix` must have shape \(2, 2\)"),
        (
            lambda: audit_matrix(CHAIN, [[0.5, np.nan], [0, 0]]),
            r"`matrix`.*nan at index \(0, 1\)",
        ),
        (lambda: audit_matrix(CHAIN, np.eye(2), tolerance=-1), r"`tolerance`"),
        (
            lambda: audit_matrix(ji.chain([1.0], wall="both"), np.eye(2)),
            r"independent contacts, but its 2 closed contacts have rank 1",
        ),
        (
            lambda: audit_matrix(ji.chain([1.0, 1.0], gaps=[1.0]), [[1.0]]),
            r"closed contact",
        ),
        (lambda: audit_matrix(ji.chain(np.ones(14)), np.eye(13)), r"at most 12 rows"),
        (lambda: carnot_energy_loss(CHAIN, [1.0]), r"`jump` must have shape \(3,\)"),
        (lambda: carnot_energy_loss(CHAIN, [1.0, 0, 0], -0.1), r"`restitution`.*-0\.1"),
        (
            lambda: carnot_energy_loss(CHAIN, [1.0, 0, 0], [0.1, 0.2]),
            r"`restitution`.*shape",
        ),
    ],
)
def test_audit_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_carnot():
    for scene, v in ((CHAIN, [1.0, 0.2, -0.7]), (ji.chain([1.0], wall="both"), [0.7])):
        for e in (0.0, 0.6, 1.0) if scene is CHAIN else (0.0,):
            out = ji.impact(ji.Newton(e), scene, v)
            loss = kinetic_energy(scene, v) - kinetic_energy(scene, out.velocity)
            close(carnot_energy_loss(scene, out.velocity - jnp.asarray(v), e), loss)
            assert (loss > 0) == (e < 1)


E, MU, XI = np.array([[0.5, 0.1], [0.2, 0.3]]), [0.2, 0.3], [1.0, -0.4]


def test_friction_block_values():
    scene = block()
    v = from_quasi_velocities(scene, [-1.0, -0.3], [0.7])
    p, side = friction_impulses(scene, E, MU, XI, v)
    close(p * kinetic_norm(scene), [2.06916698558489603, 1.19237147595356551])
    close(side, [-0.333643151241107629, 0.115358474050281735])
    change = friction_energy_change(scene, v, p, side)
    close(change, -0.567592042214138333)
    after = v + velocity_change(scene, p, side)
    close(to_quasi_velocities(scene, after)[0], -E @ [-1.0, -0.3])
    close(to_quasi_velocities(scene, after)[1], [0.545649424529250514])
    close(kinetic_energy(scene, after) - kinetic_energy(scene, v), change)
    close(scene.tangents.T @ v, np.full(2, 0.205560366122430203))
    # the form with Mbar and K
    bounds, qn = friction_bounds(scene, E, MU, XI), np.array([-1.0, -0.3])
    across = np.asarray(quasi_basis(scene)[1].T @ scene.tangents) * (
        np.array(MU) * XI / np.asarray(kinetic_norm(scene))
    )
    middle = [0.7] @ across @ np.linalg.solve(bounds.g_mu, (np.eye(2) + E) @ qn)
    close(0.5 * qn @ (bounds.k - bounds.m_bar) @ qn + middle, change)
    # M of (6.59), with G^-1, does not depend on friction
    g = dense(normalized_delassus(scene))
    inverse, inverse_mu = np.linalg.inv(g), np.linalg.inv(bounds.g_mu)
    close(inverse_mu - inverse @ (g - bounds.g_mu) @ inverse_mu, inverse)


def test_friction_particle():
    particle = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    bounds = friction_bounds(particle, [[0.5]], 0.3)
    close(bounds.least_ratio, 1.64383561643835616)
    close(bounds.m_bar, [[0.75]])
    close(bounds.k, [[0.3**2 * 1.5**2]])
    assert bounds.condition_i
    assert bounds.dissipates(particle, [1.0, -1.65])
    assert not bounds.dissipates(particle, [1.0, -1.64])
    # (i): 1 - e > mu^2 (1 + e)
    edge = np.sqrt(0.5 / 1.5)
    assert friction_bounds(particle, [[0.5]], edge - 1e-6).condition_i
    beyond = friction_bounds(particle, [[0.5]], edge + 1e-6)
    assert not beyond.condition_i
    assert beyond.least_ratio == np.inf
    assert not beyond.dissipates(particle, [0.0, -1.0])
    assert "no bound" in str(beyond)
    assert "|qn-| / |qt-| >= 1.64384" in str(bounds)
    assert friction_bounds(particle, [[0.5]], 0.0).least_ratio == 0.0
    assert not friction_bounds(particle, [[1.0]], 0.0).condition_i


def test_least_ratio_is_sharp_for_one_contact():
    """An oblique tangent couples: without the factor |(G^mu)^-1| the bound would be too low."""
    scene = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[0.8], [0.6]])
    bounds = friction_bounds(scene, [[0.3]], 0.4, slip=1.0)
    g_mu, root = 1 - 0.6 * 0.4, np.sqrt(2.0)
    close(bounds.g_mu, [[g_mu]])
    k = (0.8 * 0.4 * 1.3 / g_mu) ** 2
    close([bounds.m_bar_least, bounds.k_largest], [0.91, k])
    close(bounds.least_ratio, 2 * 0.8 * 0.4 * 1.3 / g_mu / (0.91 - k))
    close(bounds.g_mu_bound, 0.24)
    close(bounds.restitution_bound, 0.09)
    for factor, grows in ((1 - 1e-6, True), (1 + 1e-6, False)):
        v = np.array([-1.0, -factor * bounds.least_ratio]) / root
        p, side = friction_impulses(scene, [[0.3]], 0.4, 1.0, v)
        change = friction_energy_change(scene, v, p, side)
        after = v + velocity_change(scene, p, side)
        close(change, kinetic_energy(scene, after) - kinetic_energy(scene, v))
        assert (change > 0) == grows
        assert bounds.dissipates(scene, v) != grows


def test_friction_bounds_hold_on_random_scenes():
    generator, promised = np.random.default_rng(7), 0
    for _ in range(12):
        a = generator.normal(size=(4, 4))
        scene = ji.Scene(
            a @ a.T + np.eye(4),
            generator.normal(size=(4, 2)),
            generator.normal(size=(4, 2)),
        )
        e, mu = 0.4 * generator.random((2, 2)), 0.3 * generator.random(2)
        bounds = friction_bounds(scene, e, mu, generator.uniform(-1, 1, 2))
        symmetric = [0.5 * (x + x.T) for x in (bounds.g_mu, bounds.m_bar)]
        if bounds.g_mu_bound < 1:
            assert np.linalg.eigvalsh(symmetric[0])[0] > 0
        if bounds.restitution_bound < 1:
            assert np.linalg.eigvalsh(symmetric[1])[0] > 0
        if not bounds.condition_i:
            continue
        # at the least ratio, energy never grows, whatever the directions
        g = dense(normalized_delassus(scene))
        tangential = np.asarray(quasi_basis(scene)[1].T @ scene.tangents)
        # G - G^mu = n_q^T H [mubar][xi]
        friction = ((g - bounds.g_mu) / np.asarray(normal_columns(scene))).mean(axis=0)
        across = tangential * friction @ np.linalg.solve(bounds.g_mu, np.eye(2) + e)
        qn, qt = generator.normal(size=(500, 2)), generator.normal(size=(500, 2))
        qt *= (
            np.linalg.norm(qn, axis=1) / np.linalg.norm(qt, axis=1) / bounds.least_ratio
        )[:, None]
        change = np.einsum("ki,ij,kj->k", qn, 0.5 * (bounds.k - bounds.m_bar), qn)
        change += np.einsum("ki,ij,kj->k", qt, across, qn)
        assert change.max() <= 1e-12
        promised += 1
    assert promised >= 4


@jax.jit
def normal_columns(scene):
    """n_q^T H_t."""
    pushed = jax.vmap(lambda t: velocity_change(scene, jnp.zeros(2), t))(jnp.eye(2))
    return jax.vmap(lambda v: ji.theory.normalized_gap_velocity(scene, v))(pushed).T


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: friction_bounds(CHAIN, np.eye(2), 0.1), r"planar tangents"),
        (
            lambda: friction_bounds(block(), np.eye(3), 0.1),
            r"`matrix` must have shape \(2, 2\)",
        ),
        (lambda: friction_bounds(block(), np.eye(2), -0.1), r"`friction`.*-0\.1"),
        (lambda: friction_bounds(block(), np.eye(2), [0.1] * 3), r"`friction`.*\(3,\)"),
        (lambda: friction_bounds(block(), np.eye(2), 0.1, slip=1.5), r"`slip`.*1\.5"),
        (
            lambda: friction_energy_change(block(), [0, -1.0, 0], [1.0], [1.0, 0]),
            r"`impulse`",
        ),
        (
            lambda: friction_bounds(
                ji.Scene(np.ones(2), [[0.0], [1.0]], [[1.0], [0.0]], gaps=[1.0]),
                [[0.5]],
                0.1,
            ),
            r"closed contacts only",
        ),
        (
            lambda: friction_bounds(
                ji.Scene(np.ones(2), [[0.0], [1.0]], [[0.6], [0.8]]), [[0.5]], 1.25
            ),
            r"`friction` must leave G\^mu regular",
        ),
    ],
)
def test_friction_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
