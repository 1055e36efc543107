"""Worked motions: cradle, rocking block, shaken base, two balls; fits through motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import both_ways
from scipy.integrate import quad

import jimpact as ji

G = 9.80665


def kinds(motion):
    return motion.to_dict()["events"]["kind"]


def ended(motion):
    """Names of the statuses of a motion, or of a batch's."""
    lanes = [motion]
    if np.ndim(motion.status):
        lanes = [
            jax.tree.map(lambda x, i=i: x[i], motion) for i in range(len(motion.status))
        ]
    return [lane.to_dict()["status"] for lane in lanes]


@pytest.mark.release
def test_cradle_over_fifty_swings():
    """Repeatable, energy monotone, the ledger closes, and in the end all swing in phase."""
    system = ji.System(ji.PendulumCradle([0.1] * 3, 0.1, 0.01), gravity=True)
    period = 2 * np.pi * np.sqrt(0.1 / G)
    law = ji.LZB(0.95, exponent=1.5)

    def swing():
        return ji.simulate(
            system, law, [-0.3, 0, 0], [0.0] * 3, 50 * period, samples=1001
        )

    motion, again = swing(), swing()
    assert ended(motion) == ["ok"]
    for a, b in zip(jax.tree.leaves(motion), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    energy = np.asarray(motion.energy)
    assert np.diff(energy).max() < 1e-11 * energy[0]
    assert energy[-1] < 0.4 * energy[0]
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9 * energy[0])
    assert int(motion.events.count) > 200
    q = np.asarray(motion.q)
    spread = np.ptp(q, axis=1)
    assert spread[-100:].max() < 0.01 * np.abs(q[-100:]).max() < spread[:100].max()
    # inelastic impacts keep the momentum: a third of it is left in phase, a ninth of the energy each
    np.testing.assert_allclose(energy[-1] / energy[0], 1 / 3, atol=0.01)


def upright(theta, width=0.2, height=0.6):
    """A block standing on one corner."""
    half = abs(np.sin(theta)) * width / 2 + np.cos(theta) * height / 2
    return [0.0, half, theta]


@pytest.mark.slow
def test_free_rocking_to_rest():
    """Each impact keeps e of the angular velocity; swings last as Housner's quadrature says."""
    e = float(ji.theory.housner_restitution(3.0))
    motion = ji.simulate(
        ji.System(ji.Block(0.2, 0.6, corners="base"), gravity=True, friction=5.0),
        ji.RestitutionMatrix(ji.theory.rocking_matrix(e)),
        upright(0.15),
        [0.0] * 3,
        4.0,
        samples=81,
    )
    assert ended(motion) == ["ok"]
    last = int(motion.events.count) - 1
    assert kinds(motion) == ["impact"] * last + ["accumulation"]
    turning = np.abs(np.asarray(motion.events.velocity_after)[:20, 2])
    before = np.abs(np.asarray(motion.events.velocity_before)[:20, 2])
    np.testing.assert_allclose(turning / before, e, rtol=1e-9)
    # I_o theta'^2 / 2 = m g R (cos(alpha - theta_0) - cos(alpha - theta)) until theta = 0
    alpha, radius = np.arctan(1 / 3), np.hypot(0.1, 0.3)
    p = G * radius / (4 / 3 * radius**2)

    def slowness(
        s, top
    ):  # theta = top (1 - s^2) takes out the root at the turning point
        theta = top * (1 - s * s)
        if s == 0:
            return np.sqrt(4 * top / (2 * p * np.sin(alpha - top)))
        fall = 4 * p * np.sin(alpha - (top + theta) / 2) * np.sin(top * s * s / 2)
        return 2 * top * s / np.sqrt(fall)

    first = quad(slowness, 0, 1, args=(0.15,), epsabs=1e-12, epsrel=1e-12)[0]
    np.testing.assert_allclose(motion.events.time[0], first, atol=1e-8)
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-12)
    np.testing.assert_allclose(motion.gaps[-1], 0, atol=1e-12)
    assert (
        float(motion.events.time[last])
        < float(motion.events.accumulation_end[last])
        < 3
    )
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)


