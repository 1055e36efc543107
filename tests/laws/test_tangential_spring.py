"""Tangential springs: an own integration by events, derivatives, energies, refusals."""

import functools

import jax
import numpy as np
import pytest
from programs import OPTIMIZED
from spring_reference import Springs

import jimpact as ji

close = np.testing.assert_allclose
SPHERE = ([1.0, 1.0, 0.4], [[0.0], [1.0], [0.0]], [[1.0], [0.0], [1.0]])  # W_tt = 3.5


def after(q, mass, normals, tangents, rtol):
    """v+ of parameters q: mu, kappa, e, eta, k (m each), then v-."""
    m = normals.shape[1]
    mu, kappa, e, eta, k = q[: 5 * m].reshape(5, m)
    law = ji.LZB(e, k, eta, friction=mu, tangential_stiffness=kappa)
    out = ji.impact(
        law, ji.Scene(mass, normals, tangents=tangents), q[5 * m :], rtol=rtol
    )
    return out.velocity, out.status


@functools.cache
def program():
    """Compiled once a shape; a lane for each impact."""
    return jax.jit(
        jax.vmap(after, in_axes=(0, 0, 0, 0, None)), compiler_options=OPTIMIZED
    )


def of_contacts(rng, m):
    """Random mu, kappa, e, eta, k."""
    mu, kappa, e = (
        rng.uniform(0.05, 1, m),
        rng.uniform(0.2, 1.5, m),
        rng.uniform(0.3, 1, m),
    )
    return np.concatenate(
        [
            mu,
            kappa,
            e,
            [rng.choice([1.0, 1.5, 1.8])] * m,
            10 ** rng.uniform(-0.5, 0.5, m),
        ]
    )


def blocks(count, seed):
    """Blocks that come down flat, or nearly so, on both corners: redundant contacts."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        w, h = rng.uniform(0.3, 1.5, 2)
        normals = np.array([[0.0, 0.0], [1.0, 1.0], [-w / 2, w / 2]])
        tangents = np.array([[1.0, 1.0], [0.0, 0.0], [h / 2, h / 2]])
        v = np.array([rng.normal(), -1.0, rng.choice([0.0, 0.3]) * rng.normal()])
        yield (
            np.concatenate([of_contacts(rng, 2), v]),
            np.array([1, 1, (w * w + h * h) / 12]),
            normals,
            tangents,
        )


def spheres(count, seed):
    """Eccentric spheres (W_nt is not 0) in the plane; the second contact is another, far one."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        a = rng.uniform(-0.5, 0.5)
        normals = np.array([[0.0, 0.0], [1.0, 0.0], [a, 1.0]])
        tangents = np.array([[1.0, 0.3], [0.0, 0.0], [1.0, 0.0]])
        v = np.array([1.5 * rng.normal(), -1.0, 0.5 * rng.normal()])
        yield (
            np.concatenate([of_contacts(rng, 2), v]),
            np.array([1.0, 1.0, 0.4]),
            normals,
            tangents,
        )


def in_space(count, seed):
    """Two contacts of one body in space, random normals and tangents: slip turns."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        normals, tangents = rng.normal(size=(5, 2)), rng.normal(size=(5, 4))
        v = rng.normal(size=5)
        v *= -np.sign((normals.T @ v).max()) if (normals.T @ v).min() >= 0 else 1.0
        yield (
            np.concatenate([of_contacts(rng, 2), v]),
            10 ** rng.uniform(-0.5, 0.5, 5),
            normals,
            tangents,
        )


def spheres_in_space(count, seed):
    """One contact in space, eccentric: slip turns, and the own integration is not stiff."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        normals, tangents = np.zeros((6, 1)), np.zeros((6, 2))
        normals[2], normals[3:5, 0] = 1.0, rng.uniform(-0.5, 0.5, 2)
        tangents[[0, 1, 3, 4], [0, 1, 1, 0]] = 1.0, 1.0, 1.0, -1.0
        v = np.array([*1.5 * rng.normal(size=2), -1.0, *0.5 * rng.normal(size=3)])
        q = np.concatenate([of_contacts(rng, 1), v * -np.sign(normals.T @ v)])
        yield q, np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.4]), normals, tangents


def test_gross_sliding_is_waltons():
    """Fast slip never ends: `u- - mu (1 + e) W_tt |gamma-|`, whatever kappa is."""
    mass, normals, tangents = SPHERE
    scene = ji.Scene(mass, normals, tangents=tangents)
    for kappa in (0.3, 0.8):
        law = ji.LZB(0.9, friction=0.1, tangential_stiffness=kappa)
        out = ji.impact(law, scene, [3.0, -1.0, 0.0])
        slip = float((np.asarray(tangents).T @ out.velocity)[0])
        close(slip, 3.0 - 0.1 * 1.9 * 3.5, rtol=1e-8)


