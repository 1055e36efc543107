#!/usr/bin/env bash
# Drake: what an SDF file says about the bounce of a surface is dropped, without a word.
#
# Guess: a file with <restitution_coefficient> 0.8 either makes the ball bounce or gives a warning
# that Drake has no coefficient of restitution; and <mu> 0.3 alone is the friction coefficient.
# Seen (drake 1.51.1): no warning, no property but friction. <mu> is the static coefficient, the
# dynamic one is <mu2>, which is 1 by default: 0.3 alone is an error, as 1 is more than 0.3.
# It costs: a model that bounces in another simulator does not in this one, and nobody says so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "drake==1.51.1" "numpy<2.5"
cd "$folder"
"$folder/env/bin/python" - 2>said <<'PYTHON'
from importlib.metadata import version

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

BALL = """<sdf version="1.7"><model name="m"><link name="ball"><collision name="shell">
<geometry><sphere><radius>.1</radius></sphere></geometry><surface>
<bounce><restitution_coefficient>0.8</restitution_coefficient><threshold>0.01</threshold></bounce>
<friction><ode>{}</ode></friction></surface></collision></link></model></sdf>"""


def properties(friction):
    """Names of the contact properties of the ball, and its two coefficients of friction."""
    plant, graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 1e-3)
    Parser(plant).AddModelsFromString(BALL.format(friction), "sdf")
    inspector = graph.model_inspector()
    (ball,) = (x for x in inspector.GetAllGeometryIds() if inspector.GetProximityProperties(x))
    found = inspector.GetProximityProperties(ball)
    names = [n for group in found.GetGroupNames() for n in found.GetPropertiesInGroup(group)]
    friction = found.GetProperty("material", "coulomb_friction")
    return names, friction.static_friction(), friction.dynamic_friction()


print("drake", version("drake"))
both = properties("<mu>0.3</mu><mu2>0.2</mu2>")
print("kept:", *both)
assert both == (["coulomb_friction"], 0.3, 0.2), "the behaviour has changed"
try:
    told = str(properties("<mu>0.3</mu>"))
except RuntimeError as error:
    told = str(error)
print("mu alone:", told)
assert "dynamic friction (1) is greater than" in told, "the behaviour has changed"
PYTHON
if grep -qiE "bounce|restitution" "$folder/said"; then
    echo "the behaviour has changed: it tells of the bounce" && exit 1
fi
