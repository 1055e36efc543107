"""Worked motions by time stepping: blocks that overturn, bricks and cubes in space."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piles
import pytest
from programs import CODE
from refusals import argument
from scipy.integrate import solve_ivp

import jimpact as ji

G = 9.80665


def status(motion):
    return motion.to_dict()["status"]


class Pulse(eqx.Module):
    """One period of a sine: the horizontal acceleration of the ground."""

    amplitude: jax.Array
    frequency: jax.Array

    def __call__(self, t):
        phase = jnp.clip(self.frequency * t, 0, 2 * jnp.pi)
        x = self.amplitude / self.frequency**2 * (phase - jnp.sin(phase))
        return jnp.stack([x, 0 * x])


def overturns(width, height, amplitude, frequency, duration):
    """Housner's block: rocks about one corner at a time, angular momentum kept at each change."""
    far, slender = np.hypot(width, height) / 2, np.arctan2(width, height)
    stiffness, kept = 3 * G / (4 * far), 1 - 1.5 * np.sin(slender) ** 2

    def pull(t):
        return (
            amplitude / G * np.sin(frequency * t) if t < 2 * np.pi / frequency else 0.0
        )

    if amplitude <= G * np.tan(slender):
        return False
    t = np.arcsin(G * np.tan(slender) / amplitude) / frequency
    side, angle, spin = -1.0, -1e-14, 0.0
    while True:

        def field(t, y, side=side):
            a = side * slender - y[0]
            return [y[1], -stiffness * (np.sin(a) + pull(t) * np.cos(a))]

        def lands(s, y, begin=t, side=side):
            return y[0] if s > begin + 1e-9 else side

        def falls(t, y):
            return abs(y[0]) - np.pi / 2

        lands.terminal = falls.terminal = True
        path = solve_ivp(
            field, (t, duration), [angle, spin], events=[lands, falls],
            rtol=1e-9, atol=1e-12, max_step=0.02,
        )  # fmt: skip
        if path.t_events[1].size:
            return True
        if not path.t_events[0].size:
            return False
        t, spin, angle = path.t_events[0][0], path.y_events[0][0][1] * kept, 0.0
        if abs(spin) < 1e-4:
            return False
        side = np.sign(spin)


@pytest.mark.release
def test_pulses_overturn_the_blocks_that_housner_says():
    """24 pulses; a fallen block lies on its side, on corners that did not touch before."""
    width, height, fallen = 0.2, 1.0, 0
    for strength in (1.2, 2.0, 3.0, 5.0, 8.0, 12.0):
        for frequency in (3.0, 6.0, 12.0, 24.0):
            amplitude = strength * G * width / height
            base = Pulse(jnp.asarray(amplitude), jnp.asarray(frequency))
            motion = ji.simulate(
                ji.System(ji.Block(width, height), gravity=True, base=base), ji.Moreau(0.0, friction=1.0),
                [0.0, height / 2, 0.0], [0.0] * 3, 6.0,
                samples=2, method="time_stepping", step=2e-3,
            )  # fmt: skip
            expected = overturns(width, height, amplitude, frequency, 6.0)
            assert status(motion) == "ok", (strength, frequency)
            angle = abs(float(motion.q[-1, 2]))
            np.testing.assert_allclose(angle, np.pi / 2 if expected else 0.0, atol=0.02)
            fallen += expected
    assert 12 < fallen < 24


class Table(ji.Body):
    """A point above a table that ends at x = 1."""

    def gap_function(self, q):
        return q[1:]

    def valid(self, q):
        return 1 - q[0]

    @property
    def mass(self):
        return jnp.ones(2)

    def gravity(self, acceleration):
        return lambda q: acceleration * q[1]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"method": "time_stepping", "step": 1e-2}])
def test_leaving_the_range_of_a_gap_function_is_reported(options):
    system = ji.System(Table(), potential=Table().gravity(G))
    motion = ji.simulate(
        system, ji.Moreau(0.5), [0.0, 0.1], [1.0, 0.0], 2.0, samples=11, **options
    )
    assert status(motion) == "out_of_range"
    assert (
        5 <= np.isfinite(np.asarray(motion.q[:, 0])).sum() <= 7
    )  # x = 1 at the sixth sample
    with pytest.raises(ValueError, match=argument("q0", "-0.5")):
        ji.simulate(system, ji.Moreau(0.5), [1.5, 0.1], [1.0, 0.0], 2.0, **options)


