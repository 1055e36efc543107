"""A user's own law, in a user's own file: registered, it is fitted, compared, sampled and named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument

import jimpact as ji

BALLS, V = ji.chain([1.0, 1.0, 1.0]), jnp.array([1.0, 0.0, 0.0])


class Blended(ji.Law):
    """gamma+ = -e gamma- with a share taken by friction of no name; two required parameters."""

    restitution: jax.Array = ji.parameter(low=0, high=1)
    share: jax.Array = ji.parameter(low=0, high=0.5)

    def impulses(self, contact):
        change = -(1 + self.restitution * (1 - self.share)) * contact.gap_velocity
        p = jnp.linalg.solve(contact.normal_delassus, change)
        return ji.Impulses(p)


class Steel(ji.Force):
    """A Hertz contact of a modulus: a `Bistiffness`, whatever it is called."""

    modulus: jax.Array = ji.parameter(low=0, open_low=True)

    @property
    def bistiffness(self):
        return ji.Hertz(2 * self.modulus)

    def force(self, x, rate):
        return self.bistiffness.force(x, rate)


class Elastic(ji.Law):
    """Steel balls: no `LZB` and no `Compliant`, but it declares what these can do."""

    modulus: jax.Array = ji.parameter(low=0, open_low=True)
    has_history = True

    @property
    def contact_force(self):
        return Steel(self.modulus)

    def dynamics(self, contact):
        return ji.LZB(1.0, 2 * self.modulus).dynamics(contact)

    def impulses(self, contact):
        return ji.LZB(1.0, 2 * self.modulus).impulses(contact)


class Push(ji.Law):
    """It pushes at every contact, open or closed."""

    def impulses(self, contact):
        return ji.Impulses(jnp.ones_like(contact.gap_velocity))


@pytest.fixture
def registered():
    before = dict(ji.REGISTRY)
    ji.register(
        "blended", Blended, summary="for the tests", promises=("velocity_scaling",)
    )
    yield ji.REGISTRY["blended"]
    ji.REGISTRY.clear()
    ji.REGISTRY.update(before)


def test_one_method_is_enough():
    out = ji.impact(Blended(0.8, 0.25), BALLS, [1.0, 0.0, -0.5])
    same = ji.impact(ji.Newton(0.6), BALLS, [1.0, 0.0, -0.5])
    np.testing.assert_allclose(out.velocity, same.velocity, atol=1e-14)
    np.testing.assert_allclose(out.energy_change, same.energy_change, atol=1e-14)


@pytest.mark.parametrize(
    ("returned", "error", "words"),
    [
        (lambda p: p, TypeError, r"`Returning.impulses` must return `ji.Impulses`"),
        (lambda p: None, TypeError, "returns NoneType"),
        (
            lambda p: ji.Impulses(p[0]),
            ValueError,
            r"`normal` of shape \(2,\), but .* \(\)",
        ),
        (lambda p: ji.Impulses(p, p), ValueError, r"`tangential` of shape \(0,\)"),
        (
            lambda p: ji.Impulses(p, status=99),
            ValueError,
            r"`status` of a row of `ji.STATUS`",
        ),
    ],
)
def test_what_is_no_impulses_of_the_contacts_is_refused(returned, error, words):
    """An array of two numbers was taken for normal and tangential impulses."""

    class Returning(ji.Law):
        def impulses(self, contact):
            return returned(-contact.gap_velocity)

    with pytest.raises(error, match=words):
        ji.impact(Returning(), BALLS, V)


def test_what_every_law_gets_for_nothing():
    """Open contacts, nothing happening, NaN, batches, gradients, domains."""
    law = Blended(0.8, 0.25)
    scene = ji.chain([1.0] * 3, gaps=[0.0, 1e-3])
    for any_law in (law, Push()):
        gapped = ji.impact(any_law, scene, [1.0, 0.0, -0.5])
        assert float(gapped.impulse[1]) == 0.0
        assert float(gapped.velocity[2]) == -0.5
    away = ji.impact(law, BALLS, [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(away.velocity, [0.0, 0.0, 1.0])
    slope = jax.jit(jax.grad(lambda law: ji.impact(law, BALLS, V).velocity[0]))(law)
    assert type(slope) is Blended
    assert float(slope.share) != 0
    with pytest.raises(ValueError, match=argument("share", "0.7")):
        Blended(0.8, 0.7)
    with pytest.raises(ValueError, match=argument("share")):
        ji.impact(Blended(0.8, [0.1, 0.2, 0.3]), BALLS, V)


def test_a_law_without_friction_on_a_scene_with_tangents():
    """The example of `ji.Law` and docs/own_law.md: a normal law leaves tangential impulses at 0."""
    normals, tangents = (
        [[0.0, 0.0], [1.0, 1.0], [-0.5, 0.5]],
        [[1.0, 1.0], [0, 0], [0.2, 0.2]],
    )
    block = ji.Scene([1.0, 1.0, 0.1], normals, tangents)
    out = ji.impact(Blended(0.8, 0.25), block, [0.3, -1.0, 0.1])
    held = ji.impact(ji.Newton(0.6), block, [0.3, -1.0, 0.1])
    np.testing.assert_allclose(out.velocity, held.velocity, atol=1e-14)
    np.testing.assert_array_equal(out.tangential_impulse, [0.0, 0.0])
    contact = ji.Contact(
        np.eye(2), [-1.0, 0.0], tangential_block=(np.eye(2), np.eye(2), [0.1, 0])
    )
    assert contact.normal_delassus.shape == (2, 2)
    assert contact.whole_delassus.shape == (4, 4)


@pytest.mark.release
def test_it_has_a_history_and_a_gap_scale():
    """What a law or a force declares counts, not its class."""
    law, same = Elastic(0.5), ji.LZB(1.0, 1.0)
    got, held = (ji.history(x, BALLS, V, samples=8) for x in (law, same))
    np.testing.assert_allclose(got.force, held.force, atol=1e-12)
    slower = ji.VelocityDependent(ji.LZB(0.9, 1.0), speed_exponent=0.0)
    got, held = (ji.history(x, BALLS, V, samples=8) for x in (slower, ji.LZB(0.9, 1.0)))
    np.testing.assert_allclose(got.energy, held.energy, atol=1e-12)
    deep = [
        ji.theory.gap_scale(BALLS, x, V).delta
        for x in (law, same, ji.VelocityDependent(same))
    ]
    np.testing.assert_allclose(deep, np.broadcast_to(deep[1], (3, 2)), rtol=1e-12)
    with pytest.raises(TypeError, match="must have a history"):
        ji.history(Blended(0.8, 0.25), BALLS, V)
    with pytest.raises(TypeError, match="must have a `contact_force`"):
        ji.theory.gap_scale(BALLS, Blended(0.8, 0.25), V)
    hard = ji.Compliant(Steel(0.5), initial_energy=0.1)
    out = ji.impact(hard, BALLS, V)
    np.testing.assert_allclose(
        out.velocity,
        ji.impact(ji.LZB(1.0, initial_energy=0.1), BALLS, V).velocity,
        atol=1e-6,
    )


def test_a_law_around_another_one_has_its_capabilities():
    """Every member of `Law` but what it says itself: nobody lists them by hand."""
    members = {name for name in vars(ji.Law) if not name.startswith("_")}
    around = ji.VelocityDependent(ji.LZB(0.9, initial_energy=0.2), yield_speed=0.1)
    for name in members - {
        "impulses",
        "dynamics",
        "contact",
        "check",
        "contact_force",
        "joins_step",
    }:
        assert getattr(around, name) == getattr(around.law, name), name
    assert around.separable
    assert around.pads_scenes
    assert around.has_history
    assert ji.Moreau(0.5).joins_step
    assert not ji.VelocityDependent(ji.Moreau(0.5), speed_exponent=0.2).joins_step


def test_compare_and_the_registry(registered):
    """`compare` goes on for everyone once a law with a second required parameter is registered."""
    assert registered.parameters == ("restitution", "share")
    alone = ji.compare(BALLS, V, restitution=0.9)
    assert "moreau" in alone.entries
    assert "blended" not in alone.entries
    both = ji.compare(BALLS, V, restitution=0.9, share=0.1)
    same = ji.impact(Blended(0.9, 0.1), BALLS, V)
    np.testing.assert_allclose(
        both.entries["blended"].outcome.velocity, same.velocity, atol=1e-14
    )
    with pytest.raises((ValueError, TypeError)):
        ji.register("blended", Blended, promises=("beauty",))
    with pytest.raises(TypeError):
        ji.register("nothing", 3.0)


def test_it_is_fitted_within_its_domain():
    """The share .25 is found; balls that rebound less than any share lets them, end at its bound .5."""
    pre = np.array([[1.0, 0.0, -0.5], [2.0, 0.5, 0.0], [1.0, 0.2, -1.0]])

    def fitted(truth):
        post = np.array([ji.impact(truth, BALLS, v).velocity for v in pre])
        data = ji.Experiments(pre, post)
        return ji.fit(Blended(0.8, 0.1), BALLS, data, free=("share",), starts=2)

    np.testing.assert_allclose(fitted(Blended(0.8, 0.25)).value, [0.25], atol=1e-9)
    edge = fitted(ji.Newton(0.1))
    np.testing.assert_allclose(edge.value, [0.5])
    assert edge.at_bound.all()


def test_it_is_sampled():
    law = ji.RandomLaw(Blended(0.8, 0.25), share=ji.Uniform(0.1, 0.3))
    found = ji.monte_carlo(law, BALLS, [1.0, 0.0, -0.5], samples=64, chunk=64)
    assert found.count > 0
    assert found.std.min() > 0
    with pytest.raises(ValueError, match=argument("share")):
        ji.RandomLaw(Blended(0.8, 0.25), share=ji.Uniform(0.1, 0.6))


def test_it_is_named_in_a_study(registered, tmp_path, capsys):
    from command_line import main

    (tmp_path / "shots.csv").write_text(
        "pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s]\n1,0,0.2,0.8\n2,0,0.4,1.6\n"
    )
    study = tmp_path / "study.toml"
    study.write_text(
        '[scene]\nmasses_kg = [1.0, 1.0]\n[law]\nname = "blended"\nrestitution = 0.9\nshare = 0.1\n'
        '[fit]\nfree = ["restitution"]\nstarts = 2\n[data]\nfile = "shots.csv"\n'
    )
    assert main(["fit", str(study), "--json", "--out", str(tmp_path)]) == 0
    assert "0.6666" in capsys.readouterr().out  # 0.6 / (1 - 0.1)
    assert main(["laws", "--json"]) == 0
    assert "blended" in capsys.readouterr().out


def test_a_law_is_printed_with_its_numbers():
    """Also a gradient, in which what is compiled in is no derivative; traced ones by their shape."""
    law = ji.LZB([0.9, 0.8], 2e9, rtol=1e-6)
    assert str(law) == (
        "LZB(restitution=[0.9, 0.8], stiffness=2e+09, exponent=1.5 (static), initial_energy=0, "
        "friction=None, tangential_stiffness=None, rtol=1e-06)"
    )
    slope = jax.grad(lambda law: jnp.sum(law.restitution**2))(law)
    assert "restitution=[1.8, 1.6], stiffness=0, exponent=1.5 (static)" in str(slope)
    texts = []
    jax.jit(lambda law: texts.append(str(law)) or law.restitution)(law)
    assert "restitution=f64[2]" in texts[0]
    assert "force=Bistiffness(stiffness=3," in str(ji.Compliant(ji.Hertz(3.0)))


@pytest.mark.slow
def test_lists_of_traced_numbers():
    """`[1.0, k]` under grad and jit, in laws, scenes and velocities: as `jnp.stack` of them."""

    def listed(x):
        scene = ji.chain([1.0, x, 2.0], gaps=[0.0, 0.0 * x])
        return ji.impact(ji.Newton([0.9, 0.1 * x]), scene, [x, 0.0, -1.0]).velocity[1]

    def stacked(x):
        one = jnp.ones(())
        scene = ji.chain(jnp.stack([one, x, 2 * one]))
        law = ji.Newton(jnp.stack([0.9 * one, 0.1 * x]))
        return ji.impact(law, scene, jnp.stack([x, 0 * one, -one])).velocity[1]

    np.testing.assert_allclose(
        jax.jit(jax.grad(listed))(3.0), jax.grad(stacked)(3.0), rtol=1e-12
    )
    dense = jax.grad(
        lambda m: ji.kinetic_energy(ji.Scene([m, 1.0], [[-1.0], [m / m]]), [2.0, 0.0])
    )
    assert float(dense(3.0)) == 2.0


@pytest.mark.slow
def test_advise_tries_it():
    """With a place in the order of the laws it is a candidate, and chosen where it suffices."""

    class Half(ji.Newton):
        """Newton's law by another name."""

    ji.register("half", Half, summary="for the tests", simplicity=0.5)
    try:
        advice = ji.advise(
            ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False
        )
        assert advice.name == "half"
        assert [*advice.candidates][:2] == ["half", "newton"]
        with pytest.raises(ValueError, match=argument("simplicity")):
            ji.register("blended", Blended, simplicity=2)
    finally:
        del ji.REGISTRY["half"]


def test_declared_parameters_of_our_laws():
    """Every registered law's parameters have a domain, and its required ones are few."""
    for name, row in ji.REGISTRY.items():
        assert row.parameters, name
        assert set(row.required) <= set(row.parameters), name
        for field in dataclasses.fields(row.law):
            assert field.name in row.arguments or row.make is not None, (
                name,
                field.name,
            )
