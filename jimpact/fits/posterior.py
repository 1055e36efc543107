"""The posterior of a fit's parameters, sampled by numpyro's NUTS (extra `bayes`)."""

import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.distributions import Normal, Uniform
from jimpact.fits.estimate import in_own_precision
from jimpact.fits.parameters import mean_and_std
from jimpact.fits.problem import FitProblem
from jimpact.fits.report import Fit, check_squares
from jimpact.tools.checks import as_whole, check_choice, needed
from jimpact.tools.compiling import known_options

HOW = 'pip install "jimpact[bayes]"'
TOO_NEW = 1  # arviz: its `InferenceData` is gone, and `from_dict` takes other arguments
# Chains begin inside: at the end of a domain the sampler's own coordinate is infinite.
_INSIDE = 1e-3  # of the domain's width, or of the value where it has no end
_AFAR = 1e3  # farther than any admissible matrix
_FREE = "z"  # what is sampled in the place of an admissible matrix
MIXED = 1.05  # r-hat above which chains disagree about where the posterior is


@in_own_precision
def posterior(
    fit: Fit | FitProblem,
    priors: Mapping[str, Any] | None = None,
    *,
    samples: int = 1000,
    warmup: int = 1000,
    chains: int = 4,
    seed: int = 0,
    progress: float | None = None,
) -> Any:
    """Draws from the posterior density of the parameters, by NUTS.

    Equation: `p(x | data) ~ exp(problem.log_density(x)) prior(x)`; where sigma is not
    known it is integrated over `d sigma / sigma`. Chains start at the fit. Derivatives
    are by forward mode. Matrices that must be admissible are
    `E = E_0 + L(d) tanh(|z| / L(d)) d` of the sampled z, d its direction, L(d) how far
    the admissible ones reach from an inner E_0.

    Args:
        fit: a fit by least squares, or a problem.
        priors: by name of a parameter, or of a field for all its entries:
            `ji.Uniform(low, high)`, `ji.Normal(mean, std)` (truncated to the domain),
            or a numpyro distribution of a scalar. They take the place of those of the
            fit. Others are flat over the parameter's domain; of what is fitted in its
            logarithm (a stiffness), flat in that; of an admissible matrix, flat over
            all that are.
        samples, warmup: of each chain.
        chains: side by side in one program.
        seed: of the sampler.
        progress: numpyro's bar on stderr; None: on a terminal.

    Returns:
        `arviz.InferenceData` whose variables are called like the parameters, such as
        `draws.posterior["restitution"]` (chains, samples).

    Raises:
        ImportError: numpyro or arviz is missing, or arviz is too new; the extra is
            named.
        ValueError: unknown names, priors outside the domain, a robust loss.

    Warns of chains that disagree, and of divergences: the draws are then not to be
    trusted.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     [[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]], sigma=0.02
    ... )
    >>> result = ji.fit(ji.Newton(0.5), ji.chain([1.0, 1.0]), data)
    >>> prior = {"restitution": ji.Normal(0.5, 0.1)}
    >>> draws = ji.posterior(result, prior)  # doctest: +SKIP
    >>> e = draws.posterior["restitution"]  # doctest: +SKIP
    >>> print(f"{float(e.mean()):.2f} +- {float(e.std()):.3f}")  # doctest: +SKIP
    0.40 +- 0.013
    """
    numpyro = needed("numpyro", HOW)
    arviz = _arviz()
    if not isinstance(fit, FitProblem):
        check_squares("fit", fit)
    if isinstance(fit, Fit):
        problem = fit.problem
    else:
        problem = fit
    if isinstance(fit, Fit):
        start = fit.value
    else:
        start = problem.start
    for name, count in (("samples", samples), ("warmup", warmup), ("chains", chains)):
        as_whole(name, count, 1)
    each = _priors(problem, dict(priors or {}), numpyro.distributions)

    if problem.matrix is None:
        inner = None
    else:
        inner = _Inner(problem, problem.matrix)
    first = dict(zip(problem.names, _inside(start, problem.domains)))
    if inner is not None:
        first = {_FREE: inner.unbounded(start)}
    kernel = numpyro.infer.NUTS(
        _model(problem, each, inner, numpyro),
        forward_mode_differentiation=True,
        dense_mass=len(each) > 1,
        init_strategy=numpyro.infer.init_to_value(values=first),
    )
    if progress is None:
        shown = sys.stderr.isatty()
    else:
        shown = progress is not False
    sampler = numpyro.infer.MCMC(
        kernel,
        num_warmup=warmup,
        num_samples=samples,
        num_chains=chains,
        chain_method="vectorized",
        progress_bar=shown,
    )

    values, statistics = _drawn(sampler, seed, shown)
    draws = arviz.from_dict(posterior=values, sample_stats=statistics)
    if inner is not None:
        del draws.posterior[_FREE]
    _warn(draws, arviz)
    return draws


