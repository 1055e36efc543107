"""Long chains: only the contacts around those at work are stepped.

A wave in a chain loads a few contacts at a time. They and some beside them are a window, stepped
as a chain of its own: contacts beyond it are at rest or separate, and feel nothing before the
contact at the edge of the window matters (`events.matters`); then the window is laid anew. Where
the contacts at work no longer fit into one width, the next one takes over, at last the whole chain.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp

from jimpact.numerics import isolated, stepper
from jimpact.numerics.events import NEGLIGIBLE
from jimpact.numerics.flow import Flow
from jimpact.numerics.steps import Carry, Control
from jimpact.solvers.tridiagonal import Tridiagonal

WIDTHS = (32, 128, 512)  # contacts; the steps of one impact cost as much with 1 contact as with 32
LONG = 2  # widths: chains below are stepped whole
MARGIN = 4  # contacts that a window keeps free on either side when it is laid

Tree = TypeVar("Tree")


def run(flow: Flow, control: Control, carry: Carry) -> Carry:
    """`stepper.run`, in windows where the impact is that of one long chain."""
    m, one = carry.phase.shape[0], carry.phase.ndim == 1
    common = not isinstance(flow.exponent, tuple) or len(set(flow.exponent)) == 1
    if one and common and isinstance(flow.coupling, Tridiagonal) and not flow.gapped:
        if isinstance(flow.exponent, tuple):
            flow = flow._replace(exponent=flow.exponent[0])
        for width in WIDTHS:
            if m >= LONG * width:
                carry = _in_windows(flow, control, carry, width)
    return stepper.run(flow, control, carry)


def _in_windows(flow: Flow, control: Control, carry: Carry, width: int) -> Carry:
    """Until the impact ends, or too many contacts are at work for windows of this width."""
    m = carry.phase.shape[0]

    def span(c: Carry) -> tuple[jax.Array, jax.Array]:
        """First contact at work and how many up to the last one."""
        works = _works(flow, control, c)
        first = jnp.argmax(works)
        return first, m - jnp.argmax(works[::-1]) - first

    def fits(c: Carry) -> jax.Array:
        goes_on = ~c.done[0] & (c.passes[0] < control.max_steps)
        return goes_on & (span(c)[1] <= width - 2 * MARGIN)

    def through(c: Carry) -> Carry:
        first, count = span(c)
        low = jnp.clip(first - (width - count) // 2, 0, m - width)
        part_flow, part_control = _part((flow, control), m, low, width)
        index = jnp.arange(width)
        edge = ((index == 0) & (low > 0)) | ((index == width - 1) & (low < m - width))
        part_control = part_control._replace(beyond=edge)

        def inside(part: Carry) -> jax.Array:
            goes_on = ~part.done[0] & (part.passes[0] < control.max_steps)
            return goes_on & ~jnp.any(edge & _works(part_flow, part_control, part))

        part = jax.lax.while_loop(
            inside,
            lambda part: stepper.advance(part_flow, part_control, part, ~part.done),
            _part(c, m, low, width),
        )
        return _whole(c, part, low)

    return jax.lax.while_loop(fits, through, carry)


def _works(flow: Flow, control: Control, carry: Carry) -> jax.Array:
    return isolated.at_work(flow, control.tolerance, carry.phase, carry.state, NEGLIGIBLE)


def _part(tree: Tree, m: int, low: jax.Array, width: int) -> Tree:
    """The window of all arrays of the tree that have one entry per contact (or per link)."""

    def cut(x: jax.Array) -> jax.Array:
        if not isinstance(x, jax.Array) or x.shape[0] < m - 1:
            return x
        return jax.lax.dynamic_slice_in_dim(x, low, width - (m - x.shape[0]))

    return jax.tree.map(cut, tree)


def _whole(carry: Carry, part: Carry, low: jax.Array) -> Carry:
    """`carry` with the window put back."""

    def put(old: jax.Array, new: jax.Array) -> jax.Array:
        if old.shape == new.shape:
            return new
        return jax.lax.dynamic_update_slice_in_dim(old, new, low, 0)

    return jax.tree.map(put, carry, part)
