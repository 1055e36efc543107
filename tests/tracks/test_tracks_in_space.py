"""Poses of a body in space: impacts, angular velocities in its axes, orders of quaternions."""

import jax
import numpy as np
import pytest
from refusals import argument
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jimpact as ji

G, FPS, AT = 9.80665, 148, 0.17
NOISE = [1e-4] * 3 + [1e-3] * 3  # of places [m] and of turns [rad]
CUBE, BRICK = ji.Box([0.1, 0.1, 0.1], mass=0.3), ji.Box([0.1, 0.06, 0.04], mass=0.5)
TURN = Rotation.from_rotvec([0.5, 0.3, 0.2])
BEFORE = np.array([0.3, -0.2, -1.5, 3.0, -2.0, 4.0])
TO_XYZW = [0, 1, 2, 4, 5, 6, 3]


def scalar_first(turns):
    return np.roll(turns.as_quat(), 1, axis=-1)


def evenly(since, omega):
    return TURN * Rotation.from_rotvec(since[:, None] * omega)


def freely(inertia):
    """The same of a body with these moments, by quaternions and angular momentum in space."""

    def turns(since, omega):
        spin = TURN.apply(inertia * omega)

        def rates(_, e):
            turn = Rotation.from_quat(np.roll(e, -1))
            w = turn.apply(turn.inv().apply(spin) / inertia)  # in the axes of space
            return 0.5 * np.array([-w @ e[1:], *(e[0] * w + np.cross(w, e[1:]))])

        found = np.zeros((len(since), 4))
        for some, step in ((since < 0, -1), (since >= 0, 1)):
            times, start = since[some][::step], scalar_first(TURN)
            path = solve_ivp(
                rates, (0, times[-1]), start, t_eval=times, rtol=1e-10, atol=1e-12
            )
            found[some] = path.y.T[::step]
        return Rotation.from_quat(np.roll(found, -1, axis=1))

    return turns


def landed(body, turns=evenly, e=0.6):
    """A toss: poses without noise at times, and v+ of its impact at AT by a law."""
    pose = np.asarray(body.touching(scalar_first(TURN)))
    after = ji.impact(
        ji.Newton(e, friction=0.2), body.scenes([pose])[0], BEFORE
    ).velocity
    after = np.asarray(after)

    def poses(t):
        since = t - AT
        places, both = np.zeros((len(t), 3)), np.zeros((len(t), 4))
        for some, v in ((since < 0, BEFORE), (since >= 0, after)):
            places[some] = pose[:3] + since[some, None] * v[:3]
            both[some] = scalar_first(turns(since, v[3:])[some])
        places[:, 2] -= G * since**2 / 2
        return places, Rotation.from_quat(np.roll(both, -1, axis=1))

    return poses, after


def seen(poses, rng):
    """Times and poses (T, 7) with noise."""
    t = (np.arange(50) + rng.random()) / FPS
    places, turns = poses(t)
    noise = rng.normal(size=(len(t), 6)) * NOISE
    return t, np.hstack(
        [
            places + noise[:, :3],
            scalar_first(turns * Rotation.from_rotvec(noise[:, 3:])),
        ]
    )


def found(t, q, sigma=NOISE, order="wxyz", **options):
    return ji.tracks.find_impacts(
        t, q, sigma, acceleration=[0, 0, -G], quaternion=order, **options
    )


@pytest.mark.slow
def test_velocities_have_no_bias_and_the_stated_covariance():
    rng, (poses, after), errors, warned = np.random.default_rng(0), landed(CUBE), [], 0
    for _ in range(60):
        track = found(*seen(poses, rng))
        (impact,) = track.impacts
        error = np.concatenate([impact.pre - BEFORE, impact.post - after])
        errors.append(np.linalg.solve(np.linalg.cholesky(impact.covariance), error))
        warned += bool(track.warnings)
        assert abs(impact.time - AT) < 5 * impact.time_error
    assert warned <= 3
    # white and of unit size: sums over 60 tracks of 12 values
    assert np.abs(np.mean(errors, axis=0)).max() < 4 / np.sqrt(60)
    assert abs(np.mean(np.square(errors)) - 1) < 4 * np.sqrt(2 / 720)
    assert track.units == ("m/s",) * 3 + ("rad/s",) * 3
    assert track.covariance.shape == (12, 12)