def test_an_impact_is_in_the_middle_of_its_step():
    """`v(t) = e (|v-| + G h / 2) - G (t - h / 2)` of a point that strikes in the first step."""
    system = ji.System(Table(), potential=Table().gravity(G))
    e, h, t = 0.5, 1e-2, 0.2
    motion = ji.simulate(
        system, ji.Moreau(e), [0.0, 0.0], [0.0, -10.0], 2.0,
        samples=11, method="time_stepping", step=h,
    )  # fmt: skip
    after = e * (10.0 + 0.5 * G * h) - G * (t - 0.5 * h)
    np.testing.assert_allclose(motion.velocity[1], [0.0, after], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_a_superball_leaves_with_its_slip_reversed():
    """`u+ = -e_t u-` of the contact point, with friction enough: one impact, and free flight."""
    disc, e_t = ji.Disc(0.5), 0.6
    law = ji.Moreau(0.8, friction=50.0, tangential_restitution=e_t)
    motion = ji.simulate(
        ji.System(disc, gravity=G), law, [0.0, 0.5, 0.0], [1.0, -5.0, 3.0], 0.02,
        samples=2, method="time_stepping", step=1e-3,
    )  # fmt: skip
    x, _, spin = motion.velocity[-1]
    np.testing.assert_allclose(x + 0.5 * spin, -e_t * (1.0 + 0.5 * 3.0), rtol=1e-6)
    np.testing.assert_allclose(
        x - 1.0, 0.5 * 0.5 * (spin - 3.0), rtol=1e-6
    )  # m x' r = I spin


@pytest.mark.release
def test_a_spinning_brick_comes_to_rest_on_a_face():
    brick = ji.Box([0.1, 0.06, 0.04], mass=0.5)
    motion = ji.simulate(
        ji.System(brick, gravity=True), ji.Moreau(0.3, friction=0.4),
        brick.at([0.0, 0.0, 0.3], [0.8, 0.6, 0.0, 0.0]), [0.5, 0.2, 0.0, 3.0, 12.0, 5.0], 2.0,
        samples=21, method="time_stepping", step=1e-3,
    )  # fmt: skip
    assert status(motion) == "ok"
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-8)
    assert np.diff(motion.energy).max() < 1e-12
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-10)
    heights = np.sort(np.asarray(motion.gaps[-1]))
    np.testing.assert_allclose(heights[:4], 0, atol=2e-4)
    assert min(abs(heights[4:].mean() - side) for side in (0.1, 0.06, 0.04)) < 2e-4
    np.testing.assert_allclose(np.linalg.norm(motion.q[:, 3:], axis=1), 1, atol=1e-14)


def stepped(system, law, q0, v0):
    options = {"samples": 3, "method": ji.TimeStepping(1e-3, closed_below=1e-4)}
    return ji.simulate(system, law, q0, v0, 0.01, **options)


def lost(q):
    """A gap that is NaN below 0.5."""
    return jnp.where(q < 0.5, jnp.nan, q)


def shrinking(q):
    """A mass that turns negative below 0.5."""
    return q - 0.5


@pytest.mark.parametrize(
    ("gap", "mass", "restitution", "expected"),
    [
        (lost, [1.0], 0.5, "not_finite"),
        (lambda q: q, shrinking, 0.5, "singular_mass"),
        (lambda q: q - 0.5, [1.0], np.nan, "law_failed"),
    ],
)
def test_what_goes_wrong_on_the_way_is_reported(gap, mass, restitution, expected):
    run = jax.jit(
        lambda e: stepped(ji.System(gap, mass), ji.Moreau(e), [0.5003], [-1.0])
    )
    assert status(run(restitution)) == expected


@pytest.mark.slow
def test_a_motion_says_how_its_law_fails():
    motion = stepped(ROW, ji.Moreau(1.0), [0.0, 0.3, 0.6], [0.0] * 3)
    codes = motion.events.status.at[0].set(
        [x.name for x in ji.STATUS].index("negative_impulse")
    )
    failed = eqx.tree_at(
        lambda m: (m.status, m.events.status),
        motion,
        (jnp.int32(CODE["law_failed"]), codes),
    )
    with pytest.raises(RuntimeError, match=r"law_failed: .*: negative_impulse"):
        ji.raise_on_failure(failed)


