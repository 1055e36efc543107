"""Programs on the disk: the same values from what was not compiled here, and nothing stale."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jimpact as ji
from jimpact import kept
from jimpact.compiling import kept_in

V = np.array([1.0, 0.1, 0.0])
BALLS = ji.chain([1.0, 2.0, 1.0])


class Softened(ji.Newton):
    """A law of the caller's own."""


@pytest.fixture
def compiled(monkeypatch):
    """Names of what was compiled, not read."""
    names = []
    made = kept._compiled

    def counted(program, fixed, arrays):
        names.append(program.__name__)
        return made(program, fixed, arrays)

    monkeypatch.setattr(kept, "_compiled", counted)
    return names


def outcome(folder, law=None, scene=BALLS, v=V):
    with kept_in(folder):
        return ji.impact(ji.Newton(0.5) if law is None else law, scene, v)


def test_what_is_read_is_what_was_compiled(tmp_path, compiled):
    law = ji.LZB(restitution=0.9, stiffness=[1.0, 3.0])
    plain = ji.impact(law, BALLS, V)
    for _ in range(3):
        again = outcome(tmp_path, law)
        jax.tree.map(assert_array_equal, again, plain)
        assert jax.tree.structure(again) == jax.tree.structure(plain)
    assert len(compiled) == 1
    other = outcome(tmp_path, ji.LZB(restitution=0.7, stiffness=[1.0, 3.0]))  # numbers are free
    assert_array_equal(other.velocity, ji.impact(ji.LZB(0.7, [1.0, 3.0]), BALLS, V).velocity)
    assert len(compiled) == 1


def test_what_is_static_or_shaped_otherwise_is_another_program(tmp_path, compiled):
    outcome(tmp_path)
    outcome(tmp_path, ji.Moreau(0.5))
    outcome(tmp_path, ji.LZB(0.5))
    outcome(tmp_path, ji.LZB(0.5, max_steps=77))
    outcome(tmp_path, scene=ji.chain(np.ones(12)), v=np.arange(12.0)[::-1])
    with jax.enable_x64(False):
        outcome(tmp_path, scene=ji.chain(jnp.ones(3, jnp.float32)), v=jnp.arange(3.0)[::-1])
    assert len(compiled) == len(list(tmp_path.iterdir())) == 6


def test_laws_of_the_callers_own_are_not_kept(tmp_path, compiled):
    assert_array_equal(outcome(tmp_path, Softened(0.5)).velocity, outcome(None).velocity)
    assert not compiled
    assert not list(tmp_path.iterdir())


def test_other_sources_other_programs(tmp_path, compiled, monkeypatch):
    outcome(tmp_path)
    monkeypatch.setattr(kept, "_sources", lambda: b"edited")
    outcome(tmp_path)
    assert len(compiled) == 2


def test_derivatives_pass(tmp_path):
    with kept_in(tmp_path):
        slope = jax.jacfwd(lambda e: ji.impact(ji.Newton(e), BALLS, V).velocity)(0.5)
        batch = jax.vmap(lambda e: ji.impact(ji.Newton(e), BALLS, V).velocity)(jnp.ones(2))
        inside = eqx.filter_jit(ji.impact)(ji.Newton(0.5), BALLS, V).velocity
    assert np.isfinite(slope).all()
    assert batch.shape == (2, 3)
    assert_array_equal(inside, outcome(None).velocity)


def test_a_damaged_file_is_replaced(tmp_path, compiled):
    outcome(tmp_path)
    (path,) = tmp_path.iterdir()
    for content in (b"", b"not a program", path.read_bytes()[:-9]):
        path.write_bytes(content)
        outcome(tmp_path)
    outcome(tmp_path)
    assert len(compiled) == 4


def test_without_a_place_it_works_all_the_same(tmp_path, compiled):
    place = tmp_path / "file"
    place.write_text("")
    assert_array_equal(outcome(place).velocity, outcome(None).velocity)
    assert len(compiled) == 1
