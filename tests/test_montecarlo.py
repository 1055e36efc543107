"""Monte Carlo: statistics, distributions, failures, resume, sensitivity."""

import errno
import json
import os
import shutil
import subprocess
import sys
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jimpact as ji
from jimpact import (
    Binary,
    Compliant,
    Hertz,
    Newton,
    Normal,
    RandomLaw,
    Uniform,
    chain,
    gap_scale,
    gap_sensitivity,
    impact,
    monte_carlo,
    read_samples,
)
from jimpact.montecarlo import statistics as histograms, store
from jimpact.montecarlo.statistics import merged, moments
from jimpact.montecarlo.store import fingerprint
from jimpact.registry import registered_laws

BALLS = chain([0.25, 1.0, 0.25])
LAW = Binary(1.0, order="earliest")
BEFORE = [1.0, 0.0, -1.0]
LEFT, RIGHT = np.array([-0.6, -0.16, 1.24]), np.array([-1.24, 0.16, 0.6])  # which contact is first
GAPS = Uniform(0.0, 1e-5)
CHUNK = 256  # one compiled program for most of this file


def sampled(samples=1000, law=LAW, velocity=BEFORE, gaps=GAPS, **options):
    return monte_carlo(law, BALLS, velocity, gaps, samples, **({"chunk": CHUNK} | options))


def same(a, b):
    """Bitwise, in everything but the time it took."""
    names = "samples count mean covariance minimum maximum gap_mean gap_covariance edges counts statuses first"
    return all(
        fingerprint(getattr(a, name)) == fingerprint(getattr(b, name)) for name in names.split()
    ) and (fingerprint(a.bad) == fingerprint(b.bad))


# ------------------------------------------------------------------ statistics


