"""Shared heads: Copositivity, the audit of restitution matrices (Props. 6.2-6.5), Carnot, friction bounds."""

import numpy as np

HORN = np.array(
    [
        [1, -1, 1, 1, -1],
        [-1, 1, -1, 1, 1],
        [1, -1, 1, -1, 1],
        [1, 1, -1, 1, -1],
        [-1, 1, 1, -1, 1],
    ],
    float,
)


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), 0, tolerance)
