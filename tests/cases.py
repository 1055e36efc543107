"""The test table: one row a law. Each row makes the law from coefficients for m contacts."""

import jax.numpy as jnp

import jimpact as ji


def newton(e, k):
    return ji.Newton(e)


def moreau(e, k):
    return ji.Moreau(e)


def poisson(e, k):
    return ji.Poisson(e)


def restitution_matrix(e, k):
    return ji.RestitutionMatrix(jnp.diag(jnp.atleast_1d(e)))


def binary(order):
    def make(e, k):
        m = max(jnp.size(e), jnp.size(k))
        return ji.Binary(e, tuple(reversed(range(m))) if order == "tuple" else order)

    return make


def lzb(exponent, method="time"):
    def make(e, k):
        return ji.LZB(e, k, exponent, method=method)

    return make


def compliant(e, k):
    return ji.Compliant(ji.Bistiffness(k, 1.5, e))


# name: (registry name, maker, accuracy of the outcome, accuracy of its derivatives)
LAWS = {
    "newton": ("newton", newton, 1e-12, 1e-12),
    "moreau": ("moreau", moreau, 1e-12, 1e-12),
    "poisson": ("poisson", poisson, 1e-12, 1e-12),
    "restitution-matrix": ("restitution_matrix", restitution_matrix, 1e-12, 1e-12),
    "binary-fastest": ("binary", binary("fastest"), 1e-12, 1e-12),
    "binary-earliest": ("binary", binary("earliest"), 1e-12, 1e-12),
    "binary-left-to-right": ("binary", binary("left_to_right"), 1e-12, 1e-12),
    "binary-tuple": ("binary", binary("tuple"), 1e-12, 1e-12),
    "compliant": ("compliant", compliant, 1e-7, 1e-6),
    "lzb-hertz": ("lzb", lzb(1.5), 1e-7, 1e-6),
    "lzb-linear": ("lzb", lzb(1.0), 1e-7, 1e-6),
    "lzb-array-exponent": ("lzb", lzb(jnp.array(1.4)), 1e-7, 1e-6),
    "lzb-propagator": ("lzb", lzb(1.0, "propagator"), 1e-12, 1e-11),
    "lzb-impulse": ("lzb", lzb(1.5, "impulse"), 1e-3, 1e-1),
}
