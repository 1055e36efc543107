"""Held values and edges of every law, all lanes of its one canonical program."""

import json
from pathlib import Path

import numpy as np
import programs
import pytest
from programs import State, chain, check_held

import jimpact as ji

HELD = json.loads(
    (Path(__file__).parents[1] / "held" / "lzb_check_values.json").read_text()
)


def held_states(most=4):
    """The values of 40 digits, of chains that fit the canonical shape."""
    states = []
    for name, data in HELD.items():
        m, k, eta, e, v, after, p = (
            np.array([float(x) for x in data[column]])
            for column in ("m", "k", "eta", "e", "v_minus", "v_plus", "impulses")
        )
        if len(k) < most:
            states.append(
                chain(
                    m,
                    v,
                    data["wall"],
                    e=e,
                    k=k,
                    eta=eta,
                    after=after,
                    impulse=p,
                    name=name,
                )
            )
    return states


def in_contact_space(w, gamma, **given):
    """Two contacts whose Delassus matrix is w: coordinates are gap velocities."""
    return State(np.linalg.inv(w), np.eye(len(w)), gamma, **given)


def flat_block(a, rates, **given):
    """Rocking block at theta = 0, m = L = 1, aspect a; coordinates (y, theta)."""
    normals = np.array([[1.0, 1.0], [0.5, -0.5]])
    state = State(
        np.diag([1, (a**2 + 1) / 12]),
        normals,
        np.linalg.solve(normals.T, rates),
        **given,
    )
    state.after = np.linalg.solve(normals.T, state.after)
    return state


# -------------------------------------------------------------------------------------- LZB

E0 = [0.0, 1e-9]
LZB_EDGES = [
    # e = 0 is the limit e -> 0+, not a drop of the indentation to 0 (equations.md, design.md 4)
    *(
        chain(
            [3, 1, 2], [1, 0, -0.5], e=[0.95, e], k=[1, 3], status=None, name=f"e2 = {e}",
            after=[-0.234948, 0.901615, 0.901615],
        )
        for e in E0
    ),
    # endless re-closing below e = (2 - sqrt 3)^2 = .0718: common velocity
    *(
        chain([1, 1, 1], [1, 0, 0], e=e, after=[1 / 3] * 3, status="plastic_limit", name=f"e={e}")
        for e in (0.0, 0.03, 0.05, 0.06, 0.07)
    ),
    # a loaded contact that separates, without restitution, opens at once
    *(
        chain(
            [1, 1, 1], [1, 0, 2], e=[1, e], stored=[0, 1], after=[0, 1, 2], name=f"loaded e={e}"
        )
        for e in E0
    ),
    # precompressed at rest: gains what was stored
    chain([1, 1], [0, 0], stored=0.5, after=[-(0.5**0.5), 0.5**0.5], name="stored"),
    # 5e-18 J, where Siconos fails
    chain(
        [1e-8] * 3, [3e-5, 0, 0], k=7e9, name="tiny",
        after=3e-5 * np.array([-0.070952353651436871, 0.076403039071206993, 0.99454931458022988]),
    ),
    chain(
        [1, 1e-3, 1], [1, 0, 0], name="light ball",
        after=[-0.000497700274514, 0.935501351755378, 0.999562198922759],
    ),
    chain(
        [1, 1e-3, 1], [1, 0, 0], e=0.9, name="light ball, e=.9",
        after=[0.116178842358577, 0.800891058245824, 0.883020266583177],
    ),
    # a bad state of the propagator once: contacts turn back twice within one period
    chain(
        [1, 1e-3, 1], [1, 0, 0], e=0.9, eta=1, name="light ball, linear",
        after=[0.07522166001736, 0.74823140950437, 0.92403010857313],
    ),
    flat_block(1.0, [-1, 0], eta=1, after=[0.887201797217466964, 0.316885496822930086]),
    flat_block(1.0, [-1, 0], after=[0.856592112501210409, 0.372372624592392268]),
    flat_block(1.0, [-1, 0], e=0.8, after=[0.681255743233409859, 0.273725970322769726]),
    flat_block(0.5, [-1, 0], eta=1, e=0.8, after=[0.388601609987503532, 0.50893193343564696]),
    flat_block(0.5, [-1, 0], eta=1, e=0.9, after=[0.451190340860902387, 0.589848609570968933]),
    flat_block(2.0, [-1, 0], e=0.8, after=[0.8, 0.45], name="second corner is free"),
]  # fmt: skip


