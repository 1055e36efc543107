# /// script
# dependencies = ["KratosMultiphysics==10.4.4", "KratosDEMApplication==10.4.4"]
# ///
"""KratosDEM: `COEFFICIENT_OF_RESTITUTION` of a pair of materials; contact forces of Hertz.

Contacts are looked for in every step: by default in every fiftieth, which a ball may pass. A wall
would need a mesh: scenes with one are left out. OMP_NUM_THREADS=1 is faster for a few balls.
"""

import json
import math
import os
import tempfile
from importlib import metadata
from pathlib import Path

import KratosMultiphysics as Kratos
from KratosMultiphysics.DEMApplication.DEM_analysis_stage import DEMAnalysisStage
from rows import RADIUS, print_rows

TIME = 0.05  # [s]
MATERIAL = 1


def nodal(variable, values):
    """Block of a mesh file: a value for each ball."""
    lines = [f"{k} 0 {value}" for k, value in enumerate(values, 1)]
    return [f"Begin NodalData {variable}", *lines, "End NodalData", ""]


def mesh(masses, speed):
    """Mesh file of touching balls in a row, of which the first moves."""
    numbers = range(1, len(masses) + 1)
    places = [f"{k} {2 * RADIUS * (k - 1)!r} 0.0 0.0" for k in numbers]
    balls = [f"{k} {MATERIAL} {k}" for k in numbers]
    return "\n".join(
        [
            *("Begin Properties 1", "End Properties", ""),
            *("Begin Nodes", *places, "End Nodes", ""),
            *("Begin Elements SphericParticle3D", *balls, "End Elements", ""),
            *nodal("RADIUS", [RADIUS] * len(masses)),
            *nodal("VELOCITY_X", [speed] + [0.0] * (len(masses) - 1)),
            *("Begin SubModelPart balls", "Begin SubModelPartNodes"),
            *(map(str, numbers)),
            *("End SubModelPartNodes", "Begin SubModelPartElements"),
            *(map(str, numbers)),
            *("End SubModelPartElements", "End SubModelPart", ""),
        ]
    )


def materials(mass, restitution):
    """Materials of balls of one mass [kg]."""
    density = mass / (4 / 3 * math.pi * RADIUS**3)
    variables = {
        "PARTICLE_DENSITY": density,
        "YOUNG_MODULUS": 1e9,
        "POISSON_RATIO": 0.25,
        "PARTICLE_SPHERICITY": 1.0,
    }
    pair = {
        "COEFFICIENT_OF_RESTITUTION": restitution,
        "STATIC_FRICTION": 0.0,
        "DYNAMIC_FRICTION": 0.0,
        "FRICTION_DECAY": 500.0,
        "ROLLING_FRICTION": 0.0,
        "ROLLING_FRICTION_WITH_WALLS": 0.0,
        "DEM_DISCONTINUUM_CONSTITUTIVE_LAW_NAME": "DEM_D_Hertz_viscous_Coulomb",
    }
    both = [MATERIAL, MATERIAL]
    return {
        "materials": [
            {"material_name": "m", "material_id": MATERIAL, "Variables": variables}
        ],
        "material_relations": [
            {
                "material_names_list": ["m", "m"],
                "material_ids_list": both,
                "Variables": pair,
            }
        ],
        "material_assignation_table": [["SpheresPart", "m"]],
    }


def parameters(step):
    """What differs from the defaults."""
    return {
        "do_print_results_option": False,
        "dem_inlet_option": False,
        "GravityZ": 0.0,
        "RotationOption": False,
        "FinalTime": TIME,
        "MaxTimeStep": step,
        "NeighbourSearchFrequency": 1,
        "TranslationalIntegrationScheme": "Velocity_Verlet",
        "problem_name": "row",
        "ElementType": "SphericPartDEMElement3D",
        "solver_settings": {
            "strategy": "sphere_strategy",
            "RemoveBallsInitiallyTouchingWalls": False,
            "material_import_settings": {"materials_filename": "MaterialsDEM.json"},
        },
    }


def as_kratos(value):
    """A dictionary as Kratos holds it."""
    return Kratos.Parameters(json.dumps(value))


def after(masses, wall, restitution, step, speed=1.0):
    if wall or len(set(masses)) > 1:  # one density
        return None
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            Path("rowDEM.mdpa").write_text(mesh(masses, speed))
            data = as_kratos(materials(masses[0], restitution))
            Path("MaterialsDEM.json").write_text(data.PrettyPrintJsonString())
            model = Kratos.Model()
            analysis = DEMAnalysisStage(model, as_kratos(parameters(step)))
            analysis.Initialize()
            analysis.RunSolutionLoop()
            nodes = model.GetModelPart("SpheresPart").Nodes
            found = [node.GetSolutionStepValue(Kratos.VELOCITY_X) for node in nodes]
            analysis.Finalize()  # empties the model
            return found
        finally:
            os.chdir(before)


if __name__ == "__main__":
    Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)
    settings = {"Hertz viscous Coulomb, step 10 us": {"step": 1e-5}}
    version = metadata.version("KratosDEMApplication")
    print_rows("kratosdem", version, settings, after)
