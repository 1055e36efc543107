"""What `jimpact/data/names.json` holds: `python tests/names.py` writes it from the classes."""

import inspect
import json
from pathlib import Path

import jimpact as ji
from jimpact.fits.search import LOSSES
from jimpact.fits.solve import DEFAULT_STEPS
from jimpact.methods.contenders import CONTENDERS
from jimpact.motion.methods import METHODS as MOTION_METHODS

PATH = Path(ji.__file__).parent / "data" / "names.json"


def bodies():
    """Whether each argument must be given, by name, of each public body."""
    public = {name: getattr(ji, name) for name in ji.__all__}
    kinds = {k: x for k, x in public.items() if isinstance(x, type) and issubclass(x, ji.Body)}
    arguments = {
        name: list(inspect.signature(kind).parameters.values())
        for name, kind in kinds.items()
        if kind is not ji.Body  # of which the others are made
    }
    return {k: {x.name: x.default is x.empty for x in rows} for k, rows in arguments.items()}


def names():
    """Laws, bodies and methods by name, and the words of options."""
    ours = {k: row for k, row in ji.REGISTRY.items() if row.law.__module__.startswith("jimpact.")}
    return {
        "laws": {name: row.declaration for name, row in ours.items()},
        "bodies": bodies(),
        "methods": {name: method.jax for name, method in CONTENDERS.items()},
        "fit_methods": list(DEFAULT_STEPS),
        "losses": ["squares", *LOSSES],
        "motion_methods": list(MOTION_METHODS),
    }


def as_text():
    """The names as JSON, one line for each law, body and method."""
    groups = []
    for group, rows in names().items():
        text = json.dumps(rows)
        if isinstance(rows, dict):
            lines = ",\n".join(f"  {json.dumps(k)}: {json.dumps(x)}" for k, x in rows.items())
            text = f"{{\n{lines}\n }}"
        groups.append(f" {json.dumps(group)}: {text}")
    return "{\n" + ",\n".join(groups) + "\n}\n"


if __name__ == "__main__":
    PATH.write_text(as_text())