def test_lzb_values():
    states = held_states()
    assert len(states) == 32
    check_held("lzb", states, allowed=1e-7)  # ten times the default tolerance


@pytest.mark.slow
def test_light_and_stiff_chains():
    """Linear contacts, e >= .3, masses over four decades and stiffness over six: several events
    inside one period of the fastest. Held: exact propagation phase by phase, rtol 1e-11 beside it.
    """
    held = np.load(Path(__file__).parents[1] / "held" / "light_and_stiff.npz")
    states = [
        chain(m, v, k=k, e=e, eta=1.0, after=after, name=str(i))
        for i, (m, k, e, v, after) in enumerate(zip(*(held[x] for x in COLUMNS)))
    ]
    assert len(states) == 48
    check_held("lzb", states, allowed=2e-7)


COLUMNS = ("mass", "k", "e", "velocity", "after")


def test_lzb_edges():
    out = check_held("lzb", LZB_EDGES, allowed=1e-6)
    assert out.impulse[-1, 1] == 0.0
    stored = [s.name for s in LZB_EDGES].index("stored")
    assert out.energy_change[stored] == pytest.approx(0.5, rel=1e-7)
    ji.raise_on_failure(out)


def test_many_closings():
    """200 closings of contact 1 while contact 2 presses."""
    g = 0.9908170287626599
    state = in_contact_space(
        np.array([[1, -g], [-g, 1]]), [0.91974436, -0.95153349], e=[0.18740681, 0.2059518],
        k=[1.24614193, 0.4188893], after=[0, 0], status="plastic_limit",
    )  # fmt: skip
    check_held("lzb", [state], allowed=1e-6)


PLASTIC = [chain([1, 1, 1], [1, 0, 0], e=0.0), chain([3, 1, 2], [1, 0.4, -0.5], e=0.0)]


@pytest.mark.parametrize(
    "name", ["lzb", pytest.param("compliant", marks=pytest.mark.slow)]
)
def test_plastic_contacts_share_a_velocity(name):
    out, _ = programs.values(name)(PLASTIC)
    for i, state in enumerate(PLASTIC):
        mass = np.diag(state.mass)
        common = mass @ np.array(state.velocity) / mass.sum()
        np.testing.assert_allclose(out.velocity[i, :3], common, atol=1e-7)
    assert set(programs.names(out.status)) <= {"ok", "plastic_limit"}


# thousands of closings, each a part of the one before
LIGHT = [
    chain([1, 1e-4, 1], [1, 0, 0], e=0.5, name="one light ball"),
    chain([2, 1e-3, 1], [1, 0, 0], e=0.2, eta=1.0, name="linear"),
    chain([1, 1e-2, 1, 1], [1, 0, 0, 0], e=0.4, name="beside another ball"),
]


@pytest.mark.slow
def test_light_balls_that_bounce_thousands_of_times():
    """A tenth of the passes that integration to the tolerance takes is enough."""
    out, _ = programs.values("lzb")(LIGHT)
    for i, state in enumerate(LIGHT):
        mass = np.diag(state.mass)
        common = mass @ np.array(state.velocity) / mass.sum()
        np.testing.assert_allclose(out.velocity[i, : len(mass)], common, atol=1e-12)
    assert set(programs.names(out.status)) == {"plastic_limit"}


