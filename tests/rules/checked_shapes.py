"""Impacts and motions under a check of all shapes that signatures in `numerics` and `events` state.

    python tests/rules/checked_shapes.py [CASE ..]      none: all

A script, as the check has to begin before jimpact is imported. Programs are traced (`lower`), which
runs each line of the package, and not compiled.
"""

import importlib
import inspect
import pkgutil
import sys
import typing

import jaxtyping

PACKAGES = "jimpact.numerics", "jimpact.events"
jaxtyping.install_import_hook(PACKAGES, "beartype.beartype")

import jax
import jax.numpy as jnp
import numpy as np
import piles
from spatial_scenes import NAMED

import jimpact as ji

jax.config.update("jax_enable_x64", True)


def check_named_tuples():
    """The hook checks functions and dataclasses; this checks fields of named tuples.

    Only those that the two rooms make: JAX itself puts axes and placeholders into them.
    """
    for package in map(importlib.import_module, PACKAGES):
        for found in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            for kind in vars(importlib.import_module(found.name)).values():
                own = inspect.isclass(kind) and kind.__module__ == found.name
                if own and hasattr(kind, "_fields"):
                    check_fields(kind)


def check_fields(kind):
    """Named tuples of this kind get the shapes that its fields state."""
    make, shapes = kind.__new__, {}
    for name, hint in typing.get_type_hints(kind).items():
        either = [x for x in (hint, *typing.get_args(hint)) if inspect.isclass(x)]
        shapes[name] = tuple(
            x for x in either if issubclass(x, jaxtyping.AbstractArray)
        )

    def checked(cls, *args, **kwargs):
        made = make(cls, *args, **kwargs)
        if sys._getframe(1).f_globals["__name__"].startswith(PACKAGES):
            with jaxtyping.jaxtyped("context"):
                for name, value in made._asdict().items():
                    if shapes[name] and isinstance(value, jax.Array):
                        assert isinstance(value, shapes[name]), (
                            f"{kind.__name__}.{name}: {value}"
                        )
        return made

    kind.__new__ = checked


# ------------------------------------------------------------------------------------ impacts


def pressed(name):
    """Scene and velocity of a box on the ground."""
    body = NAMED[name]()
    return ji.Scene(body.mass, body.normals, body.tangents), jnp.asarray(body.velocity)


def pile():
    """Three discs in a row, of many bodies: their Delassus matrix is sparse."""
    discs = piles.discs([1.0, 2.0, 1.5], [0.1, 0.1, 0.1])
    return discs.scene(
        jnp.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.4, 0.0, 0.0])
    ), jnp.eye(9)[0]


CHAIN, V = ji.chain([1.0, 2.0, 1.0]), jnp.array([1.0, 0.2, 0.0])
GAPS = ji.chain([1.0, 2.0, 1.0], gaps=[0.0, 0.1])
LONG = ji.chain(np.ones(12)), jnp.arange(12.0)[::-1]
PLANE = ji.Block(0.3, 0.4, 1.3).scene([0.0, 0.2, 0.0]), jnp.array([0.3, -1.0, 0.4])
EDGE, CORNERS, PILE = pressed("edge"), pressed("flat"), pile()

# a law of one parameter, a scene, v-
IMPACTS = {
    "lzb": (lambda e: ji.LZB(e, 1.0, 1.5), CHAIN, V),
    "lzb exponents": (lambda e: ji.LZB(0.5, 1.0, 1 + e * jnp.ones(2)), CHAIN, V),
    "lzb conditioning": (
        lambda e: ji.LZB(e, 1.0, 1.5, check_conditioning=True),
        CHAIN,
        V,
    ),
    "lzb long chain": (lambda e: ji.LZB(e, 1.0, 1.5), *LONG),
    "lzb pile": (lambda e: ji.LZB(e, 1.0, 1.5), *PILE),
    "lzb plane": (lambda e: ji.LZB(e, 1.0, 1.5, friction=0.3), *PLANE),
    "lzb space": (lambda e: ji.LZB(e, 1.0, 1.5, friction=0.3, method="time"), *EDGE),
    "lzb implicit": (
        lambda e: ji.LZB(e, 1.0, 1.5, friction=0.3, method="implicit"),
        *EDGE,
    ),
    "gaps": (lambda e: ji.Compliant(ji.Bistiffness(1.0, 1.5, e)), GAPS, V),
    "gaps implicit": (
        lambda e: ji.Compliant(ji.KelvinVoigt(2.0, e), method="implicit"),
        GAPS,
        V,
    ),
    "viscous": (lambda e: ji.Compliant(ji.KelvinVoigt(2.0, e)), GAPS, V),
    "newton pile": (lambda e: ji.Newton(e), *PILE),
    "moreau": (lambda e: ji.Moreau(e), CHAIN, V),
    "moreau pile": (lambda e: ji.Moreau(e), *PILE),
    "moreau plane": (lambda e: ji.Moreau(e, friction=0.3), *PLANE),
    "moreau space": (lambda e: ji.Moreau(e, friction=0.3), *EDGE),
    "moreau four corners": (lambda e: ji.Moreau(e, friction=0.3), *CORNERS),
    "poisson": (lambda e: ji.Poisson(e, friction=0.3), *PLANE),
}


def after(name):
    """v+ as a function of the law's parameter, with v- near that of the table."""
    law, scene, v = IMPACTS[name]
    return lambda e: ji.impact(law(e), scene, v * (1 + e / 10)).velocity


def forces(name):
    """Forces of contacts over time as a function of the law's parameter."""
    law, scene, v = IMPACTS[name]
    return lambda e: ji.history(law(e), scene, v, samples=5).force


def reverse_mode(scene, v, **options):
    """Reverse derivatives of a loop that keeps states."""

    def velocity(e):
        return ji.impact(
            ji.LZB(e, 1.0, 1.5, adjoint="checkpoints", **options), scene, v
        ).velocity

    return jax.jacrev(velocity)


BALL, DROPPED = ji.System(ji.Column([1.0]), gravity=True), ([1.0], [0.0], 0.6)


def bounces(e):
    """Heights of a ball that falls to the ground, by events."""
    return ji.simulate(BALL, ji.Moreau(e), *DROPPED, samples=5).q


def springs_back(e):
    """Heights of a ball that falls on a damped spring."""
    law = ji.Compliant(ji.KelvinVoigt(1e4, e))
    return ji.simulate(BALL, law, *DROPPED, samples=5, method="contact_forces").q


CASES = {
    **{name: after(name) for name in IMPACTS},
    **{
        f"grad {name}": jax.jacrev(after(name))
        for name in ("lzb", "lzb plane", "lzb space")
    },
    **{
        f"grad {name}": jax.jacrev(after(name))
        for name in ("lzb implicit", "gaps", "moreau")
    },
    "grad moreau space": jax.jacrev(after("moreau space")),
    "hessian": jax.hessian(after("moreau plane")),
    "checkpoints": reverse_mode(CHAIN, V),
    "checkpoints implicit": reverse_mode(*EDGE, friction=0.3, method="implicit"),
    "vmap": lambda e: jax.vmap(after("lzb plane"))(e * jnp.arange(1.0, 4.0)),
    "history": forces("lzb"),
    "history implicit": forces("lzb implicit"),
    "motion by events": bounces,
    "motion by contact forces": springs_back,
}

if __name__ == "__main__":
    check_named_tuples()
    for case in sys.argv[1:] or CASES:
        print(case, flush=True)
        jax.jit(CASES[case]).lower(0.5)