def _model(
    problem: FitProblem, priors: dict[str, Any], inner: "_Inner | None", numpyro: Any
) -> Callable[[], None]:
    """The model for numpyro: x (P,) from the priors, with the log density of the data
    at x.

    Of an admissible matrix (`inner`) z (P,) is sampled in the place of x; the log
    density is then that of the priors at x(z), plus the logarithm of the determinant of
    dx/dz.
    """

    def model() -> None:
        """Sample x, or z, and add the logarithms of the densities."""
        if inner is None:
            x = jnp.stack(
                [numpyro.sample(name, prior) for name, prior in priors.items()]
            )
        else:
            flat = numpyro.distributions.ImproperUniform(
                numpyro.distributions.constraints.real_vector, (), (len(priors),)
            )
            x, log_determinant = inner.values(numpyro.sample(_FREE, flat))
            log_priors = [
                prior.log_prob(x[i]) for i, prior in enumerate(priors.values())
            ]
            numpyro.factor("prior", log_determinant + sum(log_priors))
            for i, name in enumerate(priors):
                numpyro.deterministic(name, x[i])
        numpyro.factor("data", problem.log_density(x))

    return model


def _arviz() -> Any:
    """The module arviz; an ImportError if it is missing or too new, before anything is
    sampled.
    """
    arviz = needed("arviz", HOW)
    if int(arviz.__version__.split(".")[0]) >= TOO_NEW:
        raise ImportError(
            f"arviz must be older than {TOO_NEW} for this, but is {arviz.__version__}: "
            f"{HOW}."
        )
    return arviz


def _drawn(sampler: Any, seed: int, shown: bool) -> tuple[Any, Any]:
    """Draws by name, and the sampler's fields such as 'diverging'; each (chains,
    samples).
    """

    def drawn(key: jax.Array) -> tuple[Any, Any]:
        """Run the sampler with a random key: draws and fields."""
        sampler.run(key)
        draws = sampler.get_samples(group_by_chain=True)
        return draws, sampler.get_extra_fields(group_by_chain=True)

    # as one program a short run takes half of the time (16 for 29 s); a progress bar
    # needs several
    if shown:
        run = drawn
    else:
        run = jax.jit(drawn, compiler_options=known_options())
    random_key = jax.random.PRNGKey(seed)
    values, statistics = jax.tree.map(np.asarray, run(random_key))
    return values, statistics


