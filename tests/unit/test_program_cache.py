"""Programs on the disk: the same values from what was not compiled here, and nothing stale."""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from numpy.testing import assert_allclose

import jimpact as ji
from jimpact.cli import program_cache
from jimpact.cli.program_cache import limit_size, stored_programs

pytestmark = pytest.mark.release  # they compile programs of their own

V = np.array([1.0, 0.1, 0.0])
BALLS = ji.chain([1.0, 2.0, 1.0])


class Softened(ji.Newton):
    """A user's own law."""


@pytest.fixture
def compiled(monkeypatch):
    """Names of what was compiled, not read."""
    names = []
    made = program_cache._compile

    def counted(program, static, arrays):
        names.append(program.__name__)
        return made(program, static, arrays)

    monkeypatch.setattr(program_cache, "_compile", counted)
    return names


@pytest.fixture
def without_jax_cache():
    """JAX compiles; a program that it reads from its own cache cannot be stored again."""
    before = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()
    yield
    jax.config.update("jax_enable_compilation_cache", before)
    reset_cache()


def same(one, other):
    """Equal but for rounding: they come from two compilations."""
    assert_allclose(one, other, rtol=1e-12, atol=1e-14)


def outcome(folder, law=None, scene=BALLS, v=V):
    with stored_programs(folder):
        return ji.impact(ji.Newton(0.5) if law is None else law, scene, v)


def test_a_program_that_is_read_gives_the_values_of_the_compiled_one(tmp_path, compiled):
    law = ji.LZB(restitution=0.9, stiffness=[1.0, 3.0])
    plain = ji.impact(law, BALLS, V)
    for _ in range(3):
        again = outcome(tmp_path, law)
        jax.tree.map(same, again, plain)
        assert jax.tree.structure(again) == jax.tree.structure(plain)
    assert len(compiled) == 1
    other = outcome(tmp_path, ji.LZB(restitution=0.7, stiffness=[1.0, 3.0]))  # numbers are free
    same(other.velocity, ji.impact(ji.LZB(0.7, [1.0, 3.0]), BALLS, V).velocity)
    assert len(compiled) == 1


def test_other_static_arguments_and_shapes_are_other_programs(tmp_path, compiled):
    outcome(tmp_path)
    outcome(tmp_path, ji.Moreau(0.5))
    outcome(tmp_path, ji.LZB(0.5))
    outcome(tmp_path, ji.LZB(0.5, max_steps=77))
    outcome(tmp_path, scene=ji.chain(np.ones(12)), v=np.arange(12.0)[::-1])
    with jax.enable_x64(False):
        outcome(tmp_path, scene=ji.chain(jnp.ones(3, jnp.float32)), v=jnp.arange(3.0)[::-1])
    assert len(compiled) == len(list(tmp_path.iterdir())) == 6


@pytest.mark.release
def test_programs_of_a_users_own_law_are_not_stored(tmp_path, compiled):
    same(outcome(tmp_path, Softened(0.5)).velocity, outcome(None).velocity)
    assert not compiled
    assert not list(tmp_path.iterdir())


def test_an_edited_source_makes_other_programs(tmp_path, compiled, monkeypatch):
    outcome(tmp_path)
    monkeypatch.setattr(program_cache, "_source_hash", lambda: b"edited")
    outcome(tmp_path)
    assert len(compiled) == 2


def test_derivatives_and_batches_do_not_use_the_folder(tmp_path):
    with stored_programs(tmp_path):
        slope = jax.jacfwd(lambda e: ji.impact(ji.Newton(e), BALLS, V).velocity)(0.5)
        batch = jax.vmap(lambda e: ji.impact(ji.Newton(e), BALLS, V).velocity)(jnp.ones(2))
        inside = eqx.filter_jit(ji.impact)(ji.Newton(0.5), BALLS, V).velocity
    assert np.isfinite(slope).all()
    assert batch.shape == (2, 3)
    same(inside, outcome(None).velocity)


def test_a_damaged_file_is_replaced(tmp_path, compiled, without_jax_cache):
    # no other test compiles it: jax would return what that test had read from jax's cache
    chain = {"scene": ji.chain(np.ones(7)), "v": np.arange(7.0)[::-1]}
    outcome(tmp_path, **chain)
    (path,) = tmp_path.iterdir()
    for content in (b"", b"not a program", path.read_bytes()[:-9]):
        path.write_bytes(content)
        outcome(tmp_path, **chain)
    outcome(tmp_path, **chain)
    assert len(compiled) == 4


def test_an_unusable_folder_is_ignored(tmp_path, compiled):
    folder = tmp_path / "file"
    folder.write_text("")
    same(outcome(folder).velocity, outcome(None).velocity)
    assert len(compiled) == 1


def test_the_least_recently_used_files_go_first(tmp_path, monkeypatch):
    for age, name in enumerate(("new", "jax/middle", "old")):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age - 50))  # read, written
    limit_size(tmp_path, 300)
    assert (tmp_path / "old").exists()
    limit_size(tmp_path, 250)
    assert [x.name for x in tmp_path.rglob("*") if x.is_file()] == ["new", "middle"]
    monkeypatch.setattr(program_cache.limit_size, "__defaults__", (100,))
    with stored_programs(tmp_path):
        pass
    assert [x.name for x in tmp_path.rglob("*") if x.is_file()] == ["new"]
