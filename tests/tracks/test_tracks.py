"""From the camera to a fit: impacts in tracks, bounce times, tables of trackers, bad input."""

import json

import numpy as np
import pytest
from commands_cases import call
from refusals import argument
from scipy.integrate import solve_ivp

import jimpact as ji

G = 9.80665


def ball(rng, fps=120, e=0.8, height=0.5, noise=1e-3, coordinates=1):
    """A ball that falls from a height and bounces once; its instant [s] is `sqrt(2 h / g)`."""
    speed = np.sqrt(2 * G * height)
    first = speed / G
    t = (np.arange(int(fps * (first + 1.8 * e * first))) + rng.random()) / fps
    since = t - first
    y = np.where(since < 0, -speed * since, e * speed * since) - G * since**2 / 2
    if coordinates == 3:
        y = np.column_stack([0.3 * t - 0.1 * np.maximum(since, 0), 0.2 - 0.1 * t, y])
    return t, y + noise * rng.normal(size=y.shape), first


def restitution(impact):
    pre, post = impact.pre[-1], impact.post[-1]
    n = len(impact.pre)
    slope = np.zeros(2 * n)
    slope[n - 1], slope[-1] = post / pre**2, -1 / pre
    return -post / pre, float(np.sqrt(slope @ impact.covariance @ slope))


def bound(fps):
    """Cramer and Rao: the least error of e = 0.8, by the information of place, v-, v+, instant."""
    t, _, first = ball(np.random.default_rng(0), fps)
    since, speed = t - first, np.sqrt(G)
    after = since >= 0
    speed = np.sqrt(2 * G * 0.5)
    v = np.where(after, 0.8 * speed, -speed) - G * since
    slopes = np.stack([np.ones_like(t), since * ~after, since * after, -v], axis=1)
    covariance = np.linalg.inv(slopes.T @ slopes) * 1e-6
    e_slope = np.array([0.0, 0.8 / speed, 1 / speed, 0.0])
    return float(np.sqrt(e_slope @ covariance @ e_slope))


@pytest.mark.parametrize("fps", [60, 120, 240])
def test_restitution_has_no_bias_and_the_least_error(fps):
    rng, values = np.random.default_rng(3), []
    for _ in range(80):
        t, y, _ = ball(rng, fps)
        track = ji.tracks.find_impacts(t, y, sigma=1e-3, acceleration=-G)
        (impact,) = track.impacts
        values.append(restitution(impact))
    e, stated = np.array(values).T
    least = bound(fps)
    assert abs(e.mean() - 0.8) < 3.5 * least / np.sqrt(len(e))
    np.testing.assert_allclose(e.std(), least, rtol=0.3)  # 8 % is one standard error
    np.testing.assert_allclose(stated.mean(), least, rtol=0.1)
    assert np.mean(np.abs(e - 0.8) < 1.96 * stated) > 0.87


def test_lost_frames_and_unknown_noise_in_space():
    rng, found = np.random.default_rng(8), 0
    for _ in range(60):
        t, q, first = ball(rng, coordinates=3)
        q[rng.random(len(t)) < 0.1] = np.nan
        track = ji.tracks.find_impacts(t, q, acceleration=[0, 0, -G])
        found += len(track.impacts) == 1
    assert found == 60
    impact = track.impacts[0]
    assert abs(impact.time - first) < 5 * impact.time_error
    np.testing.assert_allclose(track.sigma, 1e-3, rtol=0.5)


def test_good_tracks_have_few_warnings_and_bad_ones_have():
    rng, warned = np.random.default_rng(4), 0
    for _ in range(100):
        t, y, _ = ball(rng)
        warned += bool(
            ji.tracks.find_impacts(t, y, sigma=1e-3, acceleration=-G).warnings
        )
    assert warned <= 4  # 1 is expected; more than 4 happen once in 250
    t, y, _ = ball(rng)
    for bad, words in (
        (dict(q=1.05 * y), "not ballistic"),
        (dict(t=t + 2e-3 * rng.normal(size=len(t))), "within sigma"),
        (dict(q=np.repeat(y[::4], 4)[: len(y)]), "repeat"),
    ):
        arguments = {"t": t, "q": y, "sigma": 1e-3, "acceleration": -G} | bad
        arguments["t"] = np.sort(arguments["t"])
        lines = ji.tracks.find_impacts(**arguments).warnings
        assert any(words in line for line in lines), lines


