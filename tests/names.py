"""What `jimpact/data/names.json` holds: `python tests/names.py` writes it from the classes."""

import dataclasses
import inspect
import json
from pathlib import Path

import numpy as np

import jimpact as ji
from jimpact.cli.study import _BODIES
from jimpact.law import _KEY, Domain, Option
from jimpact.methods.contenders import METHODS

PATH = Path(ji.__file__).parent / "data" / "names.json"


def law(row):
    declared = {f.name: f.metadata.get(_KEY) for f in dataclasses.fields(row.law)}
    declared = {k: x for k, x in declared.items() if row.make is None or k not in row.arguments}
    domains = {k: x for k, x in declared.items() if isinstance(x, Domain)}
    return {
        "summary": row.summary,
        "right_when": row.right_when,
        "fails_when": row.fails_when,
        "source": row.source,
        "arguments": list(row.arguments),
        "parameters": list(row.parameters),
        "free": sorted({*row.parameters, *domains}),
        "ranges": {
            k: [x.low, x.high if np.isfinite(x.high) else None, x.open_low, x.high_unless]
            for k, x in domains.items()
            if np.isfinite(x.low)
        },
        "choices": {
            k: x.choices for k, x in declared.items() if isinstance(x, Option) and x.choices
        },
    }


def body(kind):
    arguments = list(inspect.signature(kind.__init__).parameters.values())[1:]
    return {x.name: x.default is x.empty for x in arguments}  # whether it must be given


def names():
    own = {k: row for k, row in ji.REGISTRY.items() if row.law.__module__.startswith("jimpact.")}
    return {
        "laws": {name: law(row) for name, row in own.items()},
        "bodies": {name: body(kind) for name, kind in _BODIES.items()},
        "methods": {name: method.jax for name, method in METHODS.items()},
    }


def as_text():
    """A line an entry."""
    groups = []
    for group, rows in names().items():
        lines = ",\n".join(f"  {json.dumps(k)}: {json.dumps(x)}" for k, x in rows.items())
        groups.append(f" {json.dumps(group)}: {{\n{lines}\n }}")
    return "{\n" + ",\n".join(groups) + "\n}\n"


if __name__ == "__main__":
    PATH.write_text(as_text())
