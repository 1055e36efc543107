"""Names of the bodies for those who write rooms."""

from .assembly import Bodies as Bodies
from .base import (
    CLOSED_BELOW as CLOSED_BELOW,
    STANDARD_GRAVITY as STANDARD_GRAVITY,
    LinearPotential as LinearPotential,
    Potential as Potential,
    check_penetration as check_penetration,
    check_range as check_range,
    projected as projected,
    rate_of as rate_of,
    split_name as split_name,
)
from .closed_pairs import (
    ActivePairs as ActivePairs,
    block as block,
    listed_pairs as listed_pairs,
    over_blocks as over_blocks,
    with_block as with_block,
)
from .functions import FunctionBody as FunctionBody
from .particles import Column as Column, Corner as Corner
from .pendulums import PendulumCradle as PendulumCradle
from .rigid import (
    place_of as place_of,
    quaternion_of as quaternion_of,
    turning_of as turning_of,
)
from .shapes import (
    Block as Block,
    Box as Box,
    Coin as Coin,
    Dimer as Dimer,
    Disc as Disc,
    Polygon as Polygon,
    SpatialDimer as SpatialDimer,
    Sphere as Sphere,
)
from .study import body_of as body_of
