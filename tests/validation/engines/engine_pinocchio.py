# /// script
# dependencies = ["pin==4.1.0", "numpy"]
# ///
"""Pinocchio: `impulseDynamics(model, data, q, v, J, r_coeff, inv_damping)` takes e and rows of J.

It is Newton's law for all rows at once: J v+ = -e J v-. It finds no contacts, and it does not ask
whether an impulse pushes.
"""

import numpy as np
import pinocchio
from rows import print_rows


def after(masses, wall, restitution):
    model = pinocchio.Model()
    for mass in masses:
        joint = model.addJoint(
            0, pinocchio.JointModelPX(), pinocchio.SE3.Identity(), f"x{model.njoints}"
        )
        inertia = pinocchio.Inertia(mass, np.zeros(3), np.zeros((3, 3)))
        model.appendBodyToJoint(joint, inertia, pinocchio.SE3.Identity())
    n = len(masses)
    rows = np.diff(np.eye(n), axis=0)  # v[j + 1] - v[j], negative on approach
    if wall:
        rows = np.vstack([rows, -np.eye(n)[-1]])
    before = np.eye(n)[0]
    data = model.createData()
    return pinocchio.impulseDynamics(
        model, data, np.zeros(n), before, rows, restitution, 0.0
    )


if __name__ == "__main__":
    print_rows(
        "pinocchio", pinocchio.__version__, {"impulseDynamics, no damping": {}}, after
    )
