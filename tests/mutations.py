"""Mutation testing: which small mistakes in the package do the tests notice?

    python tests/mutations.py [NAME ...] [--tests FILE ...]
    python tests/mutations.py --places

Each mutation is a regular expression that matches one place of the package, and its replacement.
The package and its tests are copied, the mutation is applied to the copy, and the tests that should
notice it run there. The table says which mutations were caught, and by which test. Programs that a
mutation does not change come from the compilation cache of the environment, if there is one.

`tests/test_mutations.py` checks that every mutation has exactly one place.
"""

import argparse
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
COPIED = ("jimpact", "tests", "docs", "notebooks", "README.md", "pyproject.toml")

# [s] Tests that run longer than this do not end: the mutation made a loop endless. It is many times
# what the slowest tests take on a slow machine, so that no verdict depends on speed.
ENDLESS = 3600
NO_TESTS_COLLECTED = 5  # exit status of pytest


@dataclass(frozen=True)
class Mutation:
    """A mistake: `pattern`, which matches once in the package, replaced by `replacement`.

    `tests` (files, or node ids, in tests/) should fail with it; `within` names the files it may be
    in; `marks` selects among the tests: 'slow' where only a slow test can notice.
    """

    name: str
    pattern: str
    replacement: str
    tests: tuple[str, ...]
    within: str = "*.py"
    marks: str = "not slow and not release"