def test_signs_units_and_gravity_that_are_wrong_are_told():
    rng = np.random.default_rng(14)
    t, y, first = ball(rng)
    angle = np.where(t < first, 8.0, -5.0) * (t - first) + 0.005 * rng.normal(
        size=t.size
    )
    for sigma in (1e-3, None):
        for bad, words in (
            (dict(q=-y), "curves the other way"),
            (dict(acceleration=0.0), "acceleration"),
            (dict(q=np.degrees(angle), acceleration=0.0, units="rad"), "degrees"),
        ):
            arguments = {"t": t, "q": y, "sigma": sigma, "acceleration": -G} | bad
            if "units" in bad and sigma:
                arguments["sigma"] = 0.3
            lines = ji.tracks.find_impacts(**arguments).warnings
            assert any(words in line for line in lines), lines
    both = np.column_stack([0.3 * t, -y])
    lines = ji.tracks.find_impacts(t, both, 1e-3, acceleration=[0.0, -G]).warnings
    assert "Coordinate 2 curves the other way" in lines[0]
    good = ji.tracks.find_impacts(t, np.radians(angle), 1e-4, units="rad")
    assert good.warnings == ()


@pytest.mark.parametrize(
    ("t", "q", "acceleration", "words"),
    [
        (1.0, 1.0, 9.51, "sign"),
        (1.0, 1000.0, -9.5, "mm"),
        (1.0, 100.0, -9.5, "cm"),
        (60.0, 1.0, -9.5, "numbers of frames"),
        (1.0, 1.0, -1.6, "units of q"),
    ],
)
def test_a_track_without_a_flight_says_which_argument_explains_it(
    t, q, acceleration, words
):
    seconds = np.arange(60) / 60
    height = np.abs(2 - 4.75 * seconds**2)[:, None]
    with pytest.raises(ValueError, match=words):
        ji.tracks.find_impacts(t * seconds, q * height, acceleration=[acceleration])


def test_known_values_are_kept_to_the_last_digit():
    t, y, _ = ball(np.random.default_rng(1))
    track = ji.tracks.find_impacts(t, y, sigma=1e-3, acceleration=-G)
    assert track.acceleration.tolist() == [-G]
    assert track.sigma.tolist() == [1e-3]


def test_gliders_of_unknown_acceleration_and_two_impacts():
    rng = np.random.default_rng(6)
    t = np.arange(300) / 100
    x1 = 0.5 * t - 0.4 * np.maximum(t - 1.0, 0) + 0.3 * np.maximum(t - 2.0, 0)
    x2 = 0.6 + 0.35 * np.maximum(t - 1.0, 0)
    q = np.column_stack([x1, x2]) - 0.02 * t[:, None] ** 2 / 2
    q += 2e-4 * rng.normal(size=q.shape)
    track = ji.tracks.find_impacts(t, q, acceleration=None)
    assert len(track.impacts) == 2
    np.testing.assert_allclose([each.time for each in track.impacts], [1, 2], atol=0.01)
    np.testing.assert_allclose(track.acceleration, -0.02, atol=0.002)
    np.testing.assert_allclose(track.impacts[0].pre, [0.48, -0.02], atol=0.003)
    assert track.covariance.shape == (8, 8)
    np.testing.assert_allclose(track.covariance, track.covariance.T, atol=1e-18)
    shots = track.experiments()
    assert shots.covariance.shape == (8, 8)


def test_frames_in_contact_are_left_out():
    rng, e, duration = np.random.default_rng(9), 0.8, 0.008
    t, y, first = ball(rng, fps=1000)
    pressed = np.abs(t - first) < duration / 2
    y[pressed] += 0.01 * (1 - (2 * (t[pressed] - first) / duration) ** 2)
    track = ji.tracks.find_impacts(t, y, 1e-3, acceleration=-G, contact=0.012)
    (impact,) = track.impacts
    assert abs(restitution(impact)[0] - e) < 5 * restitution(impact)[1]


