#!/usr/bin/env bash
# Exudyn: the coefficient of restitution of two spheres depends on whether they touch at the start.
#
# Guess: restitutionCoefficient 0.5 with impact model 2 gives half of the speed, from a gap of 1 cm
# and for spheres that touch when one of them begins to move towards the other.
# Seen (exudyn 1.13.6): 0.5 from a gap, 1.0 for spheres that touch; nothing is reported.
# It costs: a row of balls that touch conserves its energy, whatever e it was given.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "exudyn==1.13.6" "numpy<2.5"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
import exudyn
import exudyn.itemInterface


def restitution(gap):
    """Separation over approach speed of two spheres of 1 kg and .1 m, the first at 1 m/s."""
    system = exudyn.SystemContainer().AddSystem()
    balls = [
        system.CreateMassPoint(
            mass=1.0,
            referencePosition=[(0.2 + gap) * k, 0, 0],
            initialVelocity=[float(k == 0), 0, 0],
        )
        for k in (0, 1)
    ]
    system.CreateSphereSphereContact(
        itemNumbers=balls,
        spheresRadii=[0.1, 0.1],
        contactStiffness=1e5,
        restitutionCoefficient=0.5,
        impactModel=2,
    )
    system.Assemble()
    settings = exudyn.SimulationSettings()
    settings.timeIntegration.endTime = 0.05
    settings.timeIntegration.numberOfSteps = 5000
    settings.timeIntegration.verboseMode = 0
    settings.solution.file.write = False
    system.SolveDynamic(settings, solverType=exudyn.DynamicSolverType.RK44)
    kind = exudyn.OutputVariableType.Velocity
    speed = [system.GetObjectOutputBody(ball, kind)[0] for ball in balls]
    return float(speed[1] - speed[0])


apart, touching = restitution(0.01), restitution(0.0)
print("exudyn", exudyn.__version__)
print(f"from a gap of 1 cm: {apart:.3f}; touching: {touching:.3f}")
assert abs(apart - 0.5) < 2e-3, "the behaviour has changed"
assert abs(touching - 1.0) < 2e-3, "the behaviour has changed"
PYTHON
