"""The errata of docs/equations.md: both sides of each are computed again, in plain numpy.

Named as in the table there. What is printed must be wrong, what is used right.
"""

from fractions import Fraction

import numpy as np
import pytest

rng = np.random.default_rng(0)


def collide(masses, velocity, restitution, order, end=False):
    """Pairs one after another; with `end` until nothing approaches. Velocities, collisions."""
    m, v = list(masses), list(velocity)
    count = 0
    while count < (40 if end else len(order)):
        j = order[count % len(order)]
        gamma = v[j + 1] - v[j]
        if end and gamma >= 0:
            break
        p = -(1 + restitution[j]) * gamma / (1 / m[j] + 1 / m[j + 1])
        v[j], v[j + 1], count = v[j] - p / m[j], v[j + 1] + p / m[j + 1], count + 1
    return v, count


def test_6_3_1_signs_and_ends_of_the_work_of_a_contact():
    """A mass of 1 kg at 1 m/s on a spring of 1 N/m: indentation sin t, impulse 1 - cos t."""
    t = np.linspace(0, np.pi, 20001)
    indentation, rate, impulse = np.sin(t), np.cos(t), 1 - np.cos(t)
    gamma = -rate
    energy = np.concatenate(
        [[0], np.cumsum(np.diff(impulse) * -(gamma[1:] + gamma[:-1]) / 2)]
    )
    np.testing.assert_allclose(
        energy, indentation**2 / 2, atol=1e-7
    )  # E' = -gamma = rate
    assert (-energy[1:-1] < 0).all()  # of +gamma, as printed
    # (6.71), (6.72): compression ends where the rate is 0, not where the indentation is
    assert np.isclose(
        impulse[np.argmax(energy)], impulse[np.argmin(abs(rate))], rtol=1e-9
    )
    assert np.isclose(energy[indentation.argmin()], 0, atol=1e-7)


@pytest.mark.parametrize("e", [0.5, 0.9])
def test_6_3_1_the_energy_is_gone_before_the_indentation(e):
    """Bistiff spring: k while loaded by 1 kg at 1 m/s, k / e^2 down to the indentation that stays."""
    k = 3.0
    deepest = 1 / np.sqrt(k)
    stays = deepest * (1 - e**2)
    stiff = k / e**2
    assert np.isclose(
        k * deepest, stiff * (deepest - stays), rtol=1e-14
    )  # the force has no jump
    given_back = 0.5 * stiff * (deepest - stays) ** 2
    assert np.isclose(
        np.sqrt(2 * given_back), e, rtol=1e-14
    )  # so E = 0 with gamma+ = e
    assert stays > 0.1 * deepest


@pytest.mark.parametrize("exponent", [1.0, 1.5, 3.0])
def test_6_3_1_force_of_stored_energy(exponent):
    k, depth = 7.0, 0.3
    force = k * depth**exponent
    energy = k * depth ** (exponent + 1) / (exponent + 1)  # the integral of the force
    up = exponent + 1
    assert np.isclose(
        force ** (up / exponent), up * k ** (1 / exponent) * energy, rtol=1e-14
    )
    assert not np.isclose(
        force ** (up / exponent), up * k ** (1 / up) * energy, rtol=0.1
    )
    share = (up * energy) ** (exponent / up)
    assert np.isclose(force, k ** (1 / up) * share, rtol=1e-14)
    assert not np.isclose(force, k ** (1 / exponent + 1) * share, rtol=0.1)


