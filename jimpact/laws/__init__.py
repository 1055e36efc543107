"""Our laws, entered in the registry: one row a law."""

from importlib.resources import files

from jimpact.core.registry import EVERY_PROPERTY, REGISTRY, Row, register
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant, make_compliant
from jimpact.laws.gap_scale import DELTA_C, gap_scale
from jimpact.laws.histories import History
from jimpact.laws.impulse_correlation import ImpulseCorrelation, interval
from jimpact.laws.kinematic import Moreau, Newton, RestitutionMatrix
from jimpact.laws.lzb import LZB, default_rtol
from jimpact.laws.poisson import Poisson
from jimpact.laws.routh import Routh
from jimpact.laws.velocity_dependent import VelocityDependent, make_velocity_dependent

__all__ = [
    "DELTA_C",
    "REGISTRY",
    "History",
    "Row",
    "default_rtol",
    "gap_scale",
    "interval",
    "register",
]

# entries by key: each begins @kind{key,
_BIBTEX = {
    entry[entry.index("{") + 1 : entry.index(",")]: entry
    for entry in (files("jimpact") / "data" / "laws.bib")
    .read_text()
    .strip()
    .split("\n\n")
}

register(
    "lzb",
    LZB,
    summary="energetic restitution, distributed by the stiffness ratios",
    right_when=(
        "local, rate-independent contacts with known stiffness ratios (touching beads)"
    ),
    fails_when="bulk waves (rods), viscous contacts, gaps that must re-close, adhesion",
    promises=EVERY_PROPERTY,
    source="Liu, Zhao and Brogliato (2008); Brogliato (2016), (6.67)-(6.73)",
    bibtex=_BIBTEX["liu2008"],
    simplicity=5,
)
register(
    "newton",
    Newton,
    summary="gamma+ = -e gamma- at every contact",
    right_when="one contact, or contacts with kinetic angle pi/2",
    fails_when="contacts at rest (no dispersion), kinetic angles above pi/2 (p < 0)",
    promises={"velocity_scaling", "mass_scaling"},
    source="Brogliato, Nonsmooth Mechanics (2016), (6.44) with diagonal E",
    bibtex=_BIBTEX["brogliato2016"],
    simplicity=1,
)
register(
    "moreau",
    Moreau,
    summary="0 <= gamma+ + e gamma- and p >= 0, one of them zero",
    right_when="stiffness rising along the chain, plastic or decoupled contacts",
    fails_when=(
        "chains at rest (no dispersion), contacts that separate before the impact"
    ),
    promises={"impulse_sign", "velocity_scaling", "mass_scaling"},
    source="Moreau (1988); Brogliato (2016), (6.51)",
    bibtex=_BIBTEX["moreau1988"],
    simplicity=2,
)
register(
    "poisson",
    Poisson,
    summary="every contact returns e times the impulse of its compression",
    right_when="contacts that reach their largest compression together",
    fails_when="dispersion in chains: it would need e > 1, which may gain energy",
    promises=EVERY_PROPERTY - {"energy"},
    source="Pfeiffer and Glocker (1996); Brogliato (2016), (6.76)-(6.79)",
    bibtex=_BIBTEX["pfeiffer1996"],
    simplicity=3,
)
register(
    "binary",
    Binary,
    summary="pair collisions one after another, in a given order",
    right_when="gaps well above the indentation, stiffness falling along the chain",
    fails_when="touching equal balls (the striker never reverses), collisions at the "
    "same instant, whose order then decides",
    promises=EVERY_PROPERTY,
    source=(
        "Brogliato (2016), (6.3)-(6.4), (6.13), (6.17)-(6.21); Towne and Hadlock (1977)"
    ),
    bibtex=_BIBTEX["towne1977"],
    simplicity=4,
)
register(
    "restitution_matrix",
    RestitutionMatrix,
    summary="qn+ = -E qn-: a full matrix of coefficients, tangential blocks included",
    right_when=(
        "E is known or fitted for this very system and kind of approach; rocking"
    ),
    fails_when=(
        "other masses or geometry than E was found for; E outside the admissible set"
    ),
    promises={"velocity_scaling", "mass_scaling"},
    source="Brogliato, Nonsmooth Mechanics (2016), (6.42)-(6.48), (6.53)",
    bibtex=_BIBTEX["brogliato2016"],
)
register(
    "compliant",
    Compliant,
    summary="springs and dampers between bodies with real gaps",
    right_when="gaps near the indentation, viscous contacts, known absolute stiffness",
    fails_when=(
        "stiffness and damping unknown in SI units; geometry that turns during contact"
    ),
    promises={"impulse_sign", "gap_velocity_sign", "energy"},
    source="Brogliato (2016), (6.14)-(6.16); forces as cited in `jimpact.laws.forces`",
    bibtex=_BIBTEX["brogliato2016"],
    simplicity=6,
    make=make_compliant,
)

register(
    "routh",
    Routh,
    summary=(
        "impulses grow in constant ratios, one energetic e for the work of all contacts"
    ),
    right_when="contacts that all approach, alike in material",
    fails_when=(
        "chains at rest (no dispersion), unequal e, contacts that separate beforehand"
    ),
    promises={"impulse_sign", "energy", "velocity_scaling", "mass_scaling"},
    source="Bowling and Rodriguez; Brogliato (2016), 6.4.3",
    bibtex=_BIBTEX["routh1897"],
)
register(
    "impulse_correlation",
    ImpulseCorrelation,
    summary="contacts beside a collision get a constant multiple of its impulse",
    right_when="a scene and an approach for which the ratio was measured or fitted",
    fails_when=(
        "another approach or stiffness: impulse ratios vary; both sides "
        "approach at once"
    ),
    promises={"velocity_scaling", "mass_scaling", "energy", "impulse_sign"},
    source="Ceanga and Hurmuzlu (2001); Brogliato (2016), 6.4.3",
    bibtex=_BIBTEX["ceanga2001"],
)
register(
    "velocity_dependent",
    VelocityDependent,
    summary=(
        "a law by name (`base`) whose e falls with the speed, and is 1 below the "
        "yield speed"
    ),
    right_when="shots of very different speeds, metals above their yield",
    fails_when="all shots equally fast: e and its exponent cannot be distinguished",
    promises=(),  # those of its base, but scaling with the velocity
    source=(
        "Brogliato, Nonsmooth Mechanics (2016), 6.3.1; Johnson, Contact Mechanics "
        "(1985), 11.5"
    ),
    bibtex=_BIBTEX["johnson1985"],
    make=make_velocity_dependent,
)
