"""Names of the impact dynamics for those who write rooms."""

from .contact_flow import Phase as Phase, power as power
from .impact_dynamics import (
    Dynamics as Dynamics,
    evaluate as evaluate,
    first_indentation as first_indentation,
)
from .tangential_spring import QUARTER as QUARTER, Slide as Slide
