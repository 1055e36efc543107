"""Restitution matrices and coefficients that are admissible for all velocities: Props.
6.2-6.5.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import (
    kinetic_norm,
    normalized_delassus,
    normalized_gap_velocity,
)
from jimpact.core.scene import Scene, kinetic_energy, velocity_change
from jimpact.numerics.tridiagonal import as_matrix
from jimpact.tools.checks import as_numbers, check_values
from jimpact.tools.compiling import full_precision

# Most rows of a matrix: its 2^12 supports of one eigenproblem each take a fraction of a
# second. Each row more doubles that.
LARGEST = 12
# |margin| below this multiple of the matrix scale is "boundary": rounding of Q reaches
# about
# m eps cond(G), so seven digits remain for the condition number in either precision.
# Ten times more would call clear answers "boundary".
COPOSITIVITY_TOLERANCE = {"float64": 1e-9, "float32": 1e-4}

# G counts as singular when its smallest eigenvalue is below this multiple of eps * m *
# largest.
_SINGULAR = 100.0


class Copositivity(NamedTuple):
    """The `answer`, the `margin` min x^T Q x over x >= 0, |x| = 1, its `witness`."""

    answer: Literal["yes", "no", "boundary"]
    margin: float
    witness: np.ndarray

    def __bool__(self) -> bool:
        """Copositive, the boundary included."""
        return self.answer != "no"


@full_precision
def margin(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Least `x^T Q x` over `x >= 0`, `|x| = 1`, and a minimizer x; pure, jit and vmap.

    Let a minimizer have the smallest possible support S. It is a local minimum of the
    Rayleigh quotient of Q_SS, hence an eigenvector of the *smallest* eigenvalue, as the
    quotient has no other local minima. That eigenvalue is simple: else one could move
    inside its eigenspace until a component vanishes, and S would not be smallest. So
    the lowest eigenvector of every Q_SS holds the minimizer; clipped to `x >= 0` every
    one is feasible and none is rejected.

    Args:
        matrix: Q (m, m), m <= 12; only its symmetric part counts.

    Returns:
        The margin () and x (m,). The margin has the derivative `x^T dQ x` wherever the
        minimizer is unique (not differentiable elsewhere); x is a constant to
        differentiation.

    Raises:
        ValueError: not square, or m > 12.

    Source: Hadeler, On copositive matrices, Linear Algebra Appl. 49 (1983) 79-89.

    >>> import jax.numpy as jnp
    >>> value, x = margin(jnp.array([[1.0, -2.0], [-2.0, 1.0]]))
    >>> round(float(value), 6), x.round(3).tolist()
    (-1.0, [0.707..., 0.707...])
    """
    m = _checked_size(matrix)
    q = 0.5 * (matrix + matrix.T)
    fixed = jax.lax.stop_gradient(q)
    largest = jnp.abs(fixed).max()
    fixed = fixed / jnp.where(largest > 0, largest, 1.0)
    # all nonempty sets of indices, as rows of zeros and ones
    numbers = np.arange(1, 2**m)[:, None]
    supports = ((numbers >> np.arange(m)) & 1).astype(q.dtype)
    inside = supports[:, :, None] * supports[:, None, :]
    # above every eigenvalue of Q_SS, which are at most m
    outside = (m + 1.0) * (1 - supports)
    identity = jnp.eye(m, dtype=q.dtype)
    blocks = inside * fixed[None] + outside[:, :, None] * identity[None]
    _, vectors = jnp.linalg.eigh(blocks)
    lowest = vectors[:, :, 0] * supports
    signs = jnp.where(jnp.sum(lowest, axis=1) < 0, -1.0, 1.0)
    lowest = lowest * signs[:, None]
    x = jnp.maximum(lowest, 0.0)
    x = x / jnp.linalg.norm(x, axis=1, keepdims=True)
    values = jnp.einsum("si,ij,sj->s", x, fixed, x)
    best = x[jnp.argmin(values)]
    return best @ q @ best, best


