"""Which e two balls get from a parameter of an engine: the measured column of docs/engines.md.

`python tests/validation/engines/pairs.py lammps` (or exudyn, drake) runs where the engine is
installed. The formulas are `ji.theory.engine_restitution`.
"""

import importlib
import sys

HERTZ, HOOKE = "hertz/material 1e8 {} .3", "hooke 1e7 {}"
ASKED = (0.1, 0.3, 0.5, 0.7, 0.9)  # coefficients of restitution
PAIR = [1.0, 1.0], False  # masses [kg], no wall


def lammps(after):
    for contact in (HERTZ, HOOKE):
        for damping in ("coeff_restitution", "tsuji"):
            for more in ("", " limit_damping"):
                setting = {"contact": contact, "damping": damping + more, "step": 1e-6}
                yield (
                    contact + " " + damping + more,
                    {e: after(*PAIR, e, **setting) for e in ASKED},
                )


def exudyn(after):
    for model in (1, 2):
        setting = {
            "model": model,
            "exponent": 1.0,
            "stiffness": 1e5,
            "step": 1e-5,
            "gap": 0.01,
        }
        yield f"impact model {model}", {e: after(*PAIR, e, **setting) for e in ASKED}


def drake(after):
    continuous = {
        d: after(*PAIR, 1, step=0.0, dissipation=d) for d in (0.1, 0.5, 1.0, 10.0)
    }
    yield "continuous, dissipation [s/m]", continuous
    setting = {"step": 1e-6, "stiffness": 1e5}
    times = (0.0, 5e-4, 1e-3, 2e-3)  # of each body [s]
    yield (
        "SAP, relaxation time of each body [s]",
        {t: after(*PAIR, 1, relaxation=t, **setting) for t in times},
    )


if __name__ == "__main__":
    name = sys.argv[1]
    after = importlib.import_module(f"engine_{name}").after
    for setting, found in globals()[name](after):
        e = ", ".join(f"{asked:g}: {v[1] - v[0]:.4f}" for asked, v in found.items())
        print(f"{name}, {setting}: {e}")
