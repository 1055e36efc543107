"""How many impacts: waves, bends, lost frames, clocks that err, exact coordinates, what is doubtful."""

import re

import numpy as np
import pytest
from refusals import argument

import jimpact as ji
from jimpact.tracks.division import divided
from jimpact.tracks.frames import Frames, rounding_step
from jimpact.tracks.waves import DAMPING, Errors, Wave

G = 9.80665
SPEED = np.sqrt(2 * G * 0.4)


def bounce(rng, fps=150, noise=8e-4, e=0.7):
    """A ball that falls from .4 m and bounces once; times since the bounce are t - SPEED / G."""
    t = (np.arange(int(fps * SPEED / G * 2.2)) + rng.random()) / fps
    since = t - SPEED / G
    y = np.where(since < 0, -SPEED, e * SPEED) * since - G * since**2 / 2
    return t, y + noise * rng.normal(size=t.size)


def gliders(rng, slope=0.0, waves=0.0, fps=400, noise=3e-5):
    """Two gliders that meet at 1 s, on a table with a slope, before a lens with waves."""
    t = np.arange(2 * fps) / fps
    since = (t - 1.0)[:, None]
    q = np.where(since < 0, [0.6, -0.2], [-0.1, 0.4]) * since + slope * since**2 / 2
    phases = rng.uniform(0, 6, (4, 2))
    lengths = rng.uniform(0.1, 0.2, (4, 2))
    lens = (
        waves / 2 * sum(np.sin(2 * np.pi * q / x + p) for x, p in zip(lengths, phases))
    )
    return t, q + lens + noise * rng.normal(size=q.shape)


def errors(impact, before, after):
    apart = np.concatenate([impact.pre - before, impact.post - after])
    return apart / np.sqrt(np.diag(impact.covariance))


@pytest.mark.parametrize(
    "waves",
    [
        [Wave(0.7, 0.02)],
        [Wave(0.7, 0.2)],
        [Wave(0.7, 1.0)],
        [Wave(0.7, 1.0), Wave(0.3, 0.1)],
    ],
    ids=["quick", "medium", "slow", "two"],
)
def test_the_covariance_of_waves_is_that_of_its_equation(waves):
    rng = np.random.default_rng(0)
    t = np.sort(rng.random(20))
    starts = np.array([0, 8])
    relative = rng.uniform(0.5, 2, 20)
    errors = Errors(np.array([0.1]), (tuple(waves),))
    covariance = errors.of(0, t, starts, relative)
    dense = 0.01 * np.diag(relative**2)
    b = DAMPING
    c = np.sqrt(1 - b**2)
    for some in (slice(0, 8), slice(8, 20)):
        apart = np.abs(t[some, None] - t[some])
        for wave in waves:
            x = apart / wave.time
            unit = np.exp(-b * x) * (np.cos(c * x) + b / c * np.sin(c * x))
            dense[some, some] += wave.size**2 * unit
    columns = rng.normal(size=(20, 3))
    np.testing.assert_allclose(
        covariance.solve(columns), np.linalg.solve(dense, columns), rtol=1e-5, atol=1e-5
    )
    parts = [
        np.linalg.slogdet(dense[some, some])[1] for some in (slice(0, 8), slice(8, 20))
    ]
    # digits go with the cube of the time over the shortest gap, here 1 s and .16 ms
    np.testing.assert_allclose(covariance.log_det(), parts, rtol=1e-7, atol=1e-4)


def test_the_division_is_the_cheapest_one():
    """Beside all divisions of a short track into at most two flights."""
    rng = np.random.default_rng(1)
    t = np.arange(30) / 30
    x = np.where(t < 0.5, t, 1 - t) + 0.01 * rng.normal(size=30)
    frames = Frames(t, x[:, None], np.array([0.01]))
    found = divided(frames, np.zeros(1), 5)

    def cost(some):
        rest = x[some] - np.polyval(np.polyfit(t[some], x[some], 1), t[some])
        return float(rest @ rest) / 1e-4 + max(3 * np.log(30), 25.0)

    every = [cost(slice(0, k)) + cost(slice(k, 30)) for k in range(5, 26)]
    assert found.cost <= min(*every, cost(slice(0, 30))) + 1e-6
    assert len(found.flights) == 2