def test_slopes_of_plastic_contacts():
    """The common velocity is known by momentum: nothing that happened before matters for it."""
    states = [*PLASTIC, chain([1, 0.1, 1], [1, 0, 0], e=0.3)]
    for v, *of_parameters in programs.derivatives("lzb")(states):
        for i, state in enumerate(states):
            mass = np.diag(state.mass)
            n = len(mass)
            share = np.tile(mass / mass.sum(), (n, 1))
            np.testing.assert_allclose(v[i, :n, :n], share, atol=1e-12)
            assert not any(slope[i, :n].any() for slope in of_parameters)


def test_lzb_between_the_limits():
    """k2/k1 -> 0: binary collisions; a symmetric impact stays so; redundant contacts share."""
    states = [
        chain(
            [1, 2, 3],
            [1, 0, 0],
            e=[0.9, 0.8],
            k=[1, 1e-7],
            after=[-4 / 15, -19 / 375, 57 / 125],
        ),
        chain([1, 4, 1], [1, 0, -1], e=0.7, k=2.0),
        State(
            np.eye(2), np.array([[1.0, 1.0], [0, 0]]), [-1, 0], e=[0.5, 0.8], k=[1, 3]
        ),
    ]
    out = check_held("lzb", states, allowed=1e-6)
    np.testing.assert_allclose(out.velocity[1, :3], -out.velocity[1, 2::-1], atol=1e-9)
    assert 0.5 < out.velocity[2, 0] < 0.8
    np.testing.assert_allclose(out.impulse[2].sum(), 1 + out.velocity[2, 0], atol=1e-8)


@pytest.mark.parametrize(
    ("masses", "k", "exponent", "u0"),
    [
        ([1.0, 1.0, 1.0], [6.454323290983815e-05, 367.0], (5.0, 1.3), 0.0),
        ([0.4649, 0.7916, 0.8412], [6.6944, 0.0506], (1.3, 2.0), [1.38e-6, 0.0]),
    ],
)
@pytest.mark.release
def test_slow_plastic_limits(masses, k, exponent, u0):
    """Mixed exponents let the last approach fade slowly: still the common velocity, reported."""
    out = ji.impact(ji.LZB(0.0, k, exponent, u0), ji.chain(masses), [1.0, 0.0, 0.0])
    assert programs.names(out.status) == ["plastic_limit"]
    np.testing.assert_allclose(out.velocity, masses[0] / sum(masses), atol=2e-7)


# -------------------------------------------------------------------------------- compliant


def test_compliant_values():
    """Touching, without losses and never opening twice it is LZB; with gaps it waits."""
    same = [
        s
        for s in held_states()
        if not s.name.startswith("wall2_lin") and np.min(s.e) == 1
    ]
    assert len(same) > 20
    own = [
        chain(
            [1, 1], [1, 0], True, eta=1, name="waits where LZB re-closes",
            after=[-0.976928618648904904, -0.213566088283562787],
        ),
        chain(
            [1, 1], [1, 1], True, e=[0.9, 0.8], k=[1, 2**0.5], name="opens once",
            after=[-0.98216523452194494662, -0.57257380387873722818],
        ),
        # gaps: by far one after another; of any size; and their limit 0
        chain(
            [0.25, 1, 0.25], [1, 0, -1], gaps=[0, 50], after=[-3 / 5, -4 / 25, 31 / 25],
        ),
        *(
            chain([1, 1, 1], [1, 0, -0.5], gaps=[g, 2 * g], after=[-0.5, 0, 1])
            for g in (1e2, 1e5, 1e9, 1e12)
        ),
        *(
            chain(
                [1, 1, 1], [1, 0, 0], gaps=g,
                after=[-0.070952353651436871, 0.076403039071206993, 0.99454931458022988],
            )
            for g in ([0, 0], [0, 1e-10], [1e-10, 1e-10])
        ),
        # a plastic contact that opens leaves its surface dented: it closes there, not at 0
        residual(0.6),
        chain([1, 1, 1], [-1, 0, 1], gaps=[0, 1], after=[-1, 0, 1]),
        reinsch(),
    ]  # fmt: skip
    check_held("compliant", same + own, allowed=3e-7)


