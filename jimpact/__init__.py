"""jimpact: differentiable laws for impacts with several contacts, in JAX.

The mental model: a `Scene` (mass matrix, contact normals) turns velocities into contact
space,
`W = N^T M^-1 N` and gap velocities `gamma = N^T v` (negative on approach); a *law* maps
`(W, gamma-)` and its own parameters to impulses `p >= 0`; `impact` gives
`v+ = v- + M^-1 (N p + H p_t)`, with tangential impulses p_t and tangents H under
friction, the energy change (<= 0 dissipates) and a status code.
Laws and scenes are pytrees: `jax.jit`, `jax.vmap` and `jax.grad` work over all of them.

>>> import jimpact as ji
>>> out = ji.impact(ji.LZB(1.0), ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
>>> [round(float(v), 3) for v in out.velocity]
[-0.071, 0.076, 0.995]
"""

import lazy_loader

__version__ = "0.1.0"

# `__init__.pyi` lists the public names; a module is imported on first use of one of its
# names, so that `jimpact --help` stays fast. No module here is named like a public
# name: importing it would put the module in the function's place.
_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]


def __getattr__(name: str) -> object:
    """The public name; an AttributeError that says which one was probably meant.

    An ImportError says which room is missing where a copy of the package lacks it.
    """
    if name.startswith("__"):
        return _public(name)
    from jimpact.tools.checks import missing_room, suggestion

    if name not in __all__:
        raise AttributeError(
            f"jimpact has no name `{name}`.{suggestion(name, __all__)}"
        )
    with missing_room(f"ji.{name}"):
        return _public(name)