def test_a_window_uses_frames_near_the_impact():
    t, y, _ = ball(np.random.default_rng(2))
    whole = ji.tracks.find_impacts(t, y, 1e-3, acceleration=-G)
    near = ji.tracks.find_impacts(t, y, 1e-3, acceleration=-G, window=0.1)
    assert sum(map(len, near.flights)) < sum(map(len, whole.flights))
    assert near.warnings == whole.warnings == ()
    assert restitution(near.impacts[0])[1] > restitution(whole.impacts[0])[1]


def dragged(rng, drag=0.12, sideways=0.0):
    """A ball that the air slows, by integration of its motion; bounces with e = 0.8."""
    t = (np.arange(90) + rng.random()) / 120

    def motion(_, x):
        v = x[3:]
        return np.append(v, np.array([0, 0, -G]) - drag * np.linalg.norm(v) * v)

    fall = solve_ivp(
        motion, (0, 2), [0, 0, 0.5, sideways, 0, 0], rtol=1e-10, atol=1e-12, dense_output=True,
        events=lambda _, x: x[2],
    )  # fmt: skip
    first, before = fall.t_events[0][0], fall.y_events[0][0]
    after = before * [1, 1, 1, 0.7, 1, -0.8]
    rise = solve_ivp(
        motion, (first, 2), after, rtol=1e-10, atol=1e-12, dense_output=True
    )
    q = np.where(t < first, fall.sol(t), rise.sol(t))[:3].T
    return t, q + 1e-3 * rng.normal(size=q.shape), before[3:], after[3:]


@pytest.mark.parametrize("drag", [0.12, None])
def test_drag_of_the_air_is_part_of_the_flights(drag):
    rng, errors, warned, drags = np.random.default_rng(5), [], 0, []
    for _ in range(40):
        t, q, *_ = dragged(rng)
        track = ji.tracks.find_impacts(t, q[:, 2], 1e-3, acceleration=-G, drag=drag)
        (impact,) = track.impacts
        value, error = restitution(impact)
        errors.append((value - 0.8) / error)
        warned += bool(track.warnings)
        drags.append(track.drag)
    assert warned <= 3
    assert abs(np.mean(errors)) < 4 / np.sqrt(40)
    assert 0.7 < np.std(errors) < 1.4
    assert error < (0.0006 if drag else 0.006)
    assert abs(np.mean(drags) - 0.12) < 0.01
    if drag is None:
        assert "drag 0." in str(track)
    t, q, *_ = dragged(rng)  # and what is wrong without it
    track = ji.tracks.find_impacts(t, q[:, 2], 1e-3, acceleration=-G)
    near = min(track.impacts, key=lambda each: abs(each.time - 0.322))
    assert abs(restitution(near)[0] - 0.8) > 0.015
    assert track.warnings


def test_drag_in_space_with_lost_frames_and_a_window():
    rng = np.random.default_rng(6)
    t, q, before, after = dragged(rng, 0.2, sideways=2.0)
    q[rng.random(90) < 0.1] = np.nan
    for options in ({}, {"window": 0.15}, {"sigma": None}):
        choice = {"sigma": 1e-3, "acceleration": [0, 0, -G], "drag": 0.2} | options
        (impact,) = ji.tracks.find_impacts(t, q, **choice).impacts
        error = np.concatenate([impact.pre - before, impact.post - after])
        assert (
            error @ np.linalg.solve(impact.covariance, error) < 25
        )  # chi^2 of 6: once in 3000


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"drag": -0.1}, "`drag`"),
        ({"drag": np.nan}, "`drag`"),
        ({"drag": 0.1, "units": "rad"}, "angles"),
        ({"drag": 50.0}, "`drag`.*too much"),
    ],
)
def test_a_drag_that_cannot_be_is_refused(options, words):
    t, q, *_ = dragged(np.random.default_rng(6))
    with pytest.raises(ValueError, match=words):
        ji.tracks.find_impacts(t, q[:, 2], 1e-3, acceleration=-G, **options)


