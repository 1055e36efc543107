"""What motions and calibration refuse of contacts with a bounded force."""

import pytest
from refusals import argument

import jimpact as ji


def test_what_motions_and_calibration_refuse():
    force = ji.ElastoPlastic(1.0, 0.2)
    with pytest.raises(TypeError, match=argument("law")):
        ji.simulate(
            *(
                ji.System(ji.Column([1.0]), gravity=True),
                ji.Compliant(force),
                [1.0],
                [0.0],
                1.0,
            ),
            method="contact_forces",
        )
    with pytest.raises(TypeError, match=argument("force")):
        ji.calibrate(force, 0.9, 1.0, 1.0)