def test_statistics_are_those_of_the_raw_samples(tmp_path):
    law = RandomLaw(LAW, restitution=Uniform(0.8, 1.0))
    result = sampled(law=law, folder=tmp_path, keep_samples=True)
    parts = list(read_samples(tmp_path))
    assert [len(part["status"]) for part in parts] == [256, 256, 256, 232]
    v, gaps = (np.concatenate([part[name] for part in parts]) for name in ("velocity", "gaps"))
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
    np.testing.assert_allclose(result.standard_error, v.std(axis=0, ddof=1) / np.sqrt(1000))
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
    assert not np.array_equal(np.asarray(last), gaps[299 - 256])  # another chunk, other draws
    with pytest.raises(ValueError, match=r"`index` must lie in \[0, 299\], but has value 300"):
        result.replay(300)


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
    moving = monte_carlo(Newton(0.5), balls, Normal([2.0, 0.0], 0.1), samples=4000, chunk=1000)
    a = np.array([[0.25, 0.75], [0.75, 0.25]])  # v+ = A v-, all of them approach
    np.testing.assert_allclose(moving.mean, a @ [2.0, 0.0], atol=4 * 0.1 / np.sqrt(4000))
    np.testing.assert_allclose(moving.covariance, 0.01 * a @ a.T, rtol=0.1)
    result = monte_carlo(
        lambda key: Newton(jax.random.uniform(key)), balls, [1.0, 0.0], samples=10, chunk=16
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
    with pytest.raises(ValueError, match="`samples` must be at most 300, the rows of `gaps`"):
        monte_carlo(LAW, BALLS, BEFORE, gaps, samples=301)


def test_float32_samples_are_summed_in_float64():
    rng = np.random.default_rng(1)
    values = (1000 + 0.01 * rng.standard_normal((1, 200_000))).astype(np.float32)
    exact = values.astype(float)
    whole = moments(values[:, :1])
    for part in np.array_split(values[:, 1:], 37, axis=1):
        whole = merged(whole, moments(part))
    assert whole.count == 200_000
    np.testing.assert_allclose(whole.mean, exact.mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(whole.covariance[0, 0], exact.var(ddof=1), rtol=1e-10)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (Newton(0.5), chain([1.0, 1.0])))
    ends = Uniform(*(jnp.float32(x) for x in (1.0, 2.0)))
    result = monte_carlo(
        single[0],
        single[1],
        lambda k: jnp.stack([ends.sample(k, 1, jnp.float32, False)[0], jnp.float32(0)]),
        samples=50,
        chunk=64,
    )
    assert result.first["velocity"].dtype == np.float32
    assert result.mean.dtype == np.float64


def test_histograms_hold_what_lies_outside_the_first_range():
    ends = histograms.bin_range(np.array([[0.0, 1.0], [3.0, 3.0]]))
    np.testing.assert_allclose(ends[0], [-0.1, 1.1])
    assert ends[1, 0] < 3.0 < ends[1, 1]
    counts = histograms.bin_counts(
        np.array([[-5.0, 0.5, 9.0, 7.0], [3.0, 3.0, 3.0, 3.0]]), ends, 10
    )
    assert counts[0, 0] == 1
    assert counts[0, -1] == 2
    assert counts[1].max() == 4
    low, high = np.array([-5.0, 3.0]), np.array([9.0, 3.0])
    assert histograms.binned_quantiles(0.0, ends, counts, low, high).tolist() == [-5.0, 3.0]
    assert histograms.binned_quantiles(1.0, ends, counts, low, high).tolist() == [9.0, 3.0]
    assert -5.0 <= histograms.binned_quantiles(0.2, ends, counts, low, high)[0] <= -0.1


def test_chunks_of_unequal_size_are_merged():
    values = np.random.default_rng(0).normal([[1.0], [5.0]], 1.0, (2, 10))
    whole = merged(moments(values[:, :3]), moments(values[:, 3:]))
    np.testing.assert_allclose(whole.mean, values.mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(whole.covariance, np.cov(values), rtol=1e-13)


def test_bad_samples_are_numbered_over_all_chunks():
    """Of 8 samples a chunk, the last of which counts 5 of them."""
    row = histograms.OUTCOMES.index(next(x for x in histograms.OUTCOMES if x.failure))
    samples = {
        "gaps": np.zeros((8, 1)),
        "velocity_before": np.zeros((8, 2)),
        "velocity": np.arange(16.0).reshape(8, 2),
        "status": np.array([0, 0, row, 0, 0, row, 0, 0]),
    }
    task = histograms.Task(number=3, count=5, ends=np.array([[0.0, 9.0], [0.0, 9.0]]))
    chunk = histograms.reduced(task, samples, 4, False)
    assert chunk.bad["index"].tolist() == [3 * 8 + 2]
    assert chunk.moments.count == 4


def test_random_parameters_are_independent():
    law = RandomLaw(ji.LZB(0.5, 1.0), restitution=Uniform(0.0, 1.0), stiffness=Uniform(1.0, 2.0))
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


# ------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"samples": 0}, ValueError, "`samples` must be an int >= 1, but has value 0"),
        ({"samples": -3}, ValueError, "`samples` must be an int >= 1"),
        ({"samples": 1e3}, ValueError, "`samples` must be an int >= 1, but has value 1000.0"),
        ({"samples": True}, ValueError, "`samples` must be an int >= 1"),
        ({"chunk": 0}, ValueError, "`chunk` must be an int >= 1"),
        ({"bins": 0}, ValueError, "`bins` must be an int >= 1"),
        ({"key": "seed"}, TypeError, "`key` must be a JAX random key or an integer"),
        ({"key": jax.random.split(jax.random.key(0))}, ValueError, "`key` must be one key"),
        ({"executor": "cloud"}, ValueError, "`executor` must be one of serial, devices, dask"),
        ({"keep_samples": True}, ValueError, "`folder` must be given to keep samples"),
        ({"law": 3.0}, TypeError, "`law` must be a Law or a function key -> Law"),
        ({"law": lambda key: 3.0}, TypeError, "`law` must give a Law for a key"),
        ({"velocity": [1.0, 0.0]}, ValueError, r"`velocity` must have shape \(3,\)"),
        ({"velocity": [1.0, np.nan, 0.0]}, ValueError, "`velocity` must be finite"),
        ({"gaps": None}, ValueError, "`gaps` must be given where neither"),
        ({"gaps": [0.0, -1e-6]}, ValueError, "negative gap is an overlap.*`initial_energy`"),
        (
            {"gaps": [[0.0, 1e-6], [0.0, -1e-6]]},
            ValueError,
            r"-1e-06 at index \[1, 1\].*`initial_energy`",
        ),
        (
            {"gaps": Uniform(-1e-6, 1e-5)},
            ValueError,
            r"Uniform\(low=-1e-06, high=1e-05\) does.*`initial_energy`",
        ),
        ({"gaps": Normal(-1e-6, 1e-5)}, ValueError, "mean of at least 0.*`initial_energy`"),
        ({"gaps": Uniform(0.0, [1e-5] * 3)}, ValueError, "scalars or 2 values in `high`"),
        ({"gaps": lambda key: jnp.zeros(3)}, ValueError, r"`gaps\(key\)` must have shape \(2,\)"),
    ],
)
def test_bad_arguments_are_named(change, error, message):
    with pytest.raises(error, match=message):
        sampled(**change)


