"""Laws of section 6.4.3, and what is said there of them, in the contract's programs and plain numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
from programs import State, chain
from refusals import argument

import jimpact as ji

LZB_AFTER = np.array([-0.0086153561548806457, 0.10414279851550412, 0.90447255763937653])
LZB_ELASTIC = np.array(
    [-0.070952353651436871, 0.076403039071206993, 0.994549314580229878]
)


def correlated(e, ratio, v=1.0):
    """v+ of three equal balls, the others at rest: kinetic energy falls by what contact 1 loses."""
    a = 2 - 2 * ratio + 2 * ratio**2
    p = v * (1 + np.sqrt(1 - a * (1 - e**2) / (2 - ratio))) / a
    return np.array([v - p, (1 - ratio) * p, ratio * p])


def test_the_ratio_of_lzb_returns_its_outcome():
    """p2 / p1 of LZB's whole impact, Hertz contacts: exact at e = 1, to 1e-3 at e = .9.

    There LZB compresses contact 2 as well, which a constant ratio never does. A coefficient that
    loses the same energy, .90074, returns LZB's outcome exactly.
    """
    elastic = LZB_ELASTIC[2] / (1 - LZB_ELASTIC[0])
    np.testing.assert_allclose(correlated(1.0, elastic), LZB_ELASTIC, atol=1e-12)
    ratio = LZB_AFTER[2] / (1 - LZB_AFTER[0])
    assert ratio == pytest.approx(0.8967468, abs=1e-7)
    error = np.abs(correlated(0.9, ratio) - LZB_AFTER).max()
    assert 5e-4 < error < 1e-3
    lost = 0.5 * (1 - LZB_AFTER @ LZB_AFTER)
    e = np.sqrt(1 - 2 * (2 - ratio) * lost)
    assert e == pytest.approx(0.90074, abs=1e-5)
    np.testing.assert_allclose(correlated(e, ratio), LZB_AFTER, atol=1e-12)


@pytest.mark.slow
def test_impulse_ratios_are_not_constant():
    """The chapter's criticism: F2 / F1 of (6.68) grows from 0 to where contact 1 opens."""
    balls = ji.chain(jnp.ones(3))  # the program of test_own_law.py
    found = ji.history(ji.LZB(0.9, 1.0), balls, jnp.array([1.0, 0, 0]), samples=8)
    first, second = np.asarray(found.force).T
    loaded = first > 0
    ratio = second[loaded] / first[loaded]
    assert (np.diff(ratio) > 0).all()
    assert ratio[0] < 0.2
    assert ratio[-1] > 3
    total = found.impulse[-1, 1] / found.impulse[-1, 0]
    assert float(total) == pytest.approx(0.8967468, abs=1e-6)


@pytest.mark.parametrize(
    ("ratio", "says"),
    [
        (
            0.4,
            r"`ratio` must lie in \[0\.5, 0\.948753\] for contact 1 beside contact 0",
        ),
        ([0.6, 0.96], r"for contact 1 beside contact 0, but has value 0\.96"),
        (
            [[0.0, 0.6], [0.3, 0.0]],
            r"for contact 0 beside contact 1, but has value 0\.3",
        ),
        (-0.1, r"`ratio` must lie in \[0, inf\)"),
    ],
)
def test_ratios_outside_their_interval_are_refused(ratio, says):
    with pytest.raises(ValueError, match=says):
        ji.impact(
            ji.ImpulseCorrelation(0.9, ratio), ji.chain([1.0] * 3), [1.0, 0.0, 0.0]
        )


def test_ratios_are_checked_inside_jit():
    """Law and scene are known there: too large a ratio is an error while it is traced."""
    balls = ji.chain([1.0, 1.0, 1.0])

    def shape(law):
        return jax.eval_shape(
            lambda v: ji.impact(law, balls, v).velocity, np.ones(3)
        ).shape

    assert shape(ji.ImpulseCorrelation(0.9, 0.6)) == (3,)
    with pytest.raises(ValueError, match=argument("ratio", "1.6")):
        shape(ji.ImpulseCorrelation(0.9, 1.6))


@pytest.mark.slow
def test_a_matrix_of_ratios_is_that_of_each_contact_that_collides():
    """Ratios .6 of contact 2 beside 1 and .9 the other way: in jit, so that one program does both."""
    balls = ji.chain([1.0, 1.0, 1.0])

    @jax.jit
    def after(ratio, v):
        return ji.impact(ji.ImpulseCorrelation(0.9, ratio), balls, v)

    ratio = np.array([[0.0, 0.6], [0.9, 0.0]])
    first, last = (
        after(ratio, np.array([1.0, 0, 0])),
        after(ratio, np.array([0.0, 0, -1])),
    )
    np.testing.assert_allclose(first.velocity, correlated(0.9, 0.6), atol=1e-12)
    np.testing.assert_allclose(-last.velocity[::-1], correlated(0.9, 0.9), atol=1e-12)
    wrong = after(np.array([[0.0, 0.97], [0.9, 0.0]]), np.array([1.0, 0, 0]))
    assert ji.STATUS[int(wrong.status)].name == "infeasible"


@pytest.mark.slow
def test_statement_of_bowling():
    """Routh's increments with one energetic e: LZB's outcome for one contact and at pi/2, not else."""
    one = chain([1.0, 3.0], [2.0, 0.5], e=0.7, k=3.0)
    normals = np.array([[1.0, 0], [0, 1], [0, 0]])
    right = State(np.diag([1.0, 2, 3]), normals, [-1.0, -0.4, 0.3], e=0.7, k=[1, 30.0])
    balls = chain([1.0, 1, 1], [1.0, 0, 0], e=0.7)
    routh, lzb = (
        programs.values(name)([one, right, balls])[0] for name in ("routh", "lzb")
    )
    np.testing.assert_allclose(routh.velocity[:2], lzb.velocity[:2], atol=1e-7)
    assert np.abs(routh.velocity[2] - lzb.velocity[2]).max() > 0.1


