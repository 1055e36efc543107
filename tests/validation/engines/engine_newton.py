# /// script
# dependencies = ["newton==1.8.0"]
# ///
"""newton, solver XPBD: `restitution` of a shape, used where `enable_restitution` is set."""

import newton
import numpy as np
import warp as wp
from rows import RADIUS, TIME, print_rows


def after(masses, wall, restitution, step):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    kind = newton.ModelBuilder.ShapeConfig(density=0.0, mu=0.0, restitution=restitution)
    for k, mass in enumerate(masses):
        inertia = wp.mat33(np.eye(3) * 0.4 * mass * RADIUS**2)
        place = wp.transform(wp.vec3(2 * RADIUS * k, 0.0, 0.0), wp.quat_identity())
        body = builder.add_body(xform=place, mass=mass, inertia=inertia)
        builder.add_shape_sphere(body, radius=RADIUS, cfg=kind)
    if wall:
        x = RADIUS * (2 * len(masses) - 1)
        builder.add_shape_plane(
            plane=(-1.0, 0.0, 0.0, x), width=0.0, length=0.0, cfg=kind
        )
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverXPBD(model, enable_restitution=True)
    state, other, control = model.state(), model.state(), model.control()
    velocity = np.zeros((len(masses), 6), np.float32)
    velocity[0, 0] = 1.0
    state.body_qd.assign(velocity)
    for _ in range(round(TIME / step)):
        state.clear_forces()
        contacts = model.collide(state)
        solver.step(state, other, control, contacts, step)
        state, other = other, state
    return state.body_qd.numpy()[:, 0]


if __name__ == "__main__":
    wp.config.quiet = True
    print_rows(
        "newton-XPBD", newton.__version__, {"step 1/60 s": {"step": 1 / 60}}, after
    )
