"""Method 'implicit': impacts by steps without events, of `LZB` and `Compliant`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from implicit_cases import pressed
from programs import CODE
from refusals import argument

import jimpact as ji
from jimpact.core.contact import contact_of
from jimpact.events import implicit_steps
from jimpact.events.contact_flow import Chain, Dense
from jimpact.events.impact_dynamics import method_for
from jimpact.laws.lzb import BISTIFFNESS
from jimpact.numerics.driver import SLOTS_IN_SPACE
from jimpact.numerics.step_impulses import StepProblem, descent_lengths, solve

pytestmark = pytest.mark.slow  # they compile programs of their own


def test_reverse_mode_of_many_numbers():
    """Of ten balls in their masses: the forward slope; second derivatives raise."""
    masses, change = jnp.linspace(1.0, 2.0, 10), jnp.cos(jnp.arange(10.0))

    def first(mass, most=9999):
        law = ji.LZB(0.8, 1.0, 1.5, method="implicit", max_steps=most)
        out = ji.impact(law, ji.chain(mass), np.eye(10)[0])
        return out.velocity[0], out.status

    _, forward, _ = jax.jvp(first, (masses,), (change,), has_aux=True)
    gradient, status = jax.grad(first, has_aux=True)(masses)
    assert gradient @ change == pytest.approx(float(forward), rel=1e-8)
    assert status == CODE["ok"]
    with pytest.raises(NotImplementedError, match=argument("method", "'implicit'")):
        jax.jacfwd(jax.grad(lambda mass: first(mass)[0]))(masses)


def test_tangents_of_the_impulses_of_a_step():
    """Two contacts in space, one slips and unloads, one sticks: differences of the solution."""
    rng = np.random.default_rng(1)
    spread = rng.normal(size=(6, 6)) / 4
    k, two = jnp.asarray(np.eye(6) + spread @ spread.T)[..., None], jnp.ones((2, 1))
    velocity = jnp.array([0.3, -1.0, 2.0, -1.0, 0.1, 0.05])[:, None]
    given = StepProblem(
        Dense(k), velocity, two, two * 0.5, 0.4 * two, descent_lengths(k, 2)
    )
    given = given._replace(unloading=jnp.array([[0.5], [0.0]]))
    change = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(size=x.shape) * (np.asarray(x) != 0)), given
    )
    change = change._replace(descent=0 * given.descent)
    exactly, fine = jax.jit(solve), jnp.full((1, 1), 1e-14)

    def impulses(step):
        q = jnp.zeros((6, 1))
        for _ in range(10):
            q, left = exactly(
                jax.tree.map(lambda a, b: a + step * b, given, change), q, fine
            )
        assert left < 1e-13
        return q

    q = impulses(0.0)
    slides, sticks = jnp.hypot(*q[2:4, 0]), jnp.hypot(*q[4:, 0])
    assert 0 < q[0, 0] < 1
    assert slides == pytest.approx(0.4 * q[0, 0])
    assert sticks < 0.39
    _, (rate, _) = jax.jvp(lambda p: solve(p, q, fine), (given,), (change,))
    np.testing.assert_allclose(
        rate, (impulses(1e-5) - impulses(-1e-5)) / 2e-5, atol=1e-8
    )


def test_slopes_of_a_queue_are_those_alone():
    """More impacts than there are slots, of different lengths: each slope that of one impact."""
    scene, each = ji.chain([1.0], wall=True), jnp.linspace(0.0, 0.9, 2 * SLOTS_IN_SPACE)

    def after(e):
        return ji.impact(ji.LZB(e, 1.0, 1.5, method="implicit"), scene, [1.0]).velocity[
            0
        ]

    slopes = jax.vmap(jax.jacfwd(after))(each)
    np.testing.assert_allclose(slopes, -1.0, atol=1e-3)


def test_auto_leaves_several_contacts_in_space_to_it():
    """Exact: one contact, and all without friction, whatever tangents the scene has."""
    for name, method in (
        ("corner", "time"),
        ("edge", "implicit"),
        ("legs", "implicit"),
    ):
        scene, v = pressed(name)
        assert method_for("auto", contact_of(scene, v), True) == method, name
        assert method_for("auto", contact_of(scene, v), False) == "time", name
    balls = ji.chain([1.0] * 9)
    assert method_for("auto", contact_of(balls, jnp.zeros(9)), False) == "time"


def test_impulses_of_a_step():
    """Slip beyond the cone, stick within it, a contact whose unloading takes its force away."""
    k = jnp.diag(jnp.array([1.0, 1.0, 2.0, 2.0]))[
        ..., None
    ]  # two contacts in the plane
    lengths = descent_lengths(k, 2)
    np.testing.assert_allclose(lengths[:, 0], [1.0, 1.0, 0.5, 0.5])
    load, zero = jnp.ones((2, 1)), jnp.zeros((2, 1))
    velocity = jnp.array([[-3.0], [-3.0], [0.4], [3.0]])
    problem = StepProblem(Dense(k), velocity, load, zero, 0.5 * load, lengths)
    q, left = solve(problem, jnp.zeros((4, 1)), jnp.full((1, 1), 1e-12))
    np.testing.assert_allclose(q[:, 0], [1.0, 1.0, -0.2, -0.5], atol=1e-12)
    assert left[0, 0] <= 1e-12
    # gamma = -.5 + f: with a = 3 the force that is left solves f = 1 - 3 (f - .5)
    problem = problem._replace(velocity=velocity.at[0].set(-0.5), unloading=3 * load)
    q, _ = solve(problem, jnp.zeros((4, 1)), jnp.full((1, 1), 1e-12))
    np.testing.assert_allclose(q[:2, 0], [0.625, 1.0], atol=1e-12)


def test_sweeps_of_contacts_that_stick_end_soon():
    """Slip of two rates, 19 to 1: two changes tell both; K y = -u has the solution (-.1, 0)."""
    k = jnp.eye(4).at[2, 3].set(0.9).at[3, 2].set(0.9)[..., None]
    one, velocity = jnp.ones((2, 1)), jnp.array([[0.0], [0.0], [0.1], [0.09]])
    problem = StepProblem(Dense(k), velocity, one, 0 * one, one, jnp.full((4, 1), 0.4))
    q, left = solve(problem, 0 * velocity, jnp.full((1, 1), 1e-13))
    np.testing.assert_allclose(q[:, 0], [1.0, 1.0, -0.1, 0.0], atol=1e-12)
    assert left[0, 0] <= 1e-13


def test_an_impact_in_a_batch_is_what_it_is_alone():
    """Its sweeps end where it is right, not where the slowest of the batch is."""
    k = jnp.stack(
        [jnp.eye(4).at[2, 3].set(c).at[3, 2].set(c) for c in (0.5, 0.999)], axis=-1
    )
    velocity, one = (
        jnp.array([[0.0], [0.0], [1.0], [0.3]]) * jnp.ones((1, 2)),
        jnp.ones((2, 2)),
    )
    problem = StepProblem(
        Dense(k), velocity, one, 0 * one, 2 * one, jnp.full((4, 2), 0.4)
    )
    alone = jax.tree.map(lambda x: x[..., :1], problem)
    (both, _), (single, left) = (
        solve(p, 0 * p.velocity, 0.2 + 0 * p.load[:1]) for p in (problem, alone)
    )
    assert left[0, 0] > 1e-3  # it ends before it is exact
    np.testing.assert_allclose(both[:, 0], single[:, 0], rtol=1e-12)


def test_redundant_contacts_keep_descent_lengths_safe():
    """diag(1/d) - K has no negative eigenvalue, for K of low rank."""
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(3, 12))
    k = factor.T @ factor
    d = np.asarray(descent_lengths(jnp.asarray(k)[..., None], 4))[:, 0]
    assert np.linalg.eigvalsh(np.diag(1 / d) - k).min() > -1e-12
    d = np.asarray(descent_lengths(jnp.asarray(k)[..., None], 4, friction_only=True))[
        :, 0
    ]
    assert np.linalg.eigvalsh((np.diag(1 / d) - k)[4:, 4:]).min() > -1e-12
    # one contact in the plane: its tangential row alone
    coupled = jnp.array([[1.0, 0.8], [0.8, 2.0]])[..., None]
    alone = descent_lengths(coupled, 1, friction_only=True)
    assert float(alone[1, 0]) == pytest.approx(0.5)


def test_friction_is_guessed_as_a_part_of_the_load():
    """Under half of the load half of the friction; none where the contact has just closed."""
    rate = jnp.array([[2.0], [0.0], [0.6], [0.0]])
    load = jnp.array([[1.0], [3.0]])
    guess = steps_of_two(1.0, gapped=False).guess(rate, load)
    np.testing.assert_allclose(guess[:, 0], [1.0, 3.0, 0.3, 0.0])


def steps_of_two(restitution, gapped):
    """Steps of two contacts without friction that do not act on each other."""
    return implicit_steps.ImplicitSteps(
        coupling=Dense(jnp.eye(2)[..., None]),
        equations=BISTIFFNESS,
        omega=jnp.array([[1.0], [2.0]]),
        restitution=restitution * jnp.ones((2, 1)),
        exponent_array=None,
        friction=jnp.zeros((2, 1)),
        descent=jnp.ones((2, 1)),
        tolerance=jnp.full((1, 1), 1e-5),
        exponent_static=1.5,
        gapped=gapped,
    )


def test_what_the_sweeps_of_a_step_leave_is_part_of_its_error():
    """Contacts whose friction nearly cancels: both stick, slowly; slip that is left is an error."""
    k = jnp.eye(4).at[2, 3].set(0.999).at[3, 2].set(0.999)[..., None]
    flow = dataclasses.replace(
        steps_of_two(0.5, gapped=False),
        coupling=Dense(k),
        friction=jnp.ones((2, 1)),
        descent=descent_lengths(k, 2),
    )
    loaded, velocity = jnp.ones((2, 1)), jnp.array([[0.0], [0.0], [1e-4], [-1e-4]])
    after, error = flow.substep(flow.start(loaded, velocity), jnp.full((1, 1), 0.3))
    slip = np.abs(
        after.velocity[2:]
    ).max()  # it takes impulses of .1, and the discs have .3
    assert slip > 2 * float(flow.tolerance[0, 0])
    assert error > 0.8 * slip


def test_a_force_that_acts_until_its_contact_turns_is_not_forgotten():
    """Forces F that stay, e = 0: gamma_0' is 1.5 F until gamma_0 = 0, then .5 F; a step has .5 F."""
    k, n = jnp.array([[1.0, 0.5], [0.5, 1.0]])[..., None], jnp.ones((2, 1))
    flow = steps_of_two(0.0, gapped=False)
    flow = dataclasses.replace(
        flow, coupling=Dense(k), omega=1e-3 * n, tolerance=1e-4 * flow.tolerance
    )
    h, force = 0.1, 1.25e-3 * 100**1.5
    start = flow.start(100 * n, jnp.array([[-0.05], [-5.0]]))
    after, error = flow.substep(start, jnp.full((1, 1), h))
    wrong = 0.5 * force * (h - 0.05 / (1.5 * force)) - float(after.velocity[0, 0])
    assert wrong == pytest.approx(1 / 30, rel=1e-3)
    assert wrong < error < 4 * wrong


