"""Deliberately wrong laws: the suite must catch each of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import LAWS
from test_contract import SCENES, check_promises
from test_lzb_values import case

import jimpact as ji
from jimpact.numerics import events, flow, isolated


class WrongSign(ji.Newton):
    """p of the wrong sign: contacts pull."""

    def impulses(self, contact):
        return ji.Impulses(-super().impulses(contact).normal)


class GainsEnergy(ji.Newton):
    """(1 + e) becomes (1 + 2 e)."""

    def impulses(self, contact):
        p = super().impulses(contact).normal
        return ji.Impulses(p * (1 + 2 * self.restitution) / (1 + self.restitution))


class NotHomogeneous(ji.Newton):
    """Restitution that depends on the speed."""

    def impulses(self, contact):
        p = super().impulses(contact).normal
        return ji.Impulses(p / (1 + jnp.max(jnp.abs(contact.gap_velocity))))


@pytest.mark.parametrize("wrong", [WrongSign, GainsEnergy, NotHomogeneous])
def test_contract_catches(wrong):
    scene, v = SCENES["wall"]()
    with pytest.raises(AssertionError):
        check_promises(ji.REGISTRY["lzb"], wrong(jnp.array(0.9)), scene, v, 1e-7)


def missing_square(original):
    def scales(given, phase):
        # c = 1/e instead of 1/e^2: gamma_j = sqrt(e_j) g_j
        return original(given._replace(restitution=jnp.sqrt(given.restitution)), phase)

    return scales


def no_recompression(original):
    def change(given, phase, state, arrived, opened):
        # a contact whose expansion is interrupted stays in expansion
        moved, after, closed = original(given, phase, state, arrived, opened)
        interrupted = arrived & ~opened & (phase == flow.EXPANSION)
        return moved, jnp.where(interrupted, flow.EXPANSION, after), closed

    return change


def check_values_hold():
    for name in ("hertz3_e.9_g1", "wall2_hertz_e.9.8_gs2_repeated"):
        scene, v, (e, k, exponent), expected, _ = case(name)
        out = ji.impact(ji.LZB(e, k, exponent, max_steps=500), scene, v)
        assert int(out.status) == 0
        np.testing.assert_allclose(out.velocity, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("module", "name", "wrong"),
    [
        (flow, "scales", missing_square),
        (events, "change_phase", no_recompression),
    ],
)
def test_check_values_catch(monkeypatch, module, name, wrong):
    check_values_hold()
    broken = wrong(getattr(module, name))
    monkeypatch.setattr(module, name, broken)
    if name == "scales":
        monkeypatch.setattr(isolated, name, broken)
    jax.clear_caches()
    try:
        with pytest.raises(AssertionError):
            check_values_hold()
    finally:
        monkeypatch.undo()
        jax.clear_caches()


def test_every_registered_law_has_a_row():
    assert {row[0] for row in LAWS.values()} == set(ji.REGISTRY)