def test_friction_below_0_is_reported():
    run = jax.jit(
        lambda mu: stepped(
            ji.System(ji.Block(0.2, 0.4), gravity=True),
            ji.Moreau(0.0, friction=mu),
            [0.0, 0.2, 0.0],
            [1.0, 0.0, 0.0],
        )
    )
    assert status(run(-0.3)) == "law_failed"


@pytest.mark.slow
def test_a_quaternion_of_length_2_is_reported():
    ball = ji.Sphere(0.1)
    run = jax.jit(lambda q: stepped(ji.System(ball), ji.Moreau(0.5), q, jnp.zeros(6)))
    assert status(run(ball.at([0.0, 0.0, 0.2]).at[3].set(2.0))) == "out_of_range"


ROW = ji.System(lambda q: q[1:] - q[:-1] - 0.2, [1.0, 1.0, 1.0])


def test_an_elastic_row_never_gains_energy():
    """The left ball strikes while the other two still leave each other."""
    motion = stepped(ROW, ji.Moreau(1.0), [0.0, 0.2004, 0.4004], [1.0, 0.0, 0.1])
    np.testing.assert_allclose(
        motion.kinetic_energy, motion.kinetic_energy[0], rtol=1e-8
    )


def test_impacts_closer_than_a_step_are_one():
    """The right ball is nearer by what it moves in 3 and in 0.1 steps: two impacts, and one."""
    for steps, after in ((3.0, [-2.0, 0.0, 1.0]), (0.1, [-5 / 3, -2 / 3, 4 / 3])):
        first, late = 2.5e-3, steps * 1e-3
        start = [-0.2 - first - late, 0.0, 0.2 + 2 * first]
        motion = stepped(ROW, ji.Moreau(1.0), start, [1.0, 0.0, -2.0])
        np.testing.assert_allclose(motion.velocity[-1], after, atol=1e-8)


@pytest.mark.release
def test_a_tossed_block_never_gains_energy():
    """From step to step: at rest, in a stop, with unequal e, in impacts whose slip turns round."""
    rng, n = np.random.default_rng(0), 60
    q = np.stack([np.zeros(n), np.full(n, 0.35), rng.uniform(-3, 3, n)], axis=1)
    v = rng.normal(size=(n, 3)) * [1, 1, 5]
    e, mu, e_t = (np.repeat(rng.uniform(low, 1, (n, 1)), 4, 1) for low in (0, 0, -1))
    e[n // 2 :] = rng.uniform(size=(n // 2, 4))
    e_t[::2] = 0

    @jax.jit
    @jax.vmap
    def toss(q, v, e, mu, e_t):
        return ji.simulate(
            ji.System(ji.Block(0.2, 0.4), gravity=True), ji.Moreau(e, friction=mu, tangential_restitution=e_t),
            q, v, 0.6, samples=601, method="time_stepping", step=1e-3,
        )  # fmt: skip

    motion = toss(q, v, e, mu, e_t)
    assert np.isin(motion.status, [CODE["ok"], CODE["coarse_step"]]).all()
    assert np.diff(motion.energy, axis=1).max() < 1e-6
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)


@pytest.mark.parametrize(
    ("law", "named"),
    [
        (ji.Moreau(jnp.full(3, 0.5)), "`restitution`"),
        (
            ji.Moreau(0.5, friction=0.3, tangential_restitution=jnp.zeros(3)),
            "`tangential_restitution`",
        ),
    ],
)
def test_coefficients_that_do_not_fit_are_named(law, named):
    pile = piles.discs(1.0, [0.1, 0.1], planes=[[0.0, 1.0, 0.0]])
    for body, q0 in (
        (pile, pile.at([[0.0, 0.1], [0.5, 0.1]])),
        (ji.Block(0.2, 0.4), [0, 0.2, 0]),
    ):
        with pytest.raises(ValueError, match=named):
            stepped(ji.System(body), law, q0, np.zeros(len(q0)))


