"""One contract for every registered law: what it promises holds, and what can fail is reported.

All states of a law are lanes of one compiled batch (`programs.values`), its derivatives of one
more. A user's own law is held to the same functions (`test_wrong_laws_are_caught`).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
from programs import LAWS, SEQUENTIAL, SLOW_SLOPES, State, chain, failed

import jimpact as ji

each_law = pytest.mark.parametrize("name", LAWS)


def random_states(count, seed, least=0.0, most=1.0):
    """Scenes of three contacts, kinetic angles of all sizes; something approaches."""
    rng = np.random.default_rng(seed)
    states = []
    for _ in range(count):
        a = rng.normal(size=(4, 4))
        normals, v = rng.normal(size=(4, 3)), rng.normal(size=4)
        v = v if (normals.T @ v < 0).any() else -v
        states.append(
            State(
                a @ a.T + 0.2 * np.eye(4),
                normals,
                v,
                e=rng.uniform(least, most, 3),
                k=10 ** rng.uniform(-1, 1, 3),
            )
        )
    return states


def random_chains(count, seed):
    rng = np.random.default_rng(seed)
    states = []
    for i in range(count):
        wall = (False, True, "left", "both")[i % 4]
        n = 4 - (wall in (True, "left")) - 2 * (wall == "both")
        v = rng.normal(size=n)
        if (
            wall == "both"
        ):  # a body that never comes to rest is no state of the contract
            wall, n = False, 2
        m = n - 1 + bool(wall)
        v = v if np.min(np.diff(v), initial=0) < 0 else -v
        states.append(
            chain(
                10 ** rng.uniform(-0.5, 0.5, n),
                v,
                wall,
                e=rng.uniform(0.3, 1, m),
                k=10 ** rng.uniform(-1, 1, m),
            )
        )
    return states


DENSE = random_states(18, seed=1, least=0.2)
JAMMED = [DENSE.pop(6), DENSE.pop(3)]  # they press each other until all is lost
GENERAL = [*DENSE, *random_chains(16, seed=2)]
LIGHT = [
    chain([1.0, 1e-3, 1.0], [1.0, 0.0, 0.0], e=0.9),
    chain([1e-3, 1.0, 1e-3, 1.0], [1.0, 0.0, 0.0, -1.0], e=0.8, k=[1.0, 30.0, 0.1]),
    chain([1e4, 1.0, 1.0], [1.0, 0.0, -1.0], e=0.5),
]


def check_promises(run, entry, accuracy, states):
    """Signs, energy, momentum, scaling: kept, or else (where not promised) reported by the status."""
    fast = [
        dataclasses.replace(s, velocity=1e3 * np.asarray(s.velocity)) for s in states
    ]
    light = [dataclasses.replace(s, mass=1e-4 * np.asarray(s.mass)) for s in states]
    (out, found), (out_fast, _), (out_light, _) = run(states), run(fast), run(light)
    assert np.isfinite(out.velocity).all()
    assert found.momentum.all()
    signs = {
        "impulse_sign": found.kinetic,
        "gap_velocity_sign": found.kinematic,
        "energy": found.energetic,
    }
    over = ~np.isin(
        programs.names(out.status), ["max_steps"]
    )  # reported, and few: see below
    for promise, holds in signs.items():
        if promise in entry.promises:
            assert holds[over].all(), (promise, np.flatnonzero(over & ~holds))
        silent = ~holds & ~failed(out.status)
        assert not silent.any(), (promise, np.flatnonzero(silent))
    speed = np.array([np.abs(s.velocity).max() for s in states])[:, None]
    if "velocity_scaling" in entry.promises:
        error = np.abs(out_fast.velocity / 1e3 - out.velocity) / speed
        assert error.max() < 2 * accuracy, error.max(axis=1)
    if "mass_scaling" in entry.promises:
        error = np.abs(out_light.velocity - out.velocity) / speed
        assert error.max() < 2 * accuracy, error.max(axis=1)
    return out, found


@each_law
def test_promises(name):
    row = LAWS[name]
    entry = ji.REGISTRY[row.registered]
    out, _ = check_promises(programs.values(name), entry, row.accuracy, GENERAL + LIGHT)
    # "right or flagged" is worth something only if little is flagged
    share = failed(out.status).mean()
    assert share <= row.flagged, (
        f"{name} flags {share:.0%} of the contract's states as failures: a law that is right on few "
        f"scenes says so by `flagged` of its row in tests/programs.py (now {row.flagged:.0%})"
    )


@pytest.mark.parametrize(
    "name",
    [
        *SEQUENTIAL,
        pytest.param("lzb", marks=pytest.mark.release),
        pytest.param(
            "compliant",
            marks=[
                pytest.mark.release,
                pytest.mark.xfail(reason="ends with an approach", strict=True),
            ],
        ),
    ],
)
def test_jammed_contacts(name):
    """What presses on until all is lost ends in the plastic limit, not just short of it."""
    row = LAWS[name]
    out, _ = check_promises(
        programs.values(name), ji.REGISTRY[row.registered], row.accuracy, JAMMED
    )
    assert not failed(out.status).any(), programs.names(out.status)


@each_law
def test_one_contact_is_newtons(name):
    """v+ = v- + (1 + e) ..., whatever else the law knows."""
    states = []
    for e in (0.0, 1e-9, 0.4, 1.0):
        p = (1 + e) * 1.5 / (1 + 1 / 3)
        after = [2 - p, 0.5 + p / 3]
        for k in (1e-3, 1.0, 1e6):
            states.append(chain([1, 3], [2, 0.5], e=e, k=k, after=after, impulse=[p]))
    programs.check_held(name, states, allowed=max(1e-12, LAWS[name].accuracy))


@each_law
def test_nothing_happens(name):
    """Separating, at rest relative to each other, at rest: v+ = v- to the last bit, p = 0."""
    states = [
        chain([1, 1, 1], [0, 0, 1]),
        chain([1, 2, 1], [0.3, 0.3, 0.3]),
        chain([1, 2, 1], [0, 0, 0]),
    ]
    out, _ = programs.values(name)(states)
    for i, state in enumerate(states):
        assert np.array_equal(out.velocity[i, :3], state.velocity)
    assert not out.impulse.any()
    assert not out.energy_change.any()
    assert programs.names(out.status) == ["ok"] * 3


@each_law
def test_open_contacts_take_no_part(name):
    """Padded lanes hold open contacts; here one of them would approach."""
    if name in ("compliant", *SEQUENTIAL):
        pytest.skip("its open contacts close: tested with the law")
    gapped = chain([1, 1, 1], [1.0, 0.0, -0.5], e=0.7, gaps=[0.0, 1e-3], k=[2.0, 1.0])
    alone = chain([1, 1], [1.0, 0.0], e=0.7, k=2.0)
    out, _ = programs.values(name)([gapped, alone])
    np.testing.assert_allclose(
        out.velocity[0, :2], out.velocity[1, :2], atol=2 * LAWS[name].accuracy
    )
    assert out.velocity[0, 2] == -0.5
    assert out.impulse[0, 1] == 0.0


@each_law
def test_order_of_contacts_does_not_matter(name):
    if LAWS[name].by_order:
        pytest.skip("its order is by number of the contact")
    turned = [
        dataclasses.replace(s, normals=s.normals[:, ::-1], e=s.e[::-1], k=s.k[::-1])
        for s in GENERAL
    ]
    (a, _), (b, _) = programs.values(name)(GENERAL), programs.values(name)(turned)
    tied = np.isin(programs.names(a.status), ["order_dependent", "plastic_limit"])
    size = np.array([np.abs(s.velocity).max() for s in GENERAL])[:, None]
    error = np.abs(a.velocity - b.velocity) / size
    assert error[~tied].max() < 4 * LAWS[name].accuracy
    fine = ~tied & ~failed(a.status)
    assert fine.sum() >= 3
    np.testing.assert_array_equal(a.status[fine], b.status[fine])


@each_law
def test_decoupled_contacts_are_solved_as_if_alone(name):
    """Two pairs of balls in one scene, and each with another pair that separates."""
    if not LAWS[name].through_w:
        pytest.skip(
            f"contacts of {name} influence each other whatever W is (see tests/programs.py)"
        )
    pairs = np.array([[-1, 0], [1, 0], [0, -1], [0, 1.0]])
    mass = np.diag([1, 2, 3, 0.5])

    def state(v):
        full = np.zeros((4, 3))
        full[:, :2] = pairs
        full[:, 2] = [0, 1, 0, 0]  # far away
        return State(mass, full, v, e=[0.9, 0.3, 0.5], k=[1, 5, 1.0], gaps=[0, 0, 1e3])

    both, first = state([1, -0.5, 1, 0]), state([1, -0.5, 0, 1])
    second = state([0, 1, 1, 0])
    out, _ = programs.values(name)([both, first, second])
    if name == "compliant":  # the second coordinate reaches its far contact one day
        return
    np.testing.assert_allclose(
        out.velocity[0, :2], out.velocity[1, :2], atol=4 * LAWS[name].accuracy
    )
    np.testing.assert_allclose(
        out.velocity[0, 2:], out.velocity[2, 2:], atol=4 * LAWS[name].accuracy
    )


@each_law
def test_one_bad_lane_stays_alone(name):
    nan = chain([1, 1, 1], [np.nan, 0, 0])
    bad = chain([1, 1, 1], [1, 0, 0], e=np.nan)
    good = GENERAL[16]
    out, _ = programs.values(name)([nan, good, bad])
    alone, _ = programs.values(name)([good])
    assert programs.names(out.status)[0] == "not_finite"
    assert failed(out.status).tolist() == [True, failed(alone.status[0]), True]
    # its place in the batch decides how a processor rounds it
    error = np.abs(out.velocity[1] - alone.velocity[0]).max()
    assert error <= LAWS[name].accuracy * np.abs(good.velocity).max()
    with pytest.raises(RuntimeError, match=r"not_finite: .*at 0"):
        ji.raise_on_failure(out)


@each_law
def test_what_the_host_refuses_has_a_status_inside_jit(name):
    """A law may leave such values alone: an open contact, a symmetric factor, a scale."""
    normals = np.asarray(ji.chain([1.0, 1.0, 1.0]).normals)
    asymmetric = State(np.eye(3) + np.eye(3, k=1) / 4, normals, [1, 0, 0])
    no_body = State(np.eye(3), normals * np.array([1, 0]), [1, 0, 0])
    unknown, negative = (
        chain([1, 1, 1], [1, 0, 0], gaps=[0, gap]) for gap in (np.nan, -0.1)
    )
    out, _ = programs.values(name)([asymmetric, no_body, negative, unknown])
    assert programs.names(out.status) == [*["out_of_range"] * 3, "not_finite"]


@each_law
def test_energies_that_no_number_holds_are_out_of_range(name):
    """Of 1e370, 1e-430 and 1e-320 J; not of extreme masses and speeds with an ordinary energy."""
    sizes = ((1e-30, 1e200), (1e-30, 1e-200), (1.0, 1e-160), (1e120, 1e-60))
    states = [chain([mass, 2 * mass], [speed, 0]) for mass, speed in sizes]
    stiff = chain([1e-280, 2e-280], [1, 0], k=1e280)
    out, _ = programs.values(name)([*states, stiff])
    assert programs.names(out.status) == [*["out_of_range"] * 3, "ok", "ok"]


SMOOTH = [
    chain(
        [1.0, 2.0, 1.5, 0.7],
        [1.0, 0.4, 0.1, -0.6],
        e=[0.9, 0.7, 0.8],
        k=[1, 2.5, 0.7],
        eta=1.4,
    ),
    chain([3.0, 1.0, 2.0], [1.0, 0.2, -0.5], e=[0.95, 0.6], k=[1, 3.0], eta=[1.5, 1.3]),
    chain([1.0, 2.0], [1.0, 0.3], True, e=[0.9, 0.8], k=[1.0, 1.4], eta=1.6),
    State(
        np.array([[2, 0.3], [0.3, 1]]),
        np.array([[1, 0.2], [-0.3, 0.9]]),
        [-1, -0.6],
        e=[0.9, 0.6],
        k=[1, 2.5],
    ),
]
STEP = 4e-3  # of differences of fourth order, relative


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(x, marks=[pytest.mark.slow] if x in SLOW_SLOPES else [])
        for x in LAWS
    ],
)
def test_derivatives(name):
    """Forward equals reverse, and both are the slope of the values."""
    states = SMOOTH
    if name == "poisson":
        states = [dataclasses.replace(s, e=np.max(s.e)) for s in SMOOTH]
    found = programs.derivatives(name)(states)
    forward, reverse = found[0], found[-1]
    for a, b in zip(forward, reverse):
        np.testing.assert_allclose(
            a, b, rtol=0, atol=LAWS[name].slope * (1 + np.abs(a).max())
        )
        assert np.isfinite(a).all()
    rng = np.random.default_rng(3)
    moved, along = [], []
    for state in states:
        n, m = state.size
        eta = np.broadcast_to(np.asarray(state.eta, float), m)
        e, k = (np.broadcast_to(np.asarray(x, float), m) for x in (state.e, state.k))
        way = [rng.uniform(-1, 1, x) for x in (n, m, m, m)]
        way[1] = -np.abs(way[1])
        along.append(way)
        for step in (2 * STEP, STEP, -STEP, -2 * STEP):
            moved.append(
                dataclasses.replace(
                    state,
                    velocity=np.asarray(state.velocity) + step * way[0],
                    e=e + step * way[1],
                    k=k * (1 + step * way[2]),
                    eta=eta + step * way[3],
                )
            )
    out, _ = programs.values(name)(moved)
    f = out.velocity.reshape(len(states), 4, 4)
    slope = (-f[:, 0] + 8 * f[:, 1] - 8 * f[:, 2] + f[:, 3]) / (12 * STEP)
    for i, (state, way) in enumerate(zip(states, along)):
        n, m = state.size
        way[2] = way[2] * np.broadcast_to(np.asarray(state.k, float), m)
        found = sum(
            forward[j][i][:, : len(w)] @ w for j, w in enumerate(way)
        )  # by v, e, k, eta
        np.testing.assert_allclose(found[:n], slope[i, :n], rtol=0, atol=1e-6)


def test_a_law_is_a_pytree_and_its_gradient_a_law():
    law = ji.Moreau(jnp.array([0.9, 0.6]))
    balls, v = ji.chain(jnp.array([1.0, 2.0, 0.7])), jnp.array([1.0, 0.1, -0.4])
    gradient = jax.grad(lambda law: ji.impact(law, balls, v).velocity[1])(law)
    assert type(gradient) is type(law)
    for make in (row.make for row in LAWS.values()):
        law = make(*jnp.full((4, 3), 0.5).at[2].set(1.5))
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), law)
        assert type(batch) is type(law)
        assert jax.tree.structure(batch) == jax.tree.structure(law)


def test_every_registered_law_has_a_row():
    assert {row.registered for row in LAWS.values()} == set(ji.REGISTRY)
    for entry in ji.REGISTRY.values():
        assert entry.promises <= {
            "impulse_sign",
            "gap_velocity_sign",
            "energy",
            "velocity_scaling",
            "mass_scaling",
        }
        for words in (entry.summary, entry.right_when, entry.fails_when, entry.source):
            assert words
        assert entry.bibtex.count("{") == entry.bibtex.count("}") > 3


# ------------------------------------------------------------------------------- wrong laws


WRONG = {
    "right": lambda p, gamma, e: p,
    "sign": lambda p, gamma, e: -p,
    "energy": lambda p, gamma, e: p * (1 + 2 * e) / (1 + e),
    "too little": lambda p, gamma, e: 0.5 * p,
    "not homogeneous": lambda p, gamma, e: p / (1 + jnp.max(jnp.abs(gamma))),
}


@pytest.fixture(scope="module")
def wrong():
    """`wrong(kind)(states)`: Moreau's impulses, spoilt in one of the ways above."""

    @jax.jit
    @jax.vmap
    def program(kind, mass, normals, gaps, v, e, k, eta, stored):
        scene = ji.Scene(mass, normals, gaps=gaps)
        out = ji.impact(ji.Moreau(e), scene, v)
        p = jax.lax.switch(
            kind, [*WRONG.values()], out.impulse, ji.gap_velocity(scene, v), e
        )
        after = v + ji.velocity_change(scene, p)
        energy = ji.kinetic_energy(scene, after) - ji.kinetic_energy(scene, v)
        wrong = dataclasses.replace(
            out, velocity=after, impulse=p, energy_change=energy
        )
        return wrong, ji.audit(wrong, scene, v)

    def of(kind):
        def run(states):
            columns = [
                np.stack(column) for column in zip(*map(programs.padded, states))
            ]
            at = np.full(len(states), [*WRONG].index(kind))
            return jax.tree.map(np.asarray, program(at, *columns))

        return run

    return of


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_laws_are_caught(wrong, kind):
    """Held to what `lzb` promises; chains that only approach, with one e, are right by Moreau."""
    states = [dataclasses.replace(s, e=0.8) for s in GENERAL[16:]]
    states = [s for s in states if (s.normals.T @ s.velocity <= 0).all()]
    assert len(states) > 2
    if kind == "right":
        check_promises(wrong(kind), ji.REGISTRY["lzb"], 1e-7, states)
        return
    with pytest.raises(AssertionError):
        check_promises(wrong(kind), ji.REGISTRY["lzb"], 1e-7, states)
