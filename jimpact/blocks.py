"""Contacts that do not feel each other: found on the host, solved in groups side by side.

Where the contacts fall apart into groups that no body and no constraint joins, W is block
diagonal: an impact of 100 separate pairs is 100 impacts of one contact. Which contacts belong
together is seen from the zeros of M, N and the constraints, never from rounded values of W.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import is_traced
from jimpact.contact_space import solve_mass
from jimpact.laws.base import Law
from jimpact.scene import Scene
from jimpact.status import CODE

# Groups of unequal size are filled up to the largest of them: compiling one program more takes
# longer than many impacts. A second one for the smaller groups must save this factor of entries
# of W.
WORTH_A_PROGRAM = 4

# Contact indices (count, size), one array for each program; where a group is smaller, m plus one of
# its contacts fills its row up (one of its own: stored energy there is on the group's scale). They
# are data, not structure: scenes whose groups differ in their members only share the compiled
# impact.
Groups = tuple[np.ndarray, ...]


def coupled_groups(scene: Scene) -> Groups | None:
    """Groups of contacts between which the Delassus matrix is zero whatever its values.

    Contacts belong together where they move a common coordinate, or coordinates joined by an
    entry of a dense M or by bilateral constraints. Open contacts are in no group (traced gaps: all
    contacts count as closed). None: there is but one group of all contacts, or the zeros are not
    known on the host, or the scene is a chain, whose tridiagonal W costs O(m) as it is.

    >>> import jimpact as ji
    >>> from jimpact.blocks import coupled_groups
    >>> beside = ji.Scene([1.0] * 4, [[-1, 0], [1, 0], [0, -1], [0, 1]])  # o o  o o
    >>> [group.tolist() for group in coupled_groups(beside)]
    [[[0], [1]]]
    """
    m = scene.contacts
    if scene.walls is not None or m == 1 or is_traced((scene.normals, scene.constraints)):
        return None
    if scene.mass.ndim == 2 and is_traced(scene.mass):
        return None
    known = scene.gaps is not None and not is_traced(scene.gaps)
    members = np.flatnonzero(np.asarray(scene.gaps) <= 0) if known else np.arange(m)
    if len(members) == 0:
        return None
    touched = [np.asarray(scene.normals)[:, members]]
    if scene.mass.ndim == 2:
        touched.append(np.asarray(scene.mass))
    if scene.constraints is not None:
        touched.append(np.asarray(scene.constraints))
    label = components(np.concatenate(touched, axis=1) != 0)[: len(members)]
    groups = [members[label == first] for first in np.unique(label)]
    return None if len(groups[0]) == m else _by_size(groups, m)


def components(touches: np.ndarray) -> np.ndarray:
    """For each column of a boolean matrix the first of the columns it hangs together with."""
    none = touches.shape[1]
    label = np.arange(none)
    while True:
        of_row = np.where(touches, label[None, :], none).min(axis=1)
        least = np.where(touches, of_row[:, None], none).min(axis=0)
        least = least[least]  # of the column it points to: long chains take few rounds
        if (least == label).all():
            return label
        label = least


def _by_size(groups: list[np.ndarray], m: int) -> Groups:
    """The groups in one array, or the smaller ones and the larger ones in two."""
    groups = sorted(groups, key=len)  # stable
    size = np.array([len(group) for group in groups])
    few = np.arange(len(groups))  # entries of W if the first so many groups have their own array
    entries = few * size[few - 1] ** 2 + (len(groups) - few) * size[-1] ** 2
    cut = int(np.argmin(entries)) if entries[0] > WORTH_A_PROGRAM * entries.min() else 0

    def filled(part: list[np.ndarray]) -> np.ndarray:
        most = len(part[-1])
        return np.stack([np.pad(g, (0, most - len(g)), constant_values=m + g[0]) for g in part])

    return tuple(filled(part) for part in (groups[:cut], groups[cut:]) if part)


def solve_groups(
    law: Law,
    scene: Scene,
    groups: Groups,
    gamma: jax.Array,
    stored: jax.Array,
    happens: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Impulses p (m,) of all groups, the gravest status () and the diagonal of W (m,).

    `gamma` is 0 at open contacts, `happens` whether anything happens in the scene. A group in
    which nothing does gets p = 0, unless the law also pulls at separating contacts.
    """
    normals = scene.normals
    moved = solve_mass(scene, normals)  # W of a group is N^T M^-1 N of its columns
    p, gravest = jnp.zeros_like(gamma), jnp.asarray(CODE["ok"])

    def of_group(
        index: jax.Array, delassus: jax.Array, gamma: jax.Array, stored: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        own = jnp.any(gamma < 0) | jnp.any(stored > 0) | ~jnp.all(jnp.isfinite(gamma))
        solved = happens & (own | law.pulls)
        approach = jnp.where(solved, gamma, -jnp.ones_like(gamma))  # harmless, as in `impact`
        p, code = restricted(law, index).impulse(delassus, approach)
        return jnp.where(solved, p, 0.0), jnp.where(solved, code, CODE["ok"])

    for filled in groups:
        index = jnp.asarray(filled % len(gamma))
        there = (filled < len(gamma)) & scene.closed[index]  # the others are like open contacts
        w = jnp.einsum("nca,ncb->cab", normals[:, index], moved[:, index])
        keep = (there[:, :, None] & there[:, None, :]) | jnp.eye(index.shape[1], dtype=bool)[None]
        own = (jnp.where(there, x[index], 0.0) for x in (gamma, stored))
        given: list[jax.Array] = [index, jnp.where(keep, w, 0.0), *own]
        if len(index) == 1:
            part, code = of_group(*(x[0] for x in given))
        else:
            part, code = jax.vmap(of_group)(*given)
        p = p.at[filled.reshape(-1)].set(part.reshape(-1), mode="drop")
        gravest = jnp.maximum(gravest, jnp.max(code))
    return p, gravest, jnp.sum(normals * moved, axis=0)


def restricted(law: Law, index: jax.Array) -> Law:
    """The law of some contacts only: their entries of what it has one of per contact."""
    return jax.tree.map(lambda x: x[index] if eqx.is_array(x) and x.ndim == 1 else x, law)
