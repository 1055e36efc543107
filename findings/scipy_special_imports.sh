#!/usr/bin/env bash
# scipy.special: importing it imports a compiler of Fortran wrappers and two test frameworks.
#
# Guess: `import scipy.special` loads special functions and what they call.
# Seen (scipy 1.17.1, numpy 2.4.6): it loads numpy.f2py, numpy.testing, unittest and pydoc, too, by
# `from numpy import *` in its layer for other array libraries: numpy imports those modules when their
# names are asked for.
# It costs: a command that needs one quantile of Student's t starts a tenth of a second later, two
# thirds of that for f2py.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "scipy==1.17.1" "numpy==2.4.6"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
import sys

import numpy

unasked = ("numpy.f2py", "numpy.testing", "unittest", "pydoc")
before = [name for name in unasked if name in sys.modules]
import scipy.special

after = [name for name in unasked if name in sys.modules]
print("numpy", numpy.__version__, "has loaded", before, "- scipy", scipy.__version__, "then", after)
assert before == [], "the behaviour has changed"
assert after == list(unasked), "the behaviour has changed"
PYTHON
