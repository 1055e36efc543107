"""Public names of `ji.data` and where they live."""

from .measured import (
    cube_impacts as cube_impacts,
    ellipse_impacts as ellipse_impacts,
    square_drops as square_drops,
    square_impacts as square_impacts,
)
