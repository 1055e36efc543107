#!/usr/bin/env bash
# newton: a USD material that states a restitution takes the friction away.
#
# Guess: a physics material with restitution 0.8 and no friction leaves the friction as it is
# without a material, 1.0.
# Seen (newton 1.8.0): friction 0, the fallback of the USD schema, instead of newton's default 1.
# It costs: a box that was given a bounce begins to slide.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "newton[importers]==1.8.0" "usd-core==26.8"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
import newton
import warp
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

warp.config.quiet = True


def friction_and_restitution(name, **material):
    """As newton reads them from a ball with this material, or none."""
    stage = Usd.Stage.CreateNew(name)
    ball = UsdGeom.Sphere.Define(stage, "/ball")
    for kind in (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI):
        kind.Apply(ball.GetPrim())
    UsdPhysics.MassAPI.Apply(ball.GetPrim()).CreateMassAttr(1.0)
    if material:
        made = UsdShade.Material.Define(stage, "/surface")
        surface = UsdPhysics.MaterialAPI.Apply(made.GetPrim())
        for key, value in material.items():
            getattr(surface, f"Create{key}Attr")(value)
        binding = UsdShade.MaterialBindingAPI.Apply(ball.GetPrim())
        binding.Bind(made, UsdShade.Tokens.weakerThanDescendants, "physics")
    stage.Save()
    builder = newton.ModelBuilder()
    builder.add_usd(name)
    return builder.shape_material_mu[0], round(builder.shape_material_restitution[0], 6)


plain = friction_and_restitution("plain.usda")
bounces = friction_and_restitution("bounces.usda", Restitution=0.8)
print("newton", newton.__version__)
print("without a material: friction, restitution", *plain)
print("restitution alone:  friction, restitution", *bounces)
assert plain == (1.0, 0.0), "the behaviour has changed"
assert bounces == (0.0, 0.8), "the behaviour has changed"
PYTHON