@pytest.mark.parametrize(("exponent", "e"), [(1.0, 0.6), (1.5, 0.9)])
def test_6_3_1_force_in_expansion(exponent, e):
    """Slope of `F = F_max ((d - d_r) / (d_c - d_r))^eta` over the impulse, where d' = dd / dt."""
    k, deepest, at, rate = 3.0, 0.5, 0.4, -0.8
    stays, largest = (1 - e**2) * deepest, k * deepest**exponent

    def force(d):
        return largest * ((d - stays) / (deepest - stays)) ** exponent

    slope = (force(at + 1e-6) - force(at - 1e-6)) / 2e-6 * rate / force(at)  # dp = F dt
    left = force(at) ** (1 / exponent) * slope
    used = exponent * largest ** (1 / exponent) * rate / (e**2 * deepest)
    printed = exponent * force(at) ** (1 / exponent) * rate / (e**2 * at)
    assert np.isclose(left, used, rtol=1e-8)
    assert not np.isclose(left, printed, rtol=0.02)


def test_number_of_contacts_of_6_1_1_and_of_definition_6_1():
    """Three balls on the ground: impulses of three kinds change v; of no contact, none does."""
    grounded = np.array(
        [[1.0, 0, 0], [-1, 1, 0], [0, -1, 1]]
    )  # ground, ball 1 on 2, ball 2 on 3
    assert np.linalg.matrix_rank(grounded) == 3
    assert np.linalg.matrix_rank(grounded[:, :0]) == 0


@pytest.mark.parametrize(("strikers", "forward"), [(1, 2), (2, 4), (3, 5), (4, 6)])
def test_five_balls_hit_by_up_to_four(strikers, forward):
    """6.1.1.4: Hertz contacts of k = 1, balls of 1 kg at 1 m/s, by Verlet's method."""
    v = np.where(np.arange(5 + strikers) < strikers, 1.0, 0.0)
    x, step = np.zeros(len(v)), 2e-3

    def push(x):
        force = np.maximum(-np.diff(x), 0.0) ** 1.5
        return np.append(0.0, force) - np.append(force, 0.0)

    for _ in range(30_000):
        v = v + step / 2 * push(x)
        x = x + step * v
        v = v + step / 2 * push(x)
    assert (np.diff(v) > 0).all()  # over
    assert (v > 0).sum() == forward
    assert forward != strikers + 1 or strikers == 1
    if strikers == 4:
        assert np.isclose(v[v > 0].min(), 0.085, atol=2e-3)


def test_measured_shot_of_6_1_2():
    after = np.array([-0.0605, 0.1049, 0.9978])  # of equal balls, the first at 1 m/s
    assert np.isclose(after.sum(), 1.042, atol=5e-4)
    assert np.isclose(after @ after, 1.010, atol=5e-4)


def test_equation_6_79():
    """Ball 1 at a wall without restitution, ball 2 on it with e = 1, both at -1: impulses 1 and 0.

    `0 <= p_e - e p_c _|_ gamma >= 0` with gamma at the end of compression lets ball 1 into the wall.
    """
    e, N = np.array([0.0, 1.0]), np.array([[1.0, -1.0], [0.0, 1.0]])
    compressed = np.zeros(2)
    p_c = np.linalg.solve(N, compressed - np.array([-1.0, -1.0]))
    np.testing.assert_allclose(p_c, [2, 1])
    assert (N.T @ compressed == 0).all()  # so that the least p_e is allowed at t_c
    printed = N.T @ (compressed + N @ (e * p_c))
    assert printed.min() < -0.9
    s = np.array([1.0, 0.0])
    used = N.T @ (compressed + N @ (e * p_c + s))
    np.testing.assert_allclose(used, [0, 1])
    assert s @ used == 0


def test_equation_6_13():
    m, (e1, e2) = (1.0, 2.0, 3.0), (0.9, 0.8)
    m21, m32 = m[1] / m[0], m[2] / m[1]
    v, _ = collide(m, (1.0, 0.0, 0.0), (e1, e2), (0, 1))
    assert np.isclose(
        v[1], (1 - m32 * e2) * (1 + e1) / (1 + m21) / (1 + m32), rtol=1e-14
    )
    assert not np.isclose(v[1], (1 - m32 * e2) * (1 + m21 * e1) / (1 + m21), rtol=0.1)


