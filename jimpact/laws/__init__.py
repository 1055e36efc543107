"""The registry of laws: one row a law. The CLI, the contract tests and the charts read it."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jimpact.laws.base import Law
from jimpact.laws.binary import Binary
from jimpact.laws.compliant import Compliant, make_compliant
from jimpact.laws.lzb import LZB
from jimpact.laws.moreau import Moreau
from jimpact.laws.newton import Newton
from jimpact.laws.poisson import Poisson
from jimpact.laws.restitution_matrix import RestitutionMatrix


class Row(NamedTuple):
    """A law, what it promises on every scene, and where it comes from.

    `promises` names the properties the contract suite holds it to; where the law breaks another
    one of them, its status must say so.
    """

    law: type[Law]
    parameters: tuple[str, ...]
    summary: str
    right_when: str
    fails_when: str
    promises: frozenset[str]
    source: str
    bibtex: str
    make: Callable[..., Law] | None = None  # from `parameters`, where the class takes others

    def build(self, **parameters: Any) -> Law:
        """The law with these parameters."""
        return (self.make or self.law)(**parameters)


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

EVERY_PROPERTY = frozenset(
    {"impulse_sign", "gap_velocity_sign", "energy", "velocity_scaling", "mass_scaling"}
)

REGISTRY: dict[str, Row] = {
    "lzb": Row(
        law=LZB,
        parameters=("restitution", "stiffness", "exponent", "initial_energy"),
        summary="energetic restitution, distributed by the stiffness ratios",
        right_when="local, rate-independent contacts with known stiffness ratios (touching beads)",
        fails_when="bulk waves (rods), viscous contacts, gaps that must re-close, adhesion",
        promises=EVERY_PROPERTY,
        source="Liu, Zhao and Brogliato (2008); Brogliato (2016), (6.67)-(6.73)",
        bibtex=LIU,
    ),
    "newton": Row(
        law=Newton,
        parameters=("restitution",),
        summary="gamma+ = -e gamma- at every contact",
        right_when="one contact, or contacts with kinetic angle pi/2",
        fails_when="contacts at rest (no dispersion), kinetic angles above pi/2 (p < 0)",
        promises=frozenset({"velocity_scaling", "mass_scaling"}),
        source="Brogliato, Nonsmooth Mechanics (2016), (6.41) with diagonal E",
        bibtex=BROGLIATO,
    ),
    "moreau": Row(
        law=Moreau,
        parameters=("restitution",),
        summary="0 <= gamma+ + e gamma- and p >= 0, one of them zero",
        right_when="stiffness rising along the chain, plastic or decoupled contacts",
        fails_when="chains at rest (no dispersion), contacts that separate before the impact",
        promises=frozenset({"impulse_sign", "velocity_scaling", "mass_scaling"}),
        source="Moreau (1988); Brogliato (2016), (6.51)",
        bibtex=MOREAU,
    ),
    "poisson": Row(
        law=Poisson,
        parameters=("restitution",),
        summary="every contact returns e times the impulse of its compression",
        right_when="contacts that reach their largest compression together",
        fails_when="dispersion in chains (would need e > 1), unequal e (may gain energy)",
        promises=EVERY_PROPERTY - {"energy"},
        source="Pfeiffer and Glocker (1996); Brogliato (2016), (6.76)-(6.79)",
        bibtex=PFEIFFER,
    ),
    "binary": Row(
        law=Binary,
        parameters=("restitution",),
        summary="pair collisions one after another, in a given order",
        right_when="gaps well above the indentation, stiffness falling along the chain",
        fails_when="touching equal balls (the striker never reverses), ties: order dependent",
        promises=EVERY_PROPERTY,
        source="Brogliato (2016), (6.3)-(6.4), (6.13), (6.17)-(6.21); Towne and Hadlock (1977)",
        bibtex=TOWNE,
    ),
    "restitution_matrix": Row(
        law=RestitutionMatrix,
        parameters=("matrix",),
        summary="qn+ = -E qn-: a full matrix of coefficients, tangential blocks included",
        right_when="E is known or fitted for this very system and kind of approach; rocking",
        fails_when="other masses or geometry than E was found for; E outside the admissible set",
        promises=frozenset({"velocity_scaling", "mass_scaling"}),
        source="Brogliato, Nonsmooth Mechanics (2016), (6.42)-(6.48), (6.53)",
        bibtex=BROGLIATO,
    ),
    "compliant": Row(
        law=Compliant,
        parameters=("stiffness", "exponent", "restitution", "rheology", "damping"),
        summary="springs and dampers between bodies with real gaps",
        right_when="gaps near the indentation, viscous contacts, known absolute stiffness",
        fails_when="stiffness and damping unknown in SI units; geometry that turns during contact",
        promises=frozenset({"impulse_sign", "gap_velocity_sign", "energy"}),
        source="Brogliato (2016), (6.14)-(6.16); forces as cited in `rheology.py`",
        bibtex=BROGLIATO,
        make=make_compliant,
    ),
}