@pytest.mark.release
def test_a_corner_hops_while_the_other_is_the_pivot():
    """Short hops of one corner, in the steps in which the other strikes: none is missed."""
    motion = ji.simulate(
        ji.System(ji.Block(0.2, 0.6), gravity=True),
        ji.LZB(0.3, friction=0.8),
        upright(0.15),
        [0.0] * 3,
        3.0,
        samples=61,
    )
    assert ended(motion) == ["ok"]
    assert (
        100 < int(motion.events.count) < 200
    )  # 496 if each contact came to rest for itself
    assert int(motion.steps) < 10 * int(motion.events.count)
    energy = np.asarray(motion.energy)
    assert np.diff(energy).max() < 1e-11 * energy[0]
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)
    assert np.asarray(motion.gaps).min() > -1e-9
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-12)
    np.testing.assert_allclose(motion.gaps[-1, :2], 0, atol=1e-12)


@pytest.mark.release
def test_three_touching_beads_come_to_rest():
    """Nested accumulations: 4183 events if each contact came to rest for itself."""
    beads = 0.1 + 0.01 * np.array([1.0, 3.0, 5.0])

    def drop(slow):
        return ji.simulate(
            ji.System(ji.Column([0.1] * 3, 0.01), gravity=True),
            ji.LZB(0.9),
            beads,
            [0.0] * 3,
            2.0,
            method=ji.EventDriven(slow=slow),
        )

    motion, fine = drop(1e-6), drop(1e-10)
    last, late = int(motion.events.count) - 1, int(fine.events.count) - 1
    assert ended(motion) == ended(fine) == ["ok"]
    assert last < 400 < 4 * last < late
    rest = float(fine.events.time[late])
    assert (
        motion.events.time[last]
        < rest
        < motion.events.accumulation_end[last]
        < rest + 0.01
    )
    for found in (motion, fine):
        np.testing.assert_allclose(found.q[-1], beads - 0.1, atol=1e-12)
        np.testing.assert_allclose(found.ledger_residual, 0, atol=1e-13)


@pytest.mark.release
def test_open_contacts_take_no_part_in_an_impact():
    """Not by a law either that resolves the collisions to come (it knows no gravity meanwhile)."""
    beads, start = ji.System(ji.Column([0.1] * 3), gravity=True), [0.1, 0.101, 0.102]
    motion = ji.simulate(beads, ji.Binary(0.9), start, [0.0] * 3, 0.5, samples=2)
    count = int(motion.events.count)
    assert count > 10
    gaps = np.asarray(jax.vmap(beads.body.gap_function)(motion.events.q[:count]))
    assert gaps[np.asarray(motion.events.contacts)[:count]].max() < 1e-9