def test_bad_distributions_are_named():
    with pytest.raises(ValueError, match="`high` must be at least `low`"):
        Uniform(1.0, 0.0)
    with pytest.raises(ValueError, match="`std` must lie in"):
        Normal(0.0, 0.0)
    with pytest.raises(ValueError, match="that can be random are restitution, but not `friction`"):
        RandomLaw(LAW, friction=Uniform(0.0, 1.0))
    with pytest.raises(
        ValueError, match=r"`restitution` must lie in \[0, 1\], but Uniform.* can leave it"
    ):
        RandomLaw(LAW, restitution=Uniform(0.5, 1.5))
    with pytest.raises(ValueError, match="can leave it"):
        RandomLaw(LAW, restitution=Normal(0.5, 0.01))
    assert (
        RandomLaw(Compliant(Hertz(1.0)), stiffness=Uniform(1.0, 2.0))(
            jax.random.key(0)
        ).force.stiffness
        > 1
    )


# -------------------------------------------------------------- failed samples


def sometimes_bad(key):
    gaps = jax.random.uniform(key, (2,), minval=-1e-7, maxval=1e-5)
    return jnp.where(gaps > 9.9e-6, jnp.nan, gaps)


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
    assert [bad.index for bad in result.bad[: (~fine).sum()]] == np.flatnonzero(~fine)[:20].tolist()
    bad = result.bad[0]
    assert bad.status == "bad_gap"
    assert np.asarray(result.replay(bad.index)[1].gaps).tobytes() == bad.gaps.tobytes()
    np.testing.assert_allclose(np.abs(result.mean).max(), 0.92, atol=0.05)  # NaN went nowhere
    assert np.isfinite(result.gap_mean).all()
    report = str(result)
    assert f"bad_gap: {result.statuses['bad_gap']}, left out" in report
    assert f"replay({bad.index})" in report
    json.dumps(result.to_dict(), allow_nan=False)


def test_failed_impacts_are_kept_apart():
    # one collision is allowed: enough for the first row, not for the second
    rows = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0]] * 4)
    law = Binary(1.0, order="earliest", max_collisions=1)
    with pytest.warns(UserWarning, match="4 of 8 samples failed"):
        result = monte_carlo(law, BALLS, rows, [0.0, 1e-6], chunk=8)
    assert result.statuses == {"ok": 4, "max_steps": 4}
    np.testing.assert_allclose(result.mean, impact(law, BALLS, rows[0]).velocity, atol=1e-15)
    assert [bad.index for bad in result.bad] == [1, 3, 5, 7]
    np.testing.assert_array_equal(result.bad[0].velocity, rows[1])
    with pytest.raises(
        RuntimeError, match="None of the first 8 samples gave a usable outcome: 8 max_steps"
    ):
        monte_carlo(law, BALLS, rows[1:2].repeat(8, axis=0), [0.0, 1e-6], chunk=8)


def test_parameters_out_of_their_domain_fail():
    law = lambda key: Newton(2 * jax.random.uniform(key))  # noqa: E731
    with pytest.warns(UserWarning, match="bad_law"):
        result = monte_carlo(law, chain([1.0, 1.0]), [1.0, 0.0], samples=100, chunk=128)
    assert 20 < result.statuses["bad_law"] < 80
    assert result.maximum[1] <= 1.0


# ---------------------------------------------------------------------- resume


class Stops:
    """An executor that ctrl-C, or anything else, ends after some chunks."""

    def __init__(self, after, error=KeyboardInterrupt):
        self.left, self.error = after, error

    def run(self, plan, tasks):
        for task in tasks:
            if self.left == 0:
                raise self.error
            self.left -= 1
            yield plan(task)


@pytest.fixture(scope="module")
def whole():
    return sampled()


