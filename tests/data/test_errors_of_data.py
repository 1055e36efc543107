"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import pytest
from refusals import refused

import jimpact as ji

REFUSED = [
    (lambda: ji.data.engine_impacts("bulet"), "'bulet'. Did you mean bullet"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_input(call, message):
    refused(call, message)
