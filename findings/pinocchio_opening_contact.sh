#!/usr/bin/env bash
# Pinocchio: an impact turns a contact that separates back into the other body.
#
# Guess: impulseDynamics with r_coeff 0.5 gives no impulse to a contact that already separates, or
# one that does not pull.
# Seen (pin 4.1.0): v+ = -0.5 v- in every row of J. A contact that separates at 1 m/s approaches at
# 0.5 m/s afterwards, by an impulse that pulls.
# It costs: with all touching points in J (a foot that tips) the robot is driven into the ground;
# give rows of closing contacts only, and look again afterwards.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "pin==4.1.0" "numpy<2.5"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
import numpy as np
import pinocchio

model = pinocchio.Model()
for name in ("left", "right"):
    joint = model.addJoint(0, pinocchio.JointModelPZ(), pinocchio.SE3.Identity(), name)
    inertia = pinocchio.Inertia(1.0, np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(joint, inertia, pinocchio.SE3.Identity())
data = model.createData()
before = np.array([-1.0, 1.0])  # the left one falls, the right one rises [m/s]
after = pinocchio.impulseDynamics(model, data, np.zeros(2), before, np.eye(2), 0.5, 0.0)
print("pinocchio", pinocchio.__version__)
print("before", before, "after", np.round(after, 6), "impulses", np.round(data.impulse_c, 6))
assert np.allclose(after, [0.5, -0.5]), "the behaviour has changed"
assert np.allclose(data.impulse_c, [1.5, -1.5]), "the behaviour has changed"
PYTHON
