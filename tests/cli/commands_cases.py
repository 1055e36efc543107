"""What tests of commands share."""

from command_line import main

SHOTS = "pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s]\n1,0,0.21,0.83\n2,0,0.42,1.62\n"


STUDY = """
[scene]
masses_kg = [1.0, 1.0]
[law]
name = "Newton"
restitution = 0.9
[fit]
free = ["restitution"]
starts = 2
[data]
file = "shots.csv"
"""


SAMPLED = """
title = "binary"
[scene]
masses_kg = [0.25, 1.0, 0.25]
[law]
name = "binary"
restitution = 1.0
order = "earliest"
[monte_carlo]
velocity_m_per_s = [1.0, 0.0, -1.0]
samples = 600
seed = 5
chunk = 256
[monte_carlo.gaps_m]
low = 0.0
high = [1e-5, 2e-5]
"""


def written(folder, study=STUDY, shots=SHOTS):
    (folder / "shots.csv").write_text(shots)
    path = folder / "study.toml"
    path.write_text(study)
    return str(path)


def call(capsys, *arguments):
    code = main([str(x) for x in arguments])
    return code, capsys.readouterr()


VERBS = ("fit", "compare", "montecarlo", "chart", "stability", "advise", "simulate")


BODIES = {
    "Block": "width_m = 0.2\nheight_m = 0.6\ncorners = 'base'",
    "Polygon": "corners = [[0, 0], [1, 0], [0, 1]]\nmass_kg = 2",
    "Disc": "radius_m = 0.1\ninertia_kg_m2 = 0.01",
    "Dimer": "radius_m = 0.1\nlength_m = 1\nrod_mass_kg = 0",
    "Bodies": "planes = [0.1]\n[[system.bodies]]\nkind = 'disc'\nradius_m = 0.1",
    "Box": "sizes_m = [0.2, 0.1, 0.3]\nrounding_m = 0.01",
    "Sphere": "radius_m = 0.1\nnormal = [0.1, 0, 1]",
    "Coin": "radius_m = 0.1\nthickness_m = 0.01\ncorners = 8",
    "SpatialDimer": "radius_m = 0.1\nlength_m = 1",
    "Column": "masses_kg = [1, 2]\nradii_m = 0.1",
    "Corner": "angle_rad = 1.0",
    "PendulumCradle": "masses_kg = [1, 1]\nlength_m = 0.3\nradius_m = 0.01\ngaps_m = 0.01",
}