def number_of_collisions(m, e1, e2, most):
    """The count of docs/equations.md for v- = (v, 0, 0)."""
    a, b = (1 + e1) / (1 + m[1] / m[0]), (1 + e2) / (1 + m[1] / m[2])
    cos = (a * b - e1 - e2) / (2 * np.sqrt(e1 * e2))
    sines, count = [0.0, 1.0], 0  # sin(k chi) / sin(chi), for |cos chi| > 1 too
    while count < most:
        k = count // 2
        while len(sines) < k + 2:
            sines.append(2 * cos * sines[-1] - sines[-2])
        if sines[k + 1] + (np.sqrt(e2 / e1) * sines[k] if count % 2 == 0 else 0) <= 0:
            break
        count += 1
    return count, cos


def test_number_of_collisions_of_unequal_coefficients():
    """In exact arithmetic, so that no count is a matter of rounding."""
    counts, few = set(), set()
    for _ in range(500):
        m = np.exp(rng.uniform(-2, 2, 3)).round(3)
        e = rng.uniform(0.02, 1, 2).round(3)
        exact = [[Fraction(x) for x in row] for row in (m, (1, 0, 0), e)]
        _, count = collide(*exact, (0, 1), end=True)
        reported, cos = number_of_collisions(m, *e, 40)
        assert reported == count
        counts.add(count)
        few |= {count} if cos <= -1 else set()
    assert counts >= {2, 3, 4, 5, 40}
    assert few == {2, 3}


def test_equations_6_19_and_6_20():
    """floor is one too low where pi / arccos z is no integer."""
    e, z = 0.9, 1.9 / (2 * np.sqrt(0.9)) * 0.5
    ratio = np.pi / np.arccos(z)
    _, count = collide(*([Fraction(x) for x in row] for row in ((1, 1, 1), (1, 0, 0), (e, e))),
                       (0, 1), end=True)  # fmt: skip
    assert (count, int(np.ceil(ratio) - 1), int(np.floor(ratio - 1))) == (3, 3, 2)


@pytest.mark.parametrize(("masses", "e"), [((1, 1, 1), 1), ((1, 1, 1), 0.5), ((4, 1, 4), 1), ((1, 4, 1), 1), ((1, 2, 3), 0.8)])  # fmt: skip
def test_three_collisions_or_more(masses, e):
    """N >= 3, not N <= 3, where z > 1/2."""
    first, middle, last = masses
    cosine = 1 / np.sqrt((1 + middle / first) * (1 + middle / last))
    z = (1 + e) / (2 * np.sqrt(e)) * cosine
    exactly = ([Fraction(x) for x in row] for row in (masses, (1, 0, 0), (e, e)))
    assert (collide(*exactly, (0, 1), end=True)[1] >= 3) == (z > 0.5 + 1e-12)


@pytest.mark.parametrize("ratio", [0.3, 1.0, 2.0])
def test_equation_6_16(ratio):
    """Three equal balls on linear springs: where contact 1 opens, x_1 = x_2."""
    root = np.sqrt(ratio**2 - ratio + 1)
    low, high = (np.sqrt(1 + ratio + sign * root) for sign in (-1, 1))
    stiffness = np.array([[1.0, -1, 0], [-1, 1 + ratio, -ratio], [0, -ratio, ratio]])
    values, vectors = np.linalg.eigh(stiffness)
    rates = np.sqrt(np.abs(values))

    def compression(t):  # of contact 1, from x' = (1, 0, 0)
        phase = np.where(
            rates < 1e-7, t, np.sin(rates * t) / np.where(rates < 1e-7, 1, rates)
        )
        x = vectors @ (vectors[0] * phase)
        return x[0] - x[1]

    def used(t, sign=1):
        return (root - 1 + sign * ratio) * high * np.sin(low * t) + (
            root + 1 - ratio
        ) * low * np.sin(high * t)

    times = np.linspace(0.5, 4, 3501)
    opens = times[np.argmax([compression(t) < 0 for t in times])]
    assert used(opens - 2e-3) > 0 > used(opens + 2e-3)
    printed = [used(t, -1) for t in (opens - 2e-3, opens + 2e-3)]
    assert printed[0] * printed[1] > 0


