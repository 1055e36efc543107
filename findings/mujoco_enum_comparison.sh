#!/usr/bin/env bash
# MuJoCo: a constant compared with an entry of a model's array depends on the order of the two.
#
# Guess: `model.jnt_type[0] == mjJNT_HINGE`, `mjJNT_HINGE == model.jnt_type[0]` and
# `model.jnt_type[0] in (mjJNT_HINGE,)` are all True for a hinge.
# Seen (mujoco 4.0.0, numpy 2.4): True, False, False. The array's own comparison and int() are right.
# It costs: code that asks whether a joint is a hinge takes the other branch.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "mujoco==4.0.0" "numpy==2.4.6"
"$folder/env/bin/python" - <<'PYTHON'
import mujoco
import numpy

model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint type='hinge'/><geom size='.1'/></body></worldbody></mujoco>"
)
kind, hinge = model.jnt_type[0], mujoco.mjtJoint.mjJNT_HINGE
seen = {
    "entry == constant": bool(kind == hinge),
    "constant == entry": bool(hinge == kind),
    "entry in (constant,)": kind in (hinge,),
    "int(entry) in (constant,)": int(kind) in (hinge,),
}
print("mujoco", mujoco.__version__, "numpy", numpy.__version__)
for what, value in seen.items():
    print(f"{what:26} {value}")
assert list(seen.values()) == [True, False, False, True], "the behaviour has changed"
PYTHON