def residual(e):
    """A ball between another one and a wall, the gap wide: each collision is a pair's, with e."""
    v1, v2 = (1 - e) / 2, (1 + e) / 2
    v2 = -e * v2  # the wall
    v1, v2 = v1 - (1 + e) / 2 * (v1 - v2), v2 + (1 + e) / 2 * (v1 - v2)
    v2 = -e * v2  # the wall again, and then too slow for ball 1
    return chain(
        [1, 1], [1, 0], True, e=e, gaps=[0, 30], after=[v1, v2], name="residual"
    )


def reinsch():
    """k1 = k2 and m2 = 2 m / 3: both linear contacts open together, the ends exchange."""
    return chain([1, 2 / 3, 1], [1, 0, 0], eta=1, after=[0, 0, 1], name="Reinsch")


def test_compliant_units_and_energy():
    """Only gap over indentation counts: microns and 1e-18 J as well."""
    length, mass = 1e-6, 2e-18
    usual = chain([1, 1, 1], [1, 0, 0], k=[1, 2], gaps=[0.3, 0.1])
    small = chain(
        [mass] * 3, [1, 0, 0], k=np.array([1, 2]) * mass / length**2.5,
        gaps=np.array([0.3, 0.1]) * length,
    )  # fmt: skip
    out, _ = programs.values("compliant")([usual, small])
    np.testing.assert_allclose(out.velocity[0], out.velocity[1], atol=3e-8)
    assert abs(out.energy_change[0]) < 1e-8
    assert programs.names(out.status) == ["ok"] * 2


# -------------------------------------------------------------------------- kinematic laws

ONE = [1, 0, 0]
KINEMATIC = {
    "newton": [
        chain(
            [1, 1, 1], [1, 0, -0.5], e=[0.8, 0.4],
            after=[-13 / 30, 11 / 30, 17 / 30], impulse=[43 / 30, 16 / 15],
        ),
        in_contact_space(
            [[1, 0.25], [0.25, 1]], [0, -1], e=0.5, impulse=[-0.4, 1.6],
            status="negative_impulse", name="slender block",
        ),
        in_contact_space([[1, -0.01], [-0.01, 1]], [0, -1], e=0.5, status="ok"),
        in_contact_space([[1, 0.01], [0.01, 1]], [0, -1], e=0.5, status="negative_impulse"),
        State(
            np.eye(2), [[1, 1], [0, 0]], [-1, 0], e=0.5, after=[0.5, 0],
            status="impulse_not_unique",
        ),
        State(np.eye(2), [[1, 1], [0, 0]], [-1, 0], e=[0.5, 0.8], status="infeasible"),
    ],
    "moreau": [
        chain([1, 2, 3], ONE, e=0.5, after=[-1 / 4, 1 / 4, 1 / 4], impulse=[5 / 4, 3 / 4]),
        chain([1, 2, 3], ONE, after=[-2 / 3, 1 / 3, 1 / 3]),
        chain([1, 1, 1], ONE, e=0.3, after=[(1 - 0.6) / 3, 1.3 / 3, 1.3 / 3]),
        in_contact_space(
            [[1, 0.25], [0.25, 1]], [0, -1], e=0.5, impulse=[0, 1.5], after=[0.375, 0.5]
        ),
        # a body in a slot, both walls touching
        State([[1]], [[1, -1]], [1], e=0.0, after=[0], status="impulse_not_unique"),
        State([[1]], [[1, -1]], [1], e=0.5, after=[-0.5], status="inadmissible_velocity"),
        State([[1]], [[1, -1]], [1], e=[0.2, 0.5], status="infeasible"),
        # unequal e can gain energy: reported
        chain([4.8, 0.6, 4.25], [0.7, 2.4, -2.1], e=[0.05, 0.9], status="inadmissible_velocity"),
        chain([1, 1e-6, 1], [1, 50, -1], e=[0, 1], status="energy_gain"),
    ],
    "poisson": [
        chain([1, 1, 1], ONE, after=[-1 / 3, 2 / 3, 2 / 3]),
        chain([1, 1, 1], ONE, e=[0.8, 0.4], after=[-0.2, 0.6, 0.6]),
        chain([1, 1, 1], ONE, e=[0.4, 1], after=[1 / 15, 4 / 15, 2 / 3]),
        chain([1, 2, 3], ONE, e=[0.9, 0.8], after=[-7 / 12, 19 / 60, 19 / 60], status=None),
        chain([1, 1, 1], [1, 0, -0.5], e=[0.8, 0.4], after=[-0.5, 0.5, 0.5]),
        chain([1, 1, 1], ONE, e=[0.5, 2], after=[0, 0, 1]),  # dispersion needs e above 1
        # (6.76)-(6.79): two balls on a wall, by the order of e1 and e2
        chain([1, 1], [1, 0], True, e=[1, 1], after=[-1, 0]),
        chain([1, 1], [1, 0], True, e=[0.8, 0.6], after=[-0.8, 0], impulse=[1.8, 1.8]),
        chain([1, 1], [1, 0], True, e=[0.5, 0.8], after=[-0.5, -0.3]),
        chain([1, 1], [1, 0], True, e=[0.3, 0.9], after=[-0.45, -0.45], impulse=[1.45, 1.9]),
        chain([1, 3], [2, 0.5], True, e=[0.8, 0.6], after=[-1.6, -1 / 6], impulse=[3.6, 5.6]),
    ],
}  # fmt: skip
for rows in ("newton", "moreau", "poisson"):  # a table on four legs, in (y, two angles)
    KINEMATIC[rows].append(
        State(
            np.eye(3), [[1, 1, 1], [1, -1, -1], [1, 1, 1]], [-1, 0, -1], e=0.5,
            status=None, name="three legs",
        )
    )  # fmt: skip