def test_waves_and_slopes_are_no_impacts():
    rng = np.random.default_rng(2)
    z = []
    for slope, waves in ((0.0, 1.5e-4), (0.03, 0.0), (0.03, 1.5e-4)) * 2:
        t, q = gliders(rng, slope, waves)
        track = ji.tracks.find_impacts(t, q)
        (impact,) = track.impacts
        assert abs(impact.time - 1.0) < 5e-4
        z.append(errors(impact, [0.6, -0.2], [-0.1, 0.4]))
        assert track.warnings
        if waves:
            assert "candidates for an impact went" in str(track)
            assert track.arcs.errors.waving.all()
    assert np.sqrt(np.mean(np.square(z))) < 1.6


def test_gliders_that_wobble_before_a_lens_have_slow_and_quick_waves():
    """A wobble of .06 mm at 20 Hz beside waves of .15 mm, which one wave is not."""
    rng = np.random.default_rng(12)
    for _ in range(2):
        t, q = gliders(rng, slope=0.03, waves=1.5e-4)
        turned = -np.abs(t - 1.0)[:, None]  # the impact turns its velocity round
        q = q + 6e-5 * np.sin(2 * np.pi * 20 * turned + rng.uniform(0, 6, 2))
        track = ji.tracks.find_impacts(t, q)
        (impact,) = track.impacts
        assert np.abs(errors(impact, [0.6, -0.2], [-0.1, 0.4])).max() < 4
        for slow, quick in track.arcs.errors.waves:
            assert quick.time < 0.03 < slow.time


def test_a_spring_that_is_pressed_is_told_to_be_one_contact():
    """Two bodies of equal mass, e = 1, over a half period of .05 s; then one impact."""
    rng = np.random.default_rng(13)
    t = np.arange(1000) / 500
    share = np.clip((t - 1.0) / 0.05, 0, 1)
    pressed = 0.05 / np.pi * np.sin(np.pi * share)  # of the relative velocity 1
    after = np.maximum(t - 1.05, 0.0)
    apart = -np.minimum(t - 1.0, 0.0) - pressed + after
    middle = 0.1 * t
    q = np.stack([middle - apart / 2, middle + apart / 2], axis=1)
    q = q + 2e-5 * rng.normal(size=q.shape)
    track = ji.tracks.find_impacts(t, q, acceleration=[0.0, 0.0])
    assert len(track.impacts) > 1
    (told,) = [line for line in track.warnings if "contact=" in line]
    contact = float(re.search(r"contact=([\d.]+)", told)[1])
    (impact,) = ji.tracks.find_impacts(
        t, q, acceleration=[0.0, 0.0], contact=contact
    ).impacts
    assert abs(impact.time - 1.025) < 1e-3
    assert np.abs(errors(impact, [0.6, -0.4], [-0.4, 0.6])).max() < 3.5


@pytest.mark.parametrize(
    ("changes", "lasts"),
    [((-0.3, 0.25, -1.2), True), ((-1.4, 1.3, -1.2), False)],
)
def test_a_run_of_pushes_is_one_contact_by_its_whole_change_of_velocity(changes, lasts):
    """The first two pushes take one another back; of bounces all do."""
    t = np.arange(1000) / 500
    at = (1.0, 1.05, 1.1)
    pushed = (dv * np.maximum(t - when, 0) for dv, when in zip(changes, at))
    noise = 2e-5 * np.random.default_rng(14).normal(size=t.size)
    track = ji.tracks.find_impacts(t, t + sum(pushed) + noise)
    assert len(track.impacts) == 3
    assert any("contact=" in line for line in track.warnings) == lasts


def test_frames_lost_at_the_impact_do_not_bound_its_instant():
    rng = np.random.default_rng(3)
    z = []
    for lost in (3, 8, 15) * 8:
        t, y = bounce(rng)
        hit = int(np.searchsorted(t, SPEED / G))
        y[hit : hit + lost] = np.nan
        (impact,) = ji.tracks.find_impacts(t, y, 8e-4, acceleration=-G).impacts
        z.append(errors(impact, [-SPEED], [0.7 * SPEED]))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.35


def test_a_clock_that_errs_loses_no_impact():
    """Legs of a puck at very different speeds, sigma not given."""
    rng = np.random.default_rng(4)
    corners = np.array([[0.0, 0.0], [0.9, 0.5], [0.2, 0.9], [1.0, 0.1], [0.5, 1.0]])
    speeds = np.array([2.0, 6.0, 3.0, 2.5])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    instants = np.concatenate([[0.0], np.cumsum(lengths / speeds)])
    for _ in range(6):
        t = np.arange(rng.random() / 60, instants[-1], 1 / 60)
        q = np.column_stack([np.interp(t, instants, x) for x in corners.T])
        q += 3e-4 * rng.normal(size=q.shape)
        track = ji.tracks.find_impacts(t + 3e-4 * rng.normal(size=t.size), q)
        np.testing.assert_allclose(
            [x.time for x in track.impacts], instants[1:-1], atol=0.01
        )