@pytest.mark.slow
def test_unequal_coefficients_of_routh_are_one():
    """e^2 is the mean of e_j^2 by the work of compression: of (.8, .4) at works 3 to 1, .72111."""
    # contacts at pi/2: works of compression gamma_j^2 / (2 W_jj)
    normals = np.array([[1.0, 0], [0, 1]])
    state = State(np.eye(2), normals, [-np.sqrt(3.0), -1.0], e=[0.8, 0.4])
    out, _ = programs.values("routh")([state])
    e = np.sqrt((3 * 0.64 + 0.16) / 4)
    np.testing.assert_allclose(out.velocity[0, :2], [e * np.sqrt(3.0), e], rtol=1e-12)


@pytest.mark.slow
def test_hurmuzlu_and_marghitu_is_moreau():
    """One contact collides, contacts at rest stay closed or open: increments by increments.

    `dp_i = 1`, `0 <= W dp >= 0 _|_ dp >= 0` of the others, until contact i has e^2 of its work back.
    """
    rng = np.random.default_rng(2)
    states, expected = [], []
    for _ in range(6):
        masses, e = rng.uniform(0.3, 3, 4), rng.uniform(0.2, 1)
        normals = np.diff(np.eye(4), axis=0).T
        w = normals.T @ (normals / masses[:, None])
        d = np.append(
            1.0, -np.linalg.solve(w[1:, 1:], w[1:, 0])
        )  # all stay closed in a chain
        assert (d > 0).all()
        p = (1 + e) / (w[0] @ d) * d  # contact 1 alone works: gamma_1 rises in a line
        states.append(chain(masses, [1.0, 0, 0, 0], e=e))
        expected.append(np.array([1.0, 0, 0, 0]) + normals @ p / masses)
    for name in ("moreau", "routh"):
        out, _ = programs.values(name)(states)
        np.testing.assert_allclose(out.velocity, expected, atol=1e-12)


def jia(w, gamma, k, e, step=2e-4):
    """State transitions of linear contacts, in impulse: E, and a stiffness that changes with phase.

    Compression: stiffness k; at its end E becomes e^2 E and the stiffness k / e^2; a contact that is
    compressed again has E / e^2 and k again. dp_j is proportional to the force sqrt(2 k_j E_j).
    """
    k, e = np.asarray(k, float), np.asarray(e, float)
    energy, p = np.zeros(len(k)), np.zeros(len(k))
    energy[gamma < 0] = 1e-12
    compressed = gamma <= 0
    for _ in range(10_000_000):
        force = np.sqrt(2 * np.where(compressed, k, k / e**2) * energy)
        if not (force > 0).any():
            return p
        dp = step * force / force.max()
        middle = gamma + w @ dp / 2
        energy = np.maximum(energy - middle * dp, 0.0)
        gamma, p = gamma + w @ dp, p + dp
        energy = np.where((gamma < 0) & (energy == 0), 1e-12, energy)
        turns, again = compressed & (gamma > 0), ~compressed & (gamma < 0)
        energy = np.where(turns, e**2 * energy, np.where(again, energy / e**2, energy))
        compressed = gamma <= 0
    raise RuntimeError


@pytest.mark.parametrize(
    ("wall", "e", "before"),
    [(False, (0.9, 0.6), (1.0, 0, 0)), (True, (0.8, 0.6), (1.0, 0.0)), (True, (0.9, 0.8), (1.0, 1.0))],
)  # fmt: skip
def test_statement_of_jia(wall, e, before):
    """LZB with exponent 1 is their state transition diagram, repeated compression included."""
    state = chain([1.0] * len(before), before, wall, e=e, k=[1.0, 2.0], eta=1.0)
    lzb, _ = programs.values("lzb")([state])
    w = state.normals.T @ state.normals
    p = jia(w, state.normals.T @ np.asarray(before, float), [1.0, 2.0], e)
    after = np.asarray(before) + state.normals @ p
    np.testing.assert_allclose(lzb.velocity[0, : len(before)], after, atol=1e-3)


@pytest.mark.slow
def test_slopes_of_routh_in_each_restitution_at_zero():
    """Only contact 2 does work: dv+/de_2 = M^-1 N p_c for every e_2, at 0, too; e_1, e_3 have no part."""
    masses = np.array([1.0, 2.0, 0.5, 1.5])
    balls, v = ji.chain(masses), np.array([0.2, 0.2, -0.7, -0.7])
    normals = np.eye(4)[:, 1:] - np.eye(4)[:, :-1]
    pressed = np.linalg.solve(normals.T @ (normals / masses[:, None]), [0, 0.9, 0])
    slopes = jax.jacfwd(lambda e: ji.impact(ji.Routh(e), balls, v).velocity)
    for e in (0.0, 0.4):
        expected = np.zeros((4, 3))
        expected[:, 1] = normals @ pressed / masses
        np.testing.assert_allclose(
            slopes(np.array([0.0, e, 0.0])), expected, atol=1e-12
        )
    backwards = jax.jacrev(lambda e: ji.impact(ji.Routh(e), balls, v).velocity)(
        np.zeros(3)
    )
    np.testing.assert_allclose(backwards, slopes(np.zeros(3)), atol=1e-12)