def copositivity(
    matrix: Any, tolerance: float | None = None, scale: float | None = None
) -> Copositivity:
    """Decide if Q is copositive: "yes", "no" with a violating x >= 0, or "boundary".

    Equation: copositive is `x^T Q x >= 0` for all x >= 0: `margin(Q) >= 0`.

    Args:
        matrix: Q (m, m), m <= 12.
        tolerance: "boundary" where `|margin| <= tolerance * scale`; None: by its
            precision.
        scale: None: the largest |Q_ij|. Give it where Q is a difference of larger
            matrices.

    Returns:
        `Copositivity`: answer, margin, and the x (m,) that decides.

    Raises:
        ValueError: not square, m > 12, not finite, negative tolerance or scale.

    Source: all 2^m - 1 supports of x enumerated; Brogliato (2016), Prop. 6.3 asks for
    it.

    >>> copositivity([[1.0, -1.0], [-1.0, 1.0]]).answer
    'boundary'
    """
    q = as_numbers("matrix", matrix)
    _checked_size(q)
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


def _checked_size(matrix: jax.Array) -> int:
    """Number m of rows of a square matrix, checked: 1 to `LARGEST`."""
    shape = np.shape(matrix)
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
        raise ValueError(
            f"Argument `matrix` must have shape (m, m), but has shape {shape}."
        )
    if shape[0] > LARGEST:
        raise ValueError(
            f"Argument `matrix` must have at most {LARGEST} rows, as all 2^m supports "
            f"are enumerated, but has {shape[0]}."
        )
    return int(shape[0])


_compiled_margin = jax.jit(margin)


class Sign(NamedTuple):
    """Verdict on a condition `A >= 0`, entry by entry, on a matrix A (m, m)."""

    holds: bool
    worst: float  # least entry of A
    where: tuple[int, int]  # its contacts: row and column, from 0
    velocity: np.ndarray  # qn- (m,): of the approaches of one contact alone, the worst


class MatrixAudit(NamedTuple):
    """Result of `audit_matrix`; `print(audit)` describes it.

    `kinematic`, `kinetic`: Prop. 6.2 (i), (ii). `energetic`: Prop. 6.3; `bool` of it is
    True on the boundary too. Of all approaches of one length |qn-|,
    `worst_normal_velocity` qn- (m,), with `worst_velocity` v- (n,) [m/s], loses least:
    it gains energy where the answer is "no" and conserves it where it is "boundary".
    `spectral_radius` and `spectral` (Prop. 6.4) are None unless E is self-adjoint.
    `singular_value` <= `singular_value_bound` is Prop. 6.5, sufficient only.
    """

    kinematic: Sign
    kinetic: Sign
    energetic: Copositivity
    worst_normal_velocity: np.ndarray
    worst_velocity: np.ndarray
    spectral_radius: float | None
    spectral: bool | None
    singular_value: float
    singular_value_bound: float

    @property
    def singular_values(self) -> bool:
        """True where the sufficient bound of Prop. 6.5 holds."""
        return self.singular_value <= self.singular_value_bound

    @property
    def admissible(self) -> bool:
        """Kinematic, kinetic and energetic consistency for every pre-impact
        velocity.
        """
        return self.kinematic.holds and self.kinetic.holds and bool(self.energetic)

    def __str__(self) -> str:
        """Report: the verdict, and each proposition with its numbers, a line each."""
        kinematic = self.kinematic
        kinetic = self.kinetic
        energetic = self.energetic
        if self.admissible:
            verdict = "admissible"
        else:
            verdict = "NOT admissible"
        lines = [
            f"restitution matrix: {verdict} for all pre-impact velocities qn- <= 0"
        ]
        for title, sign, what in (
            ("kinematic  (6.2 i)  E >= 0", kinematic, "still approaches"),
            ("kinetic    (6.2 ii) G^-1 (I + E) >= 0", kinetic, "would have to pull"),
        ):
            i, j = (k + 1 for k in sign.where)
            text = f"yes, least entry {sign.worst:.4g}"
            if not sign.holds:
                text = f"NO, entry ({i}, {j}) is {sign.worst:.4g}: "
                text += f"contact {i} {what} when only {j} closes"
            lines.append(f"{title}: {text}")
        text = {
            "yes": f"yes, every impact loses energy (margin {energetic.margin:.4g})",
            "no": f"NO, energy grows (margin {energetic.margin:.4g})",
            "boundary": "boundary, energy never grows but is conserved",
        }[energetic.answer]
        if energetic.answer != "yes":
            qn = _as_text(self.worst_normal_velocity)
            v = _as_text(self.worst_velocity)
            text += f" for qn- = {qn}, v- = {v}"
        lines.append(f"energetic  (6.3)    G^-1 - E^T G^-1 E copositive: {text}")
        if self.spectral is None:
            text = "not applicable, E is not self-adjoint (G^-1 E not symmetric)"
        else:
            text = (
                f"{'yes' if self.spectral else 'NO'}, rho = {self.spectral_radius:.4g}"
            )
        lines.append(f"spectral   (6.4)    rho(E) <= 1: {text}")
        if self.singular_values:
            holds = "yes"
        else:
            holds = "does not hold, which decides nothing"
        lines.append(
            f"sufficient (6.5)    sigma_max(E) = {self.singular_value:.4g} <= "
            f"{self.singular_value_bound:.4g}: {holds}"
        )
        return "\n".join(lines)


