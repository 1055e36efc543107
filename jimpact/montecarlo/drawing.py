"""What runs on the device: the draws of one chunk, and their impacts.

Sample i is lane i % C of chunk i // C; its key is `fold_in(fold_in(key, chunk), lane)`. Draws and
impacts are two compiled programs, so that draws made again give the same bits.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.impacts import impact
from jimpact.law import Law, free_parameters_of
from jimpact.montecarlo.distributions import Distribution, Source
from jimpact.scene import Scene, with_gaps
from jimpact.status import STATUS, Status

# Outcomes of a sample: those of an impact, and further ones where it never reached the law.
OUTCOMES = (
    *STATUS,
    Status("bad_gap", "a drawn gap is not finite or an overlap: see LZB's `initial_energy`", True),
    Status("bad_velocity", "a drawn velocity is not finite", True),
    Status("bad_law", "a drawn parameter is not finite or outside its domain", True),
)
BAD_GAP, BAD_VELOCITY, BAD_LAW = range(len(STATUS), len(OUTCOMES))


class Sources(eqx.Module):
    """Where law, velocity and gaps come from; an array, a `Law` or None is a constant."""

    law: Any
    velocity: Source
    gaps: Source


class Drawn(eqx.Module):
    """Law, velocities and gaps of a chunk; what is random (`varies`) has a leading axis (C,)."""

    law: Law
    velocity: jax.Array
    gaps: jax.Array | None
    varies: tuple[bool, bool, bool] = eqx.field(static=True)


def is_random(source: Any) -> bool:
    """Whether it differs from sample to sample."""
    return not (source is None or isinstance(source, jax.Array | Law))


@eqx.filter_jit
def draw(
    sources: Sources,
    sizes: tuple[int, int],
    key: jax.Array,
    lanes: jax.Array,
    rows: dict[str, jax.Array],
) -> Drawn:
    """The chunk's law, velocities and gaps.

    `sizes` are (n, m), `key` is the chunk's, `rows` are those of given samples (C, n), (C, m).
    """
    keys = jax.vmap(lambda lane: jax.random.split(jax.random.fold_in(key, lane), 3))(lanes)
    varies = (is_random(sources.law), is_random(sources.velocity), is_random(sources.gaps))
    law = eqx.filter_vmap(sources.law)(keys[:, 0]) if varies[0] else sources.law
    velocity = _entries(sources.velocity, sizes[0], keys[:, 1], False)
    gaps = _entries(sources.gaps, sizes[1], keys[:, 2], True)
    return Drawn(law, rows.get("velocity", velocity), rows.get("gaps", gaps), varies)


def _entries(source: Source, size: int, keys: jax.Array, non_negative: bool) -> Any:
    if isinstance(source, Distribution):
        dtype = jnp.result_type(*jax.tree.leaves(source))
        return jax.vmap(lambda key: source.sample(key, size, dtype, non_negative))(keys)
    return jax.vmap(source)(keys) if callable(source) else source


@eqx.filter_jit
def impacts(drawn: Drawn, scene: Scene, lanes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Velocities (C, n) and statuses (C,) of a chunk, those of bad draws included."""
    law_axis = eqx.if_array(0) if drawn.varies[0] else None
    axes = (law_axis, *(0 if each else None for each in drawn.varies[1:]), None)
    run = eqx.filter_vmap(_outcome, in_axes=axes, axis_size=len(lanes))
    return run(drawn.law, drawn.velocity, drawn.gaps, scene)


def _outcome(
    law: Law, velocity: jax.Array, gaps: jax.Array | None, scene: Scene
) -> tuple[jax.Array, jax.Array]:
    code = jnp.where(_in_domain(law), 0, BAD_LAW)
    code = jnp.where(jnp.all(jnp.isfinite(velocity)), code, BAD_VELOCITY)
    if gaps is not None:
        fine = jnp.isfinite(gaps) & (gaps >= 0)
        code = jnp.where(jnp.all(fine), code, BAD_GAP)
        scene = with_gaps(scene, jnp.where(fine, gaps, 0))
    out = impact(law, scene, jnp.where(code == 0, velocity, 0))  # at rest: over at once
    return out.velocity, jnp.where(code == 0, out.status, code.astype(jnp.int32))


def _in_domain(law: Law) -> jax.Array:
    fine = jnp.asarray(True)
    for value, _, domain in free_parameters_of(law).values():
        fine = fine & domain.holds(value)
    return fine
