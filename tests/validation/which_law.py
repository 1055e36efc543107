"""False alarms and power of what says that a law is not enough: `python tests/validation/which_law.py`.

500 simulated sets of 12 shots of a pair of balls, 0.5 to 4 m/s, 1 cm/s noise; some ten minutes. The table
stands in `docs/fitting_reference.md`.
"""

import jax
import numpy as np

import jimpact as ji

SETS, SHOTS, NOISE, E = 500, 12, 0.01, 0.7
STUDENT = 2.2  # standard errors, 95 % with 11 degrees of freedom
PAIR = ji.chain([1.0, 2.0])


def sets(exponent, scatter, sigma):
    """Data with e falling by a power of the speed, or scattering from shot to shot."""
    speed = np.linspace(0.5, 4.0, SHOTS)
    pre = np.stack([speed, 0 * speed], axis=1)
    for seed in range(SETS):
        rng = np.random.default_rng(seed)
        e = np.clip(E * speed**-exponent + scatter * rng.normal(size=SHOTS), 0, 1)
        post = speed[:, None] * np.stack([(1 - 2 * e) / 3, (1 + e) / 3], axis=1)
        yield ji.Experiments(pre, post + NOISE * rng.normal(size=post.shape), sigma)


def main():
    """Print the table."""
    falling = ji.VelocityDependent(ji.Newton(E), speed_exponent=0.05)
    for sigma in (NOISE, None):
        for exponent, scatter in ((0, 0), (0.02, 0), (0.05, 0), (0, 0.01), (0, 0.03)):
            data = list(sets(exponent, scatter, sigma))
            constant = ji.fit_many(ji.Newton(E), PAIR, data)
            full = ji.fit_many(falling, PAIR, data)
            needed = [ji.nested_test(a, b).needed for a, b in zip(constant, full)]
            plain = np.mean(
                [abs(x.value[0] - E) < STUDENT * x.standard_error[0] for x in constant]
            )
            print(
                f"sigma {sigma}, exponent {exponent}, scatter {scatter}: exponent needed "
                f"{np.mean(needed):.1%}; in 95 %: {plain:.1%} by the fit",
                flush=True,
            )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