@full_precision
def dissipation_matrix(delassus: jax.Array, matrix: jax.Array) -> jax.Array:
    """`Q = G^-1 - E^T G^-1 E` (m, m): qn+ = -E qn- loses `qn-^T Q qn- / 2`.

    Args:
        delassus: G (m, m), see `ji.theory.normalized_delassus`.
        matrix: E (m, m).

    Returns:
        Q (m, m), symmetric; not finite where G is singular.

    Source: Brogliato, Nonsmooth Mechanics (2016), Prop. 6.3.

    >>> import jax.numpy as jnp
    >>> import jimpact as ji
    >>> ji.theory.dissipation_matrix(
    ...     jnp.eye(2), jnp.diag(jnp.array([0.5, 1.0]))
    ... ).tolist()
    [[0.75, 0.0], [0.0, 0.0]]
    """
    returned = matrix.T @ jnp.linalg.solve(delassus, matrix)
    return jnp.linalg.inv(delassus) - returned


@full_precision
def audit_matrix(
    scene: Scene, matrix: Any, tolerance: float | None = None
) -> MatrixAudit:
    """Check the law `qn+ = -E qn-` for all pre-impact velocities `qn- <= 0` at once.

    Equation, with the normalized Delassus matrix G: `E >= 0` (kinematic) and
    `G^-1 (I + E) >= 0` (kinetic), elementwise, necessary and sufficient (Prop. 6.2);
    `Q = G^-1 - E^T G^-1 E` copositive (energetic, necessary and sufficient, Prop. 6.3);
    where `G^-1 E` is symmetric, spectral radius `rho(E) <= 1` (Prop. 6.4, for qn- of
    any sign);
    `sigma_max(E) <= 1 / sqrt(cond G)` (Prop. 6.5, sufficient).

    Args:
        scene: m contacts; open ones are left out, with their rows and columns of E.
        matrix: E (m, m), dimensionless, between normalized gap velocities.
        tolerance: relative size of what counts as zero; None: by the precision of the
            scene.

    Returns:
        `MatrixAudit`; `print` says it in words.

    Raises:
        ValueError: E not (m, m) or not finite; more than 12 closed contacts, or none;
            redundant contacts (G singular): then not every qn- is possible.

    Source: Brogliato, Nonsmooth Mechanics (2016), Props. 6.2-6.5 (rho instead of
    lambda_max).

    >>> import jimpact as ji
    >>> result = audit_matrix(ji.chain([1.0, 1.0, 1.0]), [[0.0, 1.2], [0.2, 0.0]])
    >>> (
    ...     result.admissible,
    ...     result.energetic.answer,
    ...     result.worst_velocity.round(2).tolist(),
    ... )
    (False, 'no', [0.47, 0.47, -0.94])
    """
    array = as_numbers(
        "matrix", matrix, (scene.contacts,) * 2, "one row and one column per contact"
    )
    check_values("tolerance", tolerance, low=0.0)
    g, closed = _closed_delassus(scene)
    _check_independent(scene, g)
    e = np.asarray(array, float)[np.ix_(closed, closed)]
    if tolerance is None:
        tolerance = COPOSITIVITY_TOLERANCE.get(str(scene.mass.dtype), 1e-4)
    inverse = np.linalg.inv(g)
    q = inverse - e.T @ inverse @ e
    returned = np.abs(e.T @ inverse @ e).max()
    scale = max(np.abs(inverse).max(), returned)
    energetic = copositivity(q, tolerance, scale)
    impulse = np.zeros(len(closed))
    norm = np.asarray(kinetic_norm(scene), float)[closed]
    impulse[closed] = inverse @ -energetic.witness / norm
    # the v- without any motion along the contacts: v = M^-1 N p has qn = G pbar
    percussion = jnp.asarray(impulse, scene.mass.dtype)
    worst = velocity_change(scene, percussion) + 0.0
    worst_normal = np.array(normalized_gap_velocity(scene, worst), float)
    worst_normal[closed] = 0.0 - energetic.witness
    skew = inverse @ e - (inverse @ e).T  # 0: E is self-adjoint
    size = max(np.abs(inverse @ e).max(), 1e-300)
    self_adjoint = np.abs(skew).max() <= tolerance * size
    if self_adjoint:
        eigenvalues = np.linalg.eigvals(e)
        radius = float(np.abs(eigenvalues).max())
    else:
        radius = None
    return MatrixAudit(
        kinematic=_nonnegativity(e, tolerance * max(1.0, np.abs(e).max()), closed),
        kinetic=_nonnegativity(inverse + inverse @ e, tolerance * scale, closed),
        energetic=energetic,
        worst_normal_velocity=worst_normal,
        worst_velocity=np.asarray(worst),
        spectral_radius=radius,
        spectral=None if radius is None else radius <= 1 + tolerance,
        singular_value=float(np.linalg.norm(e, 2)),
        singular_value_bound=float(1 / np.sqrt(np.linalg.cond(g))),
    )