def test_errors_of_times_are_found_and_weigh_fast_frames_less():
    """Errors of velocities are those stated, and the report says by how much times err."""
    rng = np.random.default_rng(21)
    apart = []
    found = []
    for _ in range(30):
        t, y = bounce(rng, noise=5e-4)
        track = ji.tracks.find_impacts(
            t + 8e-4 * rng.normal(size=t.size), y, acceleration=-G
        )
        (impact,) = track.impacts
        apart.append(errors(impact, [-SPEED], [0.7 * SPEED]))
        found.append(track.arcs.errors.clock)
    assert 0.7 < np.sqrt(np.mean(np.square(apart))) < 1.3
    assert np.median(found) == pytest.approx(8e-4, rel=0.2)
    assert "grow with the speed" in " ".join(track.warnings)
    t, y = bounce(rng, noise=5e-4)
    assert ji.tracks.find_impacts(t, y, acceleration=-G).arcs.errors.clock == 0


def test_errors_before_a_lens_are_nearly_those_stated():
    rng = np.random.default_rng(22)
    apart = []
    for _ in range(8):
        t, q = gliders(rng, slope=0.02, waves=1.5e-4)
        (impact,) = ji.tracks.find_impacts(t, q).impacts
        assert len(impact.pre) == 2
        apart.append(np.sqrt(np.diag(impact.covariance)))
    assert np.max(apart) < 2e-3


def test_few_frames_of_an_unknown_gravity_scatter_as_stated():
    """Sigma of 18 degrees of freedom errs itself: errors hold that."""
    rng = np.random.default_rng(23)
    apart = []
    for _ in range(100):
        t, y = bounce(rng, 30)
        (impact,) = ji.tracks.find_impacts(t, y, acceleration=None).impacts
        apart.append(errors(impact, [-SPEED], [0.7 * SPEED]))
    assert 0.85 < np.sqrt(np.mean(np.square(apart))) < 1.15


def test_a_given_sigma_stays_where_most_flights_agree():
    """A body that is pushed in one of five flights has the given errors in the others."""
    rng = np.random.default_rng(24)
    t = np.arange(250) / 250
    instants = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    q = np.interp(t, instants, [0, 0.2, 0.05, 0.3, 0.1, 0.4])
    pushed = (t > 0.4) & (t < 0.6)
    q = q + np.where(pushed, 2e-3 * np.sin(60 * t), 0) + 1e-4 * rng.normal(size=t.size)
    track = ji.tracks.find_impacts(t, q, 1e-4)
    assert track.sigma[0] == 1e-4
    assert track.warnings


def test_coordinates_without_noise_and_in_pixels():
    rng = np.random.default_rng(5)
    t, y = bounce(rng)
    both = np.column_stack([0.2 * t, y])
    (impact,) = ji.tracks.find_impacts(t, both, acceleration=[0, -G]).impacts
    assert abs(impact.post[1] - 0.7 * SPEED) < 5 * np.sqrt(impact.covariance[3, 3])
    _, clean = bounce(np.random.default_rng(5), noise=0.0)
    pixels = 2e-3 * np.round(clean / 2e-3)
    assert rounding_step(pixels) == pytest.approx(1e-3)
    track = ji.tracks.find_impacts(t, pixels, acceleration=-G)
    assert len(track.impacts) == 1
    assert track.sigma[0] >= 1e-3 / np.sqrt(12)


@pytest.mark.parametrize("fps", [30, 60])
def test_gravity_that_is_not_known_at_low_rates(fps):
    rng = np.random.default_rng(6)
    for _ in range(5):
        t, y = bounce(rng, fps)
        track = ji.tracks.find_impacts(t, y, acceleration=None)
        assert len(track.impacts) == 1
        assert abs(track.acceleration[0] + G) < 0.5


def test_acceleration_may_be_known_of_some_coordinates():
    t, y = bounce(np.random.default_rng(7))
    both = np.column_stack([0.2 * t, y]) + 1e-4 * np.random.default_rng(8).normal(
        size=(t.size, 2)
    )
    track = ji.tracks.find_impacts(t, both, acceleration=[0.0, None])
    assert track.acceleration[0] == 0
    assert abs(track.acceleration[1] + G) < 0.1


