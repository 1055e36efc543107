"""Forward *and* reverse derivatives of a solver whose loop has no fixed length.

A `while_loop` has forward derivatives only. The rule here runs it once with one tangent for
every perturbed input, which gives the Jacobian; what is left, Jacobian times tangent, is linear
and so can be transposed: forward and reverse mode agree to rounding.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree


def both_modes(
    solve: Callable[..., tuple[Any, Any]],
) -> Callable[[Any], tuple[Any, Any]]:
    """`solve(inputs, differentiated)` -> (outputs, integers), made differentiable in both modes.

    `differentiated` is True in the run whose derivatives are taken: it may then work at a
    tighter tolerance. Inputs that are not perturbed cost nothing.
    """

    @jax.custom_jvp
    def differentiable(inputs: Any) -> tuple[Any, Any]:
        return solve(inputs, False)

    def rule(primals: Any, tangents: Any) -> Any:
        leaves, tree = jax.tree.flatten(primals[0])
        rates = jax.tree.leaves(tangents[0], is_leaf=lambda t: isinstance(t, SymbolicZero))
        moving = [i for i, rate in enumerate(rates) if not isinstance(rate, SymbolicZero)]
        flat, restore = ravel_pytree([leaves[i] for i in moving])
        flat_rate, _ = ravel_pytree([rates[i] for i in moving])

        def outputs_of(values: jax.Array) -> tuple[Any, Any]:
            moved = dict(zip(moving, restore(values)))
            at = [moved.get(i, leaf) for i, leaf in enumerate(leaves)]
            return solve(jax.tree.unflatten(tree, at), True)

        def push(direction: jax.Array) -> tuple[Any, Any, Any]:
            return jax.jvp(outputs_of, (flat,), (direction,), has_aux=True)

        out, jacobian, aux = jax.vmap(push, out_axes=(None, 0, None))(
            jnp.eye(flat.shape[0], dtype=flat.dtype)
        )
        rate = jax.tree.map(lambda columns: jnp.tensordot(flat_rate, columns, axes=1), jacobian)
        still = jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), jax.dtypes.float0), aux)
        return (out, aux), (rate, still)

    differentiable.defjvp(rule, symbolic_zeros=True)
    return differentiable
