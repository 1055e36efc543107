"""Public names of `ji.data` and where they live."""

from .engines import ENGINE_SCENES as ENGINE_SCENES, engine_impacts as engine_impacts
from .measured import (
    cube_impacts as cube_impacts,
    ellipse_impacts as ellipse_impacts,
    square_drops as square_drops,
    square_impacts as square_impacts,
)
