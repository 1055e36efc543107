# /// script
# requires-python = ">=3.12"
# dependencies = ["drake==1.58.0", "numpy"]
# ///
"""Drake: no e. Hunt and Crossley's dissipation [s/m]; in steps by SAP also a relaxation time.

Without dissipation it is e = 1, so scenes with another e are left out.
"""

from importlib.metadata import version

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from rows import RADIUS, print_rows

TIME = 0.05  # [s]
STIFFNESS = 1e6  # Drake's default [N/m]


def after(
    masses,
    wall,
    restitution,
    step,
    dissipation=0.0,
    relaxation=0.0,
    stiffness=STIFFNESS,
):
    if restitution != 1:
        return None
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=step, discrete_contact_approximation="sap", contact_model="point"
    )
    plant, _ = AddMultibodyPlant(config, builder)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])

    def solid(body, pose, shape, name):
        made = ProximityProperties()
        AddContactMaterial(made, dissipation, stiffness, CoulombFriction(0.0, 0.0))
        made.AddProperty("material", "relaxation_time", relaxation)
        plant.RegisterCollisionGeometry(body, pose, shape, name, made)

    joints = []
    for k, mass in enumerate(masses):
        ball = plant.AddRigidBody(
            f"b{k}", SpatialInertia.SolidSphereWithMass(mass, RADIUS)
        )
        solid(ball, RigidTransform(), Sphere(RADIUS), f"g{k}")
        along = PrismaticJoint(
            f"x{k}", plant.world_frame(), ball.body_frame(), [1, 0, 0]
        )
        joints.append(plant.AddJoint(along))
    if wall:
        turn = RotationMatrix.MakeYRotation(
            -np.pi / 2
        )  # the half space's normal is its z axis
        pose = RigidTransform(turn, [RADIUS * (2 * len(masses) - 1), 0, 0])
        solid(plant.world_body(), pose, HalfSpace(), "wall")
    plant.Finalize()
    simulator = Simulator(builder.Build())
    if step == 0:
        simulator.get_mutable_integrator().set_target_accuracy(1e-8)
        simulator.get_mutable_integrator().set_maximum_step_size(1e-4)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    for k, joint in enumerate(joints):
        joint.set_translation(context, 2 * RADIUS * k)
        joint.set_translation_rate(context, 1.0 if k == 0 else 0.0)
    simulator.AdvanceTo(TIME)
    return [joint.get_translation_rate(context) for joint in joints]


if __name__ == "__main__":
    settings = {
        "SAP, dissipation 0, relaxation time 0, step .1 ms": {"step": 1e-4},
        "continuous, dissipation 0": {"step": 0.0},
    }
    print_rows("drake", version("drake"), settings, after)
