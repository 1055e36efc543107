"""Public names and where they live: for type checkers, and for `lazy_loader`."""

from . import data as data, plot as plot, theory as theory, tracks as tracks
from .bodies.assembly import Bodies as Bodies
from .bodies.base import Body as Body
from .bodies.functions import scene_from_gaps as scene_from_gaps
from .bodies.mujoco_scene import from_mujoco as from_mujoco
from .bodies.particles import Column as Column, Corner as Corner
from .bodies.pendulums import PendulumCradle as PendulumCradle
from .bodies.shapes import (
    Block as Block,
    Box as Box,
    Coin as Coin,
    Dimer as Dimer,
    Disc as Disc,
    Polygon as Polygon,
    SpatialDimer as SpatialDimer,
    Sphere as Sphere,
)
from .cli.study import read_study as read_study
from .core.audits import audit as audit, summary as summary
from .core.contact import Contact as Contact, delassus_matrix as delassus_matrix
from .core.distributions import (
    Normal as Normal,
    RandomLaw as RandomLaw,
    Uniform as Uniform,
)
from .core.impacts import (
    Impact as Impact,
    impact as impact,
    raise_on_failure as raise_on_failure,
)
from .core.law import (
    Impulses as Impulses,
    Law as Law,
    option as option,
    parameter as parameter,
)
from .core.scene import (
    Scene as Scene,
    chain as chain,
    gap_velocity as gap_velocity,
    kinetic_energy as kinetic_energy,
    momentum as momentum,
    velocity_change as velocity_change,
)
from .fits.fitting import (
    bootstrap as bootstrap,
    fit as fit,
    fit_many as fit_many,
    leave_one_out as leave_one_out,
)
from .fits.fitting_motion import fit_motion as fit_motion
from .fits.posterior import posterior as posterior
from .fits.problem import FitProblem as FitProblem
from .fits.profiles import contour as contour, profile as profile
from .fits.search import Search as Search
from .fits.selection import (
    fit_laws as fit_laws,
    nested_test as nested_test,
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
)
from .laws.kinematic import (
    Moreau as Moreau,
    Newton as Newton,
    RestitutionMatrix as RestitutionMatrix,
)
from .laws.lzb import (
    LZB as LZB,
)
from .laws.mujoco_contact import (
    mujoco_restitution as mujoco_restitution,
    mujoco_solref as mujoco_solref,
)
from .laws.poisson import Poisson as Poisson
from .laws.routh import Routh as Routh
from .laws.velocity_dependent import VelocityDependent as VelocityDependent
from .methods.advice import advise as advise
from .methods.chart import work_precision as work_precision
from .methods.comparison import (
    compare as compare,
)
from .methods.scene_advice import simplest_scene as simplest_scene
from .methods.stability import stability_map as stability_map
from .methods.validity import validity_map as validity_map
from .montecarlo.run import monte_carlo as monte_carlo
from .montecarlo.store import read_samples as read_samples
from .motion.methods import (
    ContactForces as ContactForces,
    EventDriven as EventDriven,
    TimeStepping as TimeStepping,
)
from .motion.simulate import simulate as simulate
from .motion.system import (
    HarmonicBase as HarmonicBase,
    System as System,
    gravity as gravity,
)
from .saved import load as load
from .shots.data import Experiments as Experiments, read_experiments as read_experiments
from .theory.han_gilmore_tree import han_gilmore as han_gilmore
from .tools.kept_programs import keep_programs as keep_programs
from .tools.status import STATUS as STATUS

__version__: str
