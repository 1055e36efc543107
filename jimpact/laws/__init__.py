"""Our laws, entered in the registry: one row a law."""

from jimpact.law import EVERY_PROPERTY, REGISTRY, Row, register
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant, make_compliant
from jimpact.laws.kinematic import Moreau, Newton, RestitutionMatrix
from jimpact.laws.lzb import LZB
from jimpact.laws.poisson import Poisson

__all__ = ["REGISTRY", "Row", "register"]

BROGLIATO = """@book{brogliato2016,
  author = {Brogliato, Bernard}, title = {Nonsmooth Mechanics: Models, Dynamics and Control},
  edition = {3}, publisher = {Springer}, year = {2016}, doi = {10.1007/978-3-319-28664-8}}"""


LIU = """@article{liu2008,
  author = {Liu, Caishan and Zhao, Zhen and Brogliato, Bernard},
  title = {Frictionless multiple impacts in multibody systems. I. Theoretical framework},
  journal = {Proceedings of the Royal Society A}, volume = {464}, pages = {3193--3211},
  year = {2008}, doi = {10.1098/rspa.2008.0078}}"""

MOREAU = """@incollection{moreau1988,
  author = {Moreau, Jean Jacques}, title = {Unilateral contact and dry friction in finite freedom
  dynamics}, booktitle = {Nonsmooth Mechanics and Applications}, publisher = {Springer},
  pages = {1--82}, year = {1988}, doi = {10.1007/978-3-7091-2624-0_1}}"""

PFEIFFER = """@book{pfeiffer1996,
  author = {Pfeiffer, Friedrich and Glocker, Christoph},
  title = {Multibody Dynamics with Unilateral Contacts}, publisher = {Wiley}, year = {1996}}"""

TOWNE = """@article{towne1977,
  author = {Towne, Dudley H. and Hadlock, Charles R.},
  title = {One-dimensional collisions and {C}hebyshev polynomials},
  journal = {American Journal of Physics}, volume = {45}, pages = {255--259}, year = {1977}}"""

register(
    "lzb",
    LZB,
    summary="energetic restitution, distributed by the stiffness ratios",
    right_when="local, rate-independent contacts with known stiffness ratios (touching beads)",
    fails_when="bulk waves (rods), viscous contacts, gaps that must re-close, adhesion",
    promises=EVERY_PROPERTY,
    source="Liu, Zhao and Brogliato (2008); Brogliato (2016), (6.67)-(6.73)",
    bibtex=LIU,
)
register(
    "newton",
    Newton,
    summary="gamma+ = -e gamma- at every contact",
    right_when="one contact, or contacts with kinetic angle pi/2",
    fails_when="contacts at rest (no dispersion), kinetic angles above pi/2 (p < 0)",
    promises={"velocity_scaling", "mass_scaling"},
    source="Brogliato, Nonsmooth Mechanics (2016), (6.41) with diagonal E",
    bibtex=BROGLIATO,
)
register(
    "moreau",
    Moreau,
    summary="0 <= gamma+ + e gamma- and p >= 0, one of them zero",
    right_when="stiffness rising along the chain, plastic or decoupled contacts",
    fails_when="chains at rest (no dispersion), contacts that separate before the impact",
    promises={"impulse_sign", "velocity_scaling", "mass_scaling"},
    source="Moreau (1988); Brogliato (2016), (6.51)",
    bibtex=MOREAU,
)
register(
    "poisson",
    Poisson,
    summary="every contact returns e times the impulse of its compression",
    right_when="contacts that reach their largest compression together",
    fails_when="dispersion in chains (would need e > 1), unequal e (may gain energy)",
    promises=EVERY_PROPERTY - {"energy"},
    source="Pfeiffer and Glocker (1996); Brogliato (2016), (6.76)-(6.79)",
    bibtex=PFEIFFER,
)
register(
    "binary",
    Binary,
    summary="pair collisions one after another, in a given order",
    right_when="gaps well above the indentation, stiffness falling along the chain",
    fails_when="touching equal balls (the striker never reverses), ties: order dependent",
    promises=EVERY_PROPERTY,
    source="Brogliato (2016), (6.3)-(6.4), (6.13), (6.17)-(6.21); Towne and Hadlock (1977)",
    bibtex=TOWNE,
)
register(
    "restitution_matrix",
    RestitutionMatrix,
    summary="qn+ = -E qn-: a full matrix of coefficients, tangential blocks included",
    right_when="E is known or fitted for this very system and kind of approach; rocking",
    fails_when="other masses or geometry than E was found for; E outside the admissible set",
    promises={"velocity_scaling", "mass_scaling"},
    source="Brogliato, Nonsmooth Mechanics (2016), (6.42)-(6.48), (6.53)",
    bibtex=BROGLIATO,
)
register(
    "compliant",
    Compliant,
    summary="springs and dampers between bodies with real gaps",
    right_when="gaps near the indentation, viscous contacts, known absolute stiffness",
    fails_when="stiffness and damping unknown in SI units; geometry that turns during contact",
    promises={"impulse_sign", "gap_velocity_sign", "energy"},
    source="Brogliato (2016), (6.14)-(6.16); forces as cited in `rheology.py`",
    bibtex=BROGLIATO,
    make=make_compliant,
)
