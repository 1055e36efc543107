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
from montecarlo_cases import CHUNK, GAPS, LAW, sampled, sometimes_bad

from jimpact import (
    Binary,
    Newton,
    Normal,
    RandomLaw,
    Uniform,
    chain,
    impact,
    monte_carlo,
    read_samples,
)
from jimpact.core.registry import registered_laws
from jimpact.montecarlo import statistics as histograms, store
from jimpact.montecarlo.statistics import merged, moments
from jimpact.montecarlo.store import fingerprint


def same(a, b):
    """Bitwise, in everything but the time it took."""
    names = "samples count mean covariance minimum maximum gap_mean gap_covariance edges counts statuses first"
    return all(
        fingerprint(getattr(a, name)) == fingerprint(getattr(b, name))
        for name in names.split()
    ) and (fingerprint(a.bad) == fingerprint(b.bad))


def test_float32_samples_are_summed_in_float64():
    rng = np.random.default_rng(1)
    values = (1000 + 0.01 * rng.standard_normal((1, 200_000))).astype(np.float32)
    exact = values.astype(float)
    whole = moments(values[:, :1])
    for part in np.array_split(values[:, 1:], 37, axis=1):
        whole = merged(whole, moments(part))
    assert whole["used"] == 200_000
    np.testing.assert_allclose(whole["mean"], exact.mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(
        whole["products"][0, 0] / 199_999, exact.var(ddof=1), rtol=1e-10
    )
    single = jax.tree.map(
        lambda x: x.astype(jnp.float32), (Newton(0.5), chain([1.0, 1.0]))
    )
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
    assert histograms.binned_quantiles(0.0, ends, counts, low, high).tolist() == [
        -5.0,
        3.0,
    ]
    assert histograms.binned_quantiles(1.0, ends, counts, low, high).tolist() == [
        9.0,
        3.0,
    ]
    assert -5.0 <= histograms.binned_quantiles(0.2, ends, counts, low, high)[0] <= -0.1


def test_chunks_of_unequal_size_are_merged():
    values = np.random.default_rng(0).normal([[1.0], [5.0]], 1.0, (2, 10))
    whole = merged(moments(values[:, :3]), moments(values[:, 3:]))
    np.testing.assert_allclose(whole["mean"], values.mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(whole["products"] / 9, np.cov(values), rtol=1e-13)


def test_bad_samples_are_numbered_over_all_chunks():
    """Of 8 samples a chunk, the last of which counts 5 of them."""
    row = histograms.OUTCOMES.index(next(x for x in histograms.OUTCOMES if x.failure))
    samples = {
        "gaps": np.zeros((8, 1)),
        "velocity_before": np.zeros((8, 2)),
        "velocity": np.arange(16.0).reshape(8, 2),
        "status": np.array([0, 0, row, 0, 0, row, 0, 0]),
    }
    task = histograms.Task(
        number=3, count=5, ends=np.array([[0.0, 9.0], [0.0, 9.0]]), rows={}
    )
    chunk = histograms.reduced(task, samples, 4, False)
    assert chunk["bad.index"].tolist() == [3 * 8 + 2]
    assert chunk["used"] == 4


class Stops:
    """An executor that ctrl-C, or anything else, ends after some chunks."""

    def __init__(self, after, error=KeyboardInterrupt):
        self.left, self.error = after, error

    def map(self, work, tasks):
        for task in tasks:
            if self.left == 0:
                raise self.error
            self.left -= 1
            yield work(task)


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
    with pytest.raises(
        KeyboardInterrupt, match="nothing is stored, because no `folder` was given"
    ):
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
    at = len(content) // 2
    content[at] ^= 1
    for path, damaged in (
        (chunks[1], bytes(content)),
        (chunks[2], chunks[2].read_bytes()[:500]),
    ):
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
    run = store._run(json.loads((tmp_path / "manifest.json").read_text()))
    good = path.read_bytes()
    reference = store._checked(path, run)
    for at in np.random.default_rng(0).integers(0, len(good), 150):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
        try:
            arrays = store._checked(path, run)
        except Exception:
            continue
        assert fingerprint(arrays) == fingerprint(
            reference
        )  # a byte that carries nothing


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
    assert fingerprint(chain([1.0, 1.0], wall=True)) != fingerprint(
        chain([1.0, 1.0], wall="left")
    )


@pytest.mark.slow
def test_a_killed_process_continues_with_the_same_bits(tmp_path, whole):
    code = f"""
import jax; jax.config.update("jax_enable_x64", True)
import time, jimpact as ji
from jimpact import (monte_carlo, Uniform)
class Slow:
    def map(self, work, tasks):
        for task in tasks:
            yield work(task)
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


LAWS = registered_laws(
    {"restitution": 0.9, "stiffness": 1.0, "matrix": 0.9 * np.eye(2)}
)[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_every_law_can_be_sampled(name):
    law = LAWS[name]
    gaps = GAPS if law.uses_gaps else None
    if name != "restitution_matrix" and hasattr(law, "restitution"):
        law = RandomLaw(law, restitution=Uniform(0.8, 0.9))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some laws do not promise admissible outcomes
        result = sampled(
            law=law,
            velocity=Normal([1.0, 0.0, -1.0], 0.1),
            gaps=gaps,
            samples=64,
            chunk=64,
        )
    assert result.count > 0
    assert result.std.min() > 1e-3
    law, scene, velocity = result.replay(3)
    alone = impact(law, scene, velocity)
    np.testing.assert_allclose(alone.velocity, result.first["velocity"][3], atol=1e-9)
