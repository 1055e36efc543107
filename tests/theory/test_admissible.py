"""The set of all admissible outcomes: closed forms, independent oracles, its picture."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument
from scipy.optimize import minimize

import jimpact as ji
from jimpact.plot import admissible_set as plot_admissible_set
from jimpact.theory import admissible_set

BALLS, V = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
THREE = admissible_set(BALLS, V)


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), 0, tolerance)


def rigid(inertia, *points):
    """A block above the ground that touches it at x = points; coordinates (x, y, angle)."""
    return ji.Scene(
        [1.0, 1.0, inertia], [[0] * len(points), [1] * len(points), list(points)]
    )


def parts(scene):
    """M, N of the closed contacts and W = N^T M^-1 N in plain numpy."""
    mass = np.asarray(scene.mass)
    mass = np.diag(mass) if mass.ndim == 1 else mass
    normals = np.asarray(scene.normals)[:, np.asarray(scene.closed)]
    return mass, normals, normals.T @ np.linalg.solve(mass, normals)


def energy(scene, velocity):
    mass, _, _ = parts(scene)
    return 0.5 * np.einsum("...i,ij,...j->...", velocity, mass, velocity)


# --- closed forms ---------------------------------------------------------------------------


def test_arc_of_three_equal_balls():
    phi = np.linspace(0, np.pi / 3, 9)[:, None]
    a, b = np.array([-1, -1, 2]) / np.sqrt(6), np.array([-1, 1, 0]) / np.sqrt(2)
    arc = THREE.conserving_arc(9)
    close(arc, 1 / 3 + np.sqrt(2 / 3) * (np.cos(phi) * a + np.sin(phi) * b))
    close(arc[0], [0, 0, 1])
    close(arc[-1], [-1 / 3, 2 / 3, 2 / 3])
    close(np.sum(arc**4, axis=1), 1 + 4 * arc.prod(axis=1))
    assert (np.sum(arc**4, axis=1) >= 11 / 27 - 1e-12).all()
    close(np.sum(arc**2, axis=1), np.ones(9))
    close(THREE.plastic, np.full(3, 1 / 3))
    close(THREE.least_energy, 1 / 6)
    close(THREE.bounds, [[-1 / 3, 1 / 3], [0, 2 / 3], [1 / 3, 1]])
    assert (THREE.dimension, THREE.energy) == (2, 0.5)


def test_boundary_of_three_equal_balls():
    boundary = THREE.boundary(50)
    assert THREE.contains(boundary, 1e-10).all()
    corners = [[1 / 3, 1 / 3, 1 / 3], [0, 0, 1], [-1 / 3, 2 / 3, 2 / 3]]
    for corner in corners:
        close(np.abs(boundary - corner).sum(axis=1).min(), 0.0)
    u = (boundary - THREE.centre) @ THREE.axes  # unit masses
    following = np.roll(u, -1, axis=0)
    area = 0.5 * np.sum(u[:, 0] * following[:, 1] - u[:, 1] * following[:, 0])
    close(
        area, 0.5 * (2 / 3) * np.pi / 3, 1e-4
    )  # a sector of 60 degrees, counter-clockwise
    beyond = THREE.centre + 1.001 * (boundary - THREE.sample(0, 500).mean(axis=0))
    assert THREE.contains(boundary).all()
    assert not THREE.contains(
        beyond + THREE.sample(0, 500).mean(axis=0) - THREE.centre
    ).any()


def test_arc_of_unequal_balls_ends_where_a_contact_stays_closed():
    scene, v = ji.chain([1.0, 2.0, 3.0]), np.array([1.0, 0.3, -0.4])
    found = admissible_set(scene, v)
    a, b = found.conserving_arc(2)
    close(np.diff(a)[0], 0.0)
    close(np.diff(b)[1], 0.0)
    close(energy(scene, np.stack([a, b])), np.full(2, energy(scene, v)))
    close([a @ [1, 2, 3], b @ [1, 2, 3]], np.full(2, v @ [1, 2, 3]))


def test_arc_cut_by_impulse_free_contact():
    """Slender block, G_12 = 1/4, qn- = (0, -1): ends pbar = (0, 2) and pbar = (0.8, 0.8)."""
    scene = rigid(5 / 12, 0.5, -0.5)
    g = np.asarray(ji.theory.normalized_delassus(scene))
    close(g[0, 1], 0.25)
    norm = np.sqrt(np.diag(parts(scene)[2]))
    mass, normals, _ = parts(scene)
    v = np.linalg.solve(mass, normals / norm) @ np.linalg.solve(g, [0.0, -1.0])
    found = admissible_set(scene, v)
    ends = found.conserving_arc(2) @ normals / norm
    close(ends, [[0.5, 1.0], [1.0, 0.0]])
    close(np.linalg.solve(g, (ends - [0.0, -1.0]).T).T, [[0, 2], [0.8, 0.8]])
    close(found.plastic @ normals / norm, [0.25, 0.0])


def test_two_bodies_are_a_segment():
    found = admissible_set(ji.chain([1.0, 2.0]), [1.0, 0.0])
    assert found.dimension == 1
    close(found.bounds, [[-1 / 3, 1 / 3], [1 / 3, 2 / 3]])
    close(found.least_energy, 1 / 6)
    with pytest.raises(ValueError, match="dimension 1"):
        found.conserving_arc()
    with pytest.raises(ValueError, match="dimension 1"):
        found.boundary()


def test_nothing_approaches():
    for v in ([0.0, 0.0, 1.0], [0.3, 0.3, 0.3], [0.0, 0.0, 0.0]):
        found = admissible_set(BALLS, v)
        assert found.dimension == 0
        assert found.contains(v)
        assert not found.contains([0.0, 0.5, 0.5])
        close(found.bounds, np.stack([v, v], axis=1))
        close(found.sample(0, 3), np.stack([v] * 3))
        close([found.energy, found.plastic.sum()], [found.least_energy, sum(v)])
        assert "one admissible outcome" in str(found)


def test_open_contacts_take_no_part():
    found = admissible_set(ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 0.2]), V)
    close(found.bounds, [[0, 0.5], [0.5, 1], [0, 0]])
    assert not found.contains([0, 0, 1])


# --- redundant contacts, walls, constraints ---------------------------------------------------


def test_body_between_walls_has_one_outcome():
    found = admissible_set(ji.chain([1.0], wall="both"), [1.0])
    assert found.dimension == 0
    close(found.plastic, [0.0])
    found = admissible_set(ji.chain([1.0, 2.0, 3.0], wall="both"), [1.0, 0.0, -0.3])
    close(found.bounds, np.zeros((3, 2)))


def test_redundant_contact_changes_nothing():
    """A contact between two others of a rigid block is implied by them."""
    v = [0.2, -1.0, 0.3]
    two = admissible_set(rigid(0.4, 0.5, -0.5), v)
    three = admissible_set(rigid(0.4, 0.5, 0.1, -0.5), v)
    assert three.dimension == 2
    close(three.bounds, two.bounds, 1e-10)
    close(three.conserving_arc(5), two.conserving_arc(5), 1e-10)
    close(three.plastic, two.plastic, 1e-10)
    assert three.contains(two.sample(0, 200)).all()
    assert two.contains(three.sample(0, 200)).all()


def test_constraints_tie_bodies():
    """Three balls, the last two tied, are two balls of masses 1 and 2."""
    normals = np.asarray(BALLS.normals)
    tied = ji.Scene(np.ones(3), normals[:, :1], constraints=[[0.0], [1.0], [-1.0]])
    found = admissible_set(tied, V)
    close(found.bounds, [[-1 / 3, 1 / 3], [1 / 3, 2 / 3], [1 / 3, 2 / 3]])
    # a contact that the constraint holds anyway
    held = ji.Scene(np.ones(3), normals, constraints=[[0.0], [1.0], [-1.0]])
    close(admissible_set(held, V).bounds, found.bounds)
    with pytest.raises(ValueError, match=argument("velocity")):
        admissible_set(tied, [1.0, 0.0, 0.5])


# --- oracles ----------------------------------------------------------------------------------


def random_impact(generator, m):
    n = m + int(generator.integers(0, 2))
    a = generator.normal(size=(n, n))
    scene = ji.Scene(a @ a.T + np.eye(n), generator.normal(size=(n, m)))
    return scene, generator.normal(size=n)


def plastic_by_enumeration(scene, v):
    """0 <= gamma- + W p perpendicular to p >= 0, by all supports."""
    mass, normals, w = parts(scene)
    gamma = normals.T @ v
    m = len(gamma)
    for size in range(m + 1):
        for support in map(list, combinations(range(m), size)):
            p = np.zeros(m)
            p[support] = -np.linalg.solve(w[np.ix_(support, support)], gamma[support])
            if (p >= -1e-12).all() and (gamma + w @ p >= -1e-12).all():
                return v + np.linalg.solve(mass, normals @ p)
    raise AssertionError("no support fits")


def bound_by_slsqp(scene, v, i, sign, start):
    mass, normals, w = parts(scene)
    gamma, to_v = normals.T @ v, np.linalg.solve(mass, normals)
    rules = [
        {"type": "ineq", "fun": lambda p: gamma + w @ p},
        {"type": "ineq", "fun": lambda p: -(2 * gamma + w @ p) @ p},
    ]
    done = minimize(
        lambda p: sign * (v + to_v @ p)[i],
        start,
        method="SLSQP",
        bounds=[(0, None)] * len(gamma),
        constraints=rules,
        options={"ftol": 1e-13, "maxiter": 500},
    )
    return (v + to_v @ done.x)[i] if done.success else None


def test_random_scenes_against_oracles():
    generator, compared = np.random.default_rng(0), 0
    for k in range(24):
        scene, v = random_impact(generator, 1 + k % 4)
        found = admissible_set(scene, v)
        close(found.plastic, plastic_by_enumeration(scene, v), 1e-10)
        if found.dimension == 0:
            continue
        samples = found.sample(k, 300)
        mass, normals, w = parts(scene)
        p = np.linalg.solve(w, normals.T @ (samples - v).T).T
        close(samples, v + p @ np.linalg.solve(mass, normals).T, 1e-10)
        assert p.min() >= -1e-10
        assert (samples @ normals).min() >= -1e-10
        assert energy(scene, samples).max() <= found.energy * (1 + 1e-12)
        assert energy(scene, samples).min() >= found.least_energy * (1 - 1e-12) - 1e-12
        assert found.contains(samples, 1e-9).all()
        assert (samples >= found.bounds[:, 0] - 1e-9).all()
        assert (samples <= found.bounds[:, 1] + 1e-9).all()
        for i, column in ((0, 0), (len(v) - 1, 1)):
            oracle = bound_by_slsqp(scene, v, i, 1 - 2 * column, p.mean(axis=0))
            if oracle is not None:
                close(found.bounds[i, column], oracle, 1e-6)
                compared += 1
    assert compared >= 24


def test_contains_agrees_with_the_definition():
    """Random impulses, admissible or not, against gamma+, p and T+ computed by hand."""
    generator, seen = np.random.default_rng(1), {True: 0, False: 0}
    for k in range(12):
        scene, v = random_impact(generator, 2 + k % 3)
        mass, normals, w = parts(scene)
        found = admissible_set(scene, v)
        if found.dimension == 0:
            continue
        p = np.linalg.solve(w, normals.T @ (found.sample(k, 400) - v).T).T
        p = p + 0.1 * np.abs(p).mean() * generator.normal(size=p.shape)
        after = v + p @ np.linalg.solve(mass, normals).T
        allowed = (p >= 0).all(1) & (after @ normals >= 0).all(1)
        allowed &= energy(scene, after) <= energy(scene, v)
        assert (
            found.contains(after, 1e-12) == allowed
        ).mean() > 0.995  # but for rounding
        for outcome in (True, False):
            seen[outcome] += int((allowed == outcome).sum())
    assert min(seen.values()) > 300


def test_contains_wants_the_momentum_balance():
    """Three equal balls with V = (1, 0, 0): velocities after an impact sum to 1."""
    assert THREE.contains([0.0, 0.25, 0.75])
    assert not THREE.contains([0.0, 0.25, 0.7])
    assert not THREE.contains(V)
    assert THREE.contains([0.0, 0.25, 0.7], tolerance=0.1)
    assert THREE.contains(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.01]])).tolist() == [
        True,
        False,
    ]


@pytest.mark.slow
def test_outcomes_of_laws_lie_inside():
    masses = jnp.asarray(np.random.default_rng(2).uniform(0.3, 3, (6, 4)))
    v = jnp.array([1.0, 0.2, 0.1, -0.5])
    sets = [admissible_set(ji.chain(m), v) for m in masses]
    for law in (ji.Newton(0.0), ji.Newton(0.5), ji.Newton(1.0), ji.LZB(0.8)):
        after = jax.jit(
            jax.vmap(lambda m, law=law: ji.impact(law, ji.chain(m), v).velocity)
        )(masses)
        assert all(found.contains(outcome) for found, outcome in zip(sets, after))


def test_samples_are_uniform_and_repeatable():
    """In a sector with its tip at common velocity, |u|^2 and the angle are uniform."""
    samples = THREE.sample(3, 3000)
    close(samples, THREE.sample(3, 3000), 0.0)
    assert (samples != THREE.sample(4, 3000)).any()
    gamma = np.diff(samples, axis=1)
    share = 2 * (energy(BALLS, samples) - 1 / 6) / (2 / 3)
    angle = np.arctan2(
        np.sqrt(3) / 2 * gamma[:, 0], gamma[:, 1] + 0.5 * gamma[:, 0]
    ) / (np.pi / 3)
    for values in (share, angle):
        ordered = np.sort(values)
        distance = np.abs(ordered - (np.arange(3000) + 0.5) / 3000).max()
        assert distance < 1.63 / np.sqrt(3000)  # Kolmogorov-Smirnov, 1 %
    assert abs(np.corrcoef(share, angle)[0, 1]) < 0.06


@pytest.mark.parametrize(
    "masses", [[1e-6, 1.0, 1e6], [1e6, 1.0, 1e-6], [1.0, 1e-6, 1.0]]
)
def test_mass_ratios(masses):
    scene = ji.chain(masses)
    found = admissible_set(scene, V)
    arc = found.conserving_arc(5)
    close(energy(scene, arc) / energy(scene, np.array(V)), np.ones(5), 1e-9)
    close(arc @ masses / masses[0], np.ones(5), 1e-9)
    assert found.contains(arc).all()
    assert found.contains(found.plastic)
    assert np.isfinite(found.bounds).all()
    assert (found.bounds[:, 0] <= arc.min(axis=0) + 1e-6).all()
    assert (found.bounds[:, 1] >= arc.max(axis=0) - 1e-6).all()


def test_float32_scene():
    found = admissible_set(
        ji.chain(jnp.ones(3, jnp.float32)), jnp.array(V, jnp.float32)
    )
    close(found.conserving_arc(2), [[0, 0, 1], [-1 / 3, 2 / 3, 2 / 3]], 1e-6)
    out = ji.impact(ji.Newton(jnp.float32(0.9)), found.scene, jnp.array(V, jnp.float32))
    assert out.velocity.dtype == jnp.float32
    assert found.contains(out.velocity)


def test_in_words():
    text = str(THREE).splitlines()
    assert (
        text[0]
        == "closed contacts: 2, approaching: 1; admissible outcomes of dimension 2"
    )
    assert text[1].split()[2:4] == ["0.166667", "J"]
    assert [float(x) for x in text[3].split()] == [1, 1, -0.333333, 0.333333, 0.333333]
    assert text[-2:] == [
        "T+ = T- at A (0, 0, 1)",
        "T+ = T- at B (-0.333333, 0.666667, 0.666667)",
    ]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: admissible_set(BALLS, [1.0, 0.0]),
            r"`velocity` must have shape \(3,\)",
        ),
        (
            lambda: admissible_set(BALLS, [1.0, np.nan, 0.0]),
            r"`velocity`.*nan at index 1",
        ),
        (
            lambda: THREE.contains([1.0, 0.0]),
            r"`velocity` must have shape \(3,\) or \(k, 3\)",
        ),
        (lambda: THREE.contains([np.inf, 0.0, 0.0]), r"`velocity` must be finite"),
        (lambda: THREE.contains(V, tolerance=-1.0), r"`tolerance`.*-1"),
        (lambda: THREE.sample(0, 0), r"`count` must be an int >= 1, but has value 0"),
        (lambda: THREE.sample(0, 2.5), r"`count`.*2\.5"),
        (lambda: THREE.conserving_arc(0), r"`points`.*0"),
        (lambda: THREE.boundary(1), r"`points`.*1"),
        (
            lambda: admissible_set(
                ji.Scene(np.ones(12), np.random.default_rng(0).normal(size=(12, 24))),
                -np.ones(12),
            ),
            r"fewer redundant contacts: 24 contacts of rank 12",
        ),
        (
            lambda: plot_admissible_set(THREE, {"x": [1.0]}),
            r"`outcomes`.*'x' has shape \(1,\)",
        ),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --- the geometry under it --------------------------------------------------------------------


# --- the picture ------------------------------------------------------------------------------


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_picture_of_two_contacts(tmp_path):
    outcomes = {"A": [0.0, 0.0, 1.0], "gain": [0.0, 0.0, 1.1]}
    figure = plot_admissible_set(THREE, outcomes)
    (axes,) = figure.axes
    assert labels(figure)[-2:] == ["A", "gain (not admissible)"]
    drawn = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    radius = np.sqrt(2 / 3)
    angle = np.radians([120, 60])  # A left, B right
    close(drawn["A"][0], radius * np.array([np.cos(angle[0]), np.sin(angle[0])]))
    close(np.linalg.norm(drawn["before the impact"][0]), radius)
    close(drawn["plastic, least energy"][0], [0, 0])
    texts = {text.get_text(): text.get_position() for text in axes.texts}
    assert texts["A"][0] < 0 < texts["B"][0]
    close(texts["B"], 1.09 * radius * np.array([np.cos(angle[1]), np.sin(angle[1])]))
    (region,) = axes.patches
    assert region.get_xy().min() >= -radius
    figure.savefig(tmp_path / "set.png")
    assert (tmp_path / "set.png").stat().st_size > 10_000


def test_picture_of_other_numbers_of_contacts():
    for masses, panels in (([1.0, 1.0], 1), (np.ones(4), 3), (np.ones(7), 6)):
        v = np.eye(len(masses))[0]
        figure = plot_admissible_set(
            admissible_set(ji.chain(masses), v), {"stays": v}, "title"
        )
        visible = [axes for axes in figure.axes if axes.get_visible()]
        assert len(visible) == panels + 1  # and the colour bar
        assert labels(figure) == ["stays (not admissible)"]
        assert figure.get_suptitle() == "title"
    resting = admissible_set(ji.chain([1.0, 1.0], gaps=[1.0]), [0.0, 0.0])
    assert plot_admissible_set(resting).axes
