"""Shapes in the signatures of `numerics` and `events` are those that arrays have.

Each test starts a process in which jaxtyping and beartype check them (`tests/rules/checked_shapes.py`);
`.ci/legs shapes` runs the whole suite that way.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
PACKAGE = TESTS.parent / "jimpact"
# a case for each law, method and adjoint; a case is traced in .1 to 1 s
USUAL = (
    *(
        "lzb",
        "lzb plane",
        "lzb space",
        "lzb implicit",
        "gaps",
        "viscous",
        "newton pile",
    ),
    *(
        "moreau",
        "moreau plane",
        "moreau four corners",
        "poisson",
        "grad lzb plane",
        "vmap",
    ),
    *("grad lzb implicit", "history", "motion by events", "motion by contact forces"),
)


def checked(*cases, package=PACKAGE):
    path = os.pathsep.join(map(str, (package.parent, TESTS / "bodies")))
    command = [sys.executable, str(TESTS / "rules" / "checked_shapes.py"), *cases]
    return subprocess.run(
        command,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    "cases", [USUAL, pytest.param((), marks=pytest.mark.release)], ids=len
)
def test_arrays_have_the_shapes_that_signatures_state(cases):
    done = checked(*cases)
    assert done.returncode == 0, done.stdout + done.stderr


WRONG = [
    (
        "numerics/discs.py",
        'length: Float[Array, "m #N"]',
        'length: Float[Array, "N m"]',
        "over",
    ),
    (
        "events/run.py",
        'gamma: Float[Array, "m B"]',
        'gamma: Float[Array, "3 m B"]',
        "Rest.gamma",
    ),
    (
        "events/slip.py",
        'rate: Float[Array, "m 2 B"]',
        'rate: Float[Array, "m B"]',
        "SlipRates.rate",
    ),
    (
        "events/contact_flow.py",
        'tolerance: Float[Array, "1 B"]',
        "tolerance: float",
        "ContactFlow",
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("file", "right", "wrong", "place"), WRONG)
def test_a_wrong_annotation_is_noticed(file, right, wrong, place, tmp_path):
    """In an argument, in fields of named tuples, in a field of a flow."""
    copy = tmp_path / "jimpact"
    shutil.copytree(PACKAGE, copy)
    text = (copy / file).read_text()
    assert right in text
    (copy / file).write_text(text.replace(right, wrong, 1))
    done = checked("moreau space", "lzb", "lzb space", package=copy)
    assert done.returncode != 0
    assert place in done.stderr