def bounces(t, e, height=0.5):
    """Heights of a ball that is let go at 0 s, bounces and comes to rest, and when it bounces."""
    first = np.sqrt(2 * height / G)
    at, speed, times = first, G * first, []
    y = np.where(t < 0, height, np.where(t < first, height - G * t**2 / 2, 0.0))
    while speed > 1e-6:
        times.append(at)
        speed, since = e * speed, t - at
        here = (since >= 0) & (since < 2 * speed / G)
        y[here] = speed * since[here] - G * since[here] ** 2 / 2
        at += 2 * speed / G
    return y, np.array(times)


@pytest.mark.parametrize(
    ("fps", "noise"), [(60, 1e-3), (120, 1e-4), (240, 1e-3), (500, 1e-3)]
)
def test_a_ball_that_comes_to_rest_has_no_impacts_there(fps, noise):
    """Nor in the hand that holds it, half a second before."""
    for e, seed, sigma in ((0.3, 0, None), (0.8, 1, noise)):
        rng = np.random.default_rng(seed)
        t = np.arange(0, 4.0, 1 / fps) + rng.random() / fps - 0.5 * (seed == 1)
        y, times = bounces(t, e)
        track = ji.tracks.find_impacts(
            t, y + noise * rng.normal(size=t.size), sigma, acceleration=-G
        )
        found = np.array([each.time for each in track.impacts])
        late = np.abs(found - times[: len(found)]) * fps
        # the last one may lie between the bounces that its flight cannot tell
        assert late[:-1].max(initial=0.0) < 1
        heights = G * np.diff(times) ** 2 / 8
        assert len(found) >= np.argmax(
            (heights < 10 * noise) | (np.diff(times) * fps < 10)
        )
        es = np.array([restitution(each) for each in track.impacts[:-1]])
        assert (np.abs(es[:, 0] - e) < 5 * es[:, 1]).all() if len(es) else True
        told = [line for line in track.warnings if "nothing is used" in line]
        assert all("rests" in line for line in told)
        if seed and noise == 1e-3:
            assert told[0].startswith("Up to ")
        if noise == 1e-3:
            time = float(told[-1].split()[1])
            assert times[0] < time < times[-1] + 0.2


def test_a_body_that_is_held_in_the_middle_of_a_track_has_no_shots_there():
    """A disc bounces once, sticks to the table for half a second, and is thrown up again."""
    rng, t = np.random.default_rng(3), np.arange(300) / 240
    heights = [
        (0.0, 0.2, 0.0),  # from when on, height above the table, velocity upwards
        (np.sqrt(0.4 / G), 0.0, 1.0),
        (np.sqrt(0.4 / G) + 2 / G, None, 0.0),
        (np.sqrt(0.4 / G) + 2 / G + 0.5, 0.0, 2.0),
    ]
    y = np.zeros(300)
    for begins, height, speed in heights:
        since = t - begins
        flight = 0.0 if height is None else height + speed * since - G * since**2 / 2
        y = np.where(since >= 0, flight, y)
    q = np.column_stack([0.3 * t, 0.05 + y, 2.0 * t]) + [3e-4, 3e-4, 3e-3] * rng.normal(
        size=(300, 3)
    )
    track = ji.tracks.find_impacts(
        t, q, [3e-4, 3e-4, 3e-3], acceleration=[0, -G, 0], units=["m", "m", "rad"]
    )
    assert len(track.impacts) > 1
    shots = track.experiments(ji.Disc(0.05))
    assert shots.shots == ("1",)
    np.testing.assert_allclose(
        [shots.pre[0, 1], shots.post[0, 1]], [-np.sqrt(0.4 * G), 1.0], atol=0.02
    )


def test_a_window_that_leaves_too_few_frames_is_refused():
    t, y, _ = ball(np.random.default_rng(2))
    for window in (1e-6, 0.012):
        with pytest.raises(ValueError, match=argument("window")):
            ji.tracks.find_impacts(t, y, 1e-3, acceleration=-G, window=window)


