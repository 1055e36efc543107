#!/usr/bin/env bash
# PyBullet: a URDF file that has changed is not read again.
#
# Guess: loadURDF reads the file; at the latest resetSimulation forgets what was read before.
# Seen (pybullet 3.2.7): the second call with the same name gives the first text, also after
# resetSimulation. Another path to the same file gives the new text.
# It costs: a search over masses or restitutions that writes one file again and again varies
# nothing.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "pybullet==3.2.7" "numpy<2.5"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
from importlib.metadata import version
from pathlib import Path

import pybullet

BALL = """<robot name="ball"><link name="ball"><inertial><mass value="1"/>
<inertia ixx=".004" iyy=".004" izz=".004" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius=".1"/></geometry></collision>
<contact><restitution value="{}"/></contact></link></robot>"""


def restitution(name):
    """e of the body that a file describes."""
    return pybullet.getDynamicsInfo(pybullet.loadURDF(name), -1)[5]


pybullet.connect(pybullet.DIRECT)
Path("ball.urdf").write_text(BALL.format(0.8))
first = restitution("ball.urdf")
Path("ball.urdf").write_text(BALL.format(0.2))
second = restitution("ball.urdf")
pybullet.resetSimulation()
third = restitution("ball.urdf")
fourth = restitution(str(Path("ball.urdf").resolve()))
print("pybullet", version("pybullet"))
print("e 0.8 in the file:", first)
print("e 0.2 in the file:", second, "after resetSimulation:", third, "by its full path:", fourth)
assert [first, second, third, fourth] == [0.8, 0.8, 0.8, 0.2], "the behaviour has changed"
PYTHON