@pytest.mark.parametrize("name", KINEMATIC)
def test_kinematic_values(name):
    out = check_held(name, KINEMATIC[name])
    last = out.velocity[-1]
    np.testing.assert_allclose(last[:3], [0.5, 0, 0.5], atol=1e-12)


@pytest.mark.parametrize("name", ["newton", "moreau", "poisson"])
def test_rounding_beside_a_light_ball_is_no_failure_of_the_law(name):
    """W p cancels to 1e-10 of its terms; the gap velocities are none of the law's doing."""
    out, _ = programs.values(name)([chain([1, m, 1], ONE) for m in (1e-6, 1e-8)])
    assert set(programs.names(out.status)) <= {"ok", "energy_gain"}
    assert np.abs(out.energy_change).max() < 1e-8


# ----------------------------------------------------------------------------------- binary

TABLE = [  # masses, e, v+: closed forms of equations.md, section 3
    ((1, 1, 1), 1.0, (0, 0, 1)),
    ((1, 1, 1), 0.9, (0.047625, 0.049875, 0.9025)),
    ((1, 1, 1), 0.5, (0.203125, 0.234375, 0.5625)),
    ((1, 1, 1), 0.2, (0.304, 0.336, 0.36)),
    ((1, 1, 1), 0.08, (0.333331857173357, 0.333333890488082, 0.333334252338561)),
    ((1, 1, 1), 0.07, (1 / 3, 1 / 3, 1 / 3)),
    ((1, 1, 1), 0.0, (1 / 3, 1 / 3, 1 / 3)),
    ((3, 2, 5), 0.0, (0.3, 0.3, 0.3)),
    ((1, 4, 1), 1.0, (-0.6, 0.24, 0.64)),
    ((4, 1, 4), 1.0, (-0.024, 0.1024, 0.9984)),
    ((10, 1, 10), 1.0, (-0.0248383410809091, 0.295127496956844, 0.995325591385225)),
    ((1, 2, 3), 0.8, (-0.2, -0.048, 0.432)),
    ((2, 1, 2), 0.4, (0.313481481481481, 0.43998024691358, 0.466528395061728)),
]
ORDERS = {"symmetric": (-3 / 5, -4 / 25, 31 / 25), "turned": (-31 / 25, 4 / 25, 3 / 5)}