@pytest.mark.release
def test_an_overturned_block_lies_on_its_side():
    motion = ji.simulate(
        ji.System(ji.Block(0.2, 0.6), gravity=True),
        ji.LZB(0.3),
        upright(0.5),
        [0.0] * 3,
        3.0,
        samples=31,
    )
    assert ended(motion) == ["ok"]
    np.testing.assert_allclose(motion.q[-1], [0, 0.1, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(motion.gaps[-1], [0.2, 0, 0, 0.2], atol=1e-12)
    assert np.asarray(motion.gaps).min() > -1e-12
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)


@pytest.mark.release
def test_a_body_on_a_tilted_plane_slides():
    """By its tangents alone, no displacements: s'' = g (sin a - mu cos a)."""
    slope = ji.Bodies([ji.Block(0.2, 0.1)], planes=[0.3])
    system = ji.System(slope, gravity=True, friction=0.25)
    rest = [0.0] * 3
    motion = ji.simulate(
        system, ji.Moreau(0.0), slope.touching(), rest, 1.0, samples=11
    )
    assert ended(motion) == ["ok"]
    way = np.linalg.norm(np.asarray(motion.q[-1] - motion.q[0])[:2])
    assert way == pytest.approx(0.5 * G * (np.sin(0.3) - 0.25 * np.cos(0.3)), rel=1e-12)


@pytest.mark.release
def test_overturning_on_a_harmonic_base():
    """It stands still below a = g w / h, rocks above, and overturns on a stronger one."""
    law = ji.RestitutionMatrix(ji.theory.rocking_matrix(0.85))

    @jax.jit
    @jax.vmap
    def shake(acceleration):
        base = ji.HarmonicBase(
            -acceleration * G / (4 * jnp.pi) ** 2, 2.0, jnp.pi / 2, "horizontal"
        )
        start = base(jnp.zeros(()))[0]
        q0 = jnp.stack([start, jnp.full((), 0.3), jnp.zeros(())])
        return ji.simulate(
            ji.System(
                ji.Block(0.2, 0.6, corners="base"),
                gravity=True,
                base=base,
                friction=5.0,
            ),
            law,
            q0,
            jnp.zeros(3),
            2.0,
        )

    motion = shake(jnp.array([0.33, 0.36, 0.4, 0.6]))
    still, trembles, rocks, falls = np.nanmax(
        np.abs(np.asarray(motion.q)[..., 2]), axis=1
    )
    assert still < 1e-10
    # just above the threshold hops die out while the base shakes
    assert ended(motion)[1] == "ok"
    assert 1e-4 < trembles < np.pi / 2
    assert 0.1 < rocks < np.pi / 2 < falls
    np.testing.assert_allclose(motion.ledger_residual[:3], 0, atol=1e-9)


@pytest.mark.release
@pytest.mark.parametrize("law", [ji.LZB(0.9, exponent=1.5), ji.Binary(0.9)])
def test_basketball_and_tennis_ball(law):
    """With a gap they collide one after another, whatever the law; (1 + e)^2 v - v of a light one."""
    e, v = 0.9, np.sqrt(2 * G)

    def rebound(light, gap):
        system = ji.System(
            ji.Column(jnp.stack([0.6, light]), [0.12, 0.033]), gravity=True
        )
        q0 = jnp.stack([jnp.full((), 1.12), 1.12 + 0.12 + 0.033 + gap])
        motion = ji.simulate(system, law, q0, jnp.zeros(2), 0.6, samples=13)
        return motion.events.velocity_after[:2], motion.status

    light, gap = jnp.array([0.06, 0.06, 0.06, 6e-7]), jnp.array([0.0, 1e-6, 1e-2, 1e-4])
    after, status = jax.jit(jax.vmap(rebound))(light, gap)
    assert (status == 0).all()
    np.testing.assert_allclose(after[1:, 0], np.tile([e * v, -v], (3, 1)), rtol=1e-12)
    wait = gap / ((1 + e) * v)
    binary = ((1 + e) ** 2 * 0.6 / (0.6 + light) - 1) * v - G * wait
    np.testing.assert_allclose(after[1:, 1, 1], binary[1:], rtol=1e-9)
    np.testing.assert_allclose(after[3, 1, 1], ((1 + e) ** 2 - 1) * v, rtol=1e-4)
    # without one they are one impact
    together = ji.impact(law, ji.chain([0.06, 0.6], wall="right"), [v, v]).velocity
    np.testing.assert_allclose(after[0, 0], -together[::-1], rtol=1e-7)


def collides(x):
    system = ji.System(ji.PendulumCradle([0.1] * 3, 0.1, 0.01), gravity=True)
    start = jnp.stack([-x[1], 0 * x[1], 0 * x[1]])
    law = ji.LZB(x[0], rtol=1e-11)  # differences see the tolerance of the law, too
    return system, law, start, jnp.zeros(3).at[0].set(x[2]), 0.6


def shaken(x):
    system = ji.System(ji.Column([1.0]), gravity=True, base=ji.HarmonicBase(x[0], x[1]))
    return system, ji.Newton(x[2]), [0.2], [0.0], 1.0


@pytest.mark.parametrize(
    ("given", "at", "events", "step", "allowed"),
    [
        pytest.param(
            collides, [0.9, 0.3, 0.1], 2, 1e-4, 1e-8, marks=pytest.mark.release
        ),
        # the plate of 2 cm: differences see no more
        pytest.param(
            shaken, [0.02, 5.0, 0.7], 3, 4e-6, 1e-7, marks=pytest.mark.release
        ),
    ],
)
def test_derivatives_of_a_motion_against_differences(given, at, events, step, allowed):
    """Of the end, event times and the ledger; differences at a finer tolerance."""

    def run(x, rtol=1e-10):
        method = ji.EventDriven(rtol=rtol, atol=rtol / 100)
        motion = ji.simulate(*given(x), samples=4, max_events=60, method=method)
        assert motion.events.time.shape == (60,)
        end = [motion.q[-1], motion.velocity[-1], motion.contact_work[-1].ravel()]
        return jnp.concatenate(
            [*end, motion.base_work[-1:], motion.events.time[:events]]
        )

    x = jnp.array(at)
    if given is collides:  # the way back through a law's plan is another test's
        forward = jax.jit(jax.jacfwd(run))(x)
    else:
        _, forward, reverse = both_ways(run)(x)
        np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-12)
    moves = jnp.concatenate([k * step * jnp.eye(3) for k in (1, -1, 2, -2)])
    fine = jax.jit(jax.vmap(lambda x: run(x, 1e-12)))(x[None] + moves).reshape(4, 3, -1)
    differences = (8 * (fine[0] - fine[1]) - (fine[2] - fine[3])) / (12 * step)
    np.testing.assert_allclose(forward, differences.T, rtol=allowed, atol=allowed / 10)
