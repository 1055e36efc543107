"""Each bad input is one clear error on the host that names argument, value and what is allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

BALLS = ji.chain([1.0, 1.0, 1.0])
V = [1.0, 0.0, 0.0]
PAIR = ji.chain([1.0, 1.0])
TRIANGLE = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
PENTAGRAM = [[np.cos(a), np.sin(a)] for a in 0.8 * np.pi * np.arange(5)]


def samples(**options):
    """A Monte Carlo run of few samples."""
    given = {"law": ji.Binary(0.9, "earliest"), "scene": BALLS, "velocity": V}
    gaps = ji.Uniform(0.0, 1e-5)
    return ji.monte_carlo(**(given | {"gaps": gaps, "samples": 4, "progress": False} | options))


def fit_of_a_ball(**options):
    """A fit of three positions of a ball that bounces."""
    ball = ji.System(ji.Column([1.0]), gravity=True)
    given = {"measured": np.ones((3, 1)), "q0": [1.0], "v0": [0.0], "t_end": 0.3}
    return ji.fit_motion(ball, ji.Newton(0.8), **(given | options))


LAWS = [
    (lambda: ji.LZB(1.3), r"`restitution` must lie in \[0, 1\], but has value 1\.3"),
    (lambda: ji.LZB([0.5, -0.1]), r"`restitution`.*-0\.1 at index 1"),
    (lambda: ji.LZB(np.nan), r"`restitution`.*nan"),
    (lambda: ji.LZB(0.9, stiffness=0.0), r"`stiffness` must lie in \(0, inf\), but has value 0"),
    (lambda: ji.LZB(0.9, stiffness=[1.0, np.inf]), r"`stiffness`.*inf at index 1"),
    (lambda: ji.LZB(0.9, exponent=0.5), r"`exponent` must lie in \[1, inf\)"),
    (lambda: ji.LZB(0.9, exponent=(1.5, 0.9)), r"`exponent`.*0\.9 at index 1"),
    (lambda: ji.LZB(0.9, initial_energy=-1.0), r"`initial_energy`.*-1"),
    (lambda: ji.LZB(0.9, rtol=0.0), r"`rtol`"),
    (lambda: ji.LZB(0.9, method="euler"), r"`method` must be one of .*'euler'"),
    (lambda: ji.LZB("high"), r"`restitution` must be numeric"),
    (lambda: ji.LZB(None), r"`restitution` must be numeric, but has value None"),
    (lambda: ji.Newton(-0.1), r"`restitution`"),
    (lambda: ji.Moreau(-0.1), r"`restitution` must lie in \[0, 1\], but has value -0\.1"),
    (lambda: ji.Moreau([[0.5, 0.1]]), r"`restitution` must be a square matrix.*\(1, 2\)"),
    (lambda: ji.Moreau([[0.5, np.nan], [0, 0.5]]), r"`restitution`.*nan at index \(0, 1\)"),
    (lambda: ji.Poisson([0.5, 1.2]), r"`restitution`.*1\.2 at index 1"),
    (lambda: ji.Poisson(-1.0, allow_above_one=True), r"`restitution` must lie in \[0, inf\)"),
    (lambda: ji.Binary(1.1), r"`restitution`.*1\.1"),
    (lambda: ji.Binary(0.5, "slowest"), r"`order`.*'slowest'"),
    (lambda: ji.Binary(0.5, ()), r"`order`"),
    (lambda: ji.Binary(0.5, (0, 1.0)), r"`order`"),
    (lambda: ji.Binary(0.5, max_collisions=0), r"`max_collisions`"),
    (lambda: ji.Binary(0.5, max_collisions=2.5), r"`max_collisions`"),
    (lambda: ji.RestitutionMatrix([[0.5, 0.1]]), r"must be square"),
    (lambda: ji.RestitutionMatrix(0.5), r"must be square"),
    (lambda: ji.RestitutionMatrix([[0.5, np.nan], [0, 0.5]]), r"`matrix`.*\(0, 1\)"),
    (lambda: ji.RestitutionMatrix([["a"]]), r"must be numeric"),
    (lambda: ji.Compliant(1.0), r"`force`"),
    (lambda: ji.Compliant(ji.Hertz(1.0), rtol=0.0), r"`rtol`"),
    (lambda: ji.KelvinVoigt(1.0, -0.1), r"`damping`.*-0\.1"),
    (lambda: ji.HuntCrossley(0.0, 0.1), r"`stiffness`"),
    (lambda: ji.KuwabaraKono(jnp.nan, 0.1), r"`stiffness`"),
    (lambda: ji.HuntCrossley(1.0, 0.1, 0.5), r"`exponent`"),
    (lambda: ji.ElastoPlastic(1.0, 0.0), r"`yield_force` must lie in \(0, inf\), but has value 0"),
    (lambda: ji.Compliant(ji.ElastoPlastic(1.0, 1.0), friction=0.1), r"`force` must not yield"),
    (lambda: ji.Compliant(ji.ElastoPlastic(1.0, 1.0), method="implicit"), r"must not yield"),
    (lambda: ji.Compliant(ji.ElastoPlastic(1.0, 1.0), initial_energy=1.0), r"`initial_energy`"),
    (lambda: ji.Bistiffness(1.0, 0.9), r"`exponent`"),
    (lambda: ji.Bistiffness(1.0, 1.5, 1.2), r"`restitution`"),
    (lambda: ji.LinearSpring("hard"), r"`stiffness`"),
    (lambda: ji.UserForce(3.0), r"`function`"),
    (lambda: ji.UserForce(lambda x, rate, p: x, "hard"), r"`parameters`"),
    (lambda: ji.theory.distributing_rule([-1.0, 1.0], 1.0, 1.5), r"`energy`"),
    (lambda: ji.theory.precompression_energy(-1.0, 1.0), r"`force`"),
    (lambda: ji.theory.precompression_energy(1.0, 0.0), r"`stiffness`"),
]
SCENES = [
    (lambda: ji.chain([1.0, -1.0]), r"`masses` must lie in \(0, inf\).*-1 at index 1"),
    (lambda: ji.chain([1.0, np.nan]), r"`masses`"),
    (lambda: ji.chain([[1.0, 1.0]]), r"`masses` must have shape \(n,\)"),
    (lambda: ji.chain([1.0]), r"at least one contact"),
    (lambda: ji.chain([1.0, 1.0], wall="up"), r"`wall` must be one of .*'up'"),
    (lambda: ji.chain([1.0, 1.0], gaps=[-1e-6]), r"`gaps`.*-1e-06"),
    (lambda: ji.chain([1.0, 1.0], gaps=[0.0, 0.0]), r"`gaps` must have shape \(1,\)"),
    (lambda: ji.Scene([[1.0, 0.5], [0.0, 1.0]], [[1.0], [0.0]]), r"`mass` must be symmetric"),
    (lambda: ji.Scene([[1.0, 1.0], [1.0, 1.0]], [[1.0], [0.0]]), r"positive definite"),
    (lambda: ji.Scene([1.0, -1.0], [[1.0], [0.0]]), r"`mass`.*-1"),
    (lambda: ji.Scene([1.0, 1.0], [1.0, 0.0]), r"`normals` must have shape \(n, m\)"),
    (
        lambda: ji.Scene([1.0, 1.0], [[1.0, 0.0], [0.0, 0.0]]),
        r"`normals` must have no zero column.* contact 2 is zero",
    ),
    (lambda: ji.Scene([1.0, 1.0], [[np.nan], [0.0]]), r"`normals`"),
    (lambda: ji.Scene([1.0], [[1.0]], tangents=[[1.0, 0.0, 0.0]]), r"`tangents`"),
    (lambda: ji.Scene([1.0], [[1.0]], constraints=[1.0]), r"`constraints`"),
    (
        lambda: ji.Scene([1.0, 1.0], [[1.0], [0.0]], constraints=[[1.0, 2.0], [0.0, 0.0]]),
        r"`constraints` must have independent columns",
    ),
    (lambda: ji.gap_velocity(BALLS, [1.0, 0.0]), r"`velocity` must have shape \(3,\)"),
    (lambda: ji.velocity_change(BALLS, [1.0]), r"`impulse` must have shape \(2,\)"),
    (lambda: ji.Block(-1.0, 1.0, corners="base").scene(), r"`width`"),
    (lambda: ji.Block(1.0, 0.0, corners="base").scene(), r"`height`"),
    (lambda: ji.Block(1.0, 1.0, np.nan, corners="base").scene(), r"`mass`"),
    (lambda: ji.Block(1.0, 1.0, inertia=-0.1, corners="base").scene(), r"`inertia`"),
    (lambda: ji.Block(1.0, 1.0).touching(np.inf), r"`angle`"),
    (lambda: ji.Block([1.0, 2.0], 1.0, corners="base").scene(), r"`width`.*one number"),
    (lambda: ji.Block(1.0, 1.0, corners="three"), r"`corners` must be one of all, base"),
    (lambda: ji.Polygon([[0, 0], [1, 0]]), r"`corners` must have shape \(k, 2\)"),
    (lambda: ji.Polygon([[0, 0], [1, 0], [0.1, 0.1], [0, 1]]), r"convex polygon.*corner 2"),
    (lambda: ji.Polygon([[0, 0], [1, 0], [2, 0], [0, 1]]), r"convex polygon.*corner 1"),
    (lambda: ji.Polygon([[0, 0], [0, 0], [1, 0], [0, 1]]), r"convex polygon"),
    (lambda: ji.Polygon(PENTAGRAM), r"more than once"),
    (lambda: ji.Polygon(TRIANGLE, mass=0.0), r"`mass`"),
    (lambda: ji.Polygon(TRIANGLE, centre=[0.2, 0.2]), r"`inertia` must be given with `centre`"),
    (lambda: ji.Polygon(TRIANGLE, inertia=1.0, centre=[1, 1]), r"`centre` must lie inside"),
    (lambda: ji.Disc(0.0), r"`radius`"),
    (lambda: ji.Disc(1.0, inertia=1.0, centre=[1.0, 0.1]), r"`centre`"),
    (lambda: ji.Disc(0.1, inertia=1.0, centre=[0.2, 0.0]), r"`centre` must be at most 0\.1 m"),
    (lambda: ji.Bodies(ji.Disc(1.0)), r"`bodies` must be a list of bodies"),
    (lambda: ji.Bodies([ji.Disc(1.0)], planes=0.3), r"`planes` must be a list"),
    (lambda: ji.Bodies([ji.Disc(1.0)] * 2, pairs=[(0, 0.5)]), r"bodies 0 to 1"),
    (lambda: ji.Bodies([ji.Disc(1.0)]).touching(plane=3), r"`plane` must be one of 0"),
    (lambda: ji.Bodies([ji.Disc(1.0)]).at([0.0, 1.0]), r"`positions` must have shape \(1, 2\)"),
    (
        lambda: ji.Bodies([ji.Sphere(1.0)], fixed=[ji.Sphere(1.0)], places=[np.full(7, 2.0)]),
        r"`quaternion` must have length 1",
    ),
    (lambda: ji.Bodies([ji.Coin(0.1, 0.02)]), r"a Coin with round rims: give it `corners`"),
    (lambda: ji.Block(1.0, 1.0).at([0.0, 1.0, 0.0]), r"`position` must have shape \(2,\)"),
    (lambda: ji.plot.system(ji.Block(1.0, 1.0), [np.nan] * 3), r"`state` must be finite"),
    (
        lambda: ji.advise(ji.chain([1.0, 1.0]), [1.0, 0.0], ji.Newton(0.5)),
        r"`tolerance` must be numeric, but has value Newton\(",
    ),
    (lambda: ji.Bodies([ji.Column([1.0])]), r"`bodies` must hold bodies with contact points"),
    (lambda: ji.Bodies([ji.Disc(1.0)], []), r"must give a contact"),
    (lambda: ji.Bodies([ji.Disc(1.0)], [np.nan]), r"`planes`"),
    (lambda: ji.Bodies([ji.Disc(1.0)], pairs=[(0, 1)]), r"bodies 0 to 0"),
    (lambda: ji.Bodies([ji.Disc(1.0)] * 2, pairs=[(1, 1)]), r"different bodies"),
    (
        lambda: ji.Bodies([ji.Disc(1.0), ji.Dimer(0.1, 1.0)], pairs=[(0, 1)]),
        r"body 1 is a Dimer",
    ),
    (lambda: ji.Bodies([ji.Block(1, 1)] * 2, pairs=[((0, 2), (1, 0))]), r"bodies 0 to 1"),
    (lambda: ji.Box([1.0, 1.0, 0.0]), r"`sizes`"),
    (lambda: ji.Box([1.0, 1.0]), r"`sizes` must have shape \(3,\)"),
    (lambda: ji.Box([1.0, 1.0, 1.0], mass=0.0), r"`mass`"),
    (lambda: ji.Box([1.0, 1.0, 1.0], rounding=0.6), r"`rounding`"),
    (lambda: ji.Box([1.0, 1.0, 1.0], inertia=[1.0, 1.0, 2.5]), r"`inertia`.*sum of the others"),
    (lambda: ji.Box([1.0, 1.0, 1.0], inertia=[1.0, 1.0, -1.0]), r"`inertia`"),
    (lambda: ji.Box([1.0, 1.0, 1.0], inertia=1.0), r"`inertia` must have shape"),
    (lambda: ji.Box([1.0, 1.0, 1.0], inertia=np.ones(3), centre=[0, 0, 0.6]), r"`centre`"),
    (lambda: ji.Box([1.0, 1.0, 1.0], centre=[0, 0, 0.1]), r"`inertia` must be given"),
    (lambda: ji.Box([1.0, 1.0, 1.0], normal=[1.0, 0, 0]), r"`normal` must point up"),
    (lambda: ji.Sphere(-1.0), r"`radius`"),
    (lambda: ji.Sphere(1.0).touching([1.0, 1.0, 0, 0]), r"`quaternion` must have length 1"),
    (lambda: ji.Sphere(1.0).scene([0, 0, 1.0, 1, 0, 0]), r"`q` must have shape \(7,\)"),
    (lambda: ji.Dimer(-0.1, 1.0).scene(), r"`radius`"),
    (lambda: ji.Dimer(0.1, -1.0).scene(), r"`length`"),
    (lambda: ji.Dimer(0.0, 0.0).scene(), r"`length`"),
    (lambda: ji.Dimer(0.1, 1.0, rod_mass=-1.0).scene(), r"`rod_mass`"),
    (lambda: ji.SpatialDimer(0.0, 1.0).scene(), r"`radius`"),
    (lambda: ji.SpatialDimer(0.1, 1.0).touching([1.0, 1.0, 0.0, 0.0]), r"`quaternion`"),
    (lambda: ji.Corner(np.pi).scene(), r"`angle`"),
    (lambda: ji.Corner(-0.1).scene(), r"`angle`"),
    (lambda: ji.Bodies([]), "`bodies` must hold one or more"),
    (lambda: ji.PendulumCradle([1.0], 1.0, 0.1).scene(), r"two balls"),
    (lambda: ji.PendulumCradle([1.0, 1.0], -1.0, 0.1).scene(), r"`length`"),
    (lambda: ji.PendulumCradle([1.0, 1.0], 1.0, [0.1] * 3).scene(), r"`radius`"),
    (lambda: ji.PendulumCradle([1.0, 1.0], 1.0, 0.1, [0.1, 0.1]).scene(), r"`gaps`"),
    (lambda: ji.PendulumCradle([1.0, 1.0], 1.0, 0.1).scene([0.0] * 3), r"`q`"),
]
MANY = ji.Scene(np.ones(402), np.eye(402)[:, ::2], tangents=np.eye(402)[:, 1::2])
WELDED = ji.Scene([1.0] * 3, [[-1.0], [1.0], [0.0]], constraints=[[0.0], [-1.0], [1.0]])
CALLS = [
    (lambda: ji.history(ji.LZB(0.5), WELDED, [1.0, 0.0, 0.5]), "satisfy the bilateral constraints"),
    (lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, 0.0]), r"`velocity` must have shape \(3,\)"),
    (lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, 0, np.nan]), r"`velocity`.*nan at index 2"),
    (lambda: ji.impact(ji.LZB([0.9] * 3), BALLS, V), r"`restitution` must have shape \(2,\)"),
    (lambda: ji.impact(ji.LZB(0.9, exponent=(1.5,) * 3), BALLS, V), r"`exponent`.*\(2,\)"),
    (lambda: ji.impact(ji.Poisson([0.5] * 3), BALLS, V), r"`restitution` must have shape \(2,\)"),
    (lambda: ji.impact(ji.Moreau(np.eye(3)), BALLS, V), r"`restitution` must have shape \(2, 2\)"),
    (
        lambda: ji.impact(
            ji.LZB(jnp.float32(0.9), jnp.float32(1.0), initial_energy=jnp.float32(0.0), rtol=1e-8),
            ji.chain(jnp.ones(3, jnp.float32)),
            jnp.array(V, jnp.float32),
        ),
        r"`rtol` must be at least 1\.9e-06 in float32, but has value 1e-08",
    ),
    (
        lambda: ji.impact(ji.Compliant(ji.Hertz(1.0), rtol=1e-20), PAIR, [1.0, 0.0]),
        r"`rtol` must be at least",
    ),
    (lambda: ji.impact(ji.Compliant(ji.Hertz([1.0, 1.0])), PAIR, [1.0, 0.0]), r"`stiffness`"),
    (
        lambda: ji.impact(ji.Compliant(ji.KelvinVoigt(1.0, [0.1, 0.2])), PAIR, [1.0, 0.0]),
        r"`damping`",
    ),
    (
        lambda: ji.impact(ji.LZB(0.9, friction=0.1), MANY, np.ones(402)),
        r"`scene` must have at most 200 contacts .*, but has 201",
    ),
    (
        lambda: ji.impact(ji.Compliant(ji.Hertz(1.0), friction=0.1), MANY, np.ones(402)),
        r"`scene` must have at most 200 contacts .*, but has 201",
    ),
    (lambda: ji.LZB(0.9, friction=np.nan), r"`friction` must lie in \[0, inf\).*nan"),
    (lambda: ji.Moreau(0.9, friction=[0.1, -0.1]), r"`friction`.*-0\.1 at index 1"),
    (lambda: ji.impact(ji.LZB, BALLS, V), r"`law` must be of type Law"),
    (lambda: ji.impact(ji.LZB(0.9), ji.Block(1.0, 2.0), V), r"is Block\(.* `\.scene\(q\)`"),
    (lambda: ji.impact(ji.LZB(0.9), BALLS, [1.0, [0.0], 0.0]), r"`velocity`.*equally long"),
    (lambda: ji.chain(np.array([1.0, 1j])), r"`masses` must be real, but is complex"),
    (lambda: ji.chain(np.array(["2026-01-01"] * 2, "datetime64[D]")), r"`masses`.*holds dates"),
    (lambda: ji.Experiments([[1.0, 0.0], [1.0]], np.eye(2)), r"`pre`.*rows are equally long"),
    (lambda: ji.compare(BALLS, V, [ji.LZB(0.9)]), r"`laws` .* is a list.* as in \{'a': \.\.\.\}"),
    (lambda: ji.RandomLaw(ji.LZB, restitution=ji.Uniform(0.1, 0.9)), r"is the class LZB"),
    (lambda: ji.read_experiments({"pre_1[m/s]": [1.0]}), r"`path`.*make `Experiments\(pre="),
    (lambda: ji.Search("levenberg"), r"`method` must be one of .*Did you mean levenberg-marq"),
    (lambda: ji.Search(loss="hubber"), r"`loss` must be one of .*'hubber'. Did you mean huber"),
    (lambda: ji.Search("newton", max_steps=5), r"must be one of 'levenberg-marquardt', .*'newton'"),
    (lambda: ji.Search(max_steps=0), r"`max_steps` must be an int >= 1"),
    (lambda: ji.Search(seed=-1), r"`seed` must be an int >= 0"),
    (lambda: ji.Search(limit=-1.0), r"`limit` must lie in \[0, inf\)"),
    (lambda: ji.impact(ji.LZB(0.9), [1.0, 1.0, 1.0], V), r"`scene` must be of type Scene"),
    (
        lambda: ji.impact(ji.Newton(0.5), WELDED, [1.0, 0.0, 0.5]),
        r"`velocity` must satisfy .*constraint 1 has the rate 0.5",
    ),
    (lambda: ji.impact(ji.Newton(0.5), BALLS, V, noise=-1.0), r"`noise` must lie in \[0, inf\)"),
    (lambda: ji.impact(ji.Newton(0.5), BALLS, V, noise=np.nan), r"`noise`.*nan"),
    (lambda: ji.impact(ji.Newton(0.5), BALLS, V, noise=[0.1, 0.1]), r"`noise` must have shape"),
    (lambda: ji.impact(ji.Newton(0.5), BALLS, V, approach=-1.0), r"`approach`.*-1"),
    (lambda: ji.impact(ji.Binary(0.5, (0, 1, 2)), BALLS, V), r"0 to 1"),
    (lambda: ji.impact(ji.Binary(0.5, (0,)), BALLS, V), r"contact 1 is missing"),
    (lambda: ji.impact(ji.Binary(0.5, (0, 0, 1)), BALLS, V), r"twice in a row"),
    (
        lambda: ji.impact(ji.RestitutionMatrix(jnp.eye(4)), BALLS, V),
        r"shape \(2, 2\) or \(3, 3\) for 2 contacts",
    ),
    (lambda: ji.impact(ji.RestitutionMatrix(jnp.eye(3)), BALLS, V), r"must have tangents"),
    (lambda: ji.history(ji.Newton(0.9), BALLS, V), r"`law`"),
    (lambda: ji.history(ji.LZB(0.9), BALLS, V, samples=1), r"`samples`"),
    (lambda: ji.fit(ji.LZB(0.9), BALLS, [V, V]), r"`experiments` must be of type Experiments"),
    (
        lambda: ji.simulate(
            ji.Newton(0.5), ji.System(ji.Column([1.0]), gravity=True), [1.0], [0.0], 1.0
        ),
        r"`system` must be of type System",
    ),
    (lambda: ji.calibrate(ji.KelvinVoigt(1.0, 0.0), 0.01, 1.0, 1.0), r"`restitution`"),
    (lambda: ji.calibrate(ji.KelvinVoigt(1.0, 0.0), 0.5, -1.0, 1.0), r"`mass`"),
    (lambda: ji.calibrate(ji.UserForce(lambda x, rate, p: x), 0.5, 1.0, 1.0), r"`force`"),
    (
        lambda: ji.audit(BALLS, V, ji.impact(ji.Newton(0.5), BALLS, V)),
        r"audit\(out, scene, velocity\)",
    ),
    (lambda: ji.work_precision(BALLS, V, ji.LZB(0.5)), r"work_precision\(law, scene, velocity"),
    (
        lambda: ji.calibrate(
            ji.UserForce(lambda x, rate, p: x + p["damping"] * rate, {"damping": 1e-6}), 0.5, 1, 1
        ),
        r"`restitution` must be one that the force reaches",
    ),
    (lambda: ji.measured_restitution(ji.Hertz(1.0), 1.0, 0.0), r"`speed`"),
    (lambda: ji.theory.hertz_stiffness(-1.0, 0.3, 1.0), r"`modulus"),
    (lambda: ji.theory.hertz_stiffness(1.0, 0.6, 1.0), r"`poisson"),
    (lambda: ji.theory.pair_restitution(1.1, 0.5, "mean"), r"`first"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "average"), r"`rule"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "energy", 1.0), r"`stiffness2"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "mean", 1.0), r"`stiffness` must be left out"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "energy", np.inf, np.inf), r"`stiffness"),
    (lambda: ji.theory.pair_restitution(0.5, 0.5, "energy", 0.0, 1.0), r"`stiffness"),
    (lambda: ji.theory.hertz_stiffness(1.0, 0.3, 1.0, radius2=0.0), r"`radius2"),
    (lambda: ji.theory.gap_scale(PAIR, ji.Newton(1.0), [1.0, 0.0]), r"`law`"),
    (lambda: ji.theory.gap_scale(PAIR, ji.LZB(1.0), [1.0]), r"`velocity`"),
    (
        lambda: ji.theory.crossover(PAIR, ji.Compliant(ji.Hertz(1.0)), [1.0, 0.0], [0.0]),
        r"two contacts",
    ),
    (lambda: ji.theory.crossover(BALLS, ji.Compliant(ji.Hertz(1.0)), V, [[0.0]]), r"`offset`"),
    (lambda: ji.theory.rocking_dispersion(0.0), r"`aspect`"),
    (lambda: ji.theory.rocking_dispersion([[1.0]]), r"`aspect`.*one axis"),
    (lambda: ji.theory.rocking_dispersion(1.0, friction=-0.1), r"`friction`"),
    (lambda: ji.theory.rocking_dispersion(1.0, restitution=[0.5, 1.1]), r"`restitution`.*index 1"),
    (lambda: ji.theory.rocking_dispersion(1.0, exponent=0.5), r"`exponent`"),
    (lambda: ji.theory.critical_kinetic_angle(-0.1), r"`friction`"),
    (lambda: ji.theory.search_critical_angle(0.1, 0.0), r"`restitution`.*0, 1"),
    (lambda: ji.theory.rocking_matrix(1.5), r"must lie in"),
    (lambda: ji.theory.housner_restitution(0.0), r"`aspect` must lie in"),
    (lambda: ji.theory.newby_ratio(1), r"`n`"),
    (lambda: ji.theory.newby_ratio(2.5), r"`n`"),
    (lambda: ji.theory.restitution_inclusion([[1.0]], [[1.0]], 0.5, [1.0, 2.0]), r"`velocity`"),
    (
        lambda: ji.theory.restitution_inclusion([1.0], [[1.0]], 0.5, [1.0]),
        r"`coupling` must be a matrix",
    ),
    (lambda: ji.theory.restitution_inclusion([[np.nan]], [[1.0]], 0.5, [1.0]), r"`coupling`"),
]
MOTIONS = [
    ({"t_end": 0.0}, "`t_end` must be after the start at 0 s"),
    ({"t_end": (1.0, 0.5)}, "`t_end` must be after the start at 1 s, but has value 0.5"),
    ({"t_end": [0.0, 1.0, 2.0]}, r"`t_end` must be a time or a pair \(t_start, t_end\)"),
    ({"t_end": ([0.0], 1.0)}, r"`t_end` must have shape \(\) \(a time, or a pair"),
    ({"t_end": np.nan}, "`t_end` must be finite"),
    ({"q0": [-0.1]}, "no penetration"),
    ({"q0": [np.nan]}, "`q0` must be finite"),
    ({"q0": [[1.0]]}, r"`q0` must have shape \(n,\)"),
    ({"v0": [0.0, 0.0]}, r"`v0` must have shape \(1,\)"),
    ({"q0": [1.0, 2.0], "v0": [0.0, 0.0]}, r"`q0` must have shape \(1,\)"),
    ({"samples": 1}, "`samples` must be an int >= 2"),
    ({"max_events": 0}, "`max_events` must be an int >= 1"),
    ({"method": "euler"}, "`method` must be one of"),
    ({"method": "time_stepping"}, "`step` must be a number"),
    ({"method": ji.EventDriven(rtol=1e-17)}, "`rtol` must be at least"),
]
SYSTEMS = [
    (
        lambda: ji.simulate(
            ji.System(
                ji.Column([1.0]), gravity=True, base=lambda t: jnp.where(t < 0.5, 0.0, jnp.nan)
            ),
            ji.Newton(0.5),
            [1.0],
            [0.0],
            1.0,
        ),
        r"finite base motion.* at t = 0\.5",
    ),
    (lambda: ji.System(lambda q: q, [1.0], base=lambda t: t), "`base_directions` must be given"),
    (lambda: ji.System(lambda q: q, [[1.0, 2.0], [2.0, 1.0]]), "`mass` must be positive definite"),
    (lambda: ji.System(None, [1.0]), "`gap_function` must be a body or a function"),
    (
        lambda: ji.simulate(
            ji.System(ji.Block(1.0, 1.0), gravity=True, friction=[0.1, 0.2]),
            ji.Moreau(0.5),
            [0, 1, 0],
            [0] * 3,
            1.0,
        ),
        r"`friction` must have shape \(\) or \(4,\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.7), [1.0, 2.0], [1.0], [0.0], 1.0
        ),
        r"`measured` must have shape \(S, 1\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [[1.0]],
            [[1.0]],
            [[0.0]],
            1.0,
        ),
        r"`measured` must have shape \(1, S, 1\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.7), [[1.0]], [[1.0]], [0.0], 1.0
        ),
        r"`v0` must have shape \(n,\), or \(K, n\)",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.7), [[np.nan]], [1.0], [0.0], 1.0
        ),
        "at least one value",
    ),
    (
        lambda: ji.fit_motion(
            ji.System(ji.Column([1.0]), gravity=True),
            ji.Newton(0.7),
            [[1.0]],
            [1.0],
            [0.0],
            1.0,
            "stiffness",
        ),
        "must name parameters of Newton",
    ),
    (lambda: ji.compare(BALLS, V, restitutoin=0.5), "'restitutoin'. Did you mean restitution"),
    (lambda: ji.compare([1.0, 1.0], V), "`scene` must be of type Scene, but is"),
    (lambda: samples(velocity=lambda key: [1.0, 0.0, 0.0]), "`velocity` must give an array"),
    (lambda: samples(law=ji.Binary), "`law` must be a Law or a function"),
    (lambda: samples(key=2**70), "`key` must have at most 64 bits"),
    (lambda: samples(folder=3), "`folder` must be a path, but is 3"),
    (lambda: fit_of_a_ball(q0=[-1.0]), r"`q0` must have no penetration"),
    (lambda: fit_of_a_ball(t_end=-0.5), "`t_end` must be after the start"),
    (lambda: fit_of_a_ball(measured="a"), "`measured` must be numeric"),
    (lambda: fit_of_a_ball(observe=lambda m: [m.q[0, 0]]), "`observe` must give an array"),
    (lambda: fit_of_a_ball(free=None), "`free` must be of type Iterable"),
    (lambda: fit_of_a_ball(bounds=[(0, 1)]), "`bounds` must be of type Mapping"),
    (lambda: ji.Experiments([V], [V], scenes=BALLS), "`scenes` must be of type Sequence"),
    (lambda: samples(progress="x"), "`progress` must be numeric"),
    (lambda: ji.TimeStepping([0.1]), r"`step` must have shape \(\)"),
    (lambda: ji.RandomLaw(ji.Binary(0.9)), "`parameters` must name one that is random"),
    (lambda: fit_of_a_ball(sigma=np.full(3, 0.01)), r"`sigma` must have shape \(3, 1\)"),
    (lambda: fit_of_a_ball(observe="q"), "`observe` must be a function, but is 'q'"),
    (lambda: fit_of_a_ball(search="adam"), "`search` must be of type Search, but is 'adam'"),
    (lambda: ji.impact(ji.LZB, BALLS, V), r"That is the class; LZB\(\.\.\.\) makes"),
    (lambda: ji.impact("LZB", BALLS, V), r"`law` must be of type Law.*as ji\.LZB\(0\.9\)"),
    (lambda: ji.impact(BALLS, ji.LZB(0.9), V), "a Scene. The law comes before the scene"),
    (lambda: ji.impact(ji.LZB(0.9), BALLS, [V, V]), r"shape \(3,\).*jax\.vmap takes one row"),
    (lambda: ji.LZB(restituton=0.9), "no `restituton`. Did you mean restitution"),
    (lambda: ji.LZB(0.9, mu=0.3), "no `mu`. Did you mean friction"),
    (lambda: ji.RandomLaw(ji.Newton(0.9), e=ji.Uniform(0.8, 0.9)), "`e`. Did you mean restitution"),
    (lambda: ji.compare(BALLS, V, e=0.9), "'e'. Did you mean restitution"),
    (lambda: ji.fit(ji.Newton(0.5), PAIR, "a.csv"), r"'a\.csv'. `ji\.read_experiments\(path\)`"),
    (lambda: ji.fit(ji.Newton(0.5), PAIR, {}), r"is {}. `ji\.Experiments\(pre, post\)`"),
    (
        lambda: ji.fit(ji.Newton(0.5), ji.Block(0.2, 0.6), ji.Experiments([V], [V])),
        "`scene` must be of type Scene, but is Block.*A body has a scene",
    ),
    (lambda: fit_of_a_ball(search="sgd"), r"Give ji\.Search\('sgd'\)"),
    (
        lambda: ji.simulate(ji.Block(0.2, 0.6), ji.Newton(0.5), [0, 1, 0], [0, 0, 0], 1.0),
        r"but is Block.*ji\.System\(body, gravity=True\)",
    ),
    (lambda: ji.System(lambda q: q), "`mass` must be given where `gap_function` is a function"),
    (lambda: ji.summary(BALLS, BALLS, V), "`out` must be of type Impact, but is a Scene"),
    (lambda: ji.history("LZB", BALLS, V), "`law` must be of type Law, but is 'LZB'"),
    (lambda: ji.data.engine_impacts("bulet"), "'bulet'. Did you mean bullet"),
    (lambda: fit_of_a_ball(search=ji.Search(limit=-1)), r"`limit` must lie in \[0, inf\)"),
    (lambda: fit_of_a_ball(search=ji.Search(limit=np.nan)), "`limit`.*nan"),
]


@pytest.mark.parametrize(("call", "message"), [*LAWS, *SCENES, *CALLS, *SYSTEMS])
def test_bad_input(call, message):
    with pytest.raises((ValueError, TypeError), match=message) as error:
        call()
    text = str(error.value)
    assert text.count("\n") == 0
    assert "Array(" not in text
    assert "Traced" not in text


@jax.jit
@jax.vmap
def traced(velocity, noise, approach):
    """Of an impact against two welded bodies."""
    return ji.impact(ji.Newton(0.5), WELDED, velocity, noise, approach).status


def test_what_the_host_refuses_has_a_status_inside_jit():
    velocity = np.array([[1.0, 0, 0]] * 8)
    velocity[0] = 1.0, 0.0, 0.5
    velocity[1] = 1.0, 0.3, 0.3 + 1e-12  # within rounding
    noise, approach = np.zeros(8), np.zeros(8)
    noise[2:5] = approach[5:8] = -1e-9, np.nan, np.inf
    wanted = ["out_of_range", "ok", *["out_of_range", "not_finite", "out_of_range"] * 2]
    found = traced(velocity, noise, approach)
    assert [ji.STATUS[code].name for code in found] == wanted


@pytest.mark.parametrize(("change", "message"), MOTIONS)
def test_bad_motions(change, message):
    arguments = {"q0": [1.0], "v0": [0.0], "t_end": 1.0} | change
    with pytest.raises(ValueError, match=message):
        ji.simulate(ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.5), **arguments)


def test_python_numpy_and_jax_inputs_agree():
    outs = [
        ji.impact(ji.Moreau(kind([0.9, 0.8])), ji.chain(kind([1.0, 2.0, 3.0])), kind(V))
        for kind in (list, np.array, jnp.array)
    ]
    ints = ji.impact(ji.Moreau([0.9, 0.8]), ji.chain([1, 2, 3]), [1, 0, 0])
    for out in (*outs, ints):
        np.testing.assert_allclose(out.velocity, outs[0].velocity, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("gaps", lambda key: jnp.array([0.0, 1e-6])),
        ("law", lambda key: ji.Binary(0.9, "earliest")),
    ],
)
def test_a_function_that_ignores_its_key_is_told(name, function):
    with pytest.warns(UserWarning, match=f"`{name}` draws without its key"):
        samples(**{name: function})