@pytest.mark.parametrize("name", programs.SEQUENTIAL)
def test_binary_values(name):
    states = [
        chain(m, ONE, e=e, after=after, status="plastic_limit" if e < 0.08 else "ok")
        for m, e, after in TABLE
    ]
    check_held(name, states, allowed=1e-12)


def test_binary_order_by_gaps_and_ties():
    def close(gaps, after, status="ok", v=(1, 0, -1)):
        return chain([0.25, 1, 0.25], v, gaps=gaps, after=ORDERS[after], status=status)

    check_held(
        "binary-earliest",
        [
            close([1, 2], "symmetric"),
            close([2, 1], "turned"),
            close([1, 1], "symmetric", "order_dependent"),
            close([0, 0], "symmetric", "order_dependent"),
            # times are equal, speeds are not: the fastest goes first, and it is said
            chain(
                [1, 1, 1],
                [1, 0, -2],
                gaps=[0.1, 0.2],
                after=[-2, 0, 1],
                status="order_dependent",
            ),
            # open contacts collide in their turn
            chain(
                [1, 1, 1], [1, 0, 0], gaps=[0, 1e-3], after=[0, 0, 1], impulse=[1, 1]
            ),
        ],
    )
    tied = close([2, 1], "symmetric", "order_dependent")  # 'fastest' knows no gaps
    within_rounding = chain(
        [0.25, 1, 0.25], [0.3, 0, -(0.1 + 0.2)], status="order_dependent",
        after=0.3 * np.array(ORDERS["symmetric"]),
    )  # fmt: skip
    clear = chain(
        [0.25, 1, 0.25], [0.3, 0, -0.3 * (1 + 1e-9)], status="ok",
        after=0.3 * np.array(ORDERS["turned"]),
    )  # fmt: skip
    apart = chain([1, 1, 1, 1], [1, 0, 0, -1], e=0.9, status="ok")  # they share no body
    check_held("binary", [tied, within_rounding, clear, apart], allowed=1e-8)


def test_binary_redundant_contacts():
    """A ball between two walls: a series of impulses, though W is singular."""
    states = []
    for e in ([0.5, 0.8], [0.9, 0.9]):
        last = 2 * (1 + e[1]) / (1 - e[0] * e[1])
        states.append(
            chain(
                [2], [1], "both", e=e, after=[0], status="plastic_limit", name=str(last)
            )
        )
    twice = State(
        np.eye(2), [[-1, -1], [1, 1]], [1, 0], e=0.5, after=[0.25, 0.75],
        status="order_dependent",
    )  # fmt: skip
    stays = chain([2], [1], "both", e=[0.3, 0.0], status="ok")
    out = check_held("binary", [*states, twice, stays])
    np.testing.assert_allclose(
        out.impulse[:2, 1], [float(s.name) for s in states], rtol=1e-10
    )


# ------------------------------------------------------------------------------ held slopes

# d v+ / d (k2/k1, e1, e2) at eta = 1, and d v+ / d (eta, k2/k1, e1, e2) at eta = 1.5; e = 0.9
LINEAR = np.array(
    [
        [-0.12283533377629, 0.14545764544136, -0.022622311665065],
        [-0.64376648585348, 0.23257752345323, 0.41118896240025],
        [-1.2503440488269e-6, -0.4064937970789, 0.40649504742295],
    ]
)
HERTZ = np.array(
    [
        [0.081076619093299, -0.083883554615527, 0.0028069355222283],
        [-0.066928813512993, 0.068799893104474, -0.0018710795914811],
        [-0.61311351473699, 0.16549672267969, 0.4476167920573],
        [-3.3628027004369e-7, -0.44470679947149, 0.44470713575176],
    ]
)
ELASTIC = [  # d v+ / d (k2/k1, eta) at e = 1, eta = 1.5, from rtol = 1e-12
    (-0.082349731119, 0.095566227547, -0.013216496428),
    (0.087622672930, -0.101685435831, 0.014062762901),
]