def test_interrupted_runs_continue_with_the_same_bits(tmp_path, whole):
    with pytest.raises(
        KeyboardInterrupt,
        match=r"stopped after 512 of 1,000 samples; they are in .*continues from there",
    ):
        sampled(folder=tmp_path, executor=Stops(1))
    assert len(list(tmp_path.glob("chunk-*.npz"))) == 2
    result = sampled(folder=tmp_path)
    assert result.resumed == 512
    assert same(result, whole)
    again = sampled(folder=tmp_path, executor=Stops(0))  # nothing is left to compute
    assert again.resumed == 1000
    assert same(again, whole)
    assert "all read from the folder" in str(again)
    with pytest.raises(KeyboardInterrupt, match="nothing is stored, because no `folder` was given"):
        sampled(executor=Stops(1))


def test_a_run_may_grow(tmp_path, whole):
    sampled(samples=300, folder=tmp_path)
    result = sampled(folder=tmp_path)
    assert result.resumed == 256  # the partial chunk is computed again
    assert same(result, whole)


def test_damaged_and_foreign_chunks_are_named_and_not_used(tmp_path, whole):
    sampled(folder=tmp_path / "a")
    sampled(folder=tmp_path / "b", key=1)
    chunks = sorted((tmp_path / "a").glob("chunk-*.npz"))
    content = bytearray(chunks[1].read_bytes())
    at = content.index(np.int64(256).tobytes(), 2000)
    content[at] ^= 1
    for path, damaged in ((chunks[1], bytes(content)), (chunks[2], chunks[2].read_bytes()[:500])):
        path.write_bytes(damaged)
    shutil.copy(tmp_path / "b" / chunks[3].name, chunks[3])
    with pytest.warns(UserWarning, match="is not used") as caught:
        result = sampled(folder=tmp_path / "a")
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == 3
    assert all(path.name in message for path, message in zip(chunks[1:], messages))
    assert "computed again" in messages[0]
    assert "belongs to another run" in messages[2]
    assert result.resumed == 256
    assert same(result, whole)
    shutil.copy(chunks[1], chunks[2])
    with pytest.warns(UserWarning, match="it is chunk 1 of this run"):
        assert same(sampled(folder=tmp_path / "a"), whole)
    with pytest.raises(ValueError, match="has no raw samples"):
        list(read_samples(tmp_path / "a"))


def test_every_single_flipped_byte_is_seen(tmp_path):
    run = "0" * 64
    sampled(samples=10, folder=tmp_path, chunk=CHUNK, bins=3)
    path = next(tmp_path.glob("chunk-*.npz"))
    run = json.loads((tmp_path / "manifest.json").read_text())["run"]
    good = path.read_bytes()
    reference = store._checked(path, run)
    for at in np.random.default_rng(0).integers(0, len(good), 150):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
        try:
            arrays = store._checked(path, run)
        except Exception:
            continue
        assert fingerprint(arrays) == fingerprint(reference)  # a byte that carries nothing


def test_a_folder_of_another_run_is_refused(tmp_path):
    sampled(folder=tmp_path)
    with pytest.raises(ValueError, match="holds another run, which differs in gaps, key:"):
        sampled(folder=tmp_path, gaps=Uniform(0.0, 2e-5), key=1)
    with pytest.raises(ValueError, match="differs in law:"):
        sampled(folder=tmp_path, law=Binary(0.9, order="earliest"))
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest.json' is damaged"):
        sampled(folder=tmp_path)
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(ValueError, match=r"has chunks but no manifest\.json"):
        sampled(folder=tmp_path)


def test_a_full_disk_is_reported_and_costs_nothing(tmp_path, monkeypatch, whole):
    calls = []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 3:  # manifest, two chunks
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(
        OSError, match="the disk is full; what was there before is intact"
    ) as caught:
        sampled(folder=tmp_path)
    assert caught.value.errno == errno.ENOSPC
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "chunk-0000000.npz",
        "chunk-0000001.npz",
        "manifest.json",
    ]
    monkeypatch.undo()
    result = sampled(folder=tmp_path)
    assert result.resumed == 512
    assert same(result, whole)


def test_functions_are_known_by_source_and_closure():
    def scaled(factor):
        return lambda key: factor * jax.random.uniform(key, (2,))

    assert fingerprint(scaled(1.0)) == fingerprint(scaled(1.0))
    assert fingerprint(scaled(1.0)) != fingerprint(scaled(2.0))
    assert fingerprint(scaled(1.0)) != fingerprint(sometimes_bad)
    assert fingerprint(LAW) != fingerprint(Binary(1.0))  # static fields count
    assert fingerprint(chain([1.0, 1.0], wall=True)) != fingerprint(chain([1.0, 1.0], wall="left"))