def test_tangents_that_do_not_fit_are_named():
    system = ji.System(
        lambda q: q[:1], [1.0, 1.0], tangent_function=lambda q: q[jnp.array([1] * 3)]
    )
    with pytest.raises(ValueError, match=argument("system")):
        stepped(system, ji.Moreau(0.5, friction=0.2), [1.0, 0.0], [0.0, 0.0])


@pytest.mark.parametrize("options", [{}, {"method": "time_stepping", "step": 1e-2}])
@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"force": lambda q, v, t: v[:1]}, r"`force` that returns shape \(2,\)"),
        (
            {"gap_function": lambda q: q[None]},
            r"`gap_function` that returns shape \(m,\)",
        ),
        (
            {"gap_function": lambda q: q[:0]},
            r"each of m >= 1 contacts, but it returns \(0,\)",
        ),
        ({"potential": lambda q: q}, r"`potential` that returns shape \(\)"),
        ({"tangent_function": lambda q: q[None]}, r"`tangent_function` that returns"),
        (
            {"base": lambda t: jnp.stack([t, t]), "base_directions": [[1.0], [0.0]]},
            "`base` that",
        ),
        (
            {"base": lambda t: t, "base_directions": [[1.0]]},
            "`base_directions` must have shape",
        ),
        ({"force": lambda q, v: v}, r"`force` that takes JAX arrays \(q, v, t\)"),
        (
            {"force": lambda q, v, t: np.asarray(v)},
            "`force` .* raises TracerArrayConversionError",
        ),
        ({"force": lambda q, v, t: None}, "`force` .* returns None"),
        ({"gap_function": lambda q: [q[0]]}, "`gap_function` .* raises TypeError"),
        ({"gap_function": lambda q: 1}, "`gap_function` that returns floating numbers"),
    ],
)
def test_functions_of_a_system_must_return_what_they_should(given, named, options):
    system = ji.System(
        **({"gap_function": lambda q: q[:1], "mass": [1.0, 1.0]} | given)
    )
    with pytest.raises((ValueError, TypeError), match=named):
        ji.simulate(system, ji.Moreau(0.5), [1.0, 0.0], [0.0, 0.0], 1.0, **options)


@pytest.mark.parametrize("options", [{}, {"method": "time_stepping", "step": 1e-2}])
@pytest.mark.parametrize(
    "given",
    [
        {"mass": lambda q: jnp.ones(1)},
        {"force": lambda q, v, t: jnp.ones(1)},
        {"potential": lambda q: jnp.ones(())},
    ],
)
def test_functions_of_a_system_compute_in_the_precision_of_the_start(given, options):
    one = np.ones(1, np.float32)
    system = ji.System(**({"gap_function": lambda q: q, "mass": one} | given))
    name = next(iter(given))
    with pytest.raises(
        TypeError, match=f"precision of `q0`, float32, but its `{name}` returns"
    ):
        ji.simulate(system, ji.Moreau(np.float32(0.5)), one, 0 * one, 1.0, **options)


def test_a_disc_without_walls_is_refused():
    disc = piles.discs(1.0, [0.1])
    with pytest.raises(ValueError, match=argument("system")):
        stepped(ji.System(disc), ji.Moreau(0.5), disc.at([[0.0, 1.0]]), np.zeros(3))


@pytest.mark.slow
def test_a_motion_is_in_the_widest_precision_given():
    """A start in single precision, of a body in double; whole forces."""
    system = ji.System(
        lambda q: q[1:] - q[:-1] - 0.2,
        [1.0] * 3,
        force=lambda q, v, t: jnp.zeros(3, int),
    )
    start = np.array([0.0, 0.3, 0.6], np.float32), np.zeros(3, np.float32)
    with jax.numpy_dtype_promotion("standard"):
        assert stepped(system, ji.Moreau(1.0), *start).q.dtype == jnp.float64


class Apart(ji.Body):
    """Two balls on a line, whose gap grows again once they have passed each other."""

    def gap_function(self, q):
        return jnp.abs(q[1:] - q[:1]) - 0.2

    @property
    def mass(self):
        return jnp.ones(2)


LINE = (1.0, -1.0)


