"""Method 'implicit': impacts by steps without events, of `LZB` and `Compliant`."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from spatial_scenes import NAMED, random_boxes

import jimpact as ji
from jimpact.contact import contact_of
from jimpact.events import implicit_steps
from jimpact.events.contact_flow import Chain, Dense
from jimpact.events.impact_dynamics import method_for
from jimpact.events.queues import SLOTS
from jimpact.solvers.step_impulses import StepProblem, descent_lengths, solve
from jimpact.status import CODE

# v+ by method 'time' at rtol 1e-11, k = 1, eta = 1.5, mu = .3, by name and e
EDGE = [0.7057231279, 0.3448930544, 0.0365790838, -2.9887916746, -0.3493685294, -0.0909271875]
FLAT = [0.6299348115, 0.1993363367, 0.2798615911, 0.0212017465, -0.394785253, 0.0517198202]
EVENT_BY_EVENT = {
    ("edge", 0.3): EDGE,
    ("edge", 0.0): [0.7669362833, 0.3074755598, -0.2007867887, -2.4982569377, 0.0, -0.1149629959],
    ("flat", 0.3): FLAT,
    ("flat", 0.0): [0.7126974225, 0.2149277049, 0.0, 0.0, 0.0, 0.0798893306],
}
# of a box on a corner at e = mu = .3: d v+ / d (e, mu)
CORNER_JACOBIAN = [
    [-0.15552754376, -0.85593442434],
    [0.01648494272, -0.01323109553],
    [0.52132917949, 0.65157966400],
    [-1.09477701996, -0.96566689232],
    [-1.59569569688, 3.48455862744],
    [-0.00642955078, -0.86463167619],
]
DEFAULT_RTOL = 1e-5  # of the method, in the fastest approach
TIGHT = 1e-6


def pressed(name):
    """Scene and velocity of a body on the ground."""
    body = NAMED[name]()
    return ji.Scene(body.mass, body.normals, body.tangents), jnp.asarray(body.velocity)


def test_agrees_with_the_method_that_stops_at_every_event():
    """Two and four corners, e = 0 included: right to the tolerance asked for."""
    for (name, e), expected in EVENT_BY_EVENT.items():
        scene, v = pressed(name)
        law = ji.LZB(e, 1.0, 1.5, friction=0.3, method="implicit", rtol=TIGHT)
        out = ji.impact(law, scene, v)
        error = np.abs(np.asarray(out.velocity) - expected).max()
        assert out.status == 0
        assert error < 1.5 * TIGHT * np.abs(v).max(), (name, e, error)


SLIDES_OR_ROLLS = [(0.5, 0.1, False), (0.5, 1.0, True), (0.0, 0.3, True)]


@pytest.mark.parametrize(("e", "mu", "rolls"), SLIDES_OR_ROLLS)
def test_a_ball_slides_or_rolls(e, mu, rolls):
    """One contact whose friction does not change its normal force: closed forms."""
    arm = np.array([0.0, 0.0, -1.0])
    mass = np.diag([1.0, 1.0, 1.0, 0.4, 0.4, 0.4])
    rows = np.array([[*np.eye(3)[i], *np.cross(arm, np.eye(3)[i])] for i in range(3)])
    scene = ji.Scene(mass, rows[2:].T, rows[:2].T)
    law = ji.LZB(e, 2.0, 1.5, friction=mu, method="implicit")
    out = ji.impact(law, scene, [0.6, 0.8, -1.0, 0.0, 0.0, 0.0])
    speed = 5 / 7 if rolls else 1 - mu * (1 + e)
    expected = np.array([0.6 * speed, 0.8 * speed, e])
    np.testing.assert_allclose(out.velocity[:3], expected, atol=2 * DEFAULT_RTOL)
    assert out.energy_change < 0


def test_forces_gaps_and_exponents():
    """Three balls with a gap: v+ by method 'time', for forces of each kind."""
    scene = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.1])
    cases = [
        (ji.Hertz(1.0), [-0.04134429, 0.04313068, 0.9982136]),
        (ji.KelvinVoigt(2.0, 0.5), [0.07501565, 0.27741732, 0.64756704]),
        (ji.Bistiffness(1.0, jnp.array([1.3, 1.7]), 0.6), [0.171364, 0.18514237, 0.64349363]),
    ]
    for force, expected in cases:
        out = ji.impact(ji.Compliant(force, method="implicit"), scene, [1.0, 0.0, 0.0])
        np.testing.assert_allclose(out.velocity, expected, atol=1.5 * DEFAULT_RTOL)
        assert out.status == 0


def test_derivatives():
    """One contact, no friction: v+ = -e v-, also in e at e = 0. Second derivatives raise."""
    ball = ji.chain([1.0], wall=True)

    def after(e):
        return ji.impact(ji.LZB(e, 1.0, 1.5, method="implicit"), ball, [1.0]).velocity[0]

    assert jax.jacfwd(after)(0.0) == pytest.approx(-1.0, abs=5e-4)
    with pytest.raises(NotImplementedError, match="must be 'time' for second derivatives"):
        jax.hessian(after)(0.5)


def edge_problem(sigma=0.01, name="edge", **options):
    """Restitution and friction of four impacts of a box on its edge, not yet at the fit."""
    scene, velocity = pressed(name)
    shots = np.outer([0.8, 1.0, 1.2, 1.4], velocity)
    after = np.outer([0.8, 1.0, 1.2, 1.4], EDGE)
    data = ji.Experiments(shots, after, sigma=sigma)
    law = ji.LZB(0.4, friction=0.25, **options)
    return ji.FitProblem.from_shots(law, scene, data, ("restitution", "friction"))


def test_second_derivatives_of_a_fit_say_what_auto_is():
    """The error names what the user may not have asked for; nothing is compiled."""
    problem = edge_problem()

    def cost(x):
        return jnp.sum(problem.residual(x) ** 2)

    with pytest.raises(NotImplementedError, match="or 'auto', which is 'implicit' for several"):
        jax.jit(jax.hessian(cost)).lower(jnp.asarray(problem.start))


def test_a_fit_takes_the_tolerance_that_the_noise_allows():
    """Coarse under the noise; the usual one where it is smaller, unknown, or no error is seen."""
    problem = edge_problem()
    assert problem.law.rtol == 1e-4
    assert any("`rtol` = 0.0001" in note for note in problem.notes)
    gaps = np.abs(pressed("edge")[0].normals.T @ problem.experiments.pre[-1]).max()
    for others in ({"sigma": None}, {"sigma": 1e-4 * gaps}, {"name": "corner"}):
        assert edge_problem(**others).law.rtol is None, others
    assert edge_problem(rtol=1e-6).law.rtol == 1e-6


@pytest.mark.release
def test_gradient_of_a_fit():
    """Of the sum of squares, in both modes 2 J^T r; and the fit finds what the impacts had."""
    problem = edge_problem()

    def cost(x):
        return jnp.sum(problem.residual(x) ** 2)

    x = jnp.asarray(problem.start)
    wanted = 2 * problem.residual(x) @ problem.jacobian(x)
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(cost))(x), wanted, rtol=1e-4)
    found = ji.fit(problem, starts=1, profiles=False)
    np.testing.assert_allclose(found.value, 0.3, atol=1e-3)
    fine = ji.fit(edge_problem(rtol=1e-5), starts=1, profiles=False)
    assert np.abs(found.value - fine.value).max() < 0.01 * found.standard_error.min()
    np.testing.assert_allclose(found.standard_error, fine.standard_error, rtol=0.02)


@pytest.mark.slow
def test_derivatives_with_friction():
    """Those of the event-aligned method, for a box on a corner."""
    scene, v = pressed("corner")

    def after(parameters):
        e, mu = parameters
        law = ji.LZB(e, 1.0, 1.5, friction=mu, method="implicit")
        return ji.impact(law, scene, v).velocity

    forward = jax.jacfwd(after)(jnp.array([0.3, 0.3]))
    np.testing.assert_allclose(forward, CORNER_JACOBIAN, atol=5e-4)


@pytest.mark.slow
def test_reverse_mode_is_the_forward_one():
    """Of a box on an edge, in its mass matrix: so many numbers that steps are walked back."""
    scene, v = pressed("edge")

    def total(mass):
        law = ji.LZB(0.3, 1.0, 1.5, friction=0.3, method="implicit")
        return ji.impact(law, ji.Scene(mass, scene.normals, scene.tangents), v).velocity.sum()

    change = jnp.asarray(np.random.default_rng(0).normal(size=(6, 6)))
    change = change + change.T
    _, forward = jax.jit(lambda m: jax.jvp(total, (m,), (change,)))(scene.mass)
    gradient = jax.jit(jax.grad(total))(scene.mass)
    assert jnp.sum(gradient * change) == pytest.approx(float(forward), rel=1e-8)


def test_reverse_mode_of_many_numbers(monkeypatch):
    """Of ten balls in their masses: the forward slope; it says where it cannot walk back."""
    masses, change = jnp.linspace(1.0, 2.0, 10), jnp.cos(jnp.arange(10.0))

    def first(mass, most=9999):
        law = ji.LZB(0.8, 1.0, 1.5, method="implicit", max_steps=most)
        out = ji.impact(law, ji.chain(mass), np.eye(10)[0])
        return out.velocity[0], out.status

    _, forward, _ = jax.jvp(first, (masses,), (change,), has_aux=True)
    gradient, status = jax.grad(first, has_aux=True)(masses)
    assert gradient @ change == pytest.approx(float(forward), rel=1e-8)
    assert status == CODE["ok"]
    with pytest.raises(NotImplementedError, match="must be 'time' for second derivatives"):
        jax.jacfwd(jax.grad(lambda mass: first(mass)[0]))(masses)
    monkeypatch.setattr(implicit_steps, "MOST_KEPT", 20)
    *_, status = jax.vjp(lambda mass: first(mass, 9998), masses, has_aux=True)
    assert status == CODE["max_steps"]


def test_tangents_of_the_impulses_of_a_step():
    """Two contacts in space, one slips and unloads, one sticks: differences of the solution."""
    rng = np.random.default_rng(1)
    spread = rng.normal(size=(6, 6)) / 4
    k, two = jnp.asarray(np.eye(6) + spread @ spread.T)[..., None], jnp.ones((2, 1))
    velocity = jnp.array([0.3, -1.0, 2.0, -1.0, 0.1, 0.05])[:, None]
    given = StepProblem(Dense(k), velocity, two, two * 0.5, 0.4 * two, descent_lengths(k, 2))
    given = given._replace(unloading=jnp.array([[0.5], [0.0]]))
    change = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(size=x.shape) * (np.asarray(x) != 0)), given
    )
    change = change._replace(descent=0 * given.descent)
    exactly, fine = jax.jit(solve), jnp.full((1, 1), 1e-14)

    def impulses(step):
        q = jnp.zeros((6, 1))
        for _ in range(10):
            q, left = exactly(jax.tree.map(lambda a, b: a + step * b, given, change), q, fine)
        assert left < 1e-13
        return q

    q = impulses(0.0)
    slides, sticks = jnp.hypot(*q[2:4, 0]), jnp.hypot(*q[4:, 0])
    assert 0 < q[0, 0] < 1
    assert slides == pytest.approx(0.4 * q[0, 0])
    assert sticks < 0.39
    _, (rate, _) = jax.jvp(lambda p: solve(p, q, fine), (given,), (change,))
    np.testing.assert_allclose(rate, (impulses(1e-5) - impulses(-1e-5)) / 2e-5, atol=1e-8)


def test_slopes_of_a_queue_are_those_alone():
    """More impacts than there are slots, of different lengths: each slope that of one impact."""
    scene, each = ji.chain([1.0], wall=True), jnp.linspace(0.0, 0.9, 2 * SLOTS)

    def after(e):
        return ji.impact(ji.LZB(e, 1.0, 1.5, method="implicit"), scene, [1.0]).velocity[0]

    slopes = jax.vmap(jax.jacfwd(after))(each)
    np.testing.assert_allclose(slopes, -1.0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("contacts", [1, 2, 4])
def test_agrees_with_an_independent_integration(contacts):
    """Boxes and the measured cube, mu up to 1, by regularized friction (see space_reference.py)."""
    path = Path(__file__).parent / "data" / "friction_space.npz"
    with np.load(path) as file:
        held = {name[:-2]: file[name] for name in file if name.endswith(f"_{contacts}")}

    def one(mass, normals, tangents, v, e, mu, k):
        law = ji.LZB(e, k, 1.5, friction=mu, method="implicit", rtol=TIGHT)
        return ji.impact(law, ji.Scene(mass, normals, tangents), v)

    names = ("mass", "normals", "tangents", "velocity", "restitution", "friction", "stiffness")
    out = jax.jit(jax.vmap(one))(*(held[name] for name in names))
    assert not np.asarray(out.status).any()
    error = np.abs(out.velocity - held["after"]).max(axis=1)
    speed = np.abs(held["velocity"]).max(axis=1)
    assert (error <= 3 * TIGHT * speed + 3 * held["uncertainty"]).all(), error


def test_history_is_that_of_the_other_method():
    """Force, indentation, duration and end of an impact of two contacts, frozen from 'time'."""
    law = ji.LZB([0.9, 0.8], [1.0, 0.5], 1.5, method="implicit", rtol=1e-7)
    h = ji.history(law, ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0], samples=6)
    np.testing.assert_allclose(h.maximum_force, [0.89726283, 0.54923729], rtol=1e-3)
    np.testing.assert_allclose(h.force[1:3, 0], [0.85873828, 0.17296348], rtol=2e-2)
    np.testing.assert_allclose(h.velocity[-1], [-0.27931205, -0.04382761, 0.45565576], atol=1e-6)
    assert h.status == 0
    assert h.force[-1, 0] == 0


def test_auto_leaves_several_contacts_in_space_to_it():
    """Exact: one contact, and all without friction, whatever tangents the scene has."""
    for name, method in (("corner", "time"), ("edge", "implicit"), ("legs", "implicit")):
        scene, v = pressed(name)
        assert method_for("auto", contact_of(scene, v), True) == method, name
        assert method_for("auto", contact_of(scene, v), False) == "time", name
    assert method_for("impulse", contact_of(scene, v), False) == "impulse"
    balls = ji.chain([1.0] * 9)
    assert method_for("auto", contact_of(balls, jnp.zeros(9)), False) == "time"


@pytest.mark.slow
def test_random_boxes_end():
    """Boxes nearly flat on four corners, mu up to 1.5, e from 0 to 1: every impact ends, lossy."""
    draw = random_boxes("nearly flat", 16)

    def one(mass, normals, tangents, v, e, mu):
        law = ji.LZB(e, 1.0, 1.5, friction=mu, method="implicit", rtol=1e-4)
        return ji.impact(law, ji.Scene(mass, normals, tangents), v)

    out = jax.jit(jax.vmap(one))(*draw)
    assert not np.asarray(out.status).any()
    size = np.abs(draw.velocity).max(axis=1) ** 2
    assert (np.asarray(out.energy_change) < 1e-3 * size).all()


def test_what_does_not_end_says_so():
    """Too few steps: `max_steps`, which names the method that ends where contacts jam."""
    scene, v = pressed("edge")
    law = ji.LZB(0.3, 1.0, 1.5, friction=0.3, method="implicit", max_steps=5)
    out = ji.impact(law, scene, v)
    assert int(out.status) == CODE["max_steps"]
    with pytest.raises(RuntimeError, match="try method='implicit'"):
        ji.raise_on_failure(out)


def test_impulses_of_a_step():
    """Slip beyond the cone, stick within it, a contact whose unloading takes its force away."""
    k = jnp.diag(jnp.array([1.0, 1.0, 2.0, 2.0]))[..., None]  # two contacts in the plane
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
    k = jnp.stack([jnp.eye(4).at[2, 3].set(c).at[3, 2].set(c) for c in (0.5, 0.999)], axis=-1)
    velocity, one = jnp.array([[0.0], [0.0], [1.0], [0.3]]) * jnp.ones((1, 2)), jnp.ones((2, 2))
    problem = StepProblem(Dense(k), velocity, one, 0 * one, 2 * one, jnp.full((4, 2), 0.4))
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
    d = np.asarray(descent_lengths(jnp.asarray(k)[..., None], 4, friction_only=True))[:, 0]
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
    slip = np.abs(after.velocity[2:]).max()  # it takes impulses of .1, and the discs have .3
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
        x, first, last = (jnp.asarray(y)[:, None] for y in (loaded + 0 * before, before, after))
        none = jnp.zeros((2, 1), bool)
        half = flow.moved(x, first, h / 2, none)
        end = flow.moved(half, last, h / 2, none)
        end = end + flow.turned(x, half, first, last, jnp.full((1, 1), h))
        np.testing.assert_allclose(end[:, 0], loaded + way, rtol=3e-5, atol=1e-7)


def test_a_chain_needs_its_two_diagonals_only():
    """Descent in a chain is safe, and its product that of the matrix."""
    off = jnp.array([-0.9, -0.2, -0.5, -0.6])[:, None]
    k = np.eye(5) + np.diag(np.asarray(off)[:, 0], 1) + np.diag(np.asarray(off)[:, 0], -1)
    d = np.asarray(implicit_steps.descent_of(Chain(off), 5))[:, 0]
    assert np.linalg.eigvalsh(np.diag(1 / d) - k).min() > 0
    assert d.min() > 0.4
    f = jnp.arange(5.0)[:, None] ** 2
    np.testing.assert_allclose(Chain(off).times(f)[:, 0], k @ np.arange(5.0) ** 2, rtol=1e-14)
