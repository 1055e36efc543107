"""Derivatives of impacts: both modes, every order, any number of parameters, and who asks for one."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reverse_cases import both_modes

import jimpact as ji

CHAIN, AT = ji.chain([1.0, 2.0, 3.0]), jnp.array([0.9, 0.8, 1.0, 0.5])


def last_velocity(adjoint, **options):
    """v+ of the last ball as a function of both restitutions and both stiffnesses."""

    def of(p):
        law = ji.LZB(p[:2], p[2:], 1.5, adjoint=adjoint, **options)
        return ji.impact(law, CHAIN, [1.0, 0.0, 0.0]).velocity[2]

    return of


def test_the_package_asks_nothing_of_the_inside_of_jax():
    """What JAX may change with any release: private modules, interpreters, extensions.

    But for what JAX documents of operations of one's own, in one file.
    """
    operations = {"jax.extend.core", "jax.extend.core.Primitive", "jax.interpreters"}
    operations |= {"jax.interpreters.batching", "jax.interpreters.mlir"}
    for path in Path(ji.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom):
                names += [f"{node.module}.{name.name}" for name in node.names]
            elif isinstance(node, ast.Import):
                names = [name.name for name in node.names]
            elif isinstance(node, ast.Attribute):
                names = [ast.unparse(node)]
            for name in names:
                if path.name == "derive.py" and name in operations:
                    continue
                assert not name.startswith(
                    ("jax._src", "jax.interpreters", "jax.extend")
                ), path


def test_an_adjoint_that_does_not_exist():
    with pytest.raises(ValueError, match=r"`adjoint` .*checkpoints.*'chekpoints'"):
        ji.LZB(0.9, adjoint="chekpoints")


@pytest.mark.release
def test_adjoints_agree_where_they_have_a_mode():
    exact = jax.jit(jax.jacfwd(last_velocity("jacobian")))(AT)
    for mode, adjoint in ((jax.grad, "jacobian"), (jax.jacfwd, "forward")):
        np.testing.assert_allclose(
            jax.jit(mode(last_velocity(adjoint)))(AT), exact, rtol=1e-8
        )
    twice = [jax.jit(f)(AT) for f in (
        jax.hessian(last_velocity("jacobian")),
        jax.jacfwd(jax.jacfwd(last_velocity("forward"))),
    )]  # fmt: skip
    np.testing.assert_allclose(twice[1], twice[0], rtol=1e-7, atol=1e-10)
    remembered = jax.checkpoint(lambda p: jax.lax.scan(
        lambda s, _: (last_velocity("jacobian")(s * p), None), 1.0, None, 2)[0])  # fmt: skip
    along = jax.jvp(remembered, (AT,), (jnp.ones(4),))[1]
    assert float(jnp.sum(jax.jit(jax.grad(remembered))(AT))) == pytest.approx(
        float(along), rel=1e-8
    )


@pytest.mark.slow
def test_checkpoints_have_the_reverse_mode_only():
    exact = jax.jit(jax.jacfwd(last_velocity("jacobian")))(AT)
    checkpoints = last_velocity("checkpoints")
    np.testing.assert_allclose(jax.jit(jax.grad(checkpoints))(AT), exact, rtol=1e-8)
    with pytest.raises(TypeError, match="`adjoint` must be 'jacobian'"):
        jax.jacfwd(checkpoints)(AT)
    with pytest.raises(TypeError):
        jax.jit(jax.jacfwd(checkpoints))(AT)


@pytest.mark.release
def test_impacts_of_more_than_a_thousand_steps():
    """Fifty balls; six with a wall, and their second derivative forward over reverse.

    Programs that round differently do not take the same steps through a thousand events: each is
    right to the law's rtol, 1e-8.
    """
    v = jnp.zeros(50).at[0].set(1.0)
    e = jnp.array([0.9])
    for adjoint in ("jacobian", "checkpoints"):
        forward, reverse = both_modes(
            lambda e, k, a="jacobian": ji.LZB(e, k, 1.5, adjoint=a),
            ji.chain([1.0] * 50), v, e, jnp.ones(49), adjoint,
        )  # fmt: skip
        assert abs(float(forward[0])) > 0.1
        np.testing.assert_allclose(reverse, forward, rtol=1e-7)
    wall = ji.chain([1.0] * 6, wall=True)

    def speed(e):
        return ji.impact(ji.LZB(e, jnp.ones(6), 1.3), wall, jnp.eye(6)[0]).velocity[5]

    twice = [jax.jit(mode(jax.grad(speed))) for mode in (jax.jacfwd, jax.grad)]
    exact = jax.jit(jax.jacfwd(jax.jacfwd(speed)))(0.9)
    for second in twice:
        np.testing.assert_allclose(second(0.9), exact, rtol=1e-7)
