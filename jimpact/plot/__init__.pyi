"""Public names of `ji.plot` and where they live."""

from .charts import (
    advice as advice,
    stability_map as stability_map,
    stability_pairs as stability_pairs,
    validity_map as validity_map,
    work_precision as work_precision,
)
from .films import animation as animation
from .fits import contour as contour, fit as fit
from .inference import (
    corner as corner,
    correlation as correlation,
    profiles as profiles,
    residuals as residuals,
)
from .laws import (
    comparison as comparison,
    contact_loop as contact_loop,
    energy_plane as energy_plane,
    forces as forces,
    history as history,
)
from .montecarlo import monte_carlo as monte_carlo
from .motions import motion as motion, phase_portrait as phase_portrait
from .systems import force_chains as force_chains, system as system
from .theory import (
    admissible_set as admissible_set,
    rocking_dispersion as rocking_dispersion,
    rocking_domains as rocking_domains,
    rocking_outcomes as rocking_outcomes,
)
from .tracks import track as track
