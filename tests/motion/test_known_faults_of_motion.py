"""Inputs that gave a wrong answer, with the right one. Each stands for its kind."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piles
import pytest

import jimpact as ji

G = 9.80665


def status_of(out):
    return ji.STATUS[int(out.status)].name


@pytest.mark.slow
def test_programs_of_batched_motions_solve_no_systems_by_lapack():
    """As above, through all events of a motion."""
    box = ji.Box([0.2, 0.3, 0.1])
    system, law = ji.System(box, gravity=True), ji.Moreau(0.5, friction=0.3)

    def end(v):
        return ji.simulate(
            system, law, box.touching(), v, 0.2, samples=2, max_events=5
        ).velocity

    text = jax.jit(jax.vmap(end)).lower(np.zeros((4, 6))).as_text()
    assert not any(f"lapack_d{kernel}" in text for kernel in ("trsm", "getrf", "potrf"))


@pytest.mark.slow
def test_a_status_of_a_motion_is_a_row_of_the_one_table():
    ball = ji.System(lambda q: q, [1.0], potential=ji.gravity([1.0]))
    motion = ji.simulate(
        ball, ji.Newton(0.9), [1.0], [0.0], 20.0, samples=2, max_events=3
    )
    assert status_of(motion) == "max_events"
    assert "max_events" in str(motion).splitlines()[0]


@pytest.mark.slow
def test_discs_keep_their_angular_momentum():
    """Levers are those of the points in contact, also where discs overlap."""
    discs = piles.discs([1.0, 1.5], [0.1, 0.1])
    q = discs.at([[0.0, 0.0], [0.19, 0.045]])
    v = np.array([1.0, 0.2, 3.0, -1.0, 0.0, -2.0])
    motion = ji.simulate(
        ji.System(discs), ji.Moreau(0.3, friction=0.4), q, v, 0.01,
        samples=2, method="time_stepping", step=1e-3,
    )  # fmt: skip
    (x, y, _), (u, w, spin) = (
        np.reshape(a, (2, 2, 3)).transpose(2, 0, 1) for a in (motion.q, motion.velocity)
    )
    mass, radius = np.array([[1.0, 1.5]]), 0.1
    momentum = np.sum(mass * (x * w - y * u + 0.5 * radius**2 * spin), axis=1)
    assert abs(spin[1] - spin[0]).max() > 0.1
    np.testing.assert_allclose(momentum[1], momentum[0], atol=1e-13)


@pytest.mark.release
@pytest.mark.long_run
def test_flat_boxes_in_an_assembly_bounce_as_they_do_alone():
    """Which of them end early depends on rounding, which the law enlarges from bounce to bounce."""
    e, t1 = 0.9, np.sqrt(2 / G)
    expected = t1 + 2 * t1 * np.cumsum(e ** np.arange(1, 8))
    for width in (0.3, 0.5, 0.74, 0.8, 1.0, 1.2):
        for height in (0.3, 0.73):
            body = ji.Bodies([ji.Block(width, height)])
            system = ji.System(body, gravity=True)
            start = [0, 1 + height / 2, 0]
            motion = ji.simulate(
                system, ji.LZB(e, 1.0), start, [0.0, 0, 0], 10.0, samples=3
            )
            assert status_of(motion) == "ok"
            times = np.asarray(motion.event_times("impact"))[1:8]
            np.testing.assert_allclose(times, expected, rtol=1e-6)


@pytest.mark.release
def test_a_block_on_springs_passes_the_flat_position():
    """Both corners carry, one sticks: Radau with regularized friction gets through."""
    rng, cases = np.random.default_rng(11), []
    for _ in range(40):
        w, h, m = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.6), rng.uniform(0.5, 2)
        k, mu = 10 ** rng.uniform(3.3, 4.5), rng.uniform(0.05, 0.8)
        q = np.array([0, 0.5 * np.hypot(w, h) + 0.02, rng.uniform(-1, 1)])
        cases.append((w, h, m, k, mu, q, rng.normal(size=3) * [1, 1, 2] + [0, -1, 0]))

    def run(w, h, m, k, mu, q, v):
        block = ji.Block(w, h, m)
        law = ji.Compliant(ji.LinearSpring(k), friction=mu)
        return ji.simulate(
            ji.System(block, gravity=True), law, q, v, 0.35,
            method="contact_forces", samples=2, max_events=100,
        ).status  # fmt: skip

    columns = [jnp.asarray(np.stack(x)) for x in zip(*cases)]
    ends = jax.jit(jax.vmap(run))(*columns)
    assert {ji.STATUS[int(code)].name for code in ends} == {"ok"}


@pytest.mark.release
def test_a_domino_reaches_the_next_one():
    height, width, gap = 0.048, 0.0075, 0.0185
    bodies = ji.Bodies([ji.Block(width, height, mass=0.01)] * 2, pairs=[(0, 1)])
    q = np.array([0.0, height / 2, 0.0, width + gap, height / 2, 0.0])
    v = np.array([2 * height, 2 * width, -4.0, 0.0, 0.0, 0.0])
    motion = ji.simulate(
        ji.System(bodies, gravity=True), ji.Moreau(0.0, friction=0.2), q, v, 0.12,
        samples=24, max_events=200, method=ji.EventDriven(max_steps=2000),
    )  # fmt: skip
    assert status_of(motion) == "ok"
    times = np.asarray(motion.event_times("impact"))
    assert np.abs(times - 0.11298).min() < 1e-5


@pytest.mark.release
def test_a_corner_that_slides_over_an_edge_takes_no_energy():
    """Its normal jumps there: it strikes or parts. It lost .039 J, of which only the ledger told."""
    blocks = ji.Bodies(
        [ji.Block(0.3, 0.17), ji.Block(0.33, 0.16, mass=2.5)], pairs=[(0, 1)]
    )
    q = np.array([0, 0.085, 0, -0.025, 0.39, -1.0])
    system, law = ji.System(blocks, gravity=True), ji.Moreau(0.0, friction=0.1)

    def place(slip):
        v = jnp.array([0, 0, 0, 0.23, -0.06, 0.77]).at[3].add(slip)
        motion = ji.simulate(system, law, q, v, 0.5, samples=11, max_events=20)
        return motion.q[:, 4], motion

    slope, motion = jax.jacfwd(place, has_aux=True)(0.0)
    ji.raise_on_failure(motion)
    # 10 J; the step over the edge is right to its tolerance
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-8)
    known = np.isfinite(np.asarray(slope))
    assert known[:5].all()  # what comes before has derivatives
    assert not known[-3:].any()


@pytest.mark.release
def test_bodies_at_rest_stay_in_contact():
    """Rounding was a jump of a normal to them: a detachment at each sample, derivatives NaN."""
    beads = ji.System(ji.Column([1.0, 1.0]), gravity=True)

    def work(mass):
        column = eqx.tree_at(lambda s: s.body.mass, beads, mass)
        motion = ji.simulate(
            column, ji.LZB(0.5), [0.0, 0.0], [0.0, 0.0], 1.0, samples=11
        )
        return motion.q.sum() + motion.contact_work.sum(), motion.events.count

    slope, count = jax.jacfwd(work, has_aux=True)(jnp.ones(2))
    assert count == 0
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    block = ji.Block(0.2, 0.1)
    on_ground = ji.System(block, gravity=True)
    law = ji.LZB(0.5, friction=0.3)
    rest = ji.simulate(on_ground, law, block.touching(), [0.0] * 3, 1.0, samples=11)
    assert rest.events.count == 0


@pytest.mark.slow
def test_pendulums_that_swing_side_by_side_stay_together():
    """Their gaps accelerate by rounding alone, which was compared with itself: `max_steps`."""
    cradle = ji.System(ji.PendulumCradle([0.1] * 3, 0.15, 0.0125), gravity=True)

    def swing(angle, speed):
        start = jnp.full(3, angle), jnp.full(3, speed)
        return ji.simulate(cradle, ji.LZB(0.9), *start, 1.0, samples=6, max_events=4)

    angles, speeds = (
        jnp.array([-0.3, -0.2, 0.1, 0.0, 0.0]),
        jnp.array([0.0, 0.0, 0.0, 1.0, 0.3]),
    )
    motions = jax.jit(jax.vmap(swing))(angles, speeds)
    np.testing.assert_array_equal(motions.status, 0)
    np.testing.assert_array_equal(motions.events.count, 0)
    np.testing.assert_allclose(motions.q - motions.q[..., :1], 0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(("corners", "shares"), [("base", 1), (None, 2)])
def test_a_report_of_a_motion_has_no_friction_that_gives(corners, shares):
    """Mean slips of impacts gave energy where slip reverses: the sum is the work."""
    if corners is None:
        system = ji.System(ji.Disc(1.0, 0.2), gravity=True)
        start = [0.0, 1.4, 0.0], [2.0, 0.0, 0.0]
    else:
        system = ji.System(ji.Block(1.0, 1.0, corners=corners), gravity=True)
        start = [0.0, 0.9, 0.15], [0.0, 0.0, 0.0]
    motion = ji.simulate(system, ji.Moreau(0.5, friction=0.3), *start, 1.0)
    text = str(motion)
    assert "supplied" not in text
    assert ("contacts and friction absorbed" in text) == (shares == 1)
