"""Piles of discs and spheres: pairs by the grid against all pairs, contacts against definitions."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.bodies.neighbours import crowd_of, near_pairs
from jimpact.motion.methods import as_method, start_by


def brute_force(points, distance):
    """Pairs (i, j), i < j, nearer than the distance."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    return set(zip(*map(np.ndarray.tolist, np.nonzero(np.triu(apart < distance, 1)))))


@pytest.mark.parametrize("d", [2, 3])
def test_the_grid_meets_every_near_pair_once(d):
    rng = np.random.default_rng(d)
    pairs_of = jax.jit(lambda points, distance: near_pairs(points, distance, 60))
    clouds = (
        3 * rng.random((90, d)),
        np.concatenate(
            [rng.random((60, d)), 1e7 * rng.standard_normal((30, d))]
        ),  # some flew away
        0.25 * rng.integers(0, 6, (90, d))
        + 1e-13 * rng.random((90, d)),  # on borders of cells
    )
    for points in clouds:
        for distance in (0.25, 0.6):
            pairs = pairs_of(points, distance)
            used = np.asarray(pairs.used)
            first, second = (
                np.asarray(x)[used].tolist() for x in (pairs.first, pairs.second)
            )
            met = list(zip(first, second, strict=True))
            assert len(met) == len(set(met))
            assert brute_force(points, distance) <= set(met)
            assert not pairs.overflows
    assert len(met) < 90 * 89 / 2  # it leaves pairs out
    for together in (61, 62):  # in one row: the first one meets all others
        line = np.zeros((90, d))
        line[:, 0] = 1e3 * np.arange(90)
        line[:together, 0] = line[45, 0]
        line[:together, -1] += 0.1 * rng.random(together)
        assert bool(pairs_of(line, 1.0).overflows) is (together == 62)


def test_a_crowd_holds_the_densest_packing():
    """Hexagonal layers of discs, and cubic close packing of balls, moved over the cells."""
    rng = np.random.default_rng(0)
    i, j, k = (x.ravel().astype(float) for x in np.meshgrid(*[np.arange(-6, 7)] * 3))
    layer = np.unique(np.stack([i + j / 2, np.sqrt(0.75) * j], axis=1), axis=0)
    ball = np.stack(
        [i + j / 2 + k / 2, np.sqrt(0.75) * (j + k / 3), np.sqrt(2 / 3) * k], axis=1
    )
    for points, d in ((layer, 2), (ball, 3)):  # spacing 1, cells of 1 or 2
        for ratio in (1, 2):
            most = 0
            for corner in rng.random((400, d)):
                size = np.array([ratio] * (d - 1) + [3 * ratio], float)
                inside = np.all(
                    (points >= corner - 2) & (points < corner - 2 + size), axis=1
                )
                most = max(most, int(inside.sum()))
            assert 2 < most <= crowd_of(0.5, 0.5 * ratio, d)


def test_piles_of_many_contacts_warn_by_events():
    for count, warns in ((20, False), (21, True)):  # 190 and 210 contacts
        pile = ji.Bodies([ji.Disc(0.1)] * count, (), room=4 * count)
        at = pile.at(np.stack([0.3 * np.arange(count), np.zeros(count)], axis=1))
        at = jnp.asarray(at)
        arguments = ji.System(pile), ji.Moreau(0.5), at, jnp.zeros_like(at), 1.0
        start_by(as_method("time_stepping", 0.1), *arguments)
        with warnings.catch_warnings(record=True) as said:
            start_by(as_method("events"), *arguments)
        assert ["compiles for minutes" in str(x.message) for x in said] == [
            True
        ] * warns
