"""Masses, gaps and orientations of a scene that are fitted with a law, each with a prior."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.contact import Contact
from jimpact.files.study_file import OF_A_SCENE
from jimpact.fits.ties import entry_of
from jimpact.law import (
    Impulses,
    Law,
    OptionalValues,
    forwards_to_law,
    free_parameters_of,
    parameter,
)
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.scene import Scene, with_gaps

# A part of a scene is searched up to so many standard deviations of its prior away. With ten times
# more, random starts would lie where the prior makes a fit hopeless.
REACH = 10.0


@forwards_to_law
class LawInScene(Law):
    """A law, and the parts of the scene that are fitted with it; None: as the scene has them.

    A tilt by a turns the contact: `N cos(a) + H sin(a)`, `H cos(a) - N sin(a)`.
    """

    law: Law
    mass: OptionalValues = parameter(low=0.0, open_low=True, per_contact=False, default=None)
    gaps: OptionalValues = parameter(low=0.0, default=None)
    tilt: OptionalValues = parameter(low=-np.pi, high=np.pi, default=None)

    def impulses(self, contact: Contact) -> Impulses:
        """Those of the law, in a contact of a scene with these parts."""
        return self.law.impulses(contact)

    def in_scene(self, scene: Scene) -> Scene:
        """The scene with these parts."""
        if self.mass is not None:
            scene = eqx.tree_at(lambda s: s.mass, scene, self.mass)
        if self.gaps is not None:
            scene = with_gaps(scene, self.gaps)
        if self.tilt is None:
            return scene
        normals, tangents = _directions(scene)
        cos, sin = jnp.cos(self.tilt)[None, :], jnp.sin(self.tilt)[None, :]
        turned = (normals * cos + tangents * sin, tangents * cos - normals * sin)
        return eqx.tree_at(lambda s: (s._normals, s.tangents), scene, turned)


def _directions(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """Normals and tangents (n, m) of a planar scene."""
    assert scene.tangents is not None
    return scene.normals, scene.tangents


def placed(law: Law, scenes: Scene) -> tuple[Law, Scene]:
    """The law itself, and the stacked scenes with the parts that are fitted with it."""
    if not isinstance(law, LawInScene):
        return law, scenes
    return law.law, jax.vmap(law.in_scene)(scenes)


def plain_law(law: Any) -> Any:
    """The law without parts of a scene."""
    return law.law if isinstance(law, LawInScene) else law


def with_parts_of_scene(law: Law, scene: Scene | None, own_scenes: bool, free: Any) -> Law:
    """The law with the parts of the scene that `free` names; `own_scenes`: each shot has its own.

    Raises:
        ValueError: parts that the scene does not have, or that the shots do not share.
    """
    named = (free,) if isinstance(free, str) else tuple(free)
    wanted = {entry_of(name)[0] for name in named} & set(OF_A_SCENE)
    parts = [name for name in OF_A_SCENE if name in wanted - set(free_parameters_of(law))]
    if not parts or isinstance(law, LawInScene):
        return law
    if scene is None or own_scenes:
        raise ValueError(
            f"Argument `free` may name `{parts[0]}` only where all shots have one `scene`, but "
            "they have scenes of their own."
        )
    if isinstance(law, RestitutionMatrix):
        raise ValueError(
            f"Argument `free` must not name `{parts[0]}` with a RestitutionMatrix, which is "
            "admissible in one scene only."
        )
    return LawInScene(law, **{name: _part(name, scene) for name in parts})


def _part(name: str, scene: Scene) -> jax.Array:
    """The value of a part in the scene."""
    if name == "mass":
        if scene.mass.ndim == 2:
            raise ValueError("Argument `free` may name `mass` only where that of `scene` is (n,).")
        return scene.mass
    if name == "gaps":
        if scene.gaps is None:
            raise ValueError("Argument `free` may name `gaps` only where `scene` has gaps.")
        return scene.gaps
    if scene.tangents is None or scene.tangents.shape != scene.normals.shape:
        raise ValueError(
            "Argument `free` may name `tilt` only where `scene` has one tangent for each contact."
        )
    return jnp.zeros(scene.contacts, scene.mass.dtype)
