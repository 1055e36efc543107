"""Keys of a study that are sampled: its table [monte_carlo]."""

from collections.abc import Callable, Mapping
from typing import Any

from jimpact.core.distributions import Distribution, Normal, RandomLaw, Uniform
from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.tools.study_tables import arguments_of, check_keys

# Keys of the table, and the arguments of `monte_carlo` that they are.
SAMPLING = {
    **{
        "velocity_m_per_s": "velocity",
        "gaps_m": "gaps",
        "law": "law",
        "samples": "samples",
    },
    **{"seed": "key", "chunk": "chunk", "bins": "bins"},
}
DISTRIBUTIONS: dict[tuple[str, ...], Callable[..., Distribution]] = {
    ("high", "low"): Uniform,
    ("mean", "std"): Normal,
}  # by their keys


def sampling_of(table: Mapping[str, Any], law: Law, scene: Scene) -> dict[str, Any]:
    """Arguments of `monte_carlo` from the table [monte_carlo]; tables in it are
    distributions.
    """
    check_keys("[monte_carlo]", table, SAMPLING, ("velocity_m_per_s",))
    laws = table.get("law", {})
    if not isinstance(laws, dict):
        raise ValueError(f"[monte_carlo.law] must be a table, but is {laws!r}.")
    random = {name: _distribution(f"law.{name}", x) for name, x in laws.items()}
    sampled = {
        key: _distribution(key, x) if isinstance(x, dict) else x
        for key, x in table.items()
        if key != "law"
    }
    drawn = RandomLaw(law, **random) if random else law
    return {"scene": scene, "law": drawn} | arguments_of(sampled, SAMPLING)


def _distribution(key: str, table: Any) -> Distribution:
    """The distribution that a table of a study means."""
    if isinstance(table, dict):
        kind = DISTRIBUTIONS.get(tuple(sorted(table)))
    else:
        kind = None
    if kind is None:
        raise ValueError(
            f"`{key}` in [monte_carlo] must have low and high, or mean and std, but is "
            f"{table!r}."
        )
    return kind(**table)
