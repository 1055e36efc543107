"""Public names and where they live: read by type checkers, and on import by `lazy_loader`."""

from . import plot as plot, theory as theory
from .audits import audit as audit, summary as summary
from .bodies.assemblies import PlanarBodies as PlanarBodies
from .bodies.base import Body as Body, scene_from_gaps as scene_from_gaps
from .bodies.blocks import Block as Block, rocking_block as rocking_block
from .bodies.dimers import (
    Dimer as Dimer,
    SpatialDimer as SpatialDimer,
    dimer as dimer,
    dimer_3d as dimer_3d,
)
from .bodies.discs import DiskBalls as DiskBalls, disk_balls as disk_balls
from .bodies.mujoco_scene import MujocoScene as MujocoScene, from_mujoco as from_mujoco
from .bodies.particles import Column as Column, Corner as Corner, corner as corner
from .bodies.pendulums import PendulumCradle as PendulumCradle, pendulum_cradle as pendulum_cradle
from .bodies.piles import Discs as Discs, Spheres as Spheres
from .bodies.planar_piles import PlanarPile as PlanarPile
from .bodies.polygons import Disc as Disc, Polygon as Polygon
from .bodies.solids import Box as Box, Coin as Coin, Solid as Solid, Sphere as Sphere
from .bodies.spatial_bodies import SpatialBodies as SpatialBodies
from .cli.study import Study as Study, cube_impacts as cube_impacts, read_study as read_study
from .cli.study_motion import (
    MotionStudy as MotionStudy,
    read_motion_study as read_motion_study,
)
from .contact import (
    Contact as Contact,
    delassus_matrix as delassus_matrix,
    kinetic_angles as kinetic_angles,
    normalized_delassus as normalized_delassus,
    normalized_gap_velocity as normalized_gap_velocity,
)
from .fits.data import Experiments as Experiments, read_experiments as read_experiments
from .fits.fitting import (
    Refits as Refits,
    bootstrap as bootstrap,
    fit as fit,
    fit_many as fit_many,
    leave_one_out as leave_one_out,
)
from .fits.posterior import posterior as posterior
from .fits.problem import FitProblem as FitProblem
from .fits.profiles import Contour as Contour, contour as contour, profile as profile
from .fits.report import Fit as Fit, load_fit as load_fit
from .fits.selection import (
    LawFits as LawFits,
    NestedTest as NestedTest,
    fit_laws as fit_laws,
    nested_test as nested_test,
)
from .fits.uncertainty import Profile as Profile
from .impacts import Impact as Impact, impact as impact, raise_on_failure as raise_on_failure
from .law import (
    Impulses as Impulses,
    Law as Law,
    option as option,
    parameter as parameter,
)
from .laws import REGISTRY as REGISTRY, register as register
from .laws.binary import Binary as Binary
from .laws.calibration import (
    calibrate as calibrate,
    measured_restitution as measured_restitution,
)
from .laws.compliant import Compliant as Compliant
from .laws.forces import (
    Bistiffness as Bistiffness,
    ElastoPlastic as ElastoPlastic,
    Force as Force,
    Hertz as Hertz,
    HuntCrossley as HuntCrossley,
    KelvinVoigt as KelvinVoigt,
    KuwabaraKono as KuwabaraKono,
    LinearSpring as LinearSpring,
    PowerLaw as PowerLaw,
    UserForce as UserForce,
)
from .laws.histories import history as history
from .laws.impulse_correlation import (
    ImpulseCorrelation as ImpulseCorrelation,
    correlation_interval as correlation_interval,
)
from .laws.kinematic import (
    Moreau as Moreau,
    Newton as Newton,
    RestitutionMatrix as RestitutionMatrix,
)
from .laws.lzb import (
    LZB as LZB,
    distributing_rule as distributing_rule,
    precompression_energy as precompression_energy,
)
from .laws.materials import hertz_stiffness as hertz_stiffness, sphere_mass as sphere_mass
from .laws.mujoco_contact import (
    MujocoRestitution as MujocoRestitution,
    mujoco_restitution as mujoco_restitution,
    mujoco_solref as mujoco_solref,
)
from .laws.poisson import Poisson as Poisson
from .laws.routh import Routh as Routh
from .laws.velocity_dependent import VelocityDependent as VelocityDependent
from .measured import (
    ellipse_impacts as ellipse_impacts,
    square_drops as square_drops,
    square_impacts as square_impacts,
)
from .methods.advice import advise as advise
from .methods.chart import work_precision as work_precision
from .methods.comparison import (
    compare as compare,
    dispersion_index as dispersion_index,
    energy_dispersion as energy_dispersion,
    energy_ratio as energy_ratio,
)
from .methods.scene_advice import simplest_scene as simplest_scene
from .methods.stability import stability_map as stability_map
from .methods.validity import validity_map as validity_map
from .montecarlo.distributions import Normal as Normal, RandomLaw as RandomLaw, Uniform as Uniform
from .montecarlo.gaps import (
    crossover as crossover,
    gap_scale as gap_scale,
    gap_sensitivity as gap_sensitivity,
)
from .montecarlo.result import MonteCarlo as MonteCarlo
from .montecarlo.run import monte_carlo as monte_carlo
from .montecarlo.store import read_samples as read_samples
from .motion.accelerations import (
    ContactProblem as ContactProblem,
    QuasiLagrange as QuasiLagrange,
    contact_problem as contact_problem,
    quasi_lagrange as quasi_lagrange,
)
from .motion.fitting_motion import fit_motion as fit_motion
from .motion.pile_contacts import PileContacts as PileContacts, pile_contacts as pile_contacts
from .motion.record import (
    Motion as Motion,
    load_motion as load_motion,
    raise_on_failed_motion as raise_on_failed_motion,
)
from .motion.simulate import simulate as simulate
from .motion.system import (
    HarmonicBase as HarmonicBase,
    System as System,
    ball_system as ball_system,
    block_system as block_system,
    column_system as column_system,
    cradle_system as cradle_system,
    dimer_system as dimer_system,
    gravity as gravity,
)
from .scene import (
    Scene as Scene,
    chain as chain,
    column as column,
    gap_velocity as gap_velocity,
    kinetic_energy as kinetic_energy,
    momentum as momentum,
    velocity_change as velocity_change,
)
from .status import STATUS as STATUS
from .theory.han_gilmore_tree import han_gilmore as han_gilmore

__version__: str
