# /// script
# dependencies = ["pybullet==3.2.7", "numpy"]
# ///
"""PyBullet: `restitution` of `changeDynamics`; a pair has the product of both bodies.

A body that was given none counts as 0. Its damping of free motion is set to 0.
"""

from importlib.metadata import version

import pybullet as p
from rows import RADIUS, print_rows, root_of_product


def after(masses, wall, restitution, step):
    client = p.connect(p.DIRECT)
    p.setTimeStep(step)
    ball = p.createCollisionShape(p.GEOM_SPHERE, radius=RADIUS)
    bodies = []
    for k, mass in enumerate(masses):
        bodies.append(
            p.createMultiBody(mass, ball, basePosition=[2 * RADIUS * k, 0, 0])
        )
    solids = list(bodies)
    if wall:
        box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[RADIUS, 1, 1])
        solids.append(
            p.createMultiBody(0, box, basePosition=[2 * RADIUS * len(masses), 0, 0])
        )
    for body in solids:
        free = {"linearDamping": 0, "angularDamping": 0, "lateralFriction": 0}
        p.changeDynamics(body, -1, restitution=root_of_product(restitution), **free)
    p.resetBaseVelocity(bodies[0], [1, 0, 0])
    for _ in range(round(0.1 / step)):
        p.stepSimulation()
    velocity = [p.getBaseVelocity(body)[0][0] for body in bodies]
    p.disconnect(client)
    return velocity


if __name__ == "__main__":
    settings = {f"step 1/{n} s": {"step": 1 / n} for n in (240, 2400)}
    print_rows("pybullet", version("pybullet"), settings, after)
