"""Public names of `ji.plot` and the rooms in which they live."""

from jimpact.fits.pictures import contour as contour, fit as fit
from jimpact.fits.pictures_of_inference import (
    corner as corner,
    correlation as correlation,
    profiles as profiles,
    residuals as residuals,
)
from jimpact.methods.pictures import (
    stability_map as stability_map,
    stability_pairs as stability_pairs,
    validity_map as validity_map,
    work_precision as work_precision,
)
from jimpact.methods.pictures_of_advice import advice as advice
from jimpact.methods.pictures_of_comparison import (
    comparison as comparison,
    energy_plane as energy_plane,
)
from jimpact.montecarlo.pictures import monte_carlo as monte_carlo
from jimpact.motion.films import animation as animation
from jimpact.motion.pictures import motion as motion, phase_portrait as phase_portrait
from jimpact.motion.pictures_of_systems import (
    force_chains as force_chains,
    system as system,
)
from jimpact.plot.histories import (
    contact_loop as contact_loop,
    forces as forces,
    history as history,
)
from jimpact.theory.pictures import (
    admissible_set as admissible_set,
    rocking_dispersion as rocking_dispersion,
    rocking_domains as rocking_domains,
    rocking_outcomes as rocking_outcomes,
)
from jimpact.tracks.pictures import track as track