def linear_balls(ratio):
    """Squared frequencies and modes of three equal balls on linear springs."""
    return np.linalg.eigh(
        np.array([[1.0, -1, 0], [-1, 1 + ratio, -ratio], [0, -ratio, ratio]])
    )


def test_limit_without_a_second_spring():
    """k2 = 0: contact 1 opens after half a period of omega_2 = sqrt(2) omega; omega_1 is 0."""
    low, high = np.sqrt(np.abs(linear_balls(0.0)[0][1:]))
    assert np.isclose(low, 0, atol=1e-7)
    # two equal balls of 1 kg on a spring of 1 N/m, reduced mass 1/2
    assert np.isclose(np.pi / high, np.pi / np.sqrt(1 / 0.5), rtol=1e-12)


def test_remark_6_4():
    """v+ = (-1/3, 2/3, 2/3) comes back, but not after equal steps of k2/k1."""
    ratios = []
    for n in (3, 5, 7):  # omega_2 = n omega_1
        roots = np.roots([4 * n**2, -(3 * n**4 - 2 * n**2 + 3), 4 * n**2])
        ratios.append(max(roots))
        squares, modes = linear_balls(ratios[-1])
        rates = np.sqrt(np.abs(squares))
        assert np.isclose(rates[2], n * rates[1], rtol=1e-9)
        after = modes @ (modes[0] * np.cos(rates * np.pi / rates[1]))
        np.testing.assert_allclose(after, [-1 / 3, 2 / 3, 2 / 3], atol=1e-6)
    np.testing.assert_allclose(ratios, [6.171, 18.225, 36.238], rtol=1e-4)
    assert ratios[2] - ratios[1] > 1.4 * (ratios[1] - ratios[0])


def test_limit_of_a_stiff_second_contact():
    """omega_1 -> sqrt(3/2) omega: one ball against two that move as one."""
    k = 1e8
    rates = np.linalg.eigvalsh(np.array([[1.0, -1, 0], [-1, 1 + k, -k], [0, -k, k]]))
    assert np.isclose(rates[1], 1.5, rtol=1e-7)


def chain_quasi(m):
    """Delassus matrix normalized (G), its norms, and the normals of a chain."""
    normals = np.diff(np.eye(len(m)), axis=0).T
    delassus = normals.T @ np.diag(1 / np.array(m)) @ normals
    norms = np.sqrt(np.diag(delassus))
    return delassus / np.outer(norms, norms), norms, normals


def test_example_6_1():
    m = 2.0
    _, norms, normals = chain_quasi([m] * 4)
    v = np.array([0.3, -0.2, 0.5, 0.7])
    qn = normals.T @ v / norms
    np.testing.assert_allclose(qn, np.sqrt(m / 2) * np.diff(v), rtol=1e-14)
    assert not np.allclose(qn, np.diff(v) / np.sqrt(2 * m), rtol=0.1)


def test_equations_6_49_and_6_50():
    G, _, _ = chain_quasi([1.0, 2.0, 3.0])
    inverse, one = np.linalg.inv(G), np.eye(2)
    E, before = np.array([[0.7, 0.1], [0.25, 0.6]]), np.array([-1.0, -0.3])

    def change(E):
        after = -E @ before
        return 0.5 * (after @ inverse @ after - before @ inverse @ before)

    p = -inverse @ (one + E) @ before
    quadratic = (one - E) @ G @ p  # xi = 0 where qn+ = -E qn-
    assert np.isclose(
        change(E), -0.5 * p @ np.linalg.inv(one + E) @ quadratic, rtol=1e-13
    )
    assert not np.isclose(change(E), -0.5 * p @ quadratic, rtol=0.1)
    own = G @ np.array([[0.5, 0.1], [0.1, 0.3]])  # self-adjoint
    used = 0.5 * before @ (own.T @ own.T - one) @ inverse @ before
    assert np.isclose(change(own), used, rtol=1e-13)
    assert not np.isclose(
        change(own), 0.5 * before @ (own.T @ own - one) @ inverse @ before, 1e-3
    )


