# /// script
# dependencies = ["exudyn==1.13.6", "numpy"]
# ///
"""Exudyn: `restitutionCoefficient` of `CreateSphereSphereContact`, used by `impactModel` 2 (and 1).

A contact force, whose exponent and stiffness a user chooses. The wall is a sphere on the ground.
"""

import itertools

import exudyn
import exudyn.itemInterface  # (functions that create items look it up)
from rows import RADIUS, print_rows

TIME = 0.1  # [s]


def after(masses, wall, restitution, model, exponent, stiffness, step, gap=0.0):
    container = exudyn.SystemContainer()
    system = container.AddSystem()
    bodies = []
    for k, mass in enumerate(masses):
        place, velocity = [(2 * RADIUS + gap) * k, 0, 0], [1.0 if k == 0 else 0.0, 0, 0]
        start = {"referencePosition": place, "initialVelocity": velocity}
        bodies.append(system.CreateMassPoint(mass=mass, **start))
    solids = list(bodies)
    if wall:
        solids.append(
            system.CreateGround(referencePosition=[2 * RADIUS * len(masses), 0, 0])
        )
    for pair in itertools.pairwise(solids):
        system.CreateSphereSphereContact(
            itemNumbers=list(pair),
            spheresRadii=[RADIUS, RADIUS],
            contactStiffness=stiffness,
            contactStiffnessExponent=exponent,
            restitutionCoefficient=restitution,
            impactModel=model,
        )
    system.Assemble()
    settings = exudyn.SimulationSettings()
    settings.timeIntegration.endTime = TIME
    settings.timeIntegration.numberOfSteps = round(TIME / step)
    settings.timeIntegration.verboseMode = 0
    settings.solution.file.write = False
    system.SolveDynamic(settings, solverType=exudyn.DynamicSolverType.RK44)
    velocity = exudyn.OutputVariableType.Velocity
    return [system.GetObjectOutputBody(body, velocity)[0] for body in bodies]


if __name__ == "__main__":
    hertz = {
        "model": 2,
        "exponent": 1.5,
        "stiffness": 1e7,
        "step": 1e-4,
    }  # [N / m^1.5], [s]
    linear = {
        "model": 0,
        "exponent": 1.0,
        "stiffness": 1e5,
        "step": 1e-4,
    }  # [N / m], [s]
    settings = {
        "contact model 2, Hertz, step .1 ms": hertz,
        "contact model 0, linear, step .1 ms": linear,
    }
    print_rows("exudyn", exudyn.__version__, settings, after)