def test_a_wait_ends_where_the_gap_closes():
    """Free flight is one exact step to the next contact."""
    flow = steps_of_two(1.0, gapped=True)
    start = flow.start(jnp.array([[-3.0], [-8.0]]), jnp.array([[-0.5], [-1.0]]))
    after = flow.coasted(start)
    np.testing.assert_allclose(after.indentation[:, 0], [-1.0, 0.0], atol=1e-14)
    assert float(after.time[0, 0]) == pytest.approx(4.0)


def test_the_moment_of_a_turn_counts():
    """gamma linear in time through 0: the integral of c gamma, c = 1 or 1 / e^2, in fine steps."""
    e, h, begins = 0.5, 0.1, np.array([[-0.3, 0.4], [-0.3, 0.4], [0.2, 0.1]])
    ends = np.array([[0.2, -0.1], [-0.2, 0.3], [-0.4, -0.1]])
    flow = steps_of_two(e, gapped=False)
    part = (np.arange(100_000) + 0.5)[:, None] / 100_000
    for loaded, before, after in zip([1.0, 1.0, 0.0], begins, ends):
        gamma = before + part * (after - before)
        rate = np.where(gamma > 0, gamma / e**2 if loaded else 0.0, gamma)
        way = -h * np.array([1.0, 2.0]) * rate.mean(axis=0)
        x, first, last = (
            jnp.asarray(y)[:, None] for y in (loaded + 0 * before, before, after)
        )
        none = jnp.zeros((2, 1), bool)
        half = flow.moved(x, first, h / 2, none)
        end = flow.moved(half, last, h / 2, none)
        end = end + flow.turned(x, half, first, last, jnp.full((1, 1), h))
        np.testing.assert_allclose(end[:, 0], loaded + way, rtol=3e-5, atol=1e-7)


def test_a_chain_needs_its_two_diagonals_only():
    """Descent in a chain is safe, and its product that of the matrix."""
    off = jnp.array([-0.9, -0.2, -0.5, -0.6])[:, None]
    k = (
        np.eye(5)
        + np.diag(np.asarray(off)[:, 0], 1)
        + np.diag(np.asarray(off)[:, 0], -1)
    )
    d = np.asarray(implicit_steps.descent_of(Chain(off), 5))[:, 0]
    assert np.linalg.eigvalsh(np.diag(1 / d) - k).min() > 0
    assert d.min() > 0.4
    f = jnp.arange(5.0)[:, None] ** 2
    np.testing.assert_allclose(
        Chain(off).times(f)[:, 0], k @ np.arange(5.0) ** 2, rtol=1e-14
    )
