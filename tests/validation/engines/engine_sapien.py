# /// script
# dependencies = ["sapien==3.0.3", "setuptools<81"]
# ///
"""SAPIEN (PhysX 5): the material's `restitution`; a pair has the mean of both.

Below `bounce_threshold`, 2 m/s by default, nothing bounces.
"""

import numpy as np
import sapien
from rows import RADIUS, TIME, print_rows
from sapien import physx


def after(masses, wall, restitution, threshold, step):
    physx.set_scene_config(gravity=np.zeros(3, np.float32), bounce_threshold=threshold)
    system = physx.PhysxCpuSystem()
    system.timestep = step
    scene = sapien.Scene([system])
    material = physx.PhysxMaterial(0.0, 0.0, restitution)
    bodies = []
    for k, mass in enumerate(masses):
        builder = scene.create_actor_builder()
        builder.add_sphere_collision(
            radius=RADIUS, material=material, density=mass / (4 / 3 * np.pi * RADIUS**3)
        )
        builder.set_initial_pose(sapien.Pose([2 * RADIUS * k, 0, 0]))
        entity = builder.build(name=f"ball {k}")
        body = entity.find_component_by_type(physx.PhysxRigidDynamicComponent)
        body.set_linear_damping(0.0)
        bodies.append(body)
    if wall:
        builder = scene.create_actor_builder()
        builder.add_box_collision(half_size=[RADIUS, 1, 1], material=material)
        builder.set_initial_pose(sapien.Pose([2 * RADIUS * len(masses), 0, 0]))
        builder.build_static(name="wall")
    bodies[0].set_linear_velocity([1.0, 0.0, 0.0])
    for _ in range(round(TIME / step)):
        scene.step()
    return [float(body.get_linear_velocity()[0]) for body in bodies]


if __name__ == "__main__":
    settings = {
        f"TGS, bounce threshold {name} m/s, step 10 ms": {
            "threshold": value,
            "step": 0.01,
        }
        for name, value in ((".01", 0.01), ("2", 2.0))
    }
    print_rows("sapien", sapien.__version__, settings, after)
