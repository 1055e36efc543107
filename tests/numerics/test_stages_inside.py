"""Both ways to run the stages of a step: one loop, and written out as on an accelerator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.numerics import stepper


@pytest.mark.release
def test_stages_written_out_are_the_scanned_ones(monkeypatch):
    """Values and a derivative."""

    def outcomes():
        """Of a fresh function, which JAX has no compiled program of."""

        def impact(e, k):
            law = ji.LZB(e, [1.0, k], 1.5)
            return ji.impact(law, ji.chain([1.0, 2.0, 1.0]), [1.0, 0.0, -0.5]).velocity

        values = jax.vmap(lambda k: (impact(0.9, k), jax.jacfwd(impact)(0.9, k)))
        return jax.jit(values)(jnp.array([0.3, 2.0]))

    scanned = outcomes()
    jax.clear_caches()
    calls = []

    def written_out(*args):
        calls.append(args)
        return stepper._written_out(*args)

    monkeypatch.setattr(stepper, "_scanned", written_out)
    written = outcomes()
    jax.clear_caches()
    assert calls
    for one, other in zip(scanned, written):
        np.testing.assert_allclose(one, other, atol=1e-10)
