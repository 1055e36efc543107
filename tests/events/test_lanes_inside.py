"""Programs in lanes: how often their loops are traced, and what they state of their results."""

import jax
import jax.numpy as jnp
import pytest

import jimpact as ji
from jimpact.events.impact_dynamics import ImplicitProgram, ImpulseProgram
from jimpact.numerics.derive import Kind

BALLS = ji.chain([1.0, 1.0, 1.0])
V = jnp.array([1.0, 0.0, 0.0])


def last(e):
    return ji.impact(ji.LZB(e), BALLS, V).velocity[2]


@pytest.fixture
def traces(monkeypatch):
    """Batches at which loops are traced."""
    found = []
    for program in (ImpulseProgram, ImplicitProgram):

        def counted(self, *leaves, own=program.__call__):
            found.append(leaves[0].shape[-1])
            return own(self, *leaves)

        monkeypatch.setattr(program, "__call__", counted)
    return found


# batches that no other test has: JAX keeps traces
@pytest.mark.parametrize(
    ("function", "batch"),
    [
        (jax.vmap(jax.vmap(last)), (3, 29)),
        (jax.vmap(jax.vmap(jax.jacfwd(last))), (3, 31)),
        (jax.vmap(jax.vmap(jax.value_and_grad(last))), (3, 37)),
    ],
)
def test_a_loop_is_traced_once_at_the_batch_that_is_compiled(traces, function, batch):
    jax.jit(function).lower(jnp.full(batch, 0.9))
    assert traces == [batch[0] * batch[1]]


def plane():
    return (
        ji.LZB(0.9, friction=0.3),
        ji.Block(0.2, 0.6).scene([0.0, 0.3, 0.0]),
        [0.2, -1.0, 0.1],
    )


def space():
    scene = ji.Box([0.2, 0.3, 0.1]).scene([0, 0, 0.05, 1.0, 0, 0, 0])
    return ji.LZB(0.9, friction=0.3), scene, [0.2, 0.1, -1.0, 0.1, 0.0, 0.2]


@pytest.mark.parametrize("case", [lambda: (ji.LZB(0.9), BALLS, V), plane, space])
def test_results_are_as_stated(monkeypatch, case):
    (law, scene, v), seen = case(), []
    for program in (ImpulseProgram, ImplicitProgram):

        def compared(self, *leaves, own=program.__call__):
            outs = own(self, *leaves)
            if all(isinstance(x, jax.Array) for x in (*leaves, *outs)):
                stated = self.results(*(Kind(x.shape[:-1], x.dtype) for x in leaves))
                seen.append([(x.shape[:-1], x.dtype) for x in outs] == list(stated))
            return outs

        monkeypatch.setattr(program, "__call__", compared)
    v = jnp.asarray(v, float)
    jax.jit(jax.vmap(lambda k: ji.impact(law, scene, k * v).velocity)).lower(
        jnp.ones(41)
    )
    assert seen == [True]