PLANE = (
    1.0,
    0.0,
    0.0,
    -1.0,
    0.0,
    0.0,
    0.0,
    0.0,
    0.0,
)  # of two; the third flies away much faster


DISCS = ji.Bodies([ji.Disc(0.1)] * 3, planes=[], pairs=[(0, 1), (2, 0)])


@pytest.mark.release
@pytest.mark.parametrize(
    ("body", "way", "speed", "expected"),
    [
        (Apart(), LINE, 50.0, "coarse_step"),
        (DISCS, PLANE, 50.0, "coarse_step"),
        pytest.param(DISCS, PLANE, 3.0, "ok", marks=pytest.mark.release),
    ],
)
def test_bodies_that_pass_each_other_in_a_step_are_reported(body, way, speed, expected):
    """Steps of .01 s; the status does not depend on where in a step they meet."""
    way = jnp.array(way)
    aside = jnp.zeros(len(way)).at[6:7].set(1.0)  # x of the third

    @jax.jit
    @jax.vmap
    def run(start):
        return ji.simulate(
            ji.System(body), ji.Moreau(0.5), 10 * aside - start * way, 1e4 * aside + speed * way, 0.1,
            samples=2, method="time_stepping", step=1e-2,
        )  # fmt: skip

    motion = run(0.12 + jnp.array([0.0, 0.1, 0.3, 0.7, 0.9, 1.3]) * 0.5 * speed / 50)
    passed = motion.velocity[:, -1, int(np.argmin(way))] < 0
    reported = motion.status == CODE["coarse_step"]
    assert (reported == passed).all()
    assert bool(passed.any()) == (expected == "coarse_step")


def test_steps_too_many_to_count_are_refused():
    with pytest.raises(ValueError, match=argument("step", "1e-300")):
        ji.simulate(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Moreau(0.5),
            [1.0],
            [0.0],
            1.0,
            method="time_stepping",
            step=1e-300,
        )


def slid_off(**options):
    """A block slides over the right end of a heavy table, 2 m wide, and falls to the ground."""
    bodies = ji.Bodies(
        [ji.Block(2.0, 1.0, mass=1e6), ji.Block(0.4, 0.2)], planes=[0.0], pairs=[(1, 0)]
    )
    system = ji.System(bodies, gravity=True)
    law, start = ji.Moreau(0.3, friction=0.2), [0.0, 0.5, 0.0, 0.7, 1.1, 0.0]
    return ji.simulate(
        system, law, start, [0.0, 0.0, 0.0, 1.5, 0.0, 0.0], 2.0, **options
    )


# Friction moves the middle of the normal forces forward by mu h / 2 = .02 m: the block topples as
# soon as its own middle is that far from the edge at x = 1 m.
TOPPLES = (1.5 - np.sqrt(1.5**2 - 2 * 0.2 * G * 0.28)) / (0.2 * G)


@pytest.mark.release
def test_a_block_slides_off_a_table():
    motion = slid_off(samples=201, method="time_stepping", step=1e-3)
    ji.raise_on_failure(motion)
    time, (x, y, angle) = np.asarray(motion.time), np.asarray(motion.q)[:, 3:].T
    slides = time < TOPPLES - 0.005
    np.testing.assert_allclose(angle[slides], 0, atol=1e-6)
    np.testing.assert_allclose(
        x[slides], (0.7 + 1.5 * time - 0.1 * G * time**2)[slides], atol=1e-6
    )
    assert (angle[(time > TOPPLES + 0.05) & (time < TOPPLES + 0.3)] < -1e-3).all()
    np.testing.assert_allclose([y[-1], angle[-1]], [0.1, 0.0], atol=1e-4)
    assert x[-1] > 1.2
    assert (
        float(np.nanmin(motion.gaps)) > -1e-2
    )  # Moreau and Jean: h times the approach


@pytest.mark.release
def test_a_block_topples_off_a_table_at_its_moment():
    motion = ji.raise_on_failure(slid_off(samples=41))
    assert float(motion.event_times("detachment")[0]) == pytest.approx(
        TOPPLES, abs=1e-7
    )
    np.testing.assert_allclose(motion.q[-1, 4:], [0.1, 0.0], atol=1e-9)
    assert float(np.nanmin(motion.gaps)) > -1e-9
