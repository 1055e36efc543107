"""Public names of `ji.plot` and where they live."""

from .admissible import admissible_set as admissible_set
from .animation import animation as animation
from .chart import work_precision as work_precision
from .comparison import comparison as comparison
from .fits import fit as fit
from .montecarlo import monte_carlo as monte_carlo
from .motions import motion as motion, phase_portrait as phase_portrait
from .rheology import forces as forces, rheologies as rheologies
from .rocking import rocking_dispersion as rocking_dispersion, rocking_outcomes as rocking_outcomes
from .stability import stability_map as stability_map, stability_pairs as stability_pairs
from .validity import advice as advice, validity_map as validity_map