# d v+ / d (eta1, eta2) at eta = 1, by central differences of eighth order of values at rtol = 1e-13
LINEAR_IN_ETA = [
    (
        chain([1.7, 1.9, 1.2], [1.0, -0.3, -0.3], e=[1.0, 0.9], k=[1.7, 2.6], eta=1.0),
        [
            [0.0414355187, 0.1654804523],
            [-0.0745336987, -0.2956287463],
            [0.0593113714, 0.2336482076],
        ],
    ),
    (
        chain([0.7, 1.9, 1.1], [1.1, 0.2, -0.7], e=[0.9, 0.7], k=[1.7, 0.8], eta=1.0),
        [
            [-0.1924378126, 0.1063167185],
            [0.0730816396, -0.0408743232],
            [-0.0037714967, 0.0029450101],
        ],
    ),
]


def test_slopes_in_the_exponent_of_linear_springs():
    """Force x log x of a spring whose own force x needs no short steps."""
    states, slopes = zip(*LINEAR_IN_ETA)
    for *_, eta in programs.derivatives("lzb")(states):
        np.testing.assert_allclose(eta[:, :3, :2], slopes, atol=5e-8)


@pytest.mark.parametrize(
    "name", ["lzb", pytest.param("compliant", marks=pytest.mark.slow)]
)
def test_held_slopes(name):
    three = {"velocity": [1, 0, 0], "masses": [1, 1, 1]}
    states = [
        chain(**three, e=0.9, eta=1.0),
        chain(**three, e=0.9, eta=1.5),
        chain(**three, e=1.0, eta=1.5),
    ]
    for _, e, k, eta in programs.derivatives(name)(states):
        by_k, by_e = k[:, :3, 1], e[:, :3, :2]
        by_eta = eta[:, :3, :2].sum(axis=2)
        if name == "lzb":  # losses: where contacts open twice the compliant law differs
            np.testing.assert_allclose([by_k[0], *by_e[0].T], LINEAR, atol=1e-6)
            np.testing.assert_allclose(
                [by_eta[1], by_k[1], *by_e[1].T], HERTZ, atol=1e-6
            )
        np.testing.assert_allclose([by_k[2], by_eta[2]], ELASTIC, atol=1e-6)


def test_slopes_at_the_edges_are_finite_and_one_sided():
    """e = 0.05 and 1; touching contacts; events that coincide; one-sided at e = 0."""
    states = [
        chain([1, 1, 1], v, e=e) for e in (0.05, 1.0) for v in ([1, 0, 0], [1, 0.5, -1])
    ]
    symmetric = chain([0.25, 1, 0.25], [1, 0, -1], e=0.8)
    at_zero = chain([3, 1, 2], [1, 0, -0.5], e=[0.95, 0.0], k=[1, 3])
    found = programs.derivatives("lzb")([*states, symmetric, at_zero])
    for mode in found:
        for x in mode[:3]:
            assert np.isfinite(x).all()
    # the slope in e at 0 is one-sided: of second order from three values
    near = [
        chain([3, 1, 2], [1, 0, -0.5], e=[0.95, e], k=[1, 3]) for e in (0.0, 2e-3, 4e-3)
    ]
    moved = [chain([0.25, 1, 0.25], [1 + h, 0, -1], e=0.8) for h in (1e-3, -1e-3)]
    out, _ = programs.values("lzb")([*near, *moved])
    v = out.velocity[:, :3]
    slope = (-3 * v[0] + 4 * v[1] - v[2]) / 4e-3
    for mode in found:
        np.testing.assert_allclose(mode[1][-1][:3, 1], slope, atol=2e-4)
        np.testing.assert_allclose(mode[0][-2][:3, 0], (v[3] - v[4]) / 2e-3, atol=2e-4)
