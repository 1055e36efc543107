#!/usr/bin/env bash
# MuJoCo before 3.14: spheres in a row that touch have no contacts, although their margin is larger
# than the rounding of their distances.
#
# Guess: five spheres of radius .05 m at 0, .1, .2, .3, .4 m, with a margin of 1e-9 m, have four
# contacts of distances below 1e-16 m.
# Seen: mujoco 3.13.0 has none; it has four with a margin of 1e-7 m. Pairs that may touch are found
# by bounding volumes in single precision. mujoco 3.14.0 has four with both.
# It costs: the first ball of a cradle flies through the others.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
count() {
    "$folder/env/bin/python" -m pip install --quiet "mujoco==$1" "numpy==2.4.6"
    "$folder/env/bin/python" - "$1" "$2" "$3" <<'PYTHON'
import sys

import mujoco

body = "<body pos='{} 0 1'><joint type='slide' axis='1 0 0'/><geom size='.05' mass='1'/></body>"
row = "".join(body.format(0.1 * i) for i in range(5))
model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{row}</worldbody></mujoco>")
found = []
for margin in (1e-9, 1e-7):
    model.geom_margin[:] = margin
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found.append(data.ncon)
print("mujoco", mujoco.__version__, "contacts with a margin of 1 nm and 100 nm:", *found)
assert found == [int(x) for x in sys.argv[2:]], "the behaviour has changed"
PYTHON
}
count 3.13.0 0 4
count 3.14.0 4 4
