# /// script
# dependencies = ["opensim==4.6", "numpy"]
# ///
"""OpenSim: `HuntCrossleyForce`, Hertz contacts with a dissipation instead of a restitution.

Balls are bodies on sliders along x, the wall a half-space. Without gravity.
"""

import math

import opensim
from rows import RADIUS, print_rows

TIME = 0.1  # [s]
STIFFNESS = 1e6  # of each of two spheres, as the force takes it


def after(masses, wall, restitution, accuracy, speed=1.0):
    if restitution != 1.0:  # a dissipation is no coefficient of restitution
        return None
    model = opensim.Model()
    model.setGravity(opensim.Vec3(0.0))
    force = opensim.HuntCrossleyForce()
    force.setStiffness(STIFFNESS)
    force.setDissipation(0.0)
    force.setStaticFriction(0.0)
    force.setDynamicFriction(0.0)
    joints = []
    for k, mass in enumerate(masses):
        inertia = opensim.Inertia(0.4 * mass * RADIUS**2)
        body = opensim.Body(f"ball{k}", mass, opensim.Vec3(0.0), inertia)
        model.addBody(body)
        joint = opensim.SliderJoint(f"slider{k}", model.getGround(), body)
        model.addJoint(joint)
        centre = opensim.Vec3(0.0)
        sphere = opensim.ContactSphere(RADIUS, centre, body, f"sphere{k}")
        model.addContactGeometry(sphere)
        force.addGeometry(sphere.getName())
        joints.append(joint)
    if wall:
        face = (2 * len(masses) - 1) * RADIUS
        # the normal of a half-space is its -x axis, which points to the balls
        plane = opensim.ContactHalfSpace(
            opensim.Vec3(face, 0.0, 0.0),
            opensim.Vec3(0.0, 0.0, 0.0),
            model.getGround(),
            "wall",
        )
        model.addContactGeometry(plane)
        force.addGeometry("wall")
    model.addForce(force)
    state = model.initSystem()
    coordinates = [joint.getCoordinate() for joint in joints]
    for k, coordinate in enumerate(coordinates):
        coordinate.setValue(state, 2 * RADIUS * k)
        coordinate.setSpeedValue(state, speed * (k == 0))
    manager = opensim.Manager(model)
    manager.setIntegratorAccuracy(accuracy)
    manager.setIntegratorMaximumStepSize(1e-4)  # longer steps pass through a ball
    manager.initialize(state)
    end = manager.integrate(TIME)
    velocity = [coordinate.getSpeedValue(end) for coordinate in coordinates]
    return velocity if all(map(math.isfinite, velocity)) else None


if __name__ == "__main__":
    settings = {"HuntCrossleyForce, dissipation 0, accuracy 1e-6": {"accuracy": 1e-6}}
    opensim.Logger.setLevelString("Off")
    version = opensim.GetVersion().split("-")[0]
    print_rows("opensim", version, settings, after)