def test_time_is_linear_and_impacts_many():
    rng = np.random.default_rng(1)
    fps, starts, t = 120, [0.0], np.arange(3000) / 120
    y = np.zeros(len(t))
    while starts[-1] < t[-1]:
        speed = 2 + 1.5 * rng.random()
        end = starts[-1] + 2 * speed / G
        here = (t >= starts[-1]) & (t < end)
        since = t[here] - starts[-1]
        y[here] = speed * since - G * since**2 / 2
        starts.append(end)
    y += 1e-3 * rng.normal(size=len(t))
    track = ji.tracks.find_impacts(t, y, acceleration=-G)
    times = np.array([each.time for each in track.impacts])
    np.testing.assert_allclose(times, starts[1 : len(times) + 1], atol=0.5 / fps)


@pytest.mark.slow
def test_a_square_that_lands_on_a_corner_is_a_shot_in_its_pose():
    rng, body = np.random.default_rng(7), ji.Block(0.1, 0.1)
    t, q = np.arange(60) / 240, np.zeros((60, 3))
    pose = np.array([0.0, 0.0, 0.3])
    pose[1] -= float(np.min(np.asarray(body.gap_function(pose))))
    scene = body.scenes([pose])[0]
    before = np.array([0.2, -1.5, 1.0])
    after = np.asarray(ji.impact(ji.Newton(0.5), scene, before).velocity)
    since = t[:, None] - 0.12
    q = pose + np.where(since < 0, before * since, after * since)
    q[:, 1] -= G * since[:, 0] ** 2 / 2
    q += 1e-4 * rng.normal(size=q.shape)
    track = ji.tracks.find_impacts(
        t, q, acceleration=[0, -G, 0], units=["m", "m", "rad"]
    )
    shots = track.experiments(body)
    assert shots.units == ("m/s", "m/s", "rad/s")
    assert shots.contacts.tolist() == [1]
    fit = ji.fit(ji.Newton(0.8, friction=0.0), None, shots)
    assert abs(fit.value[0] - 0.5) < 4 * fit.standard_error[0]
    high = ji.tracks.find_impacts(
        t,
        q + np.array([0.0, 0.05, 0.0]),
        acceleration=[0, -G, 0],
        units=["m", "m", "rad"],
    )
    with pytest.raises(ValueError, match="closed"):
        high.experiments(body)


def test_bounce_times_reach_the_bound():
    rng, e, sigma = np.random.default_rng(5), 0.81, 0.005
    flights = 0.55 * e ** np.arange(5)
    true = np.concatenate([[0.0], np.cumsum(flights)])
    wall, scatter, stated = ji.chain([1.0], "left"), [], []
    for _ in range(12):
        shots = ji.tracks.bounce_times(true + sigma * rng.normal(size=6), sigma)
        fit = ji.fit(ji.Newton(0.7), wall, shots)
        scatter.append((fit.value[0] - e) / fit.standard_error[0])
        stated.append(fit.standard_error[0])
    # t_0, the first flight and e by six times
    k, powers = np.arange(6), np.concatenate([[0.0], np.cumsum(e ** np.arange(5))])
    slope = 0.55 * np.array([sum(j * e ** (j - 1) for j in range(1, m)) for m in k])
    slopes = np.stack([np.ones(6), powers, slope], axis=1)
    least = sigma * np.sqrt(np.linalg.inv(slopes.T @ slopes)[2, 2])
    np.testing.assert_allclose(np.mean(stated), least, rtol=0.1)
    assert np.sqrt(np.mean(np.square(scatter))) < 1.8


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"t": [0.0, 0.1], "q": [0.0, 1.0]}, "5 frames"),
        ({"t": [0.0, 0.1, 0.2, 0.15, 0.3, 0.4]}, "rise"),
        ({"t": [0.0, 0.1, np.nan, 0.3, 0.4, 0.5]}, "finite"),
        ({"sigma": 0.0}, "sigma"),
        ({"sigma": -1.0}, "sigma"),
        ({"sigma": np.nan}, "sigma"),
        ({"sigma": [0.1, 0.1]}, "sigma"),
        ({"t": [0.0, 0.1, 0.2, 0.2, 0.3, 0.4]}, "rise"),
        ({"acceleration": np.nan}, "acceleration"),
        ({"q": np.full(6, np.nan)}, "NaN in all"),
        ({"q": np.zeros((5, 1))}, "shapes"),
        ({"units": "deg"}, "'rad'"),
        ({"contact": -1.0}, "contact"),
        ({"contact": np.inf}, "contact"),
        ({"acceleration": [1.0, 2.0]}, "acceleration"),
        ({"t": np.arange(6.0)[:, None]}, "shapes"),
        ({"q": np.full(6, np.inf)}, "q"),
        ({"inertia": [1.0, 1.0, 2.0]}, "`quaternion` must name"),
        ({"window": 0.0}, "window"),
        ({"shortest": 2}, "shortest"),
    ],
)
def test_bad_tracks_are_refused(arguments, words):
    good = {"t": np.arange(6) / 10, "q": np.arange(6.0), "sigma": 0.1}
    with pytest.raises(ValueError, match=words):
        ji.tracks.find_impacts(**(good | arguments))