def test_a_force_of_velocity_bends_flights():
    """A ball with spin in the plane, by small steps of its motion; without the force it is told."""
    rng = np.random.default_rng(9)

    def air(v):
        return np.array([0.0, -G]) + 0.8 * np.stack([v[..., 1], -v[..., 0]], axis=-1)

    place = np.array([0.0, 0.5])
    v = np.array([2.0, -1.0])
    places = []
    before = after = None
    for k in range(8000):
        if k == 4000:
            before = v.copy()
            after = v = v * [0.8, -0.7]
        if k % 100 == 0:
            places.append(place)
        middle = v + air(v) * 2.5e-5
        place = place + middle * 5e-5
        v = v + air(middle) * 5e-5
    t = np.arange(80) * 5e-3
    q = np.array(places) + 2e-4 * rng.normal(size=(80, 2))
    (impact,) = ji.tracks.find_impacts(t, q, 2e-4, acceleration=air).impacts
    assert np.abs(errors(impact, before, after)).max() < 4
    assert ji.tracks.find_impacts(t, q, 2e-4, acceleration=[0, -G]).warnings
    with pytest.raises(ValueError, match=argument("acceleration")):
        ji.tracks.find_impacts(t, q, acceleration=lambda v: np.zeros(3))


def test_doubtful_impacts_are_no_shots_unless_asked():
    """Gravity is forgotten: flights of no acceleration leave impacts that are none."""
    t, y = bounce(np.random.default_rng(10))
    track = ji.tracks.find_impacts(t, y, 8e-4, acceleration=0.0)
    doubtful = [impact.doubtful for impact in track.impacts]
    assert any(doubtful)
    every = track.experiments(doubtful=True, label="drop 3")
    assert every.shots[0] == "drop 3:1"
    assert len(every.shots) == len(track.impacts)
    if not all(doubtful):
        assert len(track.experiments().shots) == doubtful.count(False)
    assert "(doubtful)" in str(track)


def test_labels_stay_in_sums():
    t, y = bounce(np.random.default_rng(11))
    track = ji.tracks.find_impacts(t, y, acceleration=-G)
    both = track.experiments(label="a") + track.experiments(label="b")
    assert both.shots == ("a:1", "b:1")


def test_rows_of_two_bodies_are_told():
    rng = np.random.default_rng(12)
    _, q = gliders(rng, fps=60)
    rows = q.ravel()
    lines = ji.tracks.find_impacts(np.arange(len(rows)) / 60, rows).warnings
    assert "alternate between 2 bodies" in lines[0]


@pytest.mark.slow
def test_the_time_grows_as_the_frames():
    """Ten times as many candidates' frames: the division of 40 000 is found, and right."""
    t = np.arange(40_000) / 400
    instants = np.array([11.3, 40.2, 77.7])
    q = 0.3 * t + sum(
        j * np.maximum(t - x, 0) for j, x in zip((-0.5, 0.6, -0.3), instants)
    )
    q = q + 1e-4 * np.random.default_rng(13).normal(size=t.size)
    track = ji.tracks.find_impacts(t, q)
    np.testing.assert_allclose([x.time for x in track.impacts], instants, atol=1e-3)


def test_measured_spin_bends_flights_by_magnus():
    """Spin of each frame, which an impact changes, with a force of velocity and spin."""
    rng = np.random.default_rng(31)
    spins = {False: np.array([0.0, 0.0, 90.0]), True: np.array([0.0, 0.0, 40.0])}

    def air(v, w):
        return np.array([0.0, -G, 0.0]) + 0.008 * np.cross(w, v)

    place = np.array([0.0, 0.5, 0.0])
    v = np.array([2.0, -1.0, 0.0])
    places = []
    before = after = None
    for k in range(8000):
        if k == 4050:
            before = v.copy()
            after = v = v * [0.8, -0.7, 1.0]
        if k % 100 == 0:
            places.append(place)
        w = spins[k >= 4050]
        middle = v + air(v, w) * 2.5e-5
        place = place + middle * 5e-5
        v = v + air(middle, w) * 5e-5
    t = np.arange(80) * 5e-3
    q = np.array(places) + 2e-4 * rng.normal(size=(80, 3))
    spin = np.array([spins[x >= 0.2025] for x in t])
    spin[5] = np.nan
    track = ji.tracks.find_impacts(t, q, 2e-4, acceleration=air, spin=spin)
    (impact,) = track.impacts
    assert np.abs(errors(impact, before, after)).max() < 4
    with pytest.raises(ValueError, match=argument("acceleration")):
        ji.tracks.find_impacts(t, q, acceleration=[0, -G, 0], spin=spin)
    with pytest.raises(ValueError, match=r"shape \(3,\) or \(80, 3\)"):
        ji.tracks.find_impacts(t, q, acceleration=air, spin=spin[:5])