class _Inner:
    """The map of z in R^P onto the admissible matrices:
    `y = y_0 + L(d) tanh(|z| / L(d)) d`.

    d = z / |z|, y_0 is the center of the region, L(d) how far it reaches from there.
    """

    def __init__(self, problem: FitProblem, region: Any):
        self.problem = problem
        self.region = region
        self.count = len(problem.names)
        self.reach = jax.jit(self._reach)

    def _reach(self, direction: jax.Array) -> jax.Array:
        """L (): how far the region reaches from its center in a direction (P,) of
        length 1.
        """
        at_center = jnp.zeros_like(self.region.center)
        ahead = at_center.at[: self.count].set(_AFAR * direction)
        return _AFAR * self.region.share(self.region.center + ahead)

    def values(self, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """x (P,) of z, and the logarithm of the determinant of dx/dz, up to a constant.

        Equation: with r = |z|, m = L tanh(r / L): `det = dm/dr (m / r)^(P - 1)`,
        `dm/dr = 1 / cosh(r / L)^2`; the dependence of L on d does not change it.
        """
        tiny = jnp.finfo(z.dtype).tiny
        r = jnp.sqrt(jnp.sum(z**2) + tiny)
        reach = self.reach(z / r)
        move = reach * jnp.tanh(r / reach)
        displacement = move * z / r
        y = self.region.center.at[: self.count].add(displacement)
        scale = self.problem.variables.scale[: self.count]
        x = y[: self.count] * scale
        # log(1 / cosh^2), in a form that does not overflow
        log_cosh = jnp.logaddexp(r / reach, -r / reach)
        slope = -2 * (log_cosh - jnp.log(2.0))
        of_directions = (self.count - 1) * jnp.log(move / r)
        return x, slope + of_directions

    def unbounded(self, values: np.ndarray) -> jax.Array:
        """z (P,) of admissible `values` (P,): the inverse of `values`.

        Equation: `z = L artanh(|y - y_0| / L) d`, along d from the center y_0 of the
        region to the point y of these values, L as far as the region reaches there. A
        point beyond `1 - _INSIDE` of L counts as one there; the center has z = 0.
        """
        point = jnp.asarray(self.problem.variables.point(values))
        move = (point - self.region.center)[: self.count]
        size = jnp.linalg.norm(move)
        if size == 0:
            return move
        reach = self.reach(move / size)
        share = jnp.minimum(size / reach, 1 - _INSIDE)
        return reach * jnp.arctanh(share) * move / size


def _inside(start: np.ndarray, domains: np.ndarray) -> np.ndarray:
    """The start (P,), at least the share `_INSIDE` of the width from the ends of
    `domains`.
    """
    low, high = domains.T
    unbounded = np.maximum(np.abs(start), 1.0)
    width = np.where(np.isfinite(high - low), high - low, unbounded)
    return np.clip(start, low + _INSIDE * width, high - _INSIDE * width)


def _priors(
    problem: FitProblem, chosen_priors: dict[str, Any], kinds: Any
) -> dict[str, Any]:
    """The numpyro distribution of each parameter, by name: chosen, or that of the fit,
    or flat.

    `kinds` is the module `numpyro.distributions`.
    """
    parameters = problem.parameters
    priors = {}
    of_fit = {i: Normal(mean, std) for i, mean, std in problem.priors}
    for i, (name, field) in enumerate(zip(problem.names, parameters.of_fields)):
        chosen = chosen_priors.get(name, chosen_priors.get(field, of_fit.get(i)))
        low, high = problem.domains[i].tolist()
        log = bool(parameters.log[i])
        priors[name] = _prior(name, chosen, low, high, log, kinds)
    for name in chosen_priors:
        known = dict.fromkeys((*problem.names, *parameters.of_fields))
        check_choice("priors", name, known)
    return priors


def _prior(
    name: str, chosen: Any, low: float, high: float, log: bool, kinds: Any
) -> Any:
    """The numpyro distribution of one parameter in its domain [low, high].

    Flat where none is chosen (`log`: in the logarithm); the normal one is truncated to
    the domain.

    Raises:
        ValueError: a distribution that reaches beyond the domain, or of another kind.
    """
    if chosen is None:
        if np.isfinite([low, high]).all():
            if log:
                return kinds.LogUniform(low, high)
            return kinds.Uniform(low, high)
        c = kinds.constraints
        if np.isfinite(high):
            below = c.less_than(high)
        else:
            below = c.real
        if np.isfinite(low):
            domain = c.greater_than(low)
        else:
            domain = below
        return kinds.ImproperUniform(domain, (), ())
    if isinstance(chosen, Uniform):
        a = float(chosen.low)
        b = float(chosen.high)
        if not low <= a < b <= high:
            raise ValueError(
                f"Argument `priors` must lie in [{low:g}, {high:g}] for `{name}`, but "
                f"has {chosen!r}."
            )
        return kinds.Uniform(a, b)
    if isinstance(chosen, Normal):
        mean_std = mean_and_std(name, chosen, low, high)
        ends = (end if np.isfinite(end) else None for end in (low, high))
        bounds = dict(zip(("low", "high"), ends))
        return kinds.TruncatedNormal(*mean_std, **bounds)
    if not isinstance(chosen, kinds.Distribution) or chosen.shape() != ():
        raise ValueError(
            f"Argument `priors` must map `{name}` to a ji.Uniform, a ji.Normal or a "
            f"numpyro distribution of one number, but has {chosen!r}."
        )
    # what it can yield must lie in the domain: seen on a sample
    key = jax.random.PRNGKey(0)
    drawn = np.asarray(chosen.sample(key, (1000,)))
    if (drawn < low).any() or (drawn > high).any():
        raise ValueError(
            f"Argument `priors` must lie in [{low:g}, {high:g}] for `{name}`, but "
            f"draws reach from {drawn.min():.3g} to {drawn.max():.3g}."
        )
    return chosen


def _warn(draws: Any, arviz: Any) -> None:
    """Warn of transitions that diverged, and of chains that disagree (r-hat above
    `MIXED`).
    """
    diverging = int(np.asarray(draws.sample_stats["diverging"]).sum())
    if diverging:
        warnings.warn(
            f"{diverging} transitions diverged: the posterior has an edge or a kink "
            f"that the sampler did not resolve; its draws near there are too few.",
            stacklevel=3,
        )
    if draws.posterior.sizes["chain"] > 1:
        spread = arviz.rhat(draws).to_array()
        if float(spread.max()) > MIXED:
            warnings.warn(
                f"The chains disagree (r-hat up to {float(spread.max()):.3g}): draw "
                f"more, or there are several minima.",
                stacklevel=3,
            )
