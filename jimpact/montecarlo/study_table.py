"""The [monte_carlo] table of a study, as arguments of `monte_carlo`."""

from collections.abc import Mapping
from typing import Any

from jimpact.law import Law
from jimpact.montecarlo.distributions import Distribution, Normal, RandomLaw, Uniform
from jimpact.scene import Scene

KEYS = ("velocity_m_per_s", "gaps_m", "law", "samples", "seed", "chunk", "bins")
_KINDS: dict[tuple[str, ...], Any] = {("high", "low"): Uniform, ("mean", "std"): Normal}


def arguments(table: Mapping[str, Any], law: Law, scene: Scene) -> dict[str, Any]:
    """`monte_carlo(**arguments)`.

    Keys: velocity_m_per_s and gaps_m, a list, or a table with low and high (uniform) or mean and
    std (normal; gaps truncated at 0); law, a table of such tables by parameter; samples, seed,
    chunk, bins.
    """
    for key in table:
        if key not in KEYS:
            raise ValueError(f"[monte_carlo] may have the keys {', '.join(KEYS)}, but has `{key}`.")
    if "velocity_m_per_s" not in table:
        raise ValueError("[monte_carlo] must have the key `velocity_m_per_s`.")
    told: dict[str, Any] = {"scene": scene}
    told["velocity"] = _source("velocity_m_per_s", table["velocity_m_per_s"])
    if "gaps_m" in table:
        told["gaps"] = _source("gaps_m", table["gaps_m"])
    random = table.get("law", {})
    if not isinstance(random, dict):
        raise ValueError(f"[monte_carlo.law] must be a table, but is {random!r}.")
    drawn = {name: _distribution(f"law.{name}", value) for name, value in random.items()}
    told["law"] = RandomLaw(law, **drawn) if drawn else law
    told |= {name: table[name] for name in ("samples", "chunk", "bins") if name in table}
    return told | ({"key": table["seed"]} if "seed" in table else {})


def _source(name: str, value: Any) -> Any:
    return _distribution(name, value) if isinstance(value, dict) else value


def _distribution(name: str, value: Any) -> Distribution:
    kind = _KINDS.get(tuple(sorted(value))) if isinstance(value, dict) else None
    if kind is None:
        raise ValueError(
            f"`{name}` in [monte_carlo] must have low and high, or mean and std, but is {value!r}."
        )
    return kind(**value)