def test_the_error_is_the_least_one():
    """That of all twenty unknowns by differences: place, turn, both velocities, the instant."""
    t, q = seen(landed(CUBE)[0], np.random.default_rng(1))
    (impact,) = found(t, q).impacts

    def poses(x):
        place, turn, v0, v1, at = np.split(x, [3, 6, 12, 18])
        since = t - at
        v = np.where(since[:, None] < 0, v0, v1)
        places = (
            place
            + v[:, :3] * since[:, None]
            - G * np.array([0, 0, 0.5]) * since[:, None] ** 2
        )
        start = Rotation.from_quat(np.roll(impact.q[3:], -1)) * Rotation.from_rotvec(
            turn
        )
        return places, start * Rotation.from_rotvec(v[:, 3:] * since[:, None])

    x = np.concatenate(
        [impact.q[:3], np.zeros(3), impact.pre, impact.post, [impact.time]]
    )
    (places, turns), slopes = poses(x), []
    for step in 1e-6 * np.eye(19):
        other, turned = poses(x + step)
        change = np.hstack([other - places, (turns.inv() * turned).as_rotvec()])
        slopes.append((change / NOISE).ravel() / 1e-6)
    least = np.linalg.inv(np.array(slopes) @ np.transpose(slopes))[6:18, 6:18]
    np.testing.assert_allclose(
        impact.covariance, least, rtol=0.15, atol=0.03 * least.max()
    )


def test_a_brick_turns_freely_between_impacts():
    inertia = np.asarray(BRICK.inertia)
    poses, after = landed(BRICK, freely(inertia))
    t, q = seen(poses, np.random.default_rng(2))
    track = found(t, q, inertia=3.0 * inertia)  # up to a factor
    (impact,) = track.impacts
    errors = np.sqrt(np.diag(impact.covariance))
    error = np.concatenate([impact.pre - BEFORE, impact.post - after])
    assert np.abs(error / errors).max() < 4
    assert not track.warnings
    assert track.experiments(BRICK).contacts.tolist() == [1]
    for sigma in (NOISE, None):
        as_sphere = found(t, q, sigma)
        assert any(
            "turn freely" in x or "residuals of" in x for x in as_sphere.warnings
        )
    with pytest.raises(ValueError, match=argument("scene")):
        as_sphere.experiments(BRICK)


@pytest.mark.slow
def test_both_orders_of_quaternions_and_both_signs():
    rng = np.random.default_rng(3)
    t, q = seen(landed(CUBE)[0], rng)
    track, flipped = found(t, q), q.copy()
    flipped[:, 3:] *= np.where(rng.random(len(t)) < 0.5, 1.0, -1.0)[:, None]
    other = found(t, flipped[:, TO_XYZW], order="xyzw")
    for each in (found(t, flipped), other):
        np.testing.assert_allclose(each.impacts[0].pre, track.impacts[0].pre, rtol=1e-9)
        np.testing.assert_allclose(each.covariance, track.covariance, rtol=1e-6)
    np.testing.assert_allclose(
        np.abs(other.impacts[0].q), np.abs(track.impacts[0].q), rtol=1e-9
    )
    shots, law = other.experiments(CUBE), ji.Newton(0.5, friction=0.1)
    fit = ji.fit(law, None, shots, free=("restitution", "friction"), starts=1)
    assert fit.warnings == ()
    assert (np.abs(fit.value - [0.6, 0.2]) < 4 * fit.standard_error).all()
    held = ji.fit(law, None, shots, starts=1)
    assert held.found("lack_of_fit")
    assert "`friction` is held" in held.warnings[0]
    for wrong, order in ((q, "xyzw"), (q[:, TO_XYZW], "wxyz")):
        with pytest.raises(ValueError, match=argument("quaternion")):
            found(t, wrong, order=order).experiments(CUBE)


def test_lost_frames_and_unknown_noise_of_poses():
    rng, (poses, after) = np.random.default_rng(4), landed(CUBE)
    t, q = seen(poses, rng)
    q[rng.choice(50, 5, replace=False)] = np.nan
    q[[20, 30], 3:] = np.nan  # the place alone was seen
    track = found(t, q, None)
    np.testing.assert_allclose(track.sigma, NOISE, rtol=0.4)
    (impact,) = track.impacts
    error = np.concatenate([impact.pre - BEFORE, impact.post - after])
    assert np.abs(error / np.sqrt(np.diag(impact.covariance))).max() < 5
    assert "1 impact" in str(track)
    assert len(track.plot().axes) == 12