def test_a_track_without_an_impact_says_so():
    t = np.arange(30) / 100
    track = ji.tracks.find_impacts(t, 1.0 - t, sigma=1e-3)
    assert track.impacts == ()
    assert "No impact" in track.warnings[0]
    assert "No impact" in str(track)
    with pytest.raises(ValueError, match="No impact"):
        track.experiments()


def test_a_track_that_does_not_move_has_no_impact():
    """Neither at a place, nor at 0, where there is no scale of lengths."""
    for place in (0.0, 0.4):
        track = ji.tracks.find_impacts(np.arange(30) / 100, np.full(30, place))
        assert not track.impacts
        assert "No impact" in track.warnings[0]


@pytest.mark.filterwarnings("error")
def test_frames_lost_by_turns():
    """Each second frame of a coordinate: no three in a row, the instant and velocities are found."""
    t = np.arange(80) / 200
    q = np.where(t < 0.203, 0.3 - 1.5 * t, -0.0045 + 0.9 * (t - 0.203))
    q = np.where(
        np.arange(80) % 2, q + 1e-4 * np.random.default_rng(2).normal(size=80), np.nan
    )
    for sigma in (None, 1e-4):
        (impact,) = ji.tracks.find_impacts(t, q, sigma).impacts
        np.testing.assert_allclose([*impact.pre, *impact.post], [-1.5, 0.9], atol=0.01)
        assert abs(impact.time - 0.203) < 4 * impact.time_error < 1e-3


@pytest.mark.slow
def test_impacts_of_unknown_gravity_are_all_found():
    """Four bounces at 500 frames a second, one frame in fifteen lost."""
    t, speed, e = np.arange(618) / 500, 9.80665 * 0.38853, 0.558
    at = 0.38853 + 2 * 0.38853 * np.concatenate(
        [[0.0], np.cumsum(e ** np.arange(1, 4))]
    )
    flight = np.searchsorted(at, t)
    since = np.where(flight > 0, t - at[flight - 1], t)
    y = np.where(flight > 0, speed * e**flight * since, 0.7402) - 9.80665 / 2 * since**2
    slides = np.array([0.7, 0.4, 0.9, 0.5, 0.8])
    ends = np.concatenate([[0.0], np.cumsum(slides[:4] * np.diff([0.0, *at]))])
    x = ends[flight] + slides[flight] * since
    for seed in range(24, 40):
        rng = np.random.default_rng(seed)
        q = np.stack([x, y], 1) + 5e-4 * rng.normal(size=(618, 2))
        q[rng.choice(618, 41, replace=False)] = np.nan
        track = ji.tracks.find_impacts(t, q, acceleration=None)
        assert len(track.impacts) == 4
        assert not track.warnings


def test_a_body_in_space_is_refused_with_advice():
    t, q, _ = ball(np.random.default_rng(1), coordinates=3)
    track = ji.tracks.find_impacts(t, q, 1e-3, acceleration=[0, 0, -G])
    with pytest.raises(ValueError, match=argument("scene")):
        track.experiments(ji.Box([0.1, 0.1, 0.1]))


def test_an_impact_in_the_first_frames_is_told():
    t = np.arange(40) / 100
    track = ji.tracks.find_impacts(t, np.abs(t - 0.025), sigma=1e-4)
    assert any("first 3 frames" in line for line in track.warnings)