def test_proposition_6_4_and_remark_6_6():
    """The largest eigenvalue 0.5 does not keep diag(0.5, -2) from gaining energy; nor does e I."""
    E, before = np.diag([0.5, -2.0]), np.array([0.0, -1.0])
    assert np.linalg.eigvals(E).max() <= 1 < np.abs(np.linalg.eigvals(E)).max()
    assert np.linalg.norm(E @ before) > np.linalg.norm(before)
    G = np.array([[1.0, 0.25], [0.25, 1.0]])  # a block twice as high as wide
    assert (-np.linalg.solve(G, 1.5 * before)).min() < 0  # an impulse that pulls


def test_after_proposition_6_4():
    """E = G E^T G^-1 holds for e I, not for unequal coefficients on a diagonal."""
    G = np.array([[1.0, -0.5], [-0.5, 1.0]])  # three equal balls
    for E, holds in ((0.7 * np.eye(2), True), (np.diag([0.9, 0.3]), False)):
        assert np.allclose(E, G @ E.T @ np.linalg.inv(G), atol=1e-12) == holds


class Block:
    """m = 1 [kg], 1 x 0.5 [m], flat on the ground: G, n_q^T H, t_q^T H and so on of (6.53)-(6.61)."""

    def __init__(self):
        m, wide, high = 1.0, 1.0, 0.5
        self.mass = np.diag([m, m, m * (wide**2 + high**2) / 12])
        self.N = np.array([[0, 0], [1, 1], [-wide / 2, wide / 2]])
        self.H = np.array([[1, 1], [0, 0], [high / 2, high / 2]])
        inverse = np.linalg.inv(self.mass)
        delassus = self.N.T @ inverse @ self.N
        self.norms = np.sqrt(np.diag(delassus))
        self.n = inverse @ self.N / self.norms  # columns n_q
        t = np.linalg.svd(self.N.T)[2][-1]  # M-orthogonal to all n_q
        self.t = (t / np.sqrt(t @ self.mass @ t))[:, None]
        self.Xi = np.hstack([self.n, self.t]).T
        self.G = self.n.T @ self.mass @ self.n
        self.slip = (
            np.array([0.2, 0.3]) / self.norms * np.array([1.0, -0.4])
        )  # [mubar][xi]
        self.nH = self.n.T @ self.H
        self.G_mu = self.G - self.nH * self.slip
        self.E = np.array([[0.5, 0.1], [0.2, 0.3]])
        self.before = np.array([-1.0, -0.3, 0.7])  # qn-, qt-

    def after(self):
        """(qn+, qt+), pbar, p_t."""
        p = -np.linalg.solve(self.G_mu, (np.eye(2) + self.E) @ self.before[:2])
        p_t = -self.slip * p
        change = self.Xi @ (self.N / self.norms @ p + self.H @ p_t)
        return self.before + change, p, p_t


def test_equations_6_54_to_6_57():
    """v_t = H^T Xi^T D v with D = (Xi M Xi^T)^-1; normal velocities in units of |grad f|."""
    block = Block()
    qdot = np.array([0.1, 0.2, 1.0])
    v = block.Xi @ block.mass @ qdot
    D = np.linalg.inv(block.Xi @ block.mass @ block.Xi.T)
    np.testing.assert_allclose(
        block.H.T @ block.Xi.T @ D @ v, block.H.T @ qdot, rtol=1e-12
    )
    assert not np.allclose(block.H.T @ block.Xi.T @ v, block.H.T @ qdot, rtol=0.05)
    after, _, _ = block.after()
    rates = block.N.T @ block.Xi.T @ D @ after  # grad f^T qdot+
    target = -block.E @ block.before[:2]
    np.testing.assert_allclose(rates / block.norms, target, rtol=1e-12)
    assert not np.allclose(rates, target, rtol=0.05)