VALUES = ("test_values.py", "test_systems.py::test_outcomes")
FLOW = (
    "test_values.py::test_lzb_values",
    "test_values.py::test_lzb_edges",
    "test_values.py::test_light_and_stiff_chains",
    "test_values.py::test_compliant_values",
    "test_systems.py::test_outcomes[lzb]",
    "test_systems.py::test_outcomes[compliant]",
    "test_fast_paths.py::test_exponents_and_chains[Hertz]",
)
KINEMATIC = (
    "test_values.py::test_kinematic_values",
    "test_complementarity.py",
    "test_contract.py::test_promises[moreau]",
)
MUTATIONS = [
    # --- the flow of LZB and Compliant
    Mutation("sign in the flow", r"-ratio \* self\.omega", "ratio * self.omega", FLOW, "contact_flow.py"),
    Mutation("wrong exponent of the force", r"const\.stiffness \* power\(x, self\.exponent\)", "const.stiffness * power(x, plus_one(self.exponent))", FLOW, "contact_flow.py"),
    Mutation(
        "missing square of e",
        r"(return jnp\.where\(modes\[: self\.contacts\] == EXPANSION, )self\.restitution",
        r"\1jnp.sqrt(self.restitution)",
        FLOW,
        "contact_flow.py",
    ),
    Mutation("(eta + 1)/2 becomes eta/2", r"\(per_row\(self\.exponent, self\.omega\) \+ 1\) / 2", "per_row(self.exponent, self.omega) / 2", FLOW, "contact_flow.py"),
    Mutation("no recompression", r"after = jnp\.where\(by_g & \(phase == EXPANSION\), COMPRESSION, after\)", "pass", FLOW, "contact_flow.py"),
    Mutation("no re-closing", r"closed = \(by_x \| by_g\) & \(phase == OPEN\)", "closed = by_x & (phase == OPEN)", FLOW, "contact_flow.py"),
    Mutation("gaps forgotten", r"apart = 0\.0 if problem\.gap is None else -problem\.gap", "apart = 0.0 if problem.gap is None else -0.5 * problem.gap", (*FLOW, "test_compliant.py::test_gapped_chains_against_scipy"), "impact_dynamics.py"),
    Mutation("a touching contact at rest is open", r"\(gamma <= 0\) \| \(x > 0\), COMPRESSION", "(gamma < 0) | (x > 0), COMPRESSION", FLOW, "contact_flow.py"),
    # --- the stepper
    Mutation(  # the last event first, and none watched on the way; either alone repairs itself
        "events in the wrong order",
        r"(?s)free = ~s\.target\n(.*)    first = jnp\.min\(order, axis=0, keepdims=True\)",
        r"free = ~s.target & ~lands\n\1    first = jnp.max(jnp.where(order <= AHEAD, order, -jnp.inf), axis=0, keepdims=True); first = jnp.where(first > -jnp.inf, first, jnp.min(order, axis=0, keepdims=True))",
        FLOW,
        "stepper.py",
    ),
    Mutation("dips switched off", r"dipped = turns & .*", "dipped = turns & False", ("test_methods.py::test_right_or_flagged[20-0.1]",), "stepper.py", "slow"),
    Mutation("crossings are missed", r"crossed, turns = free & \(c1 < -snap\)", "crossed, turns = free & (c1 < -1e3 * snap)", FLOW, "stepper.py"),
    Mutation("tolerance does not fall with passes", r"flow\.tolerance \* \(full / jnp\.maximum\(passes, full\)\)", "flow.tolerance * jnp.ones_like(passes)", ("test_methods.py::test_right_or_flagged_with_more_steps[3-0.7]",), "stepper.py", "slow"),
    Mutation("every step accepted", r"ok = error2 <= 1\n", "ok = error2 <= 1e6\n", FLOW, "stepper.py"),
    # --- complementarity
    Mutation("LCP: tie rules removed", r"own = candidates & ", "own = (candidates & False) & ", KINEMATIC, "lcp.py"),
    Mutation("LCP: the least ratio becomes the first", r"jnp\.argmin\(jnp\.where\(own, -jnp\.inf, ratio\)\)", "jnp.argmax(candidates)", KINEMATIC, "lcp.py"),
    Mutation("LCP: no solution is not reported", r"CODE\[\"infeasible\"\], CODE\[\"max_steps\"\]\), CODE\[\"ok\"\]\)", 'CODE["ok"], CODE["max_steps"]), CODE["ok"])', KINEMATIC, "lcp.py"),
    Mutation("LCP: least norm forgotten", r"return jnp\.where\(singular, rest \+ projector @ y, z\), singular", "return z, singular", KINEMATIC, "lcp.py"),
    # --- laws
    Mutation("1 + e becomes 1 + 2 e", r"return \(1 \+ e\) \* gamma\n", "return (1 + 2 * e) * gamma\n", KINEMATIC, "kinematic.py"),
    Mutation("Poisson without the supplement", r"compression\.z \+ returned \+ supplement\.z", "compression.z + returned", KINEMATIC, "poisson.py"),
    Mutation("fastest becomes first", r"level = rivals & \(speed \+ noise >= fastest\)", "level = rivals", ("test_binary.py", "test_values.py"), "collisions.py"),
    # --- friction
    Mutation("friction along the slip", r"drag = -(\w+\.astype\(self\.friction\.dtype\))", r"drag = \1", ("test_friction.py",), "friction_flow.py"),
    Mutation("friction of the other contact", r"(drag = [^\n]* \* self\.friction)\n", r"\1[::-1]\n", ("test_friction.py",), "friction_flow.py"),
    # --- impact
    Mutation("energy gain is not reported", r"change > total \+ tolerance", "change > total + jnp.inf", ("test_contract.py", "test_values.py", "test_complementarity.py"), "impacts.py"),
    Mutation("pulling is not reported", r"pull = jnp\.any\(p \* root < -floor\)", "pull = jnp.any(p * root < -1e9 * floor)", ("test_contract.py", "test_values.py"), "impacts.py"),
    Mutation("energy change without v+", r"change = 0\.5 \* momentum\(scene, jump\) @ \(v \+ v_plus\)", "change = momentum(scene, jump) @ v", ("test_contract.py", "test_values.py", "test_friction.py"), "impacts.py"),
    Mutation("open contacts take part", r"part = happens & \(contact\.closed \| law\.uses_gaps\)", "part = happens & (contact.closed | True)", ("test_own_law.py", "test_contract.py"), "impacts.py"),
    # --- fits
    Mutation("freedom counted with parameters, not rank", r"freedom = values - rank\n", "freedom = values - len(names)\n", ("test_fit.py",), "uncertainty.py"),
    Mutation("rank tolerance too coarse", r"\"float64\": 1e-6", '"float64": 1e-1', ("test_fit.py",), "uncertainty.py"),
    Mutation("standard errors without noise", r"covariance = noise\*\*2 \* ", "covariance = noise * ", ("test_fit.py",), "uncertainty.py"),
    Mutation("a bound of a parameter", r"(restitution: [^\n]* = parameter\(low=0\.0, high=)1\.0\)(\n    stiffness)", r"\g<1>2.0)\2", ("test_errors.py",), "lzb.py"),
    # --- data, sampling, motion
    Mutation("a unit", r"\"in/s\": 0\.0254", '"in/s": 0.254', ("test_experiments.py",)),
    Mutation("the seed of a chunk", r"jax\.random\.fold_in\(key, np\.uint32\(task\.number\)\)", "key", ("test_montecarlo.py",)),
    Mutation("variance by n", r"self\.products / \(self\.count - 1\)", "self.products / self.count", ("test_montecarlo.py",)),
    Mutation("restitution not in the base's frame", r"relative = state\.v - carried\n    out = impact", "relative = state.v\n    out = impact", ("test_motion.py", "validation/test_validation.py")),
    Mutation("rebound of the last contact without e", r"rebound = self\.restitution \* jnp\.sqrt", "rebound = jnp.sqrt", FLOW, "contact_flow.py"),
    # --- mistakes that no default test noticed in version 0.2
    Mutation("audit forgets stored energy", r"gain = \(change - out\.initial_energy\)", "gain = change", ("test_consistency.py::test_stored_energy_is_no_gain",), "audits.py"),
    Mutation("an impact at the beginning of its step", r"jnp\.where\(strikes, 0\.5 \* h", "jnp.where(strikes, 0.0 * h", ("test_motion_stepped.py::test_an_impact_is_in_the_middle_of_its_step",), "stepping.py"),
    Mutation("hops below the rounding of gaps are resolved", r"jnp\.maximum\(slowly, jnp\.sqrt\(least_hop\)\)", "slowly", ("test_motion.py::test_hops_below_the_rounding_of_gaps_are_passed",), "transitions.py"),
    Mutation("the median deviation taken for sigma", r"MEDIAN = 1\.4826", "MEDIAN = 1.0", ("test_fit.py::test_the_scale_of_robust_losses_is_that_of_normal_errors",), "fitting.py"),
    Mutation("5/4 becomes 3/2 in the indentation of Hertz", r"1\.25 \* mass \* speed\*\*2", "1.5 * mass * speed**2", ("test_compliant.py::test_linear_forces_reach_the_indentation_of_hertz",), "calibration.py"),
    Mutation("size of grouped impacts a million times too large", r"square \+ jnp\.sum\(part\.size\*\*2\)", "square + 1e12 * jnp.sum(part.size**2)", ("test_seams.py::test_groups_are_judged_on_the_scale_of_their_impact",), "impacts.py"),
    Mutation("a hundred times the rounding of velocities", r"\nROUNDINGS = 4\n", "\nROUNDINGS = 400\n", ("test_seams.py::test_ten_times_the_rounding_is_an_impact",), "contact.py"),
    Mutation("degrees of freedom of the F test swapped", r"fdtrc\(more, rest, ratio\)", "fdtrc(rest, more, ratio)", ("test_selection.py::test_the_need_of_a_dependence_on_speed_is_tested",), "selection.py"),
    Mutation("crossover in units of the smaller indentation", r"delta = jnp\.max\(scale\.delta\)", "delta = jnp.min(scale.delta)", ("test_compliant.py::test_offsets_of_gaps_are_in_units_of_the_larger_indentation",), "gaps.py"),
    Mutation("parameters of contacts before a right wall in wrong order", r"np\.roll\(gaps, missing\), m - 1 - copied\[::-1\]", "np.roll(gaps, missing), copied", ("test_seams.py::test_each_contact_keeps_its_restitution_before_a_right_wall",), "scene.py"),
    Mutation("sign of e_t in Poisson's expansion", r"\(1 \+ e_t\) \* contact\.", "(1 - e_t) * contact.", ("test_friction.py::test_disk_in_closed_form[poisson]",), "poisson.py"),
    Mutation("nested accumulations without the root", r"jnp\.sqrt\(settings\.accumulation\)", "settings.accumulation", ("test_motion.py::test_nested_accumulations_are_passed_below_the_root_of_slow",), "transitions.py"),
    Mutation("moments of inertia of a box with 1/10", r"\(jnp\.sum\(square\) - square\) / 12", "(jnp.sum(square) - square) / 10", ("test_bodies.py::test_moments_of_inertia_of_homogeneous_solids",), "solids.py"),
]  # fmt: skip


