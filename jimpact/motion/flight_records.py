"""What is integrated, with which tolerances, and how far a flight is."""

from typing import Any, NamedTuple

import jax


class State(NamedTuple):
    """What is integrated: q, v, work of forces, of the base, of each contact [J]."""

    q: jax.Array
    v: jax.Array
    work: jax.Array  # ()
    base_work: jax.Array  # ()
    contact_work: jax.Array  # (2, m): normal (impacts), tangential


class Settings(NamedTuple):
    """Tolerances of a motion."""

    rtol: float
    atol: float
    closed_below: jax.Array
    max_steps: int
    friction: bool
    solver: Any
    duration: jax.Array
    accumulation: jax.Array  # gap velocity that counts as slow, over the largest of the motion


class Scales(NamedTuple):
    """Largest values of the motion so far."""

    gap_velocity: jax.Array
    speed: jax.Array  # gap velocity that all kinetic energy could give a contact
    acceleration: jax.Array


class Flight(NamedTuple):
    """A flight under way."""

    t: jax.Array
    state: State
    step: jax.Array  # of the error control
    aim: jax.Array  # length of the next trial where it is aimed at something, else inf
    aimed: jax.Array  # (k,) one-hot: what the trial is to land on
    landings: jax.Array
    event: jax.Array  # (k,) one-hot: what has happened
    sample: jax.Array  # number of samples reached
    samples: State
    steps: jax.Array
    stuck: jax.Array
    undefined: jax.Array  # the last trial was not a number
