# /// script
# dependencies = ["rebound==5.2.2"]
# ///
"""REBOUND: hard spheres, `coefficient_of_restitution` a function of simulation and speed.

Each step resolves its collisions in a random order; a wall is a ball of 1e12 kg.
"""

import rebound
from rows import RADIUS, TIME, print_rows

GAP = 1e-9  # [m]: contacts that close within one step are taken in a random order


def after(masses, wall, restitution, step):
    simulation = rebound.Simulation()
    simulation.G = 0.0
    simulation.dt = step
    simulation.integrator = "leapfrog"
    simulation.collision = "direct"
    simulation.collision_resolve = "hardsphere"
    simulation.coefficient_of_restitution = lambda _, speed: restitution
    for k, mass in enumerate([*masses, *[1e12] * wall]):
        x = (2 * RADIUS + GAP) * k
        simulation.add(m=mass, x=x, vx=float(k == 0), r=RADIUS)
    simulation.integrate(TIME)
    return [simulation.particles[k].vx for k in range(len(masses))]


if __name__ == "__main__":
    setting = "direct; leapfrog, step 1 ms, gap 1e-9 m"
    print_rows("rebound", rebound.__version__, {setting: {"step": 1e-3}}, after)
