"""Is `x^T Q x >= 0` for all `x >= 0`? Exact by enumeration of supports, for small matrices."""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_values

LARGEST = 12  # 2^12 supports of one eigenproblem each are still a fraction of a second
# |margin| below this multiple of the matrix scale is "boundary": rounding of Q reaches about
# m eps cond(G), so seven digits remain for the condition number in either precision.
COPOSITIVITY_TOLERANCE = {"float64": 1e-9, "float32": 1e-4}


class Copositivity(NamedTuple):
    """The answer, the margin `min x^T Q x` over `x >= 0`, `|x| = 1`, and its minimizer."""

    answer: Literal["yes", "no", "boundary"]
    margin: float
    witness: np.ndarray

    def __bool__(self) -> bool:
        """Copositive, the boundary included."""
        return self.answer != "no"


def margin(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Least `x^T Q x` over `x >= 0`, `|x| = 1`, and a minimizer x; pure, jit and vmap.

    Let a minimizer have the smallest possible support S. It is a local minimum of the Rayleigh
    quotient of Q_SS, hence an eigenvector of the *smallest* eigenvalue, as the quotient has no
    other local minima. That eigenvalue is simple: else one could move inside its eigenspace
    until a component vanishes, and S would not be smallest. So the lowest eigenvector of every
    Q_SS holds the minimizer; clipped to `x >= 0` every one is feasible and none is rejected.

    Args:
        matrix: Q (m, m), m <= 12; only its symmetric part counts.

    Returns:
        The margin () and x (m,). The margin has the derivative `x^T dQ x` wherever the
        minimizer is unique (not differentiable elsewhere); x is a constant to differentiation.

    Raises:
        ValueError: not square, or m > 12.

    Source: Hadeler, On copositive matrices, Linear Algebra Appl. 49 (1983) 79-89.

    >>> import jax.numpy as jnp
    >>> value, x = margin(jnp.array([[1.0, -2.0], [-2.0, 1.0]]))
    >>> round(float(value), 6), x.round(3).tolist()
    (-1.0, [0.707..., 0.707...])
    """
    m = _size(matrix)
    q = 0.5 * (matrix + matrix.T)
    still = jax.lax.stop_gradient(q)
    largest = jnp.abs(still).max()
    still = still / jnp.where(largest > 0, largest, 1.0)
    supports = _supports(m).astype(q.dtype)
    inside = supports[:, :, None] * supports[:, None, :]
    outside = (m + 1.0) * (1 - supports)  # above every eigenvalue of Q_SS, which are at most m
    blocks = inside * still[None] + outside[:, :, None] * jnp.eye(m, dtype=q.dtype)[None]
    lowest = jnp.linalg.eigh(blocks)[1][:, :, 0] * supports
    lowest = lowest * jnp.where(jnp.sum(lowest, axis=1) < 0, -1.0, 1.0)[:, None]
    x = jnp.maximum(lowest, 0.0)
    x = x / jnp.linalg.norm(x, axis=1, keepdims=True)
    best = x[jnp.argmin(jnp.einsum("si,ij,sj->s", x, still, x))]
    return best @ q @ best, best


def copositivity(
    matrix: Any, tolerance: float | None = None, scale: float | None = None
) -> Copositivity:
    """Whether Q is copositive: "yes", "no" with a violating x >= 0, or "boundary".

    Args:
        matrix: Q (m, m), m <= 12.
        tolerance: "boundary" where `|margin| <= tolerance * scale`; None: by its precision.
        scale: None: the largest |Q_ij|. Give it where Q is a difference of larger matrices.

    Raises:
        ValueError: not square, m > 12, not finite, negative tolerance or scale.

    >>> copositivity([[1.0, -1.0], [-1.0, 1.0]]).answer
    'boundary'
    """
    q = as_float_array("matrix", matrix)
    _size(q)
    check_values("matrix", q)
    check_values("tolerance", tolerance, low=0.0)
    check_values("scale", scale, low=0.0)
    value, witness = (np.asarray(part) for part in _compiled_margin(q))
    if tolerance is None:
        tolerance = COPOSITIVITY_TOLERANCE.get(str(q.dtype), 1e-4)
    if scale is None:
        scale = float(jnp.abs(q).max())
    if abs(value) <= tolerance * scale:
        return Copositivity("boundary", float(value), witness)
    return Copositivity("yes" if value > 0 else "no", float(value), witness)


def _size(matrix: jax.Array) -> int:
    shape = np.shape(matrix)
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
        raise ValueError(f"Argument `matrix` must have shape (m, m), but has shape {shape}.")
    if shape[0] > LARGEST:
        raise ValueError(
            f"Argument `matrix` must have at most {LARGEST} rows, as all 2^m supports are "
            f"enumerated, but has {shape[0]}."
        )
    return int(shape[0])


def _supports(m: int) -> np.ndarray:
    """All nonempty subsets of m indices as rows of zeros and ones."""
    return (np.arange(1, 2**m)[:, None] >> np.arange(m)[None, :]) & 1


_compiled_margin = jax.jit(margin)
