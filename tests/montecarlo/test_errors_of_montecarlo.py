"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import jax.numpy as jnp
import pytest
from refusals import refused

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]


def samples(**options):
    """A Monte Carlo run of few samples."""
    given = {"law": ji.Binary(0.9, "earliest"), "scene": BALLS, "velocity": V}
    gaps = ji.Uniform(0.0, 1e-5)
    return ji.monte_carlo(
        **(given | {"gaps": gaps, "samples": 4, "progress": False} | options)
    )


REFUSED = [
    (
        lambda: samples(velocity=lambda key: [1.0, 0.0, 0.0]),
        "`velocity` must give an array",
    ),
    (lambda: samples(law=ji.Binary), "`law` must be a Law or a function"),
    (lambda: samples(key=2**70), "`key` must have at most 64 bits"),
    (lambda: samples(folder=3), "`folder` must be a path, but is 3"),
    (lambda: samples(progress="x"), "`progress` must be numeric"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("gaps", lambda key: jnp.array([0.0, 1e-6])),
        ("law", lambda key: ji.Binary(0.9, "earliest")),
    ],
)
def test_a_function_that_ignores_its_key_is_told(name, function):
    with pytest.warns(UserWarning, match=f"`{name}` draws without its key"):
        samples(**{name: function})
