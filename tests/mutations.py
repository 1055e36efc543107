"""Which mistakes would the tests notice? Small wrong changes of the package, one after another.

    python tests/mutations.py [NAME ...] [--tests FILE ...]

Each mutation is a regular expression that finds its place in the package and what takes its place.
The package is copied, changed, and the tests that should notice are run on the copy. A table says
what was caught and by which test, what was missed, and what has no place any more.
"""

import argparse
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
LIMIT = 1500  # seconds a mutation may take


@dataclass(frozen=True)
class Mutation:
    """`find` (a regular expression, once in the package) becomes `put`; `tests` should notice."""

    name: str
    find: str
    put: str
    tests: tuple[str, ...]
    within: str = "*.py"  # files it may be in
    marks: str = "not slow"  # of these tests


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
    Mutation(  # the last one first, and no other seen on the way to it; either alone mends itself
        "events in the wrong order",
        r"(?s)free = ~s\.target\n(.*)    first = jnp\.min\(at, axis=0, keepdims=True\)",
        r"free = ~s.target & ~lands\n\1    first = jnp.max(jnp.where(at <= 1, at, -jnp.inf), axis=0, keepdims=True); first = jnp.where(first > -jnp.inf, first, jnp.min(at, axis=0, keepdims=True))",
        FLOW,
        "stepper.py",
    ),
    Mutation("dips switched off", r"dipped = turns & .*", "dipped = turns & False", ("test_methods.py::test_right_or_flagged[20-0.1]",), "stepper.py", "slow"),
    Mutation("crossings not seen", r"crossed, turns = free & \(c1 < -snap\)", "crossed, turns = free & (c1 < -1e3 * snap)", FLOW, "stepper.py"),
    Mutation("tolerance does not fall with passes", r"flow\.tolerance \* \(full / jnp\.maximum\(passes, full\)\)", "flow.tolerance * jnp.ones_like(passes)", ("test_methods.py::test_right_or_flagged_with_more_steps[3-0.7]",), "stepper.py", "slow"),
    Mutation("every step accepted", r"ok = error2 <= 1\n", "ok = error2 <= 1e6\n", FLOW, "stepper.py"),
    # --- complementarity
    Mutation("LCP: tie rules removed", r"own = candidates & ", "own = (candidates & False) & ", KINEMATIC, "lcp.py"),
    Mutation("LCP: the least ratio becomes the first", r"jnp\.argmin\(jnp\.where\(own, -jnp\.inf, ratio\)\)", "jnp.argmax(candidates)", KINEMATIC, "lcp.py"),
    Mutation("LCP: no solution is not told", r"CODE\[\"infeasible\"\], CODE\[\"max_steps\"\]\), CODE\[\"ok\"\]\)", 'CODE["ok"], CODE["max_steps"]), CODE["ok"])', KINEMATIC, "lcp.py"),
    Mutation("LCP: least norm forgotten", r"return jnp\.where\(singular, rest \+ projector @ y, z\), singular", "return z, singular", KINEMATIC, "lcp.py"),
    # --- laws
    Mutation("1 + e becomes 1 + 2 e", r"return \(1 \+ e\) \* gamma\n", "return (1 + 2 * e) * gamma\n", KINEMATIC, "kinematic.py"),
    Mutation("Poisson without the supplement", r"compression\.z \+ returned \+ supplement\.z", "compression.z + returned", KINEMATIC, "poisson.py"),
    Mutation("fastest becomes first", r"level = rivals & \(speed \+ noise >= fastest\)", "level = rivals", ("test_binary.py", "test_values.py"), "collisions.py"),
    # --- friction
    Mutation("friction along the slip", r"-modes\[2 \* m :\]\.astype\(most\.dtype\) \* most", "modes[2 * m :].astype(most.dtype) * most", ("test_friction.py",), "friction_flow.py"),
    Mutation("friction of the other contact", r"most = self\.friction \* f\n", "most = self.friction[::-1] * f\n", ("test_friction.py",), "friction_flow.py"),
    # --- impact
    Mutation("energy gain is not told", r"change > total \+ tolerance", "change > total + jnp.inf", ("test_contract.py", "test_values.py", "test_complementarity.py"), "impacts.py"),
    Mutation("pulling is not told", r"pull = jnp\.any\(p \* root < -floor\)", "pull = jnp.any(p * root < -1e9 * floor)", ("test_contract.py", "test_values.py"), "impacts.py"),
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
    Mutation("bodies that pass each other are not reported", r"again \| \(\(course", "again | (False & (course", ("test_motion_stepped.py::test_bodies_that_pass_each_other_in_a_step_are_reported",), "stepping.py"),
    Mutation("rebound of the last contact without e", r"rebound = self\.restitution \* jnp\.sqrt", "rebound = jnp.sqrt", FLOW, "contact_flow.py"),
]  # fmt: skip


def place(folder, mutation):
    """The one file in which the mutation has its place, and its new text; None: no such place."""
    found = []
    for path in sorted(folder.rglob(mutation.within)):
        text = path.read_text(encoding="utf-8")
        changed, count = re.subn(mutation.find, mutation.put, text)
        if count == 1 and changed != text:
            found.append((path, changed))
    return found[0] if len(found) == 1 else None


def tried(mutation, tests=None):
    """What became of it, how long it took, and who noticed."""
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        for part in ("jimpact", "tests", "docs", "notebooks"):
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("*.pyc"))
        for part in ("README.md", "pyproject.toml"):
            shutil.copy(ROOT / part, folder / part)
        where = place(folder / "jimpact", mutation)
        if where is None:
            return "no such place", 0.0, ""
        path, text = where
        path.write_text(text, encoding="utf-8")
        files = [f"tests/{x}" for x in tests or mutation.tests]
        command = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-x", "-q", "--no-header"]
        command += ["-o", f"addopts=-m '{mutation.marks}'", "--tb=no", *files]
        environment = os.environ | {"PYTHONPATH": str(folder), "JAX_PLATFORMS": "cpu"}
        begin = time.monotonic()
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT
            )
        except subprocess.TimeoutExpired:
            return "caught", time.monotonic() - begin, "does not end"
        seconds = time.monotonic() - begin
        noticed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.M)
        if done.returncode == 0:
            return "MISSED", seconds, ""
        if done.returncode == 5:  # of pytest
            return "NO TEST", seconds, ""
        return "caught", seconds, noticed[0] if noticed else done.stdout.splitlines()[-1]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="parts of names; default: all")
    parser.add_argument("--tests", nargs="*", help="other test files to run")
    parser.add_argument("--places", action="store_true", help="only say which have a place")
    given = parser.parse_args()
    chosen = [m for m in MUTATIONS if not given.names or any(x in m.name for x in given.names)]
    missed = 0
    print("| mutation | | seconds | noticed by |\n|---|---|---|---|")
    for mutation in chosen:
        if given.places:
            where = place(ROOT / "jimpact", mutation)
            told = "no such place" if where is None else where[0].relative_to(ROOT)
            print(f"| {mutation.name} | {told} | | |")
            continue
        became, seconds, noticed = tried(mutation, given.tests)
        missed += became == "MISSED"
        print(f"| {mutation.name} | {became} | {seconds:.0f} | {noticed} |", flush=True)
    return missed


if __name__ == "__main__":
    sys.exit(min(main(), 1))
