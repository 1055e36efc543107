"""Many discs or spheres, by their masses and radii."""

import numpy as np

import jimpact as ji


def discs(masses, radii, planes=(), room=None):
    """Discs that are many whatever their number."""
    return _many(ji.Disc, masses, radii, planes, room or 4 * len(radii))


def spheres(masses, radii, planes=(), room=None):
    """Spheres that are many whatever their number."""
    return _many(ji.Sphere, masses, radii, planes, room or 7 * len(radii))


def _many(kind, masses, radii, planes, room):
    masses = np.broadcast_to(np.asarray(masses, float), np.shape(radii))
    return ji.Bodies([kind(r, m) for r, m in zip(radii, masses)], planes, room=room)