@pytest.mark.parametrize(
    "times", [[0.0, 1.0], [0.0, 0.5, 0.4], [0.0, np.nan, 1.0], [0.3, 0.6, 0.0]]
)
def test_bad_bounce_times_are_refused(times):
    with pytest.raises(ValueError, match="times"):
        ji.tracks.bounce_times(times, 0.001)


TRACKER = (
    "#multi:\n\tball\t\t\nt\tx #1\ty\t\n0,00\t1,5\t2,0\n0,01\t\t\n0,02\t1,7\t2,2\n"
)
LOGGER = '"Run 1: Time (s)";"Run 1: Height (mm)"\n0.0;1500\n0.010;nan\n0.020;1700;\n'
CAPTURE = "FREQUENCY 100\nLABELS 2\n\nX Y\n1500 2000\n- -\n1700 2200\n"


def test_tables_of_trackers_loggers_and_capture_systems(tmp_path):
    path = tmp_path / "track.txt"
    path.write_text(TRACKER)
    t, q = ji.tracks.read(path, ["x #1", "y"], time="t", unit="m", decimal=",")
    np.testing.assert_allclose(t, [0, 0.01, 0.02])
    np.testing.assert_allclose(q, [[1.5, 2.0], [np.nan, np.nan], [1.7, 2.2]])
    path.write_text(LOGGER)
    time = "Run 1: Time (s)"
    np.testing.assert_allclose(
        ji.tracks.read(path, "Run 1: Height (mm)", time=time, unit="mm")[1],
        [[1.5], [np.nan], [1.7]],
    )
    with pytest.raises(ValueError, match=r"\bmm\b"):
        ji.tracks.read(path, "Run 1: Height (mm)", time=time, unit="m")
    path.write_text(CAPTURE)
    t, q = ji.tracks.read(path, ["X", "Y"], rate=100, unit="mm")
    np.testing.assert_allclose(t, [0, 0.01, 0.02])
    np.testing.assert_allclose(q[0], [1.5, 2.0])
    with pytest.raises(ValueError, match="`unit`"):
        ji.tracks.read(path, ["X"], rate=100)
    for arguments, words in (
        ({"columns": ["Z"]}, "`Z` is missing"),
        ({"unit": "px"}, "Pixels"),
        ({"time": "X"}, "both"),
        ({"rate": None}, "neither"),
        ({"rate": 0.0}, "rate"),
        ({"decimal": "x"}, "decimal"),
    ):
        with pytest.raises(ValueError, match=words):
            ji.tracks.read(
                path, **({"columns": ["X"], "rate": 100, "unit": "mm"} | arguments)
            )
    path.write_text("X\n1,5\n")
    with pytest.raises(ValueError, match="line 2, column `X`"):
        ji.tracks.read(path, "X", rate=100, unit="m")


def test_a_picture_of_a_track():
    t, y, _ = ball(np.random.default_rng(1))
    assert len(ji.tracks.find_impacts(t, y, acceleration=-G).plot().axes) == 2


SEEN = """
[scene]
masses_kg = [0.1]
wall = "left"
[law]
name = "Newton"
restitution = 0.6
[fit]
starts = 1
[track]
file = "ball.txt"
columns = "height"
unit = "cm"
rate = 120
acceleration = -9.80665
"""


def written(folder, old="", new=""):
    """A study of a ball that a camera saw."""
    _, y, _ = ball(np.random.default_rng(11))
    (folder / "ball.txt").write_text(
        "height\n" + "\n".join(f"{100 * x:.3f}" for x in y)
    )
    path = folder / "study.toml"
    path.write_text(SEEN.replace(old, new))
    return path


def test_a_study_of_a_track_finds_its_impacts(tmp_path):
    study = ji.read_study(written(tmp_path))
    (impact,) = study.track.impacts
    assert abs(restitution(impact)[0] - 0.8) < 5 * restitution(impact)[1]
    np.testing.assert_allclose(study.experiments.pre[0], impact.pre)
    np.testing.assert_allclose(study.experiments.covariance[0], impact.covariance)
    free = ji.read_study(
        written(tmp_path, "acceleration = -9.80665", 'acceleration = "unknown"')
    )
    np.testing.assert_allclose(free.track.acceleration, -G, atol=0.1)
    assert ji.read_study("ball_track.toml").experiments.pre.shape == (3, 1)