@pytest.mark.parametrize(
    "states",
    [(spheres, blocks), pytest.param((spheres_in_space,), marks=pytest.mark.slow)],
)
def test_impacts_are_those_of_an_own_integration(states):
    """v+ within 10 rtol of scipy's DOP853 from event to event."""
    cases = [case for make in states for case in make(12, 4)]
    velocity, status = program()(*(np.stack(x) for x in zip(*cases)), 1e-8)
    assert set(np.asarray(status)) <= {0, 4, 8}
    assert (np.asarray(status) == 0).sum() >= 10
    for (q, mass, normals, tangents), v, code in zip(cases, velocity, status):
        if code == 4:
            continue
        m = normals.shape[1]
        mu, kappa, e, eta, k = q[: 5 * m].reshape(5, m)
        expected = Springs(mass, normals, tangents, mu, kappa, e, k, eta).after(
            q[5 * m :]
        )
        close(v, expected, atol=1e-7 * np.abs(q[5 * m :]).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [blocks, pytest.param(in_space, marks=pytest.mark.release)]
)
def test_derivatives_are_differences(make):
    """In mu, kappa, e, eta, k and v-, forward and reverse."""
    cases = [np.stack(x) for x in zip(*make(6, 9))]

    def value(q, *scene):
        return after(q, *scene, 1e-8)[0]

    forward = jax.jit(jax.vmap(jax.jacfwd(value)))(*cases)
    close(forward, jax.jit(jax.vmap(jax.jacrev(value)))(*cases), atol=1e-9)

    def difference(i, h):
        step = np.zeros(cases[0].shape[1])
        step[i] = h
        up, down = (
            program()(cases[0] + s * step, *cases[1:], 1e-12)[0] for s in (1, -1)
        )
        return (np.asarray(up) - np.asarray(down)) / (2 * h)

    for i in range(cases[0].shape[1]):
        expected = (4 * difference(i, 2.5e-5) - difference(i, 5e-5)) / 3
        close(forward[:, :, i], expected, atol=1e-5)


@pytest.mark.slow
def test_history_balances_energies():
    """Linear springs: T + normal + tangential energy falls only by friction that slides and e."""
    mass, normals, tangents = SPHERE
    scene = ji.Scene(mass, normals, tangents=tangents)
    law = ji.LZB(1.0, 2.0, 1.0, friction=0.8, tangential_stiffness=0.5)
    course = ji.history(law, scene, [0.3, -1.0, 0.0], samples=60)
    kinetic = 0.5 * (np.asarray(course.velocity) ** 2 @ np.asarray(mass))
    whole = (
        kinetic
        + np.asarray(course.energy).sum(1)
        + np.asarray(course.tangential_energy).sum(1)
    )
    cone = 0.8 * np.asarray(course.force) + 1e-7
    assert (np.abs(course.tangential_force) <= cone).all()
    holds = np.abs(course.tangential_force[:, 0]) < 0.999 * cone[:, 0] - 1e-6
    before = np.cumprod(holds | (np.arange(60) == 0)).astype(bool)
    assert before.sum() > 20
    close(whole[before], whole[0], rtol=1e-7)
    assert (np.diff(whole) < 1e-8).all()
    assert float(course.tangential_energy.max()) > 0.005
    close(course.tangential_energy[-1], 0.0, atol=1e-9)
    rigid = ji.history(ji.LZB(1.0, friction=0.8), scene, [0.3, -1.0, 0.0], samples=3)
    assert rigid.tangential_energy.shape == (3, 0)


def test_hertz_may_gain_and_says_so():
    """k_t changes with x, and what that gives comes from nowhere: status `energy_gain`."""
    mass, normals, tangents = SPHERE
    scene = ji.Scene(mass, normals, tangents=tangents)
    out = ji.impact(
        ji.LZB(1.0, friction=3.6, tangential_stiffness=0.97), scene, [-2.44, -1.0, 0.0]
    )
    assert ji.STATUS[int(out.status)].name == "energy_gain"
    assert not bool(ji.audit(out, scene, [-2.44, -1.0, 0.0]).energetic)


def test_stiff_springs_are_rigid_contacts():
    """kappa -> inf is the contact that sticks."""
    mass, normals, tangents = SPHERE
    scene = ji.Scene(mass, normals, tangents=tangents)
    v = [0.7, -1.0, 0.0]
    rigid = ji.impact(ji.LZB(0.8, friction=0.2), scene, v).velocity
    errors = []
    for kappa in (1e2, 1e4):
        law = ji.LZB(0.8, friction=0.2, tangential_stiffness=kappa)
        errors.append(np.abs(ji.impact(law, scene, v).velocity - rigid).max())
    assert errors[1] < 1e-2 < 100 * errors[0]
    assert errors[1] < errors[0]


REFUSED = {
    "zero": (
        lambda: ji.LZB(0.5, friction=0.1, tangential_stiffness=0.0),
        "tangential_stiffness",
    ),
    "nan": (
        lambda: ji.LZB(0.5, friction=0.1, tangential_stiffness=np.nan),
        "tangential_stiffness",
    ),
    "without mu": (lambda: ji.LZB(0.5, tangential_stiffness=0.5), "`friction`"),
    "compliant without mu": (
        lambda: ji.Compliant(ji.Hertz(1.0), tangential_stiffness=0.5),
        "`friction`",
    ),
    "viscous": (
        lambda: ji.Compliant(
            ji.KelvinVoigt(1.0, 0.1), friction=0.1, tangential_stiffness=0.5
        ),
        "`tangential_stiffness`.*rate",
    ),
    "implicit": (
        lambda: ji.LZB(0.5, friction=0.1, tangential_stiffness=0.5, method="implicit"),
        "`method`",
    ),
    "no tangents": (
        lambda: ji.impact(
            ji.LZB(0.5, friction=0.1, tangential_stiffness=0.5),
            ji.chain([1.0, 1.0]),
            [1.0, 0.0],
        ),
        "tangents",
    ),
    "shape": (
        lambda: ji.impact(
            ji.LZB(0.5, friction=0.1, tangential_stiffness=[0.5, 0.5]),
            ji.Scene(SPHERE[0], SPHERE[1], tangents=SPHERE[2]),
            [0.0, -1.0, 0.0],
        ),
        "tangential_stiffness",
    ),
    "algebraic": (
        lambda: ji.Moreau(0.5, friction=0.1, tangential_stiffness=0.5),
        "tangential_stiffness",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name):
    """What is wrong is refused, and named."""
    make, words = REFUSED[name]
    with pytest.raises((TypeError, ValueError), match=words):
        make()
