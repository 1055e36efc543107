"""Findings of a fit as data: what kind, which shots, which numbers, and the sentences
for them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

# Kinds of findings, and what each says.
KINDS = {
    # of the data
    "units": "velocities after differ from those before by the factor of a wrong unit",
    "momentum": "shots break a momentum that the contacts cannot change",
    "energy_gain": "shots gain energy",
    "no_approach": "no contact approaches in these shots",
    "copies": "shots are one, several times or scaled",
    "left_out": "shots whose impacts fail, or whose derivatives cannot be used",
    "unknown_correction": (
        "shots corrected in a way that is not known, with errors of v-"
    ),
    # of the law
    "lack_of_fit": "a test rejects the law",
    "law_fails": "the fitted law ends with a failure, or its values are not finite",
    "prior": "the data contradict a prior",
    "suspicious": "shots that the others do not expect",
    # of the search
    "kink": "the minimum is a kink of the law",
    "not_converged": "the search has not ended",
    "lower_minimum": "a profile found a lower minimum",
    "several_minima": "different minima fit equally well",
    "undetermined": "fewer parameters are determined than fitted",
    "at_bound": "a parameter is at its bound",
    "matrix_edge": "a restitution matrix ends at the edge of the admissible ones",
    "matrix_free": "nothing keeps a restitution matrix consistent",
    # of the errors
    "bent": "the law bends within the errors of v-",
    "mixed_units": "m/s and rad/s without sigma",
    "unknown_errors": "the data do not show their noise",
    "single_precision": "computed in float32",
}


@dataclass(frozen=True)
class Finding:
    """One result of a test of data or fit: its kind, the sentence for it, shots,
    numbers.

    `kind`, a key of `KINDS`, and `numbers` by name are for programs; `line` is for the
    report, `reservation` for a sentence that quotes the fit ('': nothing); `shots` are
    labels.
    """

    kind: str
    line: str
    reservation: str = ""
    shots: tuple[str, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)


def findings(
    checks: Sequence[Callable[[Any], Iterator[Finding]]], judged: Any
) -> list[Finding]:
    """All findings of these checks, in their order; `judged` is the argument of each
    check.
    """
    return [found for check in checks for found in check(judged)]


def of_sentences(
    lines: Sequence[str], reservations: Sequence[str]
) -> tuple[Finding, ...]:
    """Findings from the sentences of a file of a build before 0.2, which had no kinds.

    `lines` are those of the report, `reservations` those to quote with the values.
    """
    starts = {"Lack of fit": "lack_of_fit", "The fitted law fails": "law_fails"}
    contain = {
        "minima fit equally well": "several_minima",
        "conservation of momentum": "momentum",
    }

    def kind(line: str) -> str:
        """The kind of a sentence by its words; '' for kinds that no other result
        depends on.
        """
        kinds = [k for words, k in starts.items() if line.startswith(words)]
        kinds += [k for words, k in contain.items() if words in line]
        return next(iter(kinds), "")

    quoted = (Finding("", "", reservation) for reservation in reservations)
    return (*(Finding(kind(line), line) for line in lines), *quoted)
