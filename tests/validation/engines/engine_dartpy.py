# /// script
# requires-python = ">=3.12"
# dependencies = ["dartpy==6.20.3", "numpy"]
# ///
"""DART: restitution of a shape's dynamics aspect; that of a contact is the product of both."""

import dartpy
import numpy as np
from rows import RADIUS, TIME, print_rows, root_of_product


def ball(name, mass, x, velocity, restitution):
    """A sphere that moves along x only."""
    skeleton = dartpy.dynamics.Skeleton(name)
    joint, body = skeleton.createPrismaticJointAndBodyNodePair()
    joint.setAxis([1.0, 0.0, 0.0])
    shape = body.createShapeNode(dartpy.dynamics.SphereShape(RADIUS))
    shape.createCollisionAspect()
    aspect = shape.createDynamicsAspect()
    aspect.setRestitutionCoeff(restitution)
    aspect.setFrictionCoeff(0.0)
    body.setMass(mass)
    joint.setPosition(0, x)
    joint.setVelocity(0, velocity)
    return skeleton


def after(masses, wall, restitution, step, gap, speed=1.0):
    world = dartpy.simulation.World()
    world.setGravity([0.0, 0.0, 0.0])
    world.setTimeStep(step)
    each = root_of_product(restitution)
    balls = []
    for k, mass in enumerate([*masses, *[1e9] * wall]):  # a wall: a ball of 1e9 kg
        x = (2 * RADIUS + gap) * k
        balls.append(ball(f"ball {k}", mass, x, speed * (k == 0), each))
        world.addSkeleton(balls[-1])
    for _ in range(round(TIME / step)):
        world.step()
    return [float(np.asarray(x.getVelocities())[0]) for x in balls[: len(masses)]]


if __name__ == "__main__":
    settings = {
        "Dantzig, step 1 ms, touching": {"step": 1e-3, "gap": 0.0},
        "Dantzig, step 1 ms, overlap 1e-6 m": {"step": 1e-3, "gap": -1e-6},
        "Dantzig, step 1 ms, gap 1 mm": {"step": 1e-3, "gap": 1e-3},
    }
    version = getattr(dartpy, "__version__", "6.20.3")
    print_rows("dartpy", version, settings, after)