def test_what_poses_must_be():
    t, q = seen(landed(CUBE)[0], np.random.default_rng(5))
    angles = np.hstack([q[:, :3], np.degrees(q[:, 3:])])
    zeros, turned = np.where(np.arange(50)[:, None] == 7, 0.0, q), q.copy()
    turned[np.arange(50) > 24, 3:] = np.nan
    for arguments, words in (
        ({"q": angles}, "frame 1 has length"),
        ({"q": zeros}, "frame 8 has length 0.* NaN"),
        ({"q": q[:, :6]}, r"shape \(T, 7\)"),
        ({"q": turned}, "orientation in 2 frames"),
        ({"order": "wyxz"}, "`quaternion`"),
        ({"sigma": [1e-4] * 7}, r"\(6,\)"),
        ({"sigma": [1e-4] * 5 + [0.0]}, "`sigma`"),
        ({"inertia": [1.0, -1.0, 1.0]}, "`inertia`"),
        ({"inertia": [1.0, 2.0]}, "`inertia`"),
        ({"order": None, "inertia": [1.0, 2.0, 2.0]}, "`quaternion`"),
        ({"units": "m"}, "`units`"),
    ):
        with pytest.raises(ValueError, match=words):
            found(**({"t": t, "q": q} | arguments))
    track = found(t, q, [1e-4] * 3 + [0.5] * 3)
    assert any("degrees" in line for line in track.warnings)
    still = found(t[:20], q[:20])
    assert not still.impacts
    assert "No impact" in still.warnings[0]


def test_turns_that_do_not_meet_are_told():
    """Orientations one frame late: a filter of three frames, or clocks that differ."""
    t, q = seen(landed(CUBE)[0], np.random.default_rng(6))
    late = np.hstack([q[1:, :3], q[:-1, 3:]])
    assert any("do not meet" in line for line in found(t[1:], late).warnings)


def test_a_study_of_poses(tmp_path):
    t, q = seen(landed(CUBE)[0], np.random.default_rng(7))
    names = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
    rows = np.column_stack([t, q[:, TO_XYZW]])
    lines = [",".join(names), *(",".join(f"{x:.7f}" for x in row) for row in rows)]
    (tmp_path / "cube.csv").write_text("\n".join(lines))
    study = """
    [scene]
    kind = "Box"
    sizes_m = [0.1, 0.1, 0.1]
    mass_kg = 0.3
    q = [0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0]
    [law]
    name = "Newton"
    restitution = 0.5
    friction = 0.1
    [track]
    file = "cube.csv"
    time = "t"
    columns = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    unit = ["m", "m", "m", "1", "1", "1", "1"]
    quaternion = "xyzw"
    acceleration = [0.0, 0.0, -9.80665]
    """
    path = tmp_path / "study.toml"
    path.write_text(study)
    data = ji.read_study(path).experiments
    assert data.contacts.tolist() == [1]
    np.testing.assert_allclose(data.pre[0], BEFORE, atol=0.02)
    for old, new, words in (
        ('"xyzw"', '"zyxw"', "`quaternion`"),
        ('"xyzw"', "4", "`quaternion` in .* must be a text"),
        ('quaternion = "xyzw"', "", "7"),
        ('"xyzw"', '"xyzw"\n    inertia = [1.0, 1.0, 2.0]', "moments of inertia"),
        ('"xyzw"', '"xyzw"\n    drag = "much"', "`drag` in .* must be a number"),
    ):
        path.write_text(study.replace(old, new))
        with pytest.raises(ValueError, match=words):
            ji.read_study(path)
    path.write_text(study.replace('"xyzw"', '"xyzw"\n    drag = "unknown"'))
    assert abs(ji.read_study(path).track.drag) < 1.0


@pytest.mark.parametrize("spin", [20.0, 30.0])
def test_a_ball_that_turns_fast_has_no_jumps_but_its_own(spin):
    """Up to a third of a radian between frames: errors of sums of turns are no impacts."""
    t = np.arange(100) / 100
    before = np.array([spin, 0.0, 0.0])
    after = before + np.array([-0.5, 0.4, 0.3])
    for seed in range(7):
        rng = np.random.default_rng(seed)
        places = np.outer(t, [0.2, 0.1, 1.5]) - np.outer(t**2, [0, 0, G / 2])
        places += 1e-3 * rng.normal(size=places.shape)
        noise = Rotation.from_rotvec(5e-3 * rng.normal(size=places.shape))
        since = (t - 0.5)[:, None]
        found, none = (
            ji.tracks.find_impacts(
                t,
                np.hstack([places, (Rotation.from_rotvec(turned) * noise).as_quat()]),
                acceleration=[0, 0, -G],
                quaternion="xyzw",
            )
            for turned in (np.where(since < 0, before, after) * since, before * since)
        )
        assert not none.impacts
        (impact,) = found.impacts
        omega = np.concatenate([impact.pre[3:] - before, impact.post[3:] - after])
        errors = np.sqrt(np.diag(impact.covariance))
        of_omega = np.concatenate([errors[3:6], errors[9:]])
        assert np.abs(omega / of_omega).max() < 4.5


