"""Numbers as reports print them: zeros, signs and what is not finite."""

import numpy as np
import pytest

from jimpact.tools.checks import in_numbers
from jimpact.tools.records import formatted


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([np.inf, 2.5, -3.0], "(inf, 2.5, -3)"),
        ([-np.inf, 1.0, 1e-13], "(-inf, 1, 0)"),
        ([np.nan, 4.0, -2e-13], "(nan, 4, 0)"),
        ([np.nan, np.inf], "(nan, inf)"),
        ([1.0, 2e-12], "(1, 2e-12)"),
        ([], "()"),
    ],
)
def test_only_rounding_beside_the_largest_finite_number_is_shown_as_0(values, text):
    assert in_numbers(np.array(values)) == text


@pytest.mark.parametrize(
    "form", ["4.1f", "5.2f", "<7.1f", ">7.1f", "^7.1f", "08.2f", "+.1f", ".2%"]
)
def test_what_rounds_to_0_is_printed_as_0_of_the_same_width(form):
    assert formatted(-1e-6, form) == formatted(-0.0, form) == format(0.0, form)


def test_zeros_have_no_sign_in_exponent_forms_and_small_numbers_keep_theirs():
    assert formatted(-0.0, ".1e") == "0.0e+00"
    assert formatted(np.float64(-0.0), "10.1E") == "   0.0E+00"
    assert formatted(-4e-9, ".1e") == "-4.0e-09"
    assert formatted(-4e-10, "G") == "-4E-10"
    assert formatted(-np.inf, "F") == "-INF"
    assert formatted(-3, "4d") == "  -3"
