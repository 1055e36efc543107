"""What `work_precision` is asked for, checked."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_shape, check_values, in_common_dtype
from jimpact.law import check_law
from jimpact.laws.lzb import LZB
from jimpact.methods.charts.programs import Case
from jimpact.methods.contenders import METHODS, Method, checked
from jimpact.scene import Scene, as_velocity

SPREAD = 10.0  # stiffnesses of a batch lie within this factor, half of it to either side
SAMPLE = 16  # impacts of the batch on which errors are measured: one alone may be luckily right


def case_of(scene: Scene, velocity: Any, law: LZB, batch: int, repeats: int) -> Case:
    """The impact in double precision, one parameter per contact, with a batch around it."""
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    if not isinstance(law, LZB):
        raise TypeError(f"Argument `law` must be an LZB law, but is {type(law).__name__}.")
    for name, value in (("batch", batch), ("repeats", repeats)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"Argument `{name}` must be a whole number >= 1, but is {value!r}.")
    law, scene, v = in_common_dtype(law, scene, v)
    if v.dtype != jnp.float64:
        raise ValueError(
            f"Argument `velocity` must be in double precision, but has dtype {v.dtype}: "
            "enable jax_enable_x64."
        )
    check_law(law, scene, v.dtype)
    if not bool(law.contact(scene, v).happens):
        raise ValueError("Argument `velocity` must let a closed contact approach.")
    m = scene.contacts
    for name in ("restitution", "stiffness"):
        value = getattr(law, name)
        if value.shape not in ((), (m,)):
            check_shape(name, value, (m,), "one entry per contact, or a scalar")
    law = eqx.tree_at(
        lambda old: (old.restitution, old.stiffness),
        law,
        (jnp.broadcast_to(law.restitution, (m,)), jnp.broadcast_to(law.stiffness, (m,))),
    )
    exponents = np.random.default_rng(0).uniform(-0.5, 0.5, (batch, m))
    exponents[0] = 0.0  # the impact itself
    stiffness = law.stiffness[None, :] * jnp.asarray(SPREAD**exponents)
    return Case(law, scene, v, stiffness, min(SAMPLE, batch))


def chosen_methods(names: Sequence[str] | None, case: Case) -> tuple[list[Method], dict[str, str]]:
    """Methods asked for; without names all that can, and why the others cannot."""
    if names is None:
        why = {n: m.supports(case.law, case.scene) for n, m in METHODS.items()}
        left_out = {name: reason for name, reason in why.items() if reason is not None}
        return [m for n, m in METHODS.items() if n not in left_out], left_out
    chosen = [_method("methods", name) for name in names]
    for method in chosen:
        checked(case.law, case.scene, method)
    return chosen, {}


def _method(argument: str, name: str) -> Method:
    if name not in METHODS:
        raise ValueError(
            f"Argument `{argument}` must be among {', '.join(METHODS)}, but has {name!r}."
        )
    return METHODS[name]


def ladders_of(
    chosen: list[Method], settings: Mapping[str, Sequence[float]]
) -> dict[str, tuple[float, ...]]:
    """Settings by method."""
    for name, values in settings.items():
        if name not in [method.name for method in chosen]:
            raise ValueError(f"Argument `settings` must be of chosen methods, but has {name!r}.")
        check_values(f"settings[{name!r}]", values, low=0.0, open_low=True)
    return {m.name: tuple(settings.get(m.name, m.ladder)) for m in chosen}


def reference_method(name: str | None, case: Case) -> Method:
    """The method that errors are measured from."""
    if name is None:
        linear = METHODS["propagator"].supports(case.law, case.scene) is None
        name = "propagator" if linear else "dop853"
    method = _method("reference", name)
    checked(case.law, case.scene, method)
    if method.setting != "rtol":
        raise ValueError(f"Argument `reference` must take an rtol, but is {name!r}.")
    return method
