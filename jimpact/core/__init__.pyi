"""Names of the core for those who write rooms: `docs/own_room.md` builds one."""

from .audits import Audit as Audit, nothing_approaches as nothing_approaches
from .contact import (
    contact_of as contact_of,
    decoupled as decoupled,
    kinetic_norm as kinetic_norm,
    normalized_delassus as normalized_delassus,
    normalized_gap_velocity as normalized_gap_velocity,
)
from .distributions import (
    Distribution as Distribution,
    GivenRows as GivenRows,
    as_source as as_source,
    warn_without_key as warn_without_key,
)
from .law import (
    AnyLaw as AnyLaw,
    Declared as Declared,
    Domain as Domain,
    OptionalValues as OptionalValues,
    StaticNumber as StaticNumber,
    StaticNumbers as StaticNumbers,
    check_law as check_law,
    declarations_of as declarations_of,
    entries as entries,
    forward_only as forward_only,
    forwards_to_law as forwards_to_law,
    free_parameters_of as free_parameters_of,
    open_tolerance as open_tolerance,
    options_of as options_of,
    parameters_of as parameters_of,
    value_of as value_of,
    with_entries as with_entries,
    with_option as with_option,
    with_parameter as with_parameter,
    within_domains as within_domains,
)
from .quasi_space import quasi_basis as quasi_basis
from .registry import (
    ADVISED as ADVISED,
    REGISTRY as REGISTRY,
    registered_laws as registered_laws,
    simplest_first as simplest_first,
)
from .scene import (
    WALLS as WALLS,
    PairNormals as PairNormals,
    as_velocity as as_velocity,
    check_mass as check_mass,
    dense_mass as dense_mass,
    rounded_gaps as rounded_gaps,
    solve_mass as solve_mass,
    stackable as stackable,
    velocity_unit as velocity_unit,
    with_gaps as with_gaps,
)