def test_impacts_that_change_the_turning_alone_are_found():
    """A ball in flight whose spin alone jumps; without a jump none is found."""
    rng = np.random.default_rng(31)
    apart = []
    for _ in range(10):
        t = (np.arange(80) + rng.random()) / 150
        since = (t - 0.27)[:, None]
        v = np.array([0.2, -0.1, 1.3])
        jump = np.array([1.5, 2.0, -1.0])
        spin = np.array([2.0, -3.0, 1.0])
        places = v * since - np.array([0, 0, G / 2]) * since**2
        places = places + 2e-4 * rng.normal(size=places.shape)
        noise = Rotation.from_rotvec(1e-3 * rng.normal(size=places.shape))
        before = Rotation.from_rotvec(spin * since)
        after = Rotation.from_rotvec(np.where(since < 0, spin, spin + jump) * since)
        sigma = [2e-4] * 3 + [1e-3] * 3
        found, none = (
            ji.tracks.find_impacts(
                t,
                np.hstack([places, (turns * noise).as_quat()]),
                sigma,
                acceleration=[0, 0, -G],
                quaternion="xyzw",
            )
            for turns in (after, before)
        )
        assert not none.impacts
        assert "No impact" in none.warnings[0]
        assert not any("No impact" in line for line in found.warnings)
        (impact,) = found.impacts
        assert abs(impact.time - 0.27) < 5 * impact.time_error
        errors = np.sqrt(np.diag(impact.covariance))
        omega = np.concatenate([impact.pre[3:] - spin, impact.post[3:] - spin - jump])
        apart.append(omega / np.concatenate([errors[3:6], errors[9:]]))
    assert 0.7 < np.sqrt(np.mean(np.square(apart))) < 1.3


def test_shots_hold_what_errors_of_orientations_do_to_lever_arms():
    """v+ of a corner lies as far from its law as the shots' covariance says."""
    rng = np.random.default_rng(32)
    body = ji.Box([0.1, 0.1, 0.1], mass=0.3)
    law = ji.Newton(0.6, friction=0.2)
    turn = Rotation.from_rotvec([0.5, 0.3, 0.2])
    pose = np.asarray(body.touching(np.roll(turn.as_quat(), 1)))
    before = np.array([0.3, -0.2, -1.5, 3.0, -2.0, 4.0])
    after = np.asarray(ji.impact(law, body.scenes([pose])[0], before).velocity)
    sizes = {"with": [], "without": []}
    for _ in range(12):
        t = (np.arange(50) + rng.random()) / 148
        since = (t - 0.17)[:, None]
        v = np.where(since < 0, before, after)
        places = pose[:3] + v[:, :3] * since - np.array([0, 0, G / 2]) * since**2
        places = places + 1e-4 * rng.normal(size=(50, 3))
        noise = Rotation.from_rotvec(1e-3 * rng.normal(size=(50, 3)))
        turns = turn * Rotation.from_rotvec(v[:, 3:] * since) * noise
        track = ji.tracks.find_impacts(
            t,
            np.hstack([places, turns.as_quat()]),
            [1e-4] * 3 + [1e-3] * 3,
            acceleration=[0, 0, -G],
            quaternion="xyzw",
        )
        shots = track.experiments(body, near=5e-3)

        def predicted(v, scene=shots.scenes[0]):
            return ji.impact(law, scene, v).velocity

        slopes = np.asarray(jax.jacobian(predicted)(shots.pre[0]))
        gain = np.hstack([-slopes, np.eye(6)])
        rest = shots.post[0] - np.asarray(predicted(shots.pre[0]))
        for name, C in (
            ("with", shots.covariance[0]),
            ("without", track.impacts[0].covariance),
        ):
            whole = gain @ np.asarray(C) @ gain.T
            sizes[name].append(rest @ np.linalg.solve(whole, rest))
    assert 3.5 < np.mean(sizes["with"]) < 9.5  # of 6
    assert np.mean(sizes["without"]) > 15