def test_equations_6_58_and_6_59():
    """G^-1, not G: then M is G^-1 whatever friction does."""
    block = Block()
    after, p, p_t = block.after()
    D = np.linalg.inv(block.Xi @ block.mass @ block.Xi.T)
    change = 0.5 * (after @ D @ after - block.before @ D @ block.before)
    qn, qt = (after + block.before)[:2], (after + block.before)[2:]
    tangential = 0.5 * qt @ D[2:, 2:] @ block.t.T @ block.H @ p_t
    inverse = np.linalg.inv(block.G)
    used = 0.5 * qn @ (p + inverse @ block.nH @ p_t) + tangential
    printed = 0.5 * qn @ (p + block.G @ block.nH @ p_t) + tangential
    assert np.isclose(used, change, rtol=1e-12)
    assert not np.isclose(printed, change, rtol=2e-3)
    G_mu, coupling = np.linalg.inv(block.G_mu), block.nH * block.slip
    np.testing.assert_allclose(G_mu - inverse @ coupling @ G_mu, inverse, atol=1e-12)
    assert not np.allclose(G_mu - block.G @ coupling @ G_mu, inverse, rtol=0.05)


def test_equation_6_61():
    """The velocity that friction adds is as large as its impulse, which is G_mu^-1 (I + E) qn-."""
    block = Block()
    _, p, p_t = block.after()
    size = np.linalg.norm(block.before[:2])
    gain = np.linalg.norm(np.eye(2) + block.E, 2) * size
    slip = np.linalg.norm(block.slip, np.inf)
    heavier = np.linalg.norm(np.linalg.inv(block.G_mu), 2)
    assert np.linalg.norm(p_t) <= slip * heavier * gain
    # sharp where (I + E) qn- points along the weakest direction: there the printed bound is broken
    weakest = np.linalg.svd(block.G_mu)[2][-1]
    qn = np.linalg.solve(np.eye(2) + block.E, weakest)
    p = np.linalg.solve(block.G_mu, (np.eye(2) + block.E) @ qn)
    bound = np.linalg.norm(np.eye(2) + block.E, 2) * np.linalg.norm(qn)
    assert np.linalg.norm(p) <= heavier * bound
    assert np.linalg.norm(p) > 1.0 * bound


def test_equation_6_61_i():
    """lambda_min(M) > lambda_max(K) lets an impact gain energy; Mbar is what (6.60) bounds it by."""
    block = Block()
    plus, minus, inverse = 1.995 * np.eye(2), 0.005 * np.eye(2), np.linalg.inv(block.G)
    # E = .995 I
    slide = block.t.T @ block.H * block.slip @ np.linalg.inv(block.G_mu) @ plus
    K, M_bar = slide.T @ slide, minus.T @ inverse @ plus
    least = [np.linalg.eigvalsh(x + x.T)[0] / 2 for x in (inverse, M_bar)]
    assert least[1] < np.linalg.eigvalsh(K)[-1] < least[0]
    assert np.linalg.eigvalsh(2 * K - M_bar - M_bar.T)[-1] > 0  # a gain, at qt- = 0


def test_proposition_6_6_2():
    """M = G^-1 is positive definite without its condition, which fails here."""
    block = Block()
    norm = [
        np.linalg.norm(x, 2)
        for x in (block.G_mu, np.linalg.inv(block.G_mu), block.G, block.nH)
    ]
    friction = 20 * np.abs(block.slip).max()
    assert np.prod(norm) * friction > 1
    assert np.linalg.eigvalsh(np.linalg.inv(block.G)).min() > 0


