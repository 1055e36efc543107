"""Public names of `ji.theory` and where they live."""

from jimpact.core.contact import kinetic_angles as kinetic_angles
from jimpact.motion.accelerations import (
    contact_problem as contact_problem,
    quasi_lagrange as quasi_lagrange,
)

from .admissible import AdmissibleSet as AdmissibleSet, admissible_set as admissible_set
from .chains import (
    SeparationTimes as SeparationTimes,
    bilateral_motion as bilateral_motion,
    nesterenko_speed as nesterenko_speed,
    newby_ratio as newby_ratio,
    reinsch_chain as reinsch_chain,
    separation_times as separation_times,
)
from .corners import (
    CornerOutcome as CornerOutcome,
    reentrant_corner as reentrant_corner,
)
from .dispersion import (
    dispersion_index as dispersion_index,
    energy_dispersion as energy_dispersion,
    energy_ratio as energy_ratio,
)
from .engine_parameters import (
    engine_parameter as engine_parameter,
    engine_restitution as engine_restitution,
)
from .friction import (
    FrictionBounds as FrictionBounds,
    InclusionOutcome as InclusionOutcome,
    contact_coupling as contact_coupling,
    friction_bounds as friction_bounds,
    friction_energy_change as friction_energy_change,
    friction_impulses as friction_impulses,
    restitution_inclusion as restitution_inclusion,
)
from .gaps import (
    crossover as crossover,
    gap_scale as gap_scale,
    gap_sensitivity as gap_sensitivity,
)
from .impulse_ratios import (
    correlation_interval as correlation_interval,
    distributing_rule as distributing_rule,
    precompression_energy as precompression_energy,
)
from .materials import (
    hertz_stiffness as hertz_stiffness,
    mindlin_ratio as mindlin_ratio,
    pair_restitution as pair_restitution,
)
from .oblique import (
    spring_slip as spring_slip,
    walton_slip as walton_slip,
)
from .quasi_velocities import (
    ContactPower as ContactPower,
    contact_power as contact_power,
    from_quasi_velocities as from_quasi_velocities,
    kinetic_energy_split as kinetic_energy_split,
    normalized_delassus as normalized_delassus,
    normalized_gap_velocity as normalized_gap_velocity,
    quasi_basis as quasi_basis,
    to_quasi_velocities as to_quasi_velocities,
)
from .restitution_matrices import (
    CoefficientAudit as CoefficientAudit,
    Copositivity as Copositivity,
    MatrixAudit as MatrixAudit,
    audit_coefficients as audit_coefficients,
    audit_matrix as audit_matrix,
    carnot_energy_loss as carnot_energy_loss,
    copositivity as copositivity,
    dissipation_matrix as dissipation_matrix,
)
from .rocking import (
    RockingDispersion as RockingDispersion,
    RockingDomain as RockingDomain,
    RockingRatio as RockingRatio,
    critical_kinetic_angle as critical_kinetic_angle,
    housner_restitution as housner_restitution,
    rocking_dispersion as rocking_dispersion,
    rocking_domain as rocking_domain,
    rocking_kinetic_angle as rocking_kinetic_angle,
    rocking_matrix as rocking_matrix,
    rocking_ratios as rocking_ratios,
    search_critical_angle as search_critical_angle,
)
