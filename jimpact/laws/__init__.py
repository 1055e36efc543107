"""The registry of laws: one row a law. The CLI, the contract tests and the charts read it."""

from typing import NamedTuple

from jimpact.laws.base import Law
from jimpact.laws.lzb import LZB
from jimpact.laws.newton import Newton


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


BROGLIATO = """@book{brogliato2016,
  author = {Brogliato, Bernard}, title = {Nonsmooth Mechanics: Models, Dynamics and Control},
  edition = {3}, publisher = {Springer}, year = {2016}, doi = {10.1007/978-3-319-28664-8}}"""


LIU = """@article{liu2008,
  author = {Liu, Caishan and Zhao, Zhen and Brogliato, Bernard},
  title = {Frictionless multiple impacts in multibody systems. I. Theoretical framework},
  journal = {Proceedings of the Royal Society A}, volume = {464}, pages = {3193--3211},
  year = {2008}, doi = {10.1098/rspa.2008.0078}}"""

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
}