def test_proposition_6_6_3():
    """|E| (1 + 2 |E|) is not what its proof bounds: an M for which it promises too much."""
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    M, s = np.eye(2) + 10 * turn, 0.08
    E, limit = (
        s * turn,
        1 / np.linalg.norm(M, 2),
    )  # the symmetric part of M is the identity
    bar = (np.eye(2) - E).T @ M @ (np.eye(2) + E)
    assert s * (1 + 2 * s) < limit < s * (2 + s)
    assert np.linalg.eigvalsh(bar + bar.T).max() < 0
    for _ in range(50):  # with M = G^-1 the sharp condition is |E|^2 cond(G) < 1
        A = rng.normal(size=(2, 2))
        G, E = A @ A.T + 0.1 * np.eye(2), rng.normal(size=(2, 2))
        E *= 0.999 / np.linalg.norm(E, 2) / np.sqrt(np.linalg.cond(G))
        bar = (np.eye(2) - E).T @ np.linalg.inv(G) @ (np.eye(2) + E)
        assert np.linalg.eigvalsh(bar + bar.T).min() > 0


def test_remark_6_10():
    """The kinetic angle of a flat, wide block tends to pi/3."""
    high = 1e-4
    mass, N = (
        np.diag([1, 1, (1 + high**2) / 12]),
        np.array([[0, 0], [1, 1], [-0.5, 0.5]]),
    )
    W = N.T @ np.linalg.inv(mass) @ N
    assert np.isclose(np.arccos(-W[0, 1] / W[0, 0]), np.pi / 3, atol=1e-6)


def test_remark_6_11():
    """Two spheres of radius a and a rod of length 1: the least kinetic angle is at a = 5/24."""
    a = np.linspace(0, 5, 24_001)
    ratio = (1 + 2 * a) ** 2 / (16 * a**2 / 5 + 1 / 3 + 2 * (1 + 2 * a) ** 2)
    angle = np.arccos(-(1 / 3 - ratio) / (1 / 3 + ratio))
    assert np.isclose(a[angle.argmin()], 5 / 24, atol=1e-3)
    assert np.isclose(angle.min(), 1.42420445174657522, atol=1e-9)
    assert angle.min() < angle[0] - 0.02  # of a rod alone
    assert angle.min() < angle[-1] - 0.02


def test_rocking_matrix():
    """Housner's block: the base turns from one corner to the other, the sliding rate keeps its sign."""
    right = 0.8 * np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    printed = -right  # in the book
    before = np.array(
        [-1.0, 0.0, 0.5]
    )  # corner 1 comes down about corner 2; both slide
    _, corner_2, _ = -right @ before
    assert corner_2 > 0  # it lifts off
    _, corner_2, _ = -printed @ before
    assert corner_2 < 0  # it would go into the ground
    assert (right[:2, :2] >= 0).all()  # Prop. 6.2 (i)


def hertz(young, nu, radius):
    """Stiffness of two equal spheres; of a sphere and a plane it is sqrt(2) times as large."""
    return 4 / 3 * young / (2 * (1 - nu**2)) * np.sqrt(radius / 2)


def test_young_modulus_of_the_bead_column():
    for young, right in ((216e9, True), (210e9, False)):
        k = hertz(young, 0.276, 4e-3)
        assert np.isclose(k, 6.9716e9, rtol=2e-4) == right
        assert np.isclose(np.sqrt(2) * k, 9.858e9, rtol=2e-4) == right


def test_duration_of_one_bead():
    """34.6, not less than 32 microseconds: compression, and e times as long the expansion."""
    m, k, v, e = 2.05e-3, 9.858e9, 0.246, 0.92
    depth = (5 * m * v**2 / (4 * k)) ** 0.4
    s = (np.arange(20_000) + 0.5) / 20_000  # z = 1 - s^2 takes the singularity away
    z = 1 - s**2
    whole = np.mean(2 * s / np.sqrt(1 - z**2.5))
    assert np.isclose((1 + e) * whole * depth / v, 34.6e-6, rtol=2e-3)
