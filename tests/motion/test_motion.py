"""Whole motions against closed forms: events, derivatives, batches, contact, ledger."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piles
import pytest
from motion_cases import G, bounce_times, dropped, height, stack, status
from programs import OPTIMIZED, both_ways
from refusals import argument

import jimpact as ji

LEGS = np.array([[0.3, 0.2], [0.3, -0.2], [-0.3, 0.2], [-0.3, -0.2]])


def lane(batch, i):
    return jax.tree.map(lambda x: x[i], batch)


def kinds(motion):
    return motion.to_dict()["events"]["kind"]


@pytest.fixture(scope="module")
def balls():
    """(motion, d motion / d e) of a batch, most of it bad: one program for many tests."""
    run = jax.jit(
        jax.vmap(lambda e, *x: jax.jvp(lambda e: dropped(e, *x), (e,), (1.0,)))
    )
    return run(
        jnp.array([0.8, 0.8, 0.8, 0.99, 0.5, 0.5]),
        jnp.array([1.0, jnp.nan, -0.1, 1e-4, 0.5, 1.0]),
        jnp.array([1e-6] * 5 + [1e-12]),
    )


def test_bouncing_ball_events_and_their_derivative(balls):
    motion, slope = lane(balls[0], 0), lane(balls[1], 0)
    exact, exact_slope = jax.jvp(bounce_times, (0.8,), (1.0,))
    np.testing.assert_allclose(motion.events.time[:20], exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(slope.events.time[:20], exact_slope, rtol=0, atol=1e-10)


def test_bouncing_ball_between_events(balls):
    motion, slope = lane(balls[0], 0), lane(balls[1], 0)
    t = np.asarray(motion.time)
    t = t[t < float(bounce_times(0.8)[-1])]
    assert len(t) > 70
    both = jax.jit(jax.vmap(lambda t: jax.jvp(lambda e: height(e, t), (0.8,), (1.0,))))
    with jax.numpy_dtype_promotion("standard"):
        exact, exact_slope = both(t)
    np.testing.assert_allclose(motion.q[: len(t), 0], exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(slope.q[: len(t), 0], exact_slope, rtol=0, atol=1e-10)


def test_finite_accumulation_is_passed(balls):
    motion, slope = lane(balls[0], 0), lane(balls[1], 0)
    last = int(motion.events.count) - 1
    assert kinds(motion) == ["impact"] * last + ["accumulation"]
    first = np.sqrt(2 / G)
    end = motion.events.accumulation_end[last]
    np.testing.assert_allclose(end, first * (1 + 0.8) / (1 - 0.8), rtol=1e-12)
    # the ratio of the last two of 62 intervals: rounding grows with 1 / interval
    np.testing.assert_allclose(
        slope.events.accumulation_end[last], 2 * first / 0.2**2, rtol=1e-6
    )
    rest = np.asarray(motion.time) > float(end)
    assert rest.any()
    np.testing.assert_allclose(motion.q[rest], 0, atol=1e-12)
    np.testing.assert_allclose(motion.velocity[rest], 0, atol=1e-12)


def test_hops_below_the_rounding_of_gaps_are_passed(balls):
    """`slow` would resolve hops of 1e-24 m beside a height of 1 m, known within 2e-16 m."""
    motion = lane(balls[0], 5)
    last = int(motion.events.count) - 1
    assert kinds(motion) == ["impact"] * last + ["accumulation"]
    hops = (
        np.asarray(motion.events.velocity_before)[: last + 1, 0] ** 2 / (2 * G) * 0.5**2
    )
    eps = np.finfo(float).eps
    assert hops[last] < 100 * eps
    assert (hops[:last] > eps).all()
    first = np.sqrt(2 / G)
    end = motion.events.accumulation_end[last]
    np.testing.assert_allclose(end, first * (1 + 0.5) / (1 - 0.5), rtol=1e-6)


@pytest.mark.release
def test_contacts_that_share_bodies_come_to_rest_together():
    """What is passed lies within its estimates: in time, and in the gaps meanwhile."""
    dropped = 0.9, [0.1, 0.101, 0.102], [0.0] * 3
    fine = stack(*dropped, 2.0, method=ji.EventDriven(slow=1e-12))
    rest = fine.events.accumulation_end[int(fine.events.count) - 1]
    for slow in (1e-8, 1e-6, 1e-4):
        motion = stack(*dropped, 2.0, method=ji.EventDriven(slow=slow))
        last = int(motion.events.count) - 1
        assert kinds(motion)[last] == "accumulation"
        begin, gap = motion.events.time[last], motion.events.accumulation_gap[last]
        assert (
            begin
            < rest
            < motion.events.accumulation_end[last]
            < rest + 5 * (rest - begin)
        )
        assert gap < 10 * slow * 0.1  # about that share of the first fall
        meanwhile = stack(
            *dropped, (begin + rest) / 2, method=ji.EventDriven(slow=1e-12)
        ).gaps[-1]
        assert 0 < np.max(meanwhile) <= gap
        np.testing.assert_array_less(np.abs(motion.q[-1]), 1e-12)
        np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-13)


@pytest.mark.slow
def test_bodies_come_to_rest_on_each_other_while_they_fall():
    motion = stack(0.5, [50.0, 50.01, 50.03], [0.0, 1.0, 0.0], 3.0, between=5.0)
    assert kinds(motion)[-1] == "accumulation"
    np.testing.assert_allclose(motion.gaps[-1, 1:], 0, atol=1e-12)
    np.testing.assert_allclose(motion.velocity[-1], 1 / 3 - 30.0, rtol=1e-12)
    np.testing.assert_allclose(motion.q[-1], 150.04 / 3 + 1.0 - 45.0, rtol=1e-12)


@pytest.mark.slow
def test_lengths_may_be_in_any_unit():
    """The same fall from heights and within times in which weights are the same number."""
    heights = np.array([0.1, 0.101, 0.102])
    metres, microns = (
        stack(0.5, 10.0**k * heights, [0.0] * 3, 10.0 ** (k / 2)) for k in (0, 6)
    )
    assert status(microns) == status(metres) == "ok"
    assert kinds(microns)[:20] == kinds(metres)[:20]
    times = (motion.events.time[:20] for motion in (metres, microns))
    np.testing.assert_allclose(next(times), next(times) / 1e3, rtol=1e-9)
    np.testing.assert_allclose(microns.q[-1] / 1e6, metres.q[-1], atol=1e-9)


@pytest.mark.release
def test_a_table_comes_to_rest_on_four_legs():
    """Without friction nobody knows which leg carries what; it stands, wherever its middle is."""
    for off in (0.0, 0.25):
        table = ji.System(
            lambda q, off=off: q[0] + LEGS @ q[1:] - off * q[1],
            [1.0, 0.05, 0.05],
            potential=ji.gravity([1.0, 0.0, 0.0]),
        )
        motion = ji.simulate(
            table, ji.Moreau(0.5), [0.1, 0.05, 0.1], np.zeros(3), 3.0, samples=5
        )
        assert status(motion) == "ok"
        np.testing.assert_allclose(motion.q[-1], 0, atol=1e-12)
        np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)


def test_a_bad_motion_ends_alone(balls):
    ends = [status(lane(balls[0], i)) for i in range(5)]
    assert ends == ["ok", "not_finite", "penetration", "max_events", "ok"]
    with pytest.raises(RuntimeError, match=r"max_events.*\(1 at 3\)"):
        ji.raise_on_failure(balls[0])
    assert str(balls[0]) == "6 motions: 3 ok, 1 max_events, 1 penetration, 1 not_finite"
    impacts = kinds(lane(balls[0], 0)).count("impact")
    assert f"  events: {impacts} impact, 1 accumulation\n" in str(lane(balls[0], 0))
    np.testing.assert_allclose(
        lane(balls[0], 4).events.time[0], np.sqrt(1 / G), atol=1e-12
    )
    failed, slope = lane(balls[0], 3), lane(balls[1], 3)
    assert np.isnan(np.asarray(failed.q)[-1]).all()
    for rate in (slope.q, slope.kinetic_energy, slope.contact_work):
        assert np.isnan(np.asarray(rate)[-1]).all()
    assert np.isfinite(slope.events.time).all()


@pytest.mark.release
def test_a_law_with_friction_may_be_made_outside_of_jit():
    block, law = ji.System(ji.Block(0.2, 0.4), gravity=True), ji.LZB(0.5, friction=0.3)

    def run(q):
        return ji.simulate(block, law, q, jnp.zeros(3), 1.0, samples=2, max_events=5).q

    assert jax.eval_shape(run, jnp.array([0.0, 0.3, 0.1])).shape == (2, 3)


def test_ledger_closes(balls):
    for i, e in ((0, 0.8), (4, 0.5)):
        motion = lane(balls[0], i)
        np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)
        # all of it was taken by the contact, each impact took (1 - e^2) of what was left
        np.testing.assert_allclose(
            motion.contact_work[-1, 0, 0], -motion.energy[0], atol=1e-11
        )
        taken = -np.asarray(motion.events.energy)[:5, 0, 0]
        expected = float(motion.energy[0]) * (1 - e**2) * e ** (2 * np.arange(5.0))
        np.testing.assert_allclose(taken, expected, rtol=1e-11)


def times_of(x):
    """Event times of a ball by e, q0 and g."""
    ball = ji.System(ji.Column([1.0]), gravity=x[2])
    motion = ji.simulate(
        ball, ji.Newton(x[0]), x[1][None], [0.0], 5.0, samples=2, max_events=90
    )  # fmt: skip
    return motion.events.time[:20]


def exact_times(x):
    e, q0, g = x
    powers = e ** jnp.arange(1.0, 20)
    return jnp.sqrt(2 * q0 / g) * (
        1 + 2 * jnp.concatenate([jnp.zeros(1), jnp.cumsum(powers)])
    )


@pytest.mark.release
def test_derivatives_over_twenty_bounces_in_both_modes():
    both = jax.jit(lambda x: (jax.jacfwd(times_of)(x), jax.jacrev(times_of)(x)))
    x = jnp.array([0.8, 1.0, G])
    exact = jax.jacfwd(exact_times)(x)
    for slope in both(x):
        np.testing.assert_allclose(slope, exact, rtol=1e-9, atol=1e-11)


@pytest.mark.release
def test_second_derivatives_over_twenty_bounces():
    x = jnp.array([0.8, 1.0, G])
    found = jax.jit(jax.hessian(lambda x: times_of(x)[19]))(x)
    exact = jax.hessian(lambda x: exact_times(x)[19])(x)
    np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-9)


@pytest.mark.release
def test_derivatives_in_what_functions_close_over():
    def second(height):
        system = ji.System(lambda q: q - height, [1.0], potential=lambda q: 9.0 * q[0])
        motion = ji.simulate(
            system, ji.Newton(0.7), [1.0], [0.0], 1.2, samples=3, max_events=10
        )
        return motion.events.time[1]

    exact = jax.grad(lambda h: 2.4 * jnp.sqrt(2 * (1 - h) / 9))(0.1)
    for slopes in both_ways(lambda x: second(x[0])[None])(jnp.array([0.1]))[1:]:
        np.testing.assert_allclose(slopes, [[exact]], rtol=1e-12)


class Plate(eqx.Module):
    """It vibrates, and rises for a moment."""

    amplitude: jax.Array
    frequency: jax.Array
    phase: jax.Array
    rise: jax.Array
    centre: jax.Array
    width: jax.Array

    def __call__(self, t):
        y = self.amplitude * jnp.sin(2 * np.pi * self.frequency * t + self.phase)
        return (y + self.rise * jnp.exp(-(((t - self.centre) / self.width) ** 2)))[None]


def first_contact(plate, q0, v0):
    """When a ball first touches its plate, by many looks and bisection."""
    a, f, phase, rise, centre, width = plate

    def gap(t):
        y = a * np.sin(2 * np.pi * f * t + phase) + rise * np.exp(
            -(((t - centre) / width) ** 2)
        )
        return q0 + v0 * t - G * t * t / 2 - y

    looks = np.linspace(0, 0.4, 100_001)
    first = np.flatnonzero(gap(looks) < 0)[0]
    low, high = looks[first - 1], looks[first]
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if gap(middle) >= 0 else (low, middle)
    return high


@pytest.mark.release
def test_no_event_is_missed_between_two_looks():
    """384 vibrating plates, 120 that rise for a moment; a wall that an oscillator grazes."""
    r, n, k = np.random.default_rng(0), 384, 120
    a, f = 10 ** r.uniform(-4, -1.5, n), 10 ** r.uniform(0.5, 2.3, n)
    still = np.zeros(n)
    moves = [a, f, r.uniform(0, 6.28, n), still, still, still + 1]
    rises = [
        r.uniform(0.01, 0.2, k),
        r.uniform(0.05, 0.35, k),
        10 ** r.uniform(-2.5, -1.3, k),
    ]
    plates = [np.r_[x, y] for x, y in zip(moves, [np.zeros(k)] * 3 + rises)]
    high = r.uniform(0, 0.2, n) * (r.random(n) < 0.5)
    q = np.r_[a * r.uniform(1.001, 3, n) + high, r.uniform(0.21, 0.4, k)]
    v = np.r_[r.uniform(-1, 1, n), r.uniform(-0.5, 0.5, k)]
    depth = np.array([1e-2, 1e-3, 1e-4, 1e-5, 1e-6, -1e-5])

    def hit(plate, q, v):
        ball = ji.System(ji.Column([1.0]), gravity=True, base=Plate(*plate))
        options = {"samples": 2, "max_events": 1}
        return ji.simulate(
            ball, ji.Newton(0.5), q[None], v[None], 0.4, **options
        ).events.time[0]

    def graze(depth):
        system = ji.System(
            lambda q: q + 1 - depth, [1.0], potential=lambda q: 0.5 * q[0] ** 2
        )
        found = [
            ji.simulate(
                system, ji.Newton(0.5), [1.0], [0.0], 20.0, samples=s, max_events=1
            )
            for s in (2, 11)
        ]
        return jnp.stack([motion.events.time[0] for motion in found])

    run = jax.jit(lambda p, q, v, d: (jax.vmap(hit)(p, q, v), jax.vmap(graze)(d)))
    hits, grazes = run(plates, q, v, depth)
    exact = [first_contact(*given) for given in zip(np.transpose(plates), q, v)]
    np.testing.assert_allclose(hits, exact, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        grazes[:5].T, [np.arccos(depth[:5] - 1)] * 2, rtol=0, atol=1e-9
    )
    assert np.isnan(np.asarray(grazes[5])).all()


@pytest.mark.release
def test_ball_leaves_a_vibrating_plate():
    """It leaves when the plate falls with g: A w^2 sin(w t) = g; and hits it again."""
    w, amplitude = 20.0, 0.03

    def run(a):
        base = ji.HarmonicBase(a, w / (2 * np.pi))
        system = ji.System(ji.Column([1.0]), gravity=True, base=base)
        return ji.simulate(
            system, ji.Newton(0.0), [0.0], (a * w)[None], 0.7, samples=36
        )

    both = jax.jit(lambda a: jax.jvp(run, (a,), (1.0,)), compiler_options=OPTIMIZED)
    motion, slope = both(jnp.asarray(amplitude))
    exact, exact_slope = jax.jvp(
        lambda a: jnp.arcsin(G / a / w**2) / w, (amplitude,), (1.0,)
    )
    assert kinds(motion)[:3] == ["detachment", "impact", "detachment"]
    np.testing.assert_allclose(motion.events.time[0], exact, atol=1e-11)
    np.testing.assert_allclose(slope.events.time[0], exact_slope, rtol=1e-7)
    # from then on a parabola, until it meets the plate
    s = motion.events.time[1] - exact
    y = (
        amplitude * np.sin(w * exact)
        + amplitude * w * np.cos(w * exact) * s
        - G * s**2 / 2
    )
    np.testing.assert_allclose(
        y, amplitude * jnp.sin(w * motion.events.time[1]), atol=1e-12
    )
    period = motion.events.time[2] - motion.events.time[0]
    np.testing.assert_allclose(
        period, 2 * np.pi / w, atol=1e-10
    )  # period after period the same
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)
    assert np.ptp(np.asarray(motion.base_work)) > 0.05
    together = np.asarray(motion.time) < float(exact)
    plate = amplitude * np.sin(w * np.asarray(motion.time))
    np.testing.assert_allclose(
        np.asarray(motion.q)[together, 0], plate[together], atol=1e-13
    )


def on_slope(angle, speed, mu, e=0.0, drop=0.0, tilt=0.0, corners="all"):
    weights = G * jnp.stack([-jnp.sin(angle), jnp.cos(angle), jnp.zeros_like(angle)])
    block = ji.Block(0.2, 0.4, corners=corners)
    system = ji.System(block, potential=type(ji.gravity([0.0]))(weights), friction=mu)
    none = 0 * speed
    q0, v0 = (
        jnp.stack([none, 0.2 + drop + none, tilt + none]),
        jnp.stack([speed, none, none]),
    )
    return ji.simulate(system, ji.Moreau(e), q0, v0, 1.0, samples=21)


@pytest.fixture(scope="module")
def slides():
    """A block on a slope: slides to stick; is held; slips; tips; chatters on two corners."""
    rows = [(0.0, 1.0, 0.3), (np.arctan(0.29), 0.0, 0.3), (np.arctan(0.31), 0.0, 0.3)]
    rows = [(*row, 0.0, 0.0, 0.0) for row in (*rows, (np.arctan(0.6), 0.0, 2.0))]
    rows += [(0.0, 0.0, 0.3, 0.5, 0.01, 0.02)]
    return jax.jit(jax.vmap(on_slope))(*np.array(rows, float).T)


@pytest.mark.slow
def test_sliding_block_comes_to_stick(slides):
    motion = lane(slides, 0)
    assert kinds(motion) == ["friction"]
    np.testing.assert_allclose(motion.events.time[0], 1 / (0.3 * G), atol=1e-12)
    np.testing.assert_allclose(motion.q[-1], [1 / (2 * 0.3 * G), 0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)
    # h/w = 2: the front corner carries (1 + mu h / w) / 2 of the weight, and of the friction
    took = [-0.5 * 0.8, -0.5 * 0.2, 0, 0]  # the upper corners nothing
    np.testing.assert_allclose(motion.contact_work[-1, 1], took, atol=1e-12)


@pytest.mark.slow
def test_stick_and_slip_on_a_slope(slides):
    np.testing.assert_allclose(lane(slides, 1).q[-1], [0.0, 0.2, 0.0], atol=1e-12)
    angle, slips = np.arctan(0.31), lane(slides, 2)
    x = 0.5 * G * (np.sin(angle) - 0.3 * np.cos(angle))
    np.testing.assert_allclose(slips.q[-1], [x, 0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(slips.ledger_residual, 0, atol=1e-12)


@pytest.mark.release
def test_derivatives_of_a_block_that_comes_to_stick():
    """Where it stops, when, and what friction took, in both modes."""

    def found(x):
        motion = on_slope(*x, corners="base")
        return jnp.stack(
            [motion.q[-1, 0], motion.events.time[0], motion.contact_work[-1].sum()]
        )

    def exact(x):
        angle, speed, mu = x
        slowing = G * (mu * jnp.cos(angle) - jnp.sin(angle))
        way = speed**2 / (2 * slowing)
        return jnp.stack([way, speed / slowing, -mu * G * jnp.cos(angle) * way])

    x = jnp.array([0.1, 1.0, 0.3])
    for slopes in both_ways(found)(x)[1:]:
        np.testing.assert_allclose(slopes, jax.jit(jax.jacfwd(exact))(x), rtol=1e-11)


@pytest.mark.slow
def test_block_tips_about_its_corner(slides):
    """Steeper than width / height and rough: it turns about a fixed corner, energy conserved."""
    motion = lane(slides, 3)
    reached = np.asarray(motion.time) < 0.4
    np.testing.assert_allclose(np.asarray(motion.gaps)[reached, 0], 0, atol=1e-12)
    q, v = np.asarray(motion.q)[reached], np.asarray(motion.velocity)[reached]
    corner = q[:, 0] + 0.1 * np.cos(q[:, 2]) + 0.2 * np.sin(q[:, 2])
    np.testing.assert_allclose(corner, 0.1, atol=1e-9)
    inertia = (0.2**2 + 0.4**2) / 3  # I_corner w^2 / 2 = work of gravity
    fallen = (
        np.asarray(motion.potential_energy)[0]
        - np.asarray(motion.potential_energy)[reached]
    )
    np.testing.assert_allclose(0.5 * inertia * v[:, 2] ** 2, fallen, atol=1e-9)
    assert v[-1, 2] < -1


@pytest.mark.slow
def test_nested_accumulations_are_passed_below_the_root_of_slow(slides):
    """Impacts of corners, which share their block, end below sqrt(slow) = 1e-3 of the
    fastest approach; those of a single contact would at slow = 1e-6 of it.
    """
    motion = lane(slides, 4)
    end = kinds(motion).index("accumulation", 12)  # after a dozen impacts or more
    velocities = np.asarray(motion.events.velocity_before)[: end + 1]
    _, upwards, turning = velocities.T
    # of the two lower corners, 0.1 m beside the middle; the block tilts by 0.02 at most
    corners = np.stack([upwards - 0.1 * turning, upwards + 0.1 * turning], axis=1)
    fastest = np.maximum(-corners, 0.0).max(axis=1)  # approach at each event
    assert 1e-4 < fastest[end] / fastest.max() < 2.5e-3
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-12)
    np.testing.assert_allclose(motion.gaps[-1, :2], 0, atol=1e-12)


def stepped(e, step):
    return ji.simulate(
        ji.System(ji.Column([1.0]), gravity=True), ji.Newton(e), [1.0], [0.0], 2.0, samples=11,
        method="time_stepping", step=step,
    )  # fmt: skip


def mean_error(motion_of, exact, step):
    """Over steps up to `step`: an impact is late by any share of one, so single errors jump."""
    found = [motion_of(step * 10 ** (-k / 8)) for k in range(8)]
    assert all(status(motion) == "ok" for motion in found)
    return np.mean([np.abs(np.asarray(motion.q) - exact).max() for motion in found])


@pytest.mark.release
def test_time_stepping_is_of_first_order():
    exact = np.array([[height(0.8, t)] for t in np.linspace(0, 2, 11)])
    coarse, fine = (
        mean_error(lambda h: stepped(0.8, h), exact, h) for h in (2e-3, 2e-4)
    )
    assert fine < 3e-4
    assert 0.8 < np.log10(coarse / fine) < 1.2


@pytest.mark.parametrize(
    ("system", "law", "q0", "v0", "end"),
    [
        pytest.param(
            ji.System(ji.PendulumCradle([1.0] * 3, 0.1, 0.01), gravity=True), ji.LZB(0.9), [-0.5, 0, 0], [0.0] * 3, 0.3,
            marks=pytest.mark.release,
        ),
        pytest.param(
            ji.System(ji.Column([1.0, 0.5], 0.05), gravity=True), ji.Moreau(0.6), [0.2, 0.45], [0.0] * 2, 0.35,
            marks=pytest.mark.release,
        ),
        # it falls on a corner, tips and strikes with the other one
        pytest.param(
            ji.System(ji.Block(0.2, 0.4), gravity=True), ji.Moreau(0.0, friction=0.3),
            [0.0, 0.25, 0.1], [0.5, 0.0, 0.0], 0.25, marks=pytest.mark.release,
        ),
    ],
)  # fmt: skip
def test_time_stepping_follows_the_events(system, law, q0, v0, end):
    """Its q at the end tends to that of method 'events', with the order 1 of the step."""
    exact = ji.simulate(system, law, q0, v0, end, samples=2).q

    def motion_of(step):
        options = {"samples": 2, "method": "time_stepping", "step": step}
        return ji.simulate(system, law, q0, v0, end, **options)

    coarse = mean_error(motion_of, exact, 2e-3)
    fine = mean_error(motion_of, exact, 2e-4)
    assert fine < 1e-3
    order = np.log10(coarse / fine)  # of a step ten times finer
    assert 0.8 < order < 1.25


def test_derivatives_of_time_stepping_are_refused():
    """They would be 1 for the height after a bounce, at every step; right is 1 + 2 e at first."""
    for derivative in (jax.grad, jax.jacfwd):
        with pytest.raises(NotImplementedError, match=argument("method")):
            derivative(lambda e: stepped(e, 1e-3).q[5, 0])(0.8)


@pytest.mark.slow
def test_a_block_on_a_slope_stays_slides_and_stops():
    """Time stepping is exact here: distances are those of a constant deceleration."""
    slope, g, mu = 0.3, 9.81, 0.5
    block = ji.Block(width=0.4, height=0.2)
    tilted = ji.System(
        block, potential=lambda q: g * (jnp.sin(slope) * q[0] + jnp.cos(slope) * q[1])
    )
    start = block.touching(0.0)

    @functools.partial(jax.jit, static_argnums=2)
    def moved(mu, v, law):
        return ji.simulate(
            tilted, law(0.2, friction=mu), start, jnp.stack([v, 0.0, 0.0]), 1.0, samples=11,
            method="time_stepping", step=1e-2,
        )  # fmt: skip

    rests = moved(mu, 0.0, ji.Moreau)
    np.testing.assert_allclose(rests.q[-1], start, atol=1e-10)
    slows = g * (mu * np.cos(slope) - np.sin(slope))
    stops = moved(mu, -1.0, ji.Moreau)
    # it stops within a step
    np.testing.assert_allclose(
        stops.q[-1, 0], -1 / (2 * slows), atol=1e-2 * slows * 1e-2
    )
    np.testing.assert_allclose(stops.velocity[-1], 0, atol=1e-10)
    slides = moved(0.2, 0.0, ji.Moreau)
    gains = g * (np.sin(slope) - 0.2 * np.cos(slope))
    np.testing.assert_allclose(slides.velocity[-1], [-gains, 0, 0], atol=1e-9)
    for motion in (rests, stops, slides):
        assert status(motion) == "ok"
        np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)


def discs_in_a_box(n, columns, duration, step, samples):
    rng = np.random.default_rng(0)
    radii = 0.01 * (1 + 0.2 * (rng.random(n) - 0.5))
    half = 0.0122 * columns
    place = np.arange(n)
    centres = np.stack(
        [0.013 - half + 0.024 * (place % columns), 0.02 + 0.024 * (place // columns)]
    )
    walls = [[0.0, 1.0, 0.0], [1.0, 0.0, -half], [-1.0, 0.0, -half]]
    pile = piles.discs(np.pi * radii**2 * 1000, radii, planes=walls)
    system = ji.System(pile, gravity=True)
    v0 = np.pad(0.1 * rng.standard_normal((n, 2)), ((0, 0), (0, 1))).reshape(-1)
    law = ji.Moreau(0.3, friction=0.5)
    return ji.simulate(
        system, law, pile.at(centres.T), v0, duration,
        samples=samples, method="time_stepping", step=step,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("n", "columns", "duration"),
    [
        pytest.param(30, 6, 1.0, marks=pytest.mark.release),
        pytest.param(150, 12, 1.5, marks=[pytest.mark.release, pytest.mark.long_run]),
    ],
)
def test_discs_fall_into_a_box_and_come_to_rest(n, columns, duration):
    motion = discs_in_a_box(n, columns, duration, 1e-3, 21)
    assert status(motion) == "ok"
    speed = np.abs(np.asarray(motion.velocity[-1]).reshape(-1, 3)) * [1, 1, 0.01]
    assert speed.max() < 5e-3  # a last disc may roll on the floor
    assert np.median(speed) < 1e-6
    energy = np.asarray(motion.energy)
    assert np.diff(energy).max() < 1e-8 * energy[0]
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12 * energy[0])
    assert -1e-3 < float(np.min(motion.gaps)) < 0  # late by half a step, 1 m/s: 5e-4


def test_discs_are_a_body_like_others():
    """Gaps, slips and their gradients against those of the closed contacts in time stepping."""
    pile = piles.discs(
        [1.0, 2.0, 3.0], [0.1, 0.2, 0.1], planes=[[0.0, 2.0, 0.0], [3.0, 4.0, -1.0]]
    )
    q = pile.at([[0.0, 0.1], [0.3, 0.1], [-0.2, 0.1]]) + jnp.array([0, 0, 0.3] * 3)
    near, gradients, slips = jax.jit(
        lambda q: (
            pile.active_pairs(q, q, 0.0),
            jax.jacobian(pile.gap_function)(q),
            pile.tangents(q),
        )
    )(q)
    order = [(i, 3 + w) for w in range(2) for i in range(3)] + [(0, 1), (0, 2), (1, 2)]
    names = [i * 5 + j for i, j in order]
    closed = np.asarray(near.closed)
    assert sorted(np.asarray(near.number)[closed]) == [1, 2, 3, 8, 13]
    for k in np.flatnonzero(closed):
        column = names.index(int(near.number[k]))
        for row, expected in enumerate((gradients.T, slips)):
            found = np.zeros((4, 3))
            for body, part in zip(near.bodies[k], near.directions[k, row]):
                found[int(body)] += np.asarray(part)
            np.testing.assert_allclose(
                found[:3].reshape(-1), expected[:, column], atol=1e-15
            )


@pytest.mark.release
@pytest.mark.parametrize(
    "law", [ji.Moreau(0.5), pytest.param(ji.Newton(0.5), marks=pytest.mark.release)]
)
def test_time_stepping_of_many_beads_comes_to_rest(law):
    n = 20
    q = 0.01 + 0.02 * np.arange(n) + 0.05
    motion = ji.simulate(
        ji.System(ji.Column(np.full(n, 0.1), 0.01), gravity=True), law, q, np.zeros(n), 1.0,
        method="time_stepping", step=2e-4, samples=11,
    )  # fmt: skip
    assert (
        status(motion) == "ok"
    )  # contacts are struck again while it comes to rest, but softly
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-9)
    np.testing.assert_allclose(motion.gaps[-1], 0, atol=1e-3)
    assert int(motion.events.count) > 5
    stays = ji.simulate(
        ji.System(ji.Column(np.full(n, 0.1), 0.01), gravity=True), law, q - 0.05, np.zeros(n), 1.0,
        method="time_stepping", step=2e-4, samples=11,
    )  # fmt: skip
    assert status(stays) == "ok"
    assert int(stays.events.count) == 0


@pytest.mark.release
def test_time_stepping_reports_what_it_cannot_resolve():
    pile = piles.discs(1.0, [0.1, 0.1], planes=[[0.0, 1.0, 0.0]], room=1)
    system, q = ji.System(pile, gravity=True), pile.at([[0.0, 0.1], [0.3, 0.1]])
    crowded = ji.simulate(
        system,
        ji.Moreau(0.0),
        q,
        np.zeros(6),
        0.1,
        samples=2,
        method="time_stepping",
        step=0.05,
    )
    assert status(crowded) == "room"
    with pytest.raises(ValueError, match="must be Moreau's"):
        ji.simulate(
            system, ji.LZB(0.5), q, np.zeros(6), 0.1, method="time_stepping", step=0.05
        )
    fast = ji.simulate(
        system, ji.Moreau(0.0), q + jnp.array([0.0, 1.0, 0.0] * 2), [3.0, 0.0, 0.0] * 2, 0.1,
        samples=2, method="time_stepping", step=0.05,
    )  # fmt: skip
    assert status(fast) == "coarse_step"
    between = ji.System(lambda q: jnp.stack([q[0], 0.1 - q[0]]), [1.0])
    coarse = ji.simulate(
        between,
        ji.Moreau(1.0),
        [0.05],
        [1.0],
        3.0,
        samples=4,
        method="time_stepping",
        step=0.15,
    )
    assert status(coarse) == "coarse_step"


@pytest.mark.release
def test_contacts_that_still_approach_have_another_impact_at_once():
    """Moreau's law lets a separating contact close: the next impact is at the same instant."""
    system = ji.System(ji.Column([1.0, 1.0, 1.0]), gravity=True)
    motion = ji.simulate(
        system, ji.Moreau(0.5), [0.0] * 3, [-1.0, -0.2, -0.2], 0.01, samples=2
    )
    assert status(motion) == "ok"
    times = np.asarray(motion.events.time)[: int(motion.events.count)]
    assert len(times) > 1
    assert (times[:2] == 0).all()
    assert (np.asarray(motion.gaps) > -1e-12).all()
    pulls = ji.simulate(
        system, ji.Newton(0.5), [0.0] * 3, [0.0, 0.0, 1.0], 0.01, samples=2
    )
    assert status(pulls) == "ok"
    assert int(pulls.events.count) == 0
    squeezed = ji.simulate(
        system, ji.Newton(0.9), [0.0] * 3, [-1.0, 5.0, 5.0], 0.01, samples=2
    )
    assert status(squeezed) == "law_failed"
    with pytest.raises(RuntimeError, match="law_failed"):
        ji.raise_on_failure(squeezed)


@pytest.mark.release
def test_a_mass_matrix_that_turns_singular():
    system = ji.System(
        lambda q: q + 1, lambda q: 1 - q, force=lambda q, v, t: jnp.ones(1)
    )
    assert (
        status(ji.simulate(system, ji.Newton(0.5), [0.0], [1.0], 3.0))
        == "singular_mass"
    )
    nan = ji.System(
        lambda q: q + 1, [1.0], force=lambda q, v, t: jnp.where(q < 0.5, 1.0, jnp.nan)
    )
    assert status(ji.simulate(nan, ji.Newton(0.5), [0.0], [1.0], 3.0)) == "not_finite"
