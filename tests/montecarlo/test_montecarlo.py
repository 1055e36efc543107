"""Monte Carlo: statistics, distributions, failures, resume, sensitivity."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from montecarlo_cases import BALLS, BEFORE, CHUNK, GAPS, LAW, sampled, sometimes_bad
from refusals import argument
from scipy import stats

import jimpact as ji
from jimpact import (
    STATUS,
    Binary,
    Compliant,
    Hertz,
    Newton,
    Normal,
    RandomLaw,
    Uniform,
    chain,
    impact,
    monte_carlo,
    read_samples,
)
from jimpact.theory import gap_sensitivity

LEFT, RIGHT = (
    np.array([-0.6, -0.16, 1.24]),
    np.array([-1.24, 0.16, 0.6]),
)  # which contact is first


def test_statistics_are_those_of_the_raw_samples(tmp_path):
    law = RandomLaw(LAW, restitution=Uniform(0.8, 1.0))
    result = sampled(law=law, folder=tmp_path, keep_samples=True)
    parts = list(read_samples(tmp_path))
    assert [len(part["status"]) for part in parts] == [256, 256, 256, 232]
    v, gaps = (
        np.concatenate([part[name] for part in parts]) for name in ("velocity", "gaps")
    )
    both = np.concatenate([v, gaps], axis=1)
    covariance = np.cov(both.T)
    np.testing.assert_allclose(result.mean, v.mean(axis=0), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(result.covariance, covariance[:3, :3], rtol=1e-12)
    np.testing.assert_allclose(result.gap_mean, gaps.mean(axis=0), rtol=1e-13)
    np.testing.assert_allclose(result.gap_covariance, covariance[3:, 3:], rtol=1e-11)
    np.testing.assert_allclose(result.cross_covariance, covariance[:3, 3:], rtol=1e-10)
    np.testing.assert_array_equal(result.minimum, v.min(axis=0))
    np.testing.assert_array_equal(result.maximum, v.max(axis=0))
    assert result.counts.sum(axis=1).tolist() == [1000] * 3
    for q in (0.0, 0.05, 0.31, 0.95, 1.0):
        wanted = np.quantile(v, q, axis=0, method="inverted_cdf")
        assert np.all(np.abs(result.quantile(q) - wanted) <= result.quantile_resolution)
    np.testing.assert_allclose(
        result.standard_error, v.std(axis=0, ddof=1) / np.sqrt(1000)
    )
    np.testing.assert_array_equal(result.first["velocity"], parts[0]["velocity"])


def test_each_sample_is_the_impact_of_its_gaps():
    result = sampled(samples=300)
    gaps, v = result.first["gaps"], result.first["velocity"]
    closes_first = np.where((gaps[:, 0] < gaps[:, 1])[:, None], LEFT, RIGHT)
    np.testing.assert_allclose(v, closes_first[:256], atol=1e-14)
    share = np.mean(gaps[:, 0] < gaps[:, 1])
    assert 0.4 < share < 0.6
    law, scene, velocity = result.replay(7)
    assert np.asarray(scene.gaps).tobytes() == gaps[7].tobytes()
    np.testing.assert_allclose(impact(law, scene, velocity).velocity, v[7], atol=1e-14)
    last = result.replay(299)[1].gaps
    assert not np.array_equal(
        np.asarray(last), gaps[299 - 256]
    )  # another chunk, other draws
    with pytest.raises(ValueError, match=argument("index", "300")):
        result.replay(300)


@pytest.mark.slow
def test_random_parameters_velocities_and_their_analytic_moments():
    balls = chain([1.0, 1.0])
    result = monte_carlo(
        RandomLaw(Newton(0.5), restitution=Uniform(0.6, 1.0)),
        balls,
        [1.0, 0.0],
        samples=4000,
        chunk=1000,
    )
    # v2+ = (1 + e) / 2
    assert abs(result.mean[1] - 0.9) < 4 * result.standard_error[1]
    np.testing.assert_allclose(result.std[1], 0.2 / np.sqrt(12), rtol=0.03)
    np.testing.assert_allclose(result.quantile(0.25)[1], 0.85, atol=0.01)
    assert result.gap_mean.shape == (0,)
    moving = monte_carlo(
        Newton(0.5), balls, Normal([2.0, 0.0], 0.1), samples=4000, chunk=1000
    )
    a = np.array([[0.25, 0.75], [0.75, 0.25]])  # v+ = A v-, all of them approach
    np.testing.assert_allclose(
        moving.mean, a @ [2.0, 0.0], atol=4 * 0.1 / np.sqrt(4000)
    )
    np.testing.assert_allclose(moving.covariance, 0.01 * a @ a.T, rtol=0.1)
    result = monte_carlo(
        lambda key: Newton(jax.random.uniform(key)),
        balls,
        [1.0, 0.0],
        samples=10,
        chunk=16,
    )
    e = np.array([float(result.replay(i)[0].restitution) for i in range(10)])
    np.testing.assert_allclose(result.first["velocity"][:, 1], (1 + e) / 2, atol=1e-15)


def test_given_samples_are_used_row_by_row():
    rng = np.random.default_rng(0)
    gaps = rng.uniform(0, 1e-5, (300, 2))
    result = monte_carlo(LAW, BALLS, BEFORE, gaps, chunk=CHUNK)
    assert result.samples == 300
    np.testing.assert_array_equal(result.first["gaps"], gaps[:256])
    wanted = np.where((gaps[:, 0] < gaps[:, 1])[:, None], LEFT, RIGHT)
    np.testing.assert_allclose(result.mean, wanted.mean(axis=0), atol=1e-14)
    np.testing.assert_array_equal(np.asarray(result.replay(299)[1].gaps), gaps[299])
    with pytest.raises(ValueError, match=argument("samples", "301")):
        monte_carlo(LAW, BALLS, BEFORE, gaps, samples=301)
    rows = np.array(
        [[1.0, 0.0, -1.0], [0.5, 0.0, -1.0]]
    )  # of velocities: they alone are random
    result = monte_carlo(LAW, BALLS, rows, chunk=CHUNK)
    np.testing.assert_array_equal(result.first["velocity_before"], rows)


def test_random_parameters_are_independent():
    law = RandomLaw(
        ji.LZB(0.5, 1.0), restitution=Uniform(0.0, 1.0), stiffness=Uniform(1.0, 2.0)
    )
    drawn = [law(jax.random.key(i)) for i in range(50)]
    e, k = np.array([[float(x.restitution), float(x.stiffness) - 1] for x in drawn]).T
    assert abs(np.corrcoef(e, k)[0, 1]) < 0.5


def test_truncated_normal_gaps():
    normal = Normal([1.0, 3.0], [2.0, 0.1])
    draws = jax.vmap(lambda key: normal.sample(key, 2, jnp.float64, True))(
        jax.random.split(jax.random.key(3), 20_000)
    )
    assert float(draws.min()) >= 0
    wanted = stats.truncnorm(-0.5, np.inf, loc=1.0, scale=2.0)
    assert stats.kstest(np.asarray(draws[:, 0]), wanted.cdf).pvalue > 1e-3
    np.testing.assert_allclose(float(draws[:, 1].std()), 0.1, rtol=0.03)
    far = jax.vmap(lambda key: Normal(0.0, 1e-9).sample(key, 1, jnp.float64, True))(
        jax.random.split(jax.random.key(0), 100)
    )
    assert bool(jnp.all((far >= 0) & (far < 1e-8)))


OVERLAP = "-1e-06"  # [m]; what is compressed before the impact is `initial_energy`


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"samples": 0}, ValueError, argument("samples", 0)),
        ({"samples": -3}, ValueError, argument("samples", -3)),
        ({"samples": 1e3}, ValueError, argument("samples", 1000.0)),
        ({"samples": True}, ValueError, argument("samples", True)),
        ({"chunk": 0}, ValueError, argument("chunk", 0)),
        ({"bins": 0}, ValueError, argument("bins", 0)),
        ({"key": "seed"}, TypeError, argument("key", "seed")),
        ({"key": jax.random.split(jax.random.key(0))}, ValueError, argument("key")),
        ({"workers": 0}, ValueError, argument("workers", 0)),
        ({"workers": -1}, ValueError, argument("workers", -1)),
        ({"workers": "all"}, ValueError, argument("workers", "all")),
        ({"workers": 2, "executor": "devices"}, ValueError, argument("workers")),
        ({"executor": "cloud"}, ValueError, argument("executor", "cloud")),
        ({"keep_samples": True}, ValueError, argument("folder")),
        ({"law": 3.0}, TypeError, argument("law", 3.0)),
        ({"law": lambda key: 3.0}, TypeError, argument("law")),
        ({"velocity": [1.0, 0.0]}, ValueError, argument("velocity", "(2,)")),
        ({"velocity": [1.0, np.nan, 0.0]}, ValueError, argument("velocity", "nan")),
        ({"gaps": None}, ValueError, argument("gaps")),
        ({"gaps": [0.0, -1e-6]}, ValueError, "`initial_energy`"),
        (
            {"gaps": [[0.0, 1e-6], [0.0, -1e-6]]},
            ValueError,
            rf"{OVERLAP}.*`initial_energy`",
        ),
        ({"gaps": Uniform(-1e-6, 1e-5)}, ValueError, rf"{OVERLAP}.*`initial_energy`"),
        ({"gaps": Normal(-1e-6, 1e-5)}, ValueError, "`initial_energy`"),
        ({"gaps": Uniform(0.0, [1e-5] * 3)}, ValueError, "`high`"),
        ({"gaps": lambda key: jnp.zeros(3)}, ValueError, argument("gaps(key)", "(3,)")),
    ],
)
def test_bad_arguments_are_named(change, error, message):
    with pytest.raises(error, match=message):
        sampled(**change)


def test_bad_distributions_are_named():
    with pytest.raises(ValueError, match=argument("high")):
        Uniform(1.0, 0.0)
    with pytest.raises(ValueError, match=argument("std", "0")):
        Normal(0.0, 0.0)
    with pytest.raises(
        ValueError, match="that can be random are restitution, but not `friction`"
    ):
        RandomLaw(LAW, friction=Uniform(0.0, 1.0))
    with pytest.raises(
        ValueError,
        match=argument("restitution"),
    ):
        RandomLaw(LAW, restitution=Uniform(0.5, 1.5))
    with pytest.raises(ValueError, match=argument("restitution")):
        RandomLaw(LAW, restitution=Normal(0.5, 0.01))
    assert (
        RandomLaw(Compliant(Hertz(1.0)), stiffness=Uniform(1.0, 2.0))(
            jax.random.key(0)
        ).force.stiffness
        > 1
    )


def test_bad_draws_are_counted_listed_and_kept_apart():
    with pytest.warns(
        UserWarning, match=r"of 600 samples failed .* bad_gap\); see `bad` and `replay`"
    ):
        result = sampled(samples=600, gaps=sometimes_bad)
    draws = np.stack([np.asarray(result.replay(i)[1].gaps) for i in (0, 1)])
    np.testing.assert_array_equal(draws, result.first["gaps"][:2])
    fine = (result.first["gaps"] >= 0).all(axis=1)
    assert 0 < (~fine).sum() < 50
    assert result.statuses["bad_gap"] == result.samples - result.count
    assert len(result.bad) <= 20
    assert [bad.index for bad in result.bad[: (~fine).sum()]] == np.flatnonzero(~fine)[
        :20
    ].tolist()
    bad = result.bad[0]
    assert bad.status == "bad_gap"
    assert np.asarray(result.replay(bad.index)[1].gaps).tobytes() == bad.gaps.tobytes()
    np.testing.assert_allclose(
        np.abs(result.mean).max(), 0.92, atol=0.05
    )  # NaN went nowhere
    assert np.isfinite(result.gap_mean).all()
    report = str(result)
    assert f"bad_gap: {result.statuses['bad_gap']}, left out" in report
    assert f"replay({bad.index})" in report
    json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_failed_impacts_are_kept_apart():
    # one collision is allowed: enough for the first row, not for the second
    rows = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0]] * 4)
    law = Binary(1.0, order="earliest", max_collisions=1)
    with pytest.warns(UserWarning, match="4 of 8 samples failed"):
        result = monte_carlo(law, BALLS, rows, [0.0, 1e-6], chunk=8)
    assert result.statuses == {"ok": 4, "max_steps": 4}
    np.testing.assert_allclose(
        result.mean, impact(law, BALLS, rows[0]).velocity, atol=1e-15
    )
    assert [bad.index for bad in result.bad] == [1, 3, 5, 7]
    np.testing.assert_array_equal(result.bad[0].velocity, rows[1])
    with pytest.raises(
        RuntimeError,
        match="None of the first 8 samples gave a usable outcome: 8 max_steps",
    ):
        monte_carlo(law, BALLS, rows[1:2].repeat(8, axis=0), [0.0, 1e-6], chunk=8)


def test_parameters_out_of_their_domain_fail():
    law = lambda key: Newton(2 * jax.random.uniform(key))  # noqa: E731
    with pytest.warns(UserWarning, match="bad_law"):
        result = monte_carlo(law, chain([1.0, 1.0]), [1.0, 0.0], samples=100, chunk=128)
    assert 20 < result.statuses["bad_law"] < 80
    assert result.maximum[1] <= 1.0


@pytest.fixture(scope="module")
def whole():
    return sampled()


def test_a_quantile_is_a_number(whole):
    with pytest.raises(TypeError, match=argument("q", "None")):
        whole.quantile(None)


def test_a_folder_of_another_run_is_refused(tmp_path):
    sampled(folder=tmp_path)
    with pytest.raises(ValueError, match="gaps, key:"):
        sampled(folder=tmp_path, gaps=Uniform(0.0, 2e-5), key=1)
    with pytest.raises(ValueError, match="law:"):
        sampled(folder=tmp_path, law=Binary(0.9, order="earliest"))
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest\.json'"):
        sampled(folder=tmp_path)
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(ValueError, match=r"no manifest\.json"):
        sampled(folder=tmp_path)


LOSSY = Compliant(ji.Bistiffness(1e4, 1.5, 0.6))


SPEEDS = Uniform([0.0, 0.0, -2.0], [0.0, 0.0, -1.0])


SAMPLES = 2100  # 8 chunks, and a ninth that is not full


def struck(law=LOSSY, samples=SAMPLES, **options):
    return monte_carlo(law, BALLS, SPEEDS, None, samples, chunk=CHUNK, **options)


@pytest.mark.slow
def test_a_run_is_as_fine_as_its_standard_errors_need(tmp_path):
    """The error of a coarser tolerance is measured, stated, and a tenth of them at most."""
    result = struck()
    assert result.rtol > 1e-7
    assert 0 < result.rtol_error <= 0.1
    assert f"integrated to rtol = {result.rtol:g}" in str(result)
    fine = struck(Compliant(LOSSY.force, rtol=1e-9))  # the law's own holds
    assert fine.rtol is None
    assert "integrated" not in str(fine)
    moved = np.abs(result.mean - fine.mean) / fine.standard_error
    assert 0 < moved.max() <= result.rtol_error
    after, before = result.first["velocity"], result.first["velocity_before"][:, 2]
    parts = after / before[:, None]  # of a scale: v+ is proportional to v-
    np.testing.assert_allclose(
        parts, np.broadcast_to(parts[:1], parts.shape), rtol=1e-3
    )
    law, *where = result.replay(7)
    np.testing.assert_allclose(impact(law, *where).velocity, after[7], rtol=1e-13)
    few = struck(samples=700)  # looking would take longer than it saves
    assert (few.rtol, few.rtol_error) == (1e-8, 0.0)
    kept = struck(folder=tmp_path, keep_samples=True)  # here the samples are the result
    assert kept.rtol_error == 0.0
    assert struck(Newton(0.5)).rtol is None


def test_a_folder_keeps_its_tolerance(tmp_path):
    """A run that goes on from chunks in a folder is, to the bit, one without a folder:
    with the tolerance that the first chunk had found, though this chunk is lost.
    """
    whole = struck(workers=3)
    stored = struck(folder=tmp_path)
    assert stored.rtol == whole.rtol
    first, second, *_ = sorted(tmp_path.glob("chunk-*.npz"))
    first.unlink()
    second.unlink()
    again = struck(folder=tmp_path, executor="serial")
    assert again.resumed == SAMPLES - 2 * CHUNK
    assert again.rtol == whole.rtol
    assert again.rtol_error == whole.rtol_error
    assert again.mean.tobytes() == whole.mean.tobytes()
    assert again.covariance.tobytes() == whole.covariance.tobytes()
    more = struck(samples=SAMPLES + 300, folder=tmp_path)
    full_chunks = SAMPLES // CHUNK  # the last one was not full: it is run again
    assert more.resumed == full_chunks * CHUNK
    assert more.rtol == whole.rtol


@pytest.mark.slow
def test_an_impact_to_a_given_tolerance():
    coarse = Compliant(LOSSY.force, rtol=1e-3)
    before = jnp.array([0.0, 0.0, -1.0])
    wanted = impact(coarse, BALLS, before).velocity
    out = jax.jit(lambda rtol: impact(LOSSY, BALLS, before, rtol=rtol))(1e-3)
    np.testing.assert_allclose(out.velocity, wanted, rtol=1e-14)
    assert float(out.accuracy) == 1e-3
    own = impact(coarse, BALLS, before, rtol=1e-8).velocity  # the law's own holds
    np.testing.assert_allclose(own, wanted, rtol=1e-14)
    with pytest.raises(ValueError, match=argument("rtol", "0")):
        impact(LOSSY, BALLS, before, rtol=0.0)
    with pytest.raises(ValueError, match=argument("rtol", "1e-20")):
        impact(LOSSY, BALLS, before, rtol=1e-20)
    traced = jax.jit(
        jax.vmap(lambda rtol: impact(LOSSY, BALLS, before, rtol=rtol).status)
    )
    codes = traced(jnp.array([1e-3, 0.0, 1e-20, 2.0, -1.0, jnp.inf, jnp.nan]))
    names = [STATUS[int(code)].name for code in codes]
    assert names == ["ok", *["out_of_range"] * 5, "not_finite"]


@pytest.mark.release
def test_the_linearization_beside_monte_carlo():
    law = Compliant(Hertz(1.0))  # indentations of about 0.5 m: metre-sized gaps
    sampler = {"law": law, "samples": 256, "bins": 50}
    narrow = sampled(gaps=Uniform([0.30, 0.32], [0.31, 0.33]), **sampler)
    close = gap_sensitivity(law, BALLS, BEFORE, narrow.gap_mean, narrow)
    np.testing.assert_allclose(close.explained, 1.0, atol=0.02)
    assert "nearly linear" in str(close)
    scale = ji.theory.gap_scale(
        BALLS, law, BEFORE
    ).delta  # the report has gaps in units of it
    np.testing.assert_array_equal(narrow.gap_scale, scale)
    ratio = narrow.gap_mean[0] / scale[0]
    assert f"in units of delta_c = {scale[0]:.3g} m: {ratio:.3g} and " in str(narrow)
    assert "delta_c: indentation of a contact" in str(narrow)
    assert narrow.to_dict()["gap_scale"] == scale.tolist()
    wide = sampled(gaps=Uniform([0.0, 0.0], [3.0, 3.0]), **sampler)
    across = gap_sensitivity(law, BALLS, BEFORE, wide.gap_mean, wide)
    assert np.all(np.abs(across.explained - 1) > 0.2)
    assert "fails over this spread" in str(across)
    h = 1e-5
    rows = np.array([[0.3 + h, 0.32], [0.3 - h, 0.32]])
    pair = sampled(gaps=rows, **(sampler | {"samples": 2})).first["velocity"]
    exact = gap_sensitivity(law, BALLS, BEFORE, [0.3, 0.32])
    np.testing.assert_allclose(
        exact.jacobian[:, 0], (pair[0] - pair[1]) / (2 * h), atol=1e-4
    )
    # moving everything apart by the same time changes nothing: both contacts approach at speed 1
    np.testing.assert_allclose(exact.jacobian.sum(axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(
        exact.covariance(np.eye(2)), exact.jacobian @ exact.jacobian.T
    )


@pytest.mark.release
def test_where_the_linearization_has_nothing_to_say(whole):
    assert whole.gap_scale is None
    jumps = gap_sensitivity(LAW, BALLS, BEFORE, whole.gap_mean, whole)
    assert not jumps.jacobian.any()
    assert "jumps where the order of the collisions changes" in str(jumps)
    fastest = Binary(0.5, order="fastest")
    ignores = monte_carlo(fastest, BALLS, BEFORE, GAPS, samples=50, chunk=64)
    assert "does not depend on the gaps" in str(
        gap_sensitivity(fastest, BALLS, BEFORE, [1e-6, 1e-6], ignores)
    )
    with pytest.raises(ValueError, match="leaves open contacts out"):
        monte_carlo(Newton(0.5), BALLS, BEFORE, GAPS, samples=50, chunk=64)
    with pytest.raises(ValueError, match="`gaps` must lie in"):
        gap_sensitivity(LAW, BALLS, BEFORE, [0.0, -1.0])
    with pytest.raises(ValueError, match="`sampled` must be given"):
        _ = gap_sensitivity(LAW, BALLS, BEFORE, [0.0, 1e-6]).explained


def test_progress_is_reported_on_request(capfd):
    sampled(progress=True)
    progress = capfd.readouterr().err
    assert "1,000 of 1,000 samples" in progress
    assert "/s" in progress
    sampled()
    assert capfd.readouterr().err == ""