def carnot_energy_loss(scene: Scene, jump: Any, restitution: Any = 0.0) -> jax.Array:
    """Energy lost, `T- - T+ = (1 - e)/(1 + e) |v+ - v-|_M^2 / 2` [J] (Carnot).

    For e = 0 (persistent contact) the loss is the energy of the lost velocities,
    whatever the contacts, redundant ones included. For one e at all contacts it holds
    for Newton's E = e I and for Moreau's law, as both have
    `qn+^T pbar = -e qn-^T pbar`; else it does not apply.

    Args:
        scene: the scene of the impact.
        jump: v+ - v- (n,) [m/s].
        restitution: e in [0, 1], one for all contacts.

    Returns:
        T- - T+ () [J].

    Raises:
        ValueError: not one velocity per coordinate, e out of range or one a contact.

    Source: Brogliato (2016), Theorem 6.1 (e = 0), generalized by (6.46).

    >>> import jimpact as ji
    >>> float(carnot_energy_loss(ji.chain([1.0, 1.0]), [-0.5, 0.5]))
    0.25
    """
    change = as_numbers("jump", jump, (scene.size,), "one per coordinate of the scene")
    shape: tuple[()] = ()
    e = as_numbers(
        "restitution", restitution, shape, "one for all contacts", low=0.0, high=1.0
    )
    return (1 - e) / (1 + e) * kinetic_energy(scene, change)


