"""How a motion is computed: a word, or an object with options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

BALL = ji.System(ji.Column([1.0]), gravity=True)
HARD = ji.Newton(0.8)
SOFT = ji.Compliant(ji.LinearSpring(1e4))


def drop(law=HARD, system=BALL, **options):
    return ji.simulate(
        system, law, [0.1], [0.0], 0.5, samples=3, max_events=20, **options
    )


@pytest.mark.parametrize(
    ("law", "word", "method"),
    [
        (HARD, {}, ji.EventDriven()),
        (HARD, {"method": "events"}, ji.EventDriven()),
        (HARD, {"method": "time_stepping", "step": 0.01}, ji.TimeStepping(0.01)),
        pytest.param(
            SOFT,
            {"method": "contact_forces"},
            ji.ContactForces(),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_word_is_an_object_with_its_defaults(law, word, method):
    a, b = drop(law, **word), drop(law, method=method)
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.slow
def test_options_act():
    fine, coarse = (drop(method=ji.EventDriven(slow=x)) for x in (1e-6, 1.0))
    assert int(coarse.events.count) < int(fine.events.count)
    assert drop(method=ji.EventDriven(max_steps=1)).to_dict()["status"] == "max_steps"
    apart = drop(SOFT, method=ji.ContactForces(until_apart=True))
    assert bool(jnp.isnan(apart.q[-1, 0]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ji.EventDriven(rtol=0.0), r"`rtol` must lie in \(0"),
        (lambda: ji.EventDriven(atol=-1.0), r"`atol` must lie in \(0"),
        (lambda: ji.EventDriven(slow=2.0), r"`slow` must lie in \[0, 1\]"),
        (lambda: ji.EventDriven(closed_below=0.0), r"`closed_below` must lie in \(0"),
        (lambda: ji.EventDriven(max_steps=0), "`max_steps` must be an int >= 1"),
        (lambda: ji.ContactForces(rtol=np.nan), r"`rtol` must lie in \(0"),
        (lambda: ji.TimeStepping(0.0), r"`step` must lie in \(0"),
        (lambda: ji.TimeStepping(None), "`step` must be a number"),
        (
            lambda: drop(step=0.1, method=ji.EventDriven()),
            "`step` must be left out where",
        ),
        (
            lambda: drop(step=0.1, method=ji.TimeStepping(0.1)),
            "`step` must be left out where",
        ),
        (
            lambda: drop(step=0.1),
            "`step` must be left out but for method='time_stepping'",
        ),
        (
            lambda: drop(method="event"),
            r"`method` must be one of .* Did you mean events\?",
        ),
        (lambda: ji.System(ji.Column([1.0]), friction=-0.1), "`friction` must lie in"),
        (
            lambda: drop(system=ji.System(ji.Column([1.0]), friction=0.3)),
            "`system` must have tangents for the friction of its contacts",
        ),
        (
            lambda: drop(
                law=ji.Moreau(0.5, friction=0.3), system=ji.System(ji.Column([1.0]))
            ),
            "`system` must have tangents for the friction of its law",
        ),
        (
            lambda: drop(
                law=ji.Moreau(0.5, friction=0.3),
                system=ji.System(lambda q: q, [1.0], tangent_function=lambda q: None),
            ),
            "`system` must have tangents for the friction of its law",
        ),
        (
            lambda: ji.System(ji.Column([1.0]), gravity=-9.81),
            "`gravity` must be >= 0, the size",
        ),
    ],
)
def test_bad_options_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ji.EventDriven(until_apart=True),
            "unexpected keyword argument 'until_apart'",
        ),
        (lambda: ji.ContactForces(slow=0.1), "unexpected keyword argument 'slow'"),
        (lambda: ji.TimeStepping(0.1, rtol=1e-6), "unexpected keyword argument 'rtol'"),
        (lambda: drop(rtol=1e-6), "unexpected keyword argument 'rtol'"),
        (lambda: drop(method=ji.EventDriven), "`method` must be one of events"),
        (lambda: drop(method=None), "`method` must be one of events"),
        (
            lambda: drop(method=ji.ContactForces()),
            r"`law` must use gaps .* \(Compliant\)",
        ),
    ],
)
def test_options_of_another_method_are_refused(make, message):
    with pytest.raises(TypeError, match=message):
        make()


def test_a_motion_may_begin_later():
    late = ji.simulate(BALL, HARD, [0.1], [0.0], (2.0, 2.5), samples=3, max_events=20)
    np.testing.assert_allclose(late.time, [2.0, 2.25, 2.5])
    np.testing.assert_allclose(late.q, drop().q, atol=1e-12)
