"""Forward *and* reverse derivatives of a solver whose loop has no fixed length.

A `while_loop` has forward derivatives only. The rule here runs it once with one tangent for
every perturbed input, which gives the Jacobian; what is left, Jacobian times tangent, is linear
and so can be transposed: forward and reverse mode agree to rounding.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jimpact.compiling import full_precision
from jimpact.loops import varying_like


def both_modes(
    solve: Callable[..., tuple[Any, Any]],
) -> Callable[[Any], tuple[Any, Any]]:
    """`solve(inputs, differentiated)` -> (outputs, integers), made differentiable in both modes.

    `differentiated` is True in the run whose derivatives are taken: it may then work at a
    tighter tolerance. Inputs that are not perturbed cost nothing.
    """

    @jax.custom_jvp
    def differentiable(inputs: Any) -> tuple[Any, Any]:
        """The values."""
        return solve(inputs, False)

    @full_precision
    def rule(primals: Any, tangents: Any) -> Any:
        """Values and tangents by the Jacobian."""
        leaves, tree = jax.tree.flatten(primals[0])
        rates = jax.tree.leaves(tangents[0], is_leaf=lambda t: isinstance(t, SymbolicZero))
        moving = [i for i, rate in enumerate(rates) if not isinstance(rate, SymbolicZero)]

        def with_jacobian(at: list[jax.Array]) -> tuple[Any, Any, Any]:
            """Outputs, their Jacobian, integers."""

            def outputs_of(values: list[jax.Array]) -> tuple[Any, Any]:
                """Outputs of the perturbed inputs."""
                moved = dict(zip(moving, values))
                inputs = [moved.get(i, leaf) for i, leaf in enumerate(at)]
                return solve(jax.tree.unflatten(tree, inputs), True)

            values = [at[i] for i in moving]

            def push(directions: list[jax.Array]) -> tuple[Any, Any, Any]:
                """Outputs and their tangent in one direction."""
                return jax.jvp(outputs_of, (values,), (directions,), has_aux=True)

            return jax.vmap(push, out_axes=(None, 0, None))(unit_directions(values))

        out, jacobian, aux = with_jacobian(leaves)
        tangent = jnp.concatenate([jnp.ravel(rates[i]) for i in moving])
        rate = jax.tree.map(lambda rows: jnp.tensordot(tangent, rows, axes=1), jacobian)
        still = jax.tree.map(lambda x: SymbolicZero(jax.typeof(x).to_tangent_aval()), aux)
        return (out, aux), (rate, still)

    differentiable.defjvp(rule, symbolic_zeros=True)
    return differentiable


def without_derivatives(values: Any, why: Exception) -> Any:
    """`values` as they are; `why` is raised where one of them is differentiated."""

    @jax.custom_jvp
    def same(numbers: list[Any]) -> list[Any]:
        """The numbers as they are."""
        return numbers

    def rule(primals: Any, tangents: Any) -> Any:
        """Raises where a number is perturbed."""
        rates = jax.tree.leaves(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
        if any(not isinstance(rate, SymbolicZero) for rate in rates):
            raise why
        return primals[0], tangents[0]

    same.defjvp(rule, symbolic_zeros=True)
    leaves, tree = jax.tree.flatten(values)
    moving = [i for i, x in enumerate(leaves) if eqx.is_inexact_array(x)]
    replaced = dict(zip(moving, same([leaves[i] for i in moving])))
    return jax.tree.unflatten(tree, [replaced.get(i, x) for i, x in enumerate(leaves)])


def unit_directions(values: list[jax.Array]) -> list[jax.Array]:
    """Unit perturbations (d, ...) of each entry in turn."""
    counts = [x.size for x in values]
    unit, first, directions = jnp.eye(sum(counts), dtype=values[0].dtype), 0, []
    for x, count in zip(values, counts):
        rows = unit[:, first : first + count].reshape(-1, *x.shape)
        directions.append(varying_like(rows, x))
        first += count
    return directions