@pytest.mark.slow
def test_a_killed_process_continues_with_the_same_bits(tmp_path, whole):
    code = f"""
import jax; jax.config.update("jax_enable_x64", True)
import time, jimpact as ji
from jimpact import (monte_carlo, Uniform)
class Slow:
    def run(self, plan, tasks):
        for task in tasks:
            yield plan(task)
            time.sleep(1.0)
monte_carlo(ji.Binary(1.0, order="earliest"), ji.chain([0.25, 1.0, 0.25]), [1.0, 0.0, -1.0],
            Uniform(0.0, 1e-5), 1000, chunk={CHUNK}, executor=Slow(), folder={str(tmp_path)!r})
"""
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        while len(list(tmp_path.glob("chunk-*.npz"))) < 2:
            assert process.poll() is None
            time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
    result = sampled(folder=tmp_path)
    assert 512 <= result.resumed < 1000
    assert same(result, whole)


# ----------------------------------------------------------------- sensitivity


@pytest.mark.slow
def test_the_linearization_beside_monte_carlo():
    law = Compliant(Hertz(1.0))  # indentations of about 0.5 m: metre-sized gaps
    sampler = {"law": law, "samples": 256, "bins": 50}
    narrow = sampled(gaps=Uniform([0.30, 0.32], [0.31, 0.33]), **sampler)
    close = gap_sensitivity(law, BALLS, BEFORE, narrow.gap_mean, narrow)
    np.testing.assert_allclose(close.explained, 1.0, atol=0.02)
    assert "nearly linear" in str(close)
    scale = gap_scale(BALLS, law, BEFORE).delta  # the report has gaps in units of it
    np.testing.assert_array_equal(narrow.gap_scale, scale)
    ratio = narrow.gap_mean[0] / scale[0]
    assert f"in units of delta_c = {scale[0]:.3g} m: {ratio:.3g} and " in str(narrow)
    assert "delta_c: how deep a contact is indented" in str(narrow)
    assert narrow.to_dict()["gap_scale"] == scale.tolist()
    wide = sampled(gaps=Uniform([0.0, 0.0], [3.0, 3.0]), **sampler)
    across = gap_sensitivity(law, BALLS, BEFORE, wide.gap_mean, wide)
    assert np.all(np.abs(across.explained - 1) > 0.2)
    assert "fails over this spread" in str(across)
    h = 1e-5
    rows = np.array([[0.3 + h, 0.32], [0.3 - h, 0.32]])
    pair = sampled(gaps=rows, **(sampler | {"samples": 2})).first["velocity"]
    exact = gap_sensitivity(law, BALLS, BEFORE, [0.3, 0.32])
    np.testing.assert_allclose(exact.jacobian[:, 0], (pair[0] - pair[1]) / (2 * h), atol=1e-4)
    # moving everything apart by the same time changes nothing: both contacts approach at speed 1
    np.testing.assert_allclose(exact.jacobian.sum(axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(exact.covariance(np.eye(2)), exact.jacobian @ exact.jacobian.T)


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


LAWS = registered_laws({"restitution": 0.9, "stiffness": 1.0, "matrix": 0.9 * np.eye(2)})[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_every_law_can_be_sampled(name):
    law = LAWS[name]
    if name != "restitution_matrix" and hasattr(law, "restitution"):
        law = RandomLaw(law, restitution=Uniform(0.8, 0.9))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some laws do not promise admissible outcomes
        result = sampled(law=law, velocity=Normal([1.0, 0.0, -1.0], 0.1), samples=64, chunk=64)
    assert result.count > 0
    assert result.std.min() > 1e-3
    law, scene, velocity = result.replay(3)
    alone = impact(law, scene, velocity)
    np.testing.assert_allclose(alone.velocity, result.first["velocity"][3], atol=1e-9)


def test_progress_is_reported_on_request(capfd):
    sampled(progress=True)
    progress = capfd.readouterr().err
    assert "1,000 of 1,000 samples" in progress
    assert "/s" in progress
    sampled()
    assert capfd.readouterr().err == ""
