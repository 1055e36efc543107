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
    "scene": ("Scene chain column gap_velocity kinetic_energy momentum velocity_change"),
    "contact": (
        "Contact delassus_matrix kinetic_angles normalized_delassus normalized_gap_velocity"
    ),
    "bodies.base": "Body scene_from_gaps",
    "bodies.blocks": "Block rocking_block",
    "bodies.dimers": "Dimer SpatialDimer dimer dimer_3d",
    "bodies.discs": "DiskBalls disk_balls",
    "bodies.particles": "Column Corner corner",
    "bodies.pendulums": "PendulumCradle pendulum_cradle",
    "law": "Impulses Law option parameter",
    "laws": "REGISTRY register",
    "laws.kinematic": "Moreau Newton RestitutionMatrix",
    "laws.poisson": "Poisson",
    "laws.binary": "Binary",
    "laws.compliant": "Compliant",
    "laws.forces": (
        "Bistiffness Force Hertz HuntCrossley KelvinVoigt KuwabaraKono LinearSpring PowerLaw "
        "UserForce"
    ),
    "montecarlo.gap_scales": "Crossover GapScale crossover gap_scale",
    "laws.calibration": "calibrate compare_rheologies measured_restitution",
    "laws.materials": "hertz_stiffness sphere_mass",
    "theory.linear_chain": "bilateral_motion newby_ratio",
    "motion.contact_dynamics": "TurningImpact turning_impact",
    "plot.rheology": "plot_forces plot_rheologies",
    "montecarlo.running": "monte_carlo",
    "montecarlo.results": "MonteCarlo",
    "plot.montecarlo": "plot_monte_carlo",
    "montecarlo.gap_sensitivities": "GapSensitivity gap_sensitivity",
    "montecarlo.store": "read_samples",
    "montecarlo.distributions": "Normal RandomLaw Uniform",
    "theory.han_gilmore_tree": "HanGilmoreOutcome han_gilmore",
    "laws.lzb": "LZB distributing_rule",
    "impacts": "Impact impact raise_on_failure",
    "status": "STATUS",
    "audits": "Audit audit summary",
    "histories": "History history",
    "plot.comparison": "plot_comparison",
    "comparison": "Comparison compare dispersion_index energy_ratio",
    "theory.restitution_audit": ("MatrixAudit audit_matrix carnot_energy_loss dissipation_matrix"),
    "theory.friction_consistency": (
        "FrictionBounds friction_bounds friction_energy_change friction_impulses"
    ),
    "theory.admissible": "AdmissibleSet admissible_set",
    "plot.admissible": "plot_admissible_set",
    "theory.copositive": "Copositivity copositivity",
    "theory.quasi_velocities": (
        "ContactPower contact_power from_quasi_velocities kinetic_energy_split quasi_basis "
        "to_quasi_velocities"
    ),
    "theory.rocking_ratios": "RockingRatio housner_restitution rocking_matrix rocking_ratios",
    "theory.rocking_impacts": "rocking_dispersion search_critical_angle",
    "theory.rocking_record": "RockingDispersion critical_kinetic_angle rocking_kinetic_angle",
    "plot.rocking": "plot_rocking_dispersion plot_rocking_outcomes",
    "theory.inclusion": "InclusionOutcome contact_coupling restitution_inclusion",
    "methods.charts.chart": "work_precision",
    "methods.charts.record": "WorkPrecision",
    "plot.chart": "plot_work_precision",
    "methods.stability.mapping": "stability_map",
    "methods.stability.results": "StabilityMap",
    "plot.stability": "plot_stability_map plot_stability_pairs",
    "methods.advice.advising": "advise",
    "methods.advice.report": "Advice",
    "methods.advice.validity": "ValidityMap validity_map",
    "plot.validity": "plot_advice plot_validity_map",
    "experiments": "Experiments read_experiments",
    "fits.fitting": "Fit fit",
    "plot.fits": "plot_fit",
    "motion.simulate": "simulate",
    "plot.motions": "plot_motion plot_phase_portrait",
    "plot.animation": "animate_motion",
    "motion.system": (
        "HarmonicBase System ball_system block_system column_system cradle_system dimer_system "
        "gravity"
    ),
    "motion.fitting_motion": "MotionFit fit_motion",
    "motion.record": "Motion raise_on_failed_motion",
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
