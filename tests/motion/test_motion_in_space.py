"""Motions with friction in space, event by event: closed forms and time stepping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_in_space_cases import BRICK, SYSTEM, thrown

import jimpact as ji


@pytest.mark.release
def test_derivatives_of_a_thrown_brick_agree_with_differences():
    """Both modes, through impacts, accumulations and slip that turns until it ends; mu and e last.

    Four corners hit at .168 s. From then on friction has several outcomes, of which the solver takes
    one: it moves by 5e-9 from one input to the next. One corner more or less that comes to rest
    with the others moved the brick by 1.4e-5.
    """
    q0 = BRICK.at([0.0, 0.0, 0.1], [0.99, np.sqrt(1 - 0.99**2), 0.0, 0.0])
    x, h = jnp.array([0.5, 0.2, 0, 1.0, 2.0, 5.0, 0.3, 0.2]), 1e-5

    def places(x):
        law = ji.Moreau(x[7], friction=x[6])
        motion = ji.simulate(
            SYSTEM, law, q0, x[:6], 3 * 0.1679, samples=4, max_events=40
        )
        return motion.q[jnp.array([1, 3])]

    def differences(a, b):
        return jnp.stack(
            [places(x + a * e) - places(x + b * e) for e in jnp.eye(8)], axis=2
        )

    slope, forward = jax.jacfwd(places)(x), differences(h, 0)
    size = float(jnp.abs(slope[0]).max())
    central = differences(h, -h) / (2 * h)
    np.testing.assert_allclose(slope[0], central[0], atol=1e-5 * size)
    np.testing.assert_allclose(h * slope[1], forward[1], atol=5e-8)
    np.testing.assert_allclose(
        jax.grad(lambda x: places(x)[1].sum())(x), slope[1].sum(axis=0), atol=1e-6
    )


@pytest.mark.release
def test_a_spinning_box_slides_as_by_time_stepping():
    """Slip of four corners turns until all stop at once; the error falls with the step."""
    q0, v0 = BRICK.touching(), np.array([0.5, 0.2, 0, 0, 0, 10.0])
    motion = thrown(q0, v0, 0.6)
    assert ji.STATUS[int(motion.status)].name == "ok"
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-12)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-11)
    wrong = [
        np.abs(
            thrown(q0, v0, 0.6, method="time_stepping", step=h).q[-1] - motion.q[-1]
        ).max()
        for h in (1e-3, 1e-4)
    ]
    assert wrong[1] < 1e-4
    assert wrong[1] < 0.3 * wrong[0]


@pytest.mark.release
def test_a_thrown_brick_comes_to_rest_on_a_face():
    motion = thrown(
        BRICK.at([0.0, 0.0, 0.3], [0.8, 0.6, 0.0, 0.0]),
        [0.5, 0.2, 0.0, 3.0, 12.0, 5.0],
        0.6,
    )
    assert ji.STATUS[int(motion.status)].name == "ok"
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-11)
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-10)
    np.testing.assert_allclose(np.sort(np.asarray(motion.gaps[-1]))[:4], 0, atol=1e-12)
    # the first impact is on one corner, at the time of free fall
    assert int(motion.events.contacts[0].sum()) == 1
    assert motion.events.tangential_impulse.shape[1] == 16


@pytest.mark.release
def test_a_coin_with_corners_is_thrown_and_comes_to_rest():
    coin = ji.Coin(0.05, 0.01, mass=0.1, corners=6)
    system = ji.System(coin, gravity=True)
    q0 = coin.at([0.0, 0.0, 0.2], [0.8, 0.6, 0.0, 0.0])
    v0, law = [0.3, 0.1, 0.0, 5.0, 3.0, 20.0], ji.Moreau(0.0, friction=0.3)
    motion = ji.simulate(system, law, q0, v0, 1.5, samples=31)
    assert ji.STATUS[int(motion.status)].name == "ok"
    assert (np.diff(motion.energy) <= 1e-12).all()
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-10)
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-9)
    np.testing.assert_allclose(np.sort(np.asarray(motion.gaps[-1]))[:6], 0, atol=1e-12)


@pytest.mark.release
def test_derivatives_at_no_displacement_take_two_terms():
    q, v = BRICK.at([0.1, 0.2, 0.3], [0.8, 0.6, 0.0, 0.0]), jnp.arange(1.0, 7.0)

    def rates(moved):
        path = lambda s: BRICK.gap_function(moved(q, s * v))  # noqa: E731
        once = lambda s: jax.jvp(path, (s,), (1.0,))[1]  # noqa: E731
        return jnp.stack(jax.jvp(once, (0.0,), (1.0,)))

    np.testing.assert_allclose(
        rates(BRICK.nearby), rates(BRICK.moved), rtol=1e-12, atol=1e-12
    )