def _closed_delassus(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Normalized Delassus matrix G of the closed contacts, and their mask (m,)."""
    closed = np.asarray(scene.closed)
    if not closed.any():
        raise ValueError(
            "Argument `scene` must have a closed contact, but all gaps are open."
        )
    g = np.asarray(as_matrix(normalized_delassus(scene)), float)
    return g[np.ix_(closed, closed)], closed


def _check_independent(scene: Scene, g: np.ndarray) -> None:
    """Raise a ValueError if contacts are redundant: G, of the closed ones, is
    singular.
    """
    eigenvalues = np.linalg.eigvalsh(g)
    rounding = _SINGULAR * np.finfo(scene.mass.dtype).eps
    floor = rounding * len(g) * eigenvalues[-1]
    if eigenvalues[0] <= floor:
        raise ValueError(
            f"Argument `scene` must have independent contacts, but its {len(g)} closed "
            f"contacts have rank {int((eigenvalues > floor).sum())}: G is singular, "
            f"and a matrix law cannot be consistent for every velocity."
        )


def _nonnegativity(a: np.ndarray, tolerance: float, closed: np.ndarray) -> Sign:
    """Verdict on `a >= 0`, entry by entry, of a matrix between the closed contacts.

    Column j of `a` is the result (qn+ or pbar) of an approach of contact j alone, qn-_j
    = -1. `closed` (m,) is the mask of these contacts; entries down to -`tolerance`
    pass.
    """
    at = np.unravel_index(np.argmin(a), a.shape)
    contact = np.flatnonzero(closed)
    velocity = np.zeros(len(closed))
    velocity[contact[at[1]]] = -1.0
    worst = float(a[at])
    pair = (int(contact[at[0]]), int(contact[at[1]]))
    return Sign(worst >= -tolerance, worst, pair, velocity)


def _as_text(vector: np.ndarray) -> str:
    """A vector with four digits."""
    return "(" + ", ".join(f"{x:.4g}" for x in vector) + ")"


class CoefficientAudit(NamedTuple):
    """Result of `audit_coefficients`: can an impact by Moreau's law gain energy?

    `energetic` is true where none gains; else its `witness` pbar >= 0 are the
    normalized impulses of an impact that does. `spread` <= `spread_allowed` is
    sufficient that none gains.
    """

    energetic: Copositivity
    spread: float
    spread_allowed: float

    def __str__(self) -> str:
        """Report: the verdict, and the sufficient condition with its numbers."""
        if self.energetic:
            verdict = "no impact gains energy"
        else:
            verdict = "some impacts GAIN energy"
        if self.spread <= self.spread_allowed:
            holds = "holds"
        else:
            holds = "does not, which decides nothing"
        return (
            f"Moreau's law with these coefficients: {verdict}\n"
            f"sufficient: {self.spread:.4g} <= {self.spread_allowed:.4g}: {holds}"
        )


def audit_coefficients(scene: Scene, restitution: Any) -> CoefficientAudit:
    """Decide if Moreau's law with coefficients e_j can gain energy.

    Equation: it changes the energy by `-pbar^T D G pbar / 2`, `D = diag(d_j)`,
    `d_j = (1 - e_j) / (1 + e_j)`, G the normalized Delassus matrix, and every
    `pbar = |grad f| p` >= 0 occurs in some impact: none gains exactly where the
    symmetric part of D G is copositive. It suffices that
    `(d_max - d_min) / (d_max + d_min) <= 1 / cond(G)`. One e for all contacts never
    gains. (Poisson's law never does up to e = 1: see `Poisson`.)

    Args:
        scene: up to 12 contacts; open ones are left out.
        restitution: e in [0, 1], scalar or (m,).

    Returns:
        `CoefficientAudit`; `print` says it in words.

    Raises:
        ValueError: restitution out of range or of a wrong size, no closed contact, too
            many.

    Host function, not differentiable.

    Source: own derivation from Brogliato (2016), (6.51); Leine and van de Wouw,
    Stability and Convergence of Mechanical Systems with Unilateral Constraints (2008),
    give such conditions.

    >>> import jimpact as ji
    >>> print(ji.theory.audit_coefficients(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0]))
    Moreau's law with these coefficients: some impacts GAIN energy
    sufficient: 1 <= 0.3333: does not, which decides nothing
    """
    m = scene.contacts
    e = as_numbers("restitution", restitution, low=0.0, high=1.0, contacts=m)
    g, closed = _closed_delassus(scene)
    of_contacts = np.broadcast_to(np.asarray(e, float), closed.shape)
    each = of_contacts[closed]
    d = (1 - each) / (1 + each)
    weighted = d[:, None] * g  # D G
    low = float(d.min())
    high = float(d.max())
    return CoefficientAudit(
        energetic=copositivity(
            (weighted + weighted.T) / 2, scale=float(np.abs(g).max())
        ),
        spread=(high - low) / (high + low) if high > 0 else 0.0,
        spread_allowed=1 / float(np.linalg.cond(g)),
    )