@pytest.mark.slow
def test_the_command_prints_impacts_and_then_the_fit(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call(capsys, "new", "fit", "seen", "--like", "ball_track.toml")[0] == 0
    code, said = call(capsys, "fit", "seen")
    assert code == 0
    assert said.out.index("impact 3 at") < said.out.index("std. error")
    assert (tmp_path / "jimpact-fit-seen-track.png").exists()
    code, said = call(capsys, "fit", "seen", "--json", "--starts", "1")
    assert len(json.loads(said.out)["track"]["impacts"]) == 3


def test_a_study_of_bounces(tmp_path):
    scene = SEEN[: SEEN.index("[track]")]
    path = tmp_path / "study.toml"
    path.write_text(scene + "[bounces]\ntimes = [0.0, 0.5, 0.9, 1.22]\nsigma = 0.001\n")
    shots = ji.read_study(path).experiments
    np.testing.assert_allclose(-shots.post / shots.pre, 0.8)
    assert shots.covariance.shape == (4, 4)
    path.write_text(scene + "[bounces]\ntimes = [0.0, 0.5, 0.4]\nsigma = 0.001\n")
    with pytest.raises(ValueError, match=r"\[bounces\].*`times` must rise"):
        ji.read_study(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('unit = "cm"\n', "", "`unit` must be given"),
        ('unit = "cm"', 'unit = "px"', "`unit` must be one of"),
        ("rate = 120", "", "`rate`"),
        ("rate = 120", 'rate = "fast"', "`rate` in .* must be a number"),
        ("rate = 120", "framerate = 120", "Did you mean frame"),
        ('columns = "height"', 'columns = "hight"', "`hight` is missing"),
        (
            'columns = "height"',
            "columns = 3",
            "`columns` in .* must be a text or a list",
        ),
        ("acceleration = -9.80665", "acceleration = true", "`acceleration` in"),
        ("acceleration = -9.80665", "sigma = -1.0", "`sigma` must"),
        ("acceleration = -9.80665", "contact = -0.1", "`contact` must"),
        ("acceleration = -9.80665", "shortest = 2", "`shortest` must"),
        ("acceleration = -9.80665", "near_m = 0.001", "`near_m` in .* for bodies"),
        (
            "masses_kg = [0.1]",
            "masses_kg = [0.1, 0.1]",
            "`columns` in .* 2 coordinates",
        ),
        ("rate = 120", 'rate = 120\n[data]\nfile = "x.csv"', r"one table of shots"),
    ],
)
def test_studies_of_tracks_name_the_key_that_is_wrong(tmp_path, old, new, words):
    with pytest.raises(ValueError, match=words):
        ji.read_study(written(tmp_path, old, new))


@pytest.mark.parametrize(
    ("rate", "later", "lost"),
    [(9.0, 9.0, 40), (25.0, 12.0, 25), (-30.0, 10.0, 40), (50.0, 50.0, 30)],
)
def test_angles_turn_on_while_frames_are_lost(rate, later, lost):
    """More than half a turn in the gap: the angles of an encoder or of pictures, in any turn."""
    rng = np.random.default_rng(1)
    t = np.arange(200) / 100
    since = t - 1.4  # [s] the impact
    angle = np.where(since < 0, rate, later) * since
    place = np.where(since < 0, 0.5, -0.3) * since
    noise = [1e-3, 5e-3] * rng.normal(size=(200, 2))
    q = np.column_stack([place, angle]) + noise
    units = ["m", "rad"]
    whole = ji.tracks.find_impacts(t, q, units=units)
    q[50 : 50 + lost] = np.nan
    of_pictures = q.copy()
    of_pictures[:, 1] = np.angle(np.exp(1j * q[:, 1]))
    for seen in (q, of_pictures):
        track = ji.tracks.find_impacts(t, seen, units=units)
        (impact,) = track.impacts
        (known,) = whole.impacts
        assert impact.time == pytest.approx(1.4, abs=5 * impact.time_error)
        np.testing.assert_allclose(impact.pre[1], rate, atol=0.05)
        np.testing.assert_allclose(impact.post, known.post, atol=0.01)