@functools.cache
def sources(folder):
    """Text of each file of the package, by path."""
    return {path: path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.py"))}


def places(mutation, folder=ROOT / "jimpact"):
    """Files and their new texts, one entry for each place that the mutation matches."""
    return [
        (path, text[: match.start()] + match.expand(mutation.replacement) + text[match.end() :])
        for path, text in sources(folder).items()
        if path.match(mutation.within)
        for match in re.finditer(mutation.pattern, text)
    ]


def run(mutation, tests=None):
    """Run the tests on a mutated copy: (verdict, seconds, what noticed it)."""
    matches = places(mutation)
    if len(matches) != 1:
        return f"{len(matches)} places", 0.0, ""
    (path, text), begin = matches[0], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        for part in COPIED:
            if (ROOT / part).is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(ROOT / part, folder / part, ignore=ignored)
            else:
                shutil.copy(ROOT / part, folder / part)
        (folder / path.relative_to(ROOT)).write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-x", "-q", "--no-header"]
        command += ["-o", f"addopts=-m '{mutation.marks}'", "--tb=no", "-rfE"]
        command += [f"tests/{test}" for test in tests or mutation.tests]
        environment = os.environ | {"PYTHONPATH": name, "JAX_PLATFORMS": "cpu"}
        options = {"cwd": folder, "env": environment, "capture_output": True, "text": True}
        try:
            session = subprocess.run(command, timeout=ENDLESS, **options)
        except subprocess.TimeoutExpired:
            return "caught", time.monotonic() - begin, "does not end"
    seconds = time.monotonic() - begin
    failures = re.findall(r"^(?:FAILED|ERROR) (\S+)", session.stdout, re.M)
    if session.returncode == 0:
        return "MISSED", seconds, ""
    if session.returncode == NO_TESTS_COLLECTED:
        return "NO TEST", seconds, ""
    return "caught", seconds, failures[0] if failures else session.stdout.splitlines()[-1]


def main():
    """Print a row for each mutation; exit with 1 if one is not caught."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="parts of names of mutations; default: all")
    parser.add_argument("--tests", nargs="*", help="tests to run instead of those listed")
    parser.add_argument("--places", action="store_true", help="only print the place of each")
    options = parser.parse_args()
    chosen = [m for m in MUTATIONS if not options.names or any(x in m.name for x in options.names)]
    uncaught = 0
    print("| mutation | verdict | seconds | noticed by |\n|---|---|---|---|")
    for mutation in chosen:
        if options.places:
            files = [str(path.relative_to(ROOT)) for path, _ in places(mutation)]
            verdict = files[0] if len(files) == 1 else f"no such place ({len(files)} matches)"
            uncaught += len(files) != 1
            print(f"| {mutation.name} | {verdict} | | |")
            continue
        verdict, seconds, test = run(mutation, options.tests)
        uncaught += verdict != "caught"
        print(f"| {mutation.name} | {verdict} | {seconds:.0f} | {test} |", flush=True)
    return uncaught


if __name__ == "__main__":
    sys.exit(min(main(), 1))
