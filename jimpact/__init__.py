"""jimpact: differentiable laws for impacts with several contacts, in JAX.

The mental model: a `Scene` (mass matrix, contact normals) turns velocities into contact space,
`W = N^T M^-1 N` and gap velocities `gamma = N^T v` (negative on approach); a *law* maps
`(W, gamma-)` and its own parameters to impulses `p >= 0`; `impact` gives
`v+ = v- + M^-1 N p`, the energy change (<= 0 dissipates) and a status code.
Laws and scenes are pytrees: `jax.jit`, `jax.vmap` and `jax.grad` work over all of them.

>>> import jimpact as ji
>>> out = ji.impact(ji.LZB(1.0), ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
>>> [round(float(v), 3) for v in out.velocity]
[-0.071, 0.076, 0.995]
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# module -> public names, imported on first use so that `jimpact --help` stays fast. No module
# here is named like a public name: importing it would put the module in the function's place.
_WHERE = {
    "scene": "Scene",
    "contact_space": (
        "delassus_matrix gap_velocity kinetic_angles kinetic_energy momentum "
        "normalized_delassus normalized_gap_velocity velocity_change"
    ),
    "scenes": "chain column scene_from_gaps",
    "mechanisms.base": "Mechanism",
    "mechanisms.bodies": "Block Dimer dimer rocking_block",
    "mechanisms.spatial": "SpatialDimer dimer_3d",
    "mechanisms.planar": "Corner DiskBalls corner disk_balls",
    "mechanisms.pendulums": "PendulumCradle pendulum_cradle",
    "laws": "REGISTRY",
    "laws.base": "Law",
    "laws.newton": "Newton",
    "laws.moreau": "Moreau",
    "laws.poisson": "Poisson",
    "laws.binary": "Binary",
    "laws.compliant": "Compliant",
    "rheology": (
        "Bistiffness Force Hertz HuntCrossley KelvinVoigt KuwabaraKono LinearSpring PowerLaw "
        "UserForce"
    ),
    "compliance.gap_scales": "Crossover GapScale crossover gap_scale",
    "compliance.calibration": "calibrate compare_rheologies measured_restitution",
    "compliance.materials": "hertz_stiffness sphere_mass",
    "compliance.linear_chain": "bilateral_motion newby_ratio",
    "compliance.turning": "TurningImpact block_gaps turning_impact",
    "pictures.rheology": "plot_forces plot_rheologies",
    "montecarlo": "monte_carlo",
    "sampling.results": "MonteCarlo",
    "pictures.montecarlo": "plot_monte_carlo",
    "sampling.gap_sensitivities": "GapSensitivity gap_sensitivity",
    "sampling.store": "read_samples",
    "sampling.distributions": "Normal RandomLaw Uniform",
    "han_gilmore_tree": "HanGilmoreOutcome han_gilmore",
    "laws.lzb": "LZB distributing_rule",
    "impacts": "Impact impact raise_on_failure",
    "status": "STATUS",
    "consistency": "Audit audit summary",
    "histories": "History history",
    "pictures.comparison": "plot_comparison",
    "comparison": "Comparison compare dispersion_index energy_ratio",
    "kinematics.restitution_audit": (
        "MatrixAudit audit_matrix carnot_energy_loss dissipation_matrix"
    ),
    "kinematics.friction_consistency": (
        "FrictionBounds friction_bounds friction_energy_change friction_impulses"
    ),
    "kinematics.admissible": "AdmissibleSet admissible_set",
    "pictures.admissible": "plot_admissible_set",
    "numerics.copositive": "Copositivity copositivity",
    "quasi": (
        "ContactPower contact_power from_quasi_velocities kinetic_energy_split quasi_basis "
        "to_quasi_velocities"
    ),
    "laws.restitution_matrix": "RestitutionMatrix",
    "rocking.ratios": "RockingRatio housner_restitution rocking_matrix rocking_ratios",
    "rocking.impacts": "rocking_dispersion search_critical_angle",
    "rocking.record": "RockingDispersion critical_kinetic_angle rocking_kinetic_angle",
    "pictures.rocking": "plot_rocking_dispersion plot_rocking_outcomes",
    "kinematics.inclusion": "InclusionOutcome contact_coupling restitution_inclusion",
    "charts.chart": "work_precision",
    "charts.record": "WorkPrecision",
    "pictures.chart": "plot_work_precision",
    "stability.mapping": "stability_map",
    "stability.results": "StabilityMap",
    "pictures.stability": "plot_stability_map plot_stability_pairs",
    "advice.advising": "advise",
    "advice.report": "Advice",
    "advice.validity": "ValidityMap validity_map",
    "pictures.validity": "plot_advice plot_validity_map",
    "experiments": "Experiments read_experiments",
    "fits.fitting": "Fit fit",
    "pictures.fits": "plot_fit",
    "motion.simulation": "simulate",
    "pictures.motions": "plot_motion plot_phase_portrait",
    "pictures.animation": "animate_motion",
    "motion.system": "System gravity",
    "motion.bases": "HarmonicBase",
    "motion.fitting_motion": "MotionFit fit_motion",
    "motion.record": "Motion raise_on_failed_motion",
    "motion.ready_systems": ("ball_system block_system column_system cradle_system dimer_system"),
}
_MODULE = {name: module for module, names in _WHERE.items() for name in names.split()}

__all__ = sorted([*_MODULE, "__version__"])


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'jimpact' has no attribute {name!r}")
    value = getattr(import_module(f"jimpact.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
