"""Mutation testing: which small mistakes in the package do the contract tests notice?

    python tests/mutations.py [NAME ...]
    python tests/mutations.py --places

Each mutation replaces one expression or statement of one function, both named by their syntax, so
that formatting, comments and moves between files leave it alone. The package and its tests are
copied, the mutation is applied to the copy, and the contract tests that should notice it run there.
`tests/rules/test_mutations.py` checks that every mutation has exactly one place.
"""

import argparse
import ast
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

import pytest

ROOT = Path(__file__).parent.parent
COPIED = ("jimpact", "tests", "docs", "notebooks", "README.md", "pyproject.toml")

# [s] Tests that run longer than this do not end: the mutation made a loop endless. It is many times
# what the slowest tests take on a slow machine, so that no verdict depends on speed.
ENDLESS = 3600


@dataclass(frozen=True)
class Mutation:
    """A mistake: `expression`, which occurs once in `function`, replaced by `replacement`.

    `function` is a qualified name (`Class.method`), a class, or "" for the statements of a module.
    One of the `tests` (files, or node ids, named by file) should fail with it.
    """

    name: str
    function: str
    expression: str
    replacement: str
    tests: tuple[str, ...]


# The cheapest tests first: a run ends with the first that fails.
FLOW = (
    "test_documents.py::test_docstrings_run[jimpact.core.impacts]",
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

# fmt: off
MUTATIONS = [
    Mutation("sign in the flow", "ContactFlow.normal_constants", "-ratio", "ratio", FLOW),
    Mutation("wrong exponent of the force", "ContactFlow.force", "self.exponent", "plus_one(self.exponent)", FLOW),
    Mutation("missing square of e", "ContactFlow.scales", "self.restitution", "jnp.sqrt(self.restitution)", FLOW),
    Mutation("(eta + 1)/2 becomes eta/2", "ContactFlow.normal_constants", "eta + 1", "eta", FLOW),
    Mutation("no recompression", "ContactFlow._turning", "after = jnp.where(returns, Phase.COMPRESSION, after)", "pass", FLOW),
    Mutation("no re-closing", "ContactFlow.normal_switch", "by_x | by_g", "by_x", FLOW),
    Mutation("gaps forgotten", "first_indentation", "-problem.gap", "-0.5 * problem.gap", ("test_compliant.py",)),
    Mutation("crossings are missed", "_intentions", "-zero", "-1000.0 * zero", FLOW),
    Mutation("every step accepted", "advance", "error2 <= 1", "error2 <= 1000000.0", FLOW),
    Mutation("LCP: the least ratio becomes the first", "_leaving", "jnp.argmin(ratio)", "jnp.argmax(candidates)", KINEMATIC),
    Mutation("LCP: no solution is not reported", "_support", "CODE['infeasible']", "CODE['ok']", KINEMATIC),
    Mutation("1 + e becomes 1 + 2 e", "Kinematic.required", "1 + e", "1 + 2 * e", KINEMATIC),
    Mutation("Poisson without the supplement", "Poisson.impulses", "p_c + returned + s", "p_c + returned", KINEMATIC),
    Mutation("fastest becomes first", "choose", "rivals & (speed + noise >= fastest)", "rivals", ("test_binary.py::test_against_the_plain_reference[fastest]",)),
    Mutation("friction along the slip", "FrictionFlow.constants", "-slip.astype(self.friction.dtype)", "slip.astype(self.friction.dtype)", ("test_friction.py::test_disc_in_closed_form[lzb]",)),
    Mutation("friction of the other contact", "FrictionFlow.constants", "-slip.astype(self.friction.dtype) * self.friction", "-slip.astype(self.friction.dtype) * self.friction[::-1]", ("test_friction.py::test_lzb_in_the_plane",)),
    Mutation("pulling is not reported", "_signs", "-floor", "-1000000000.0 * floor", ("test_documents.py::test_docstrings_run[jimpact.core.impacts]",)),
    Mutation("open contacts take part", "_resolved", "law.uses_gaps", "True", ("test_own_law.py::test_what_every_law_gets_for_nothing",)),
    Mutation("oblique tangents are not reported", "_is_oblique", "are_positions & (error > _ORTHONORMAL_WITHIN * bodies)", "are_positions & False & (error > _ORTHONORMAL_WITHIN * bodies)", ("test_scenes.py::test_tangents_that_distort_friction_are_reported",)),
    Mutation("energies that no number holds pass", "Traced.status", "_has_scale(size, v)", "True", ("test_contract.py::test_energies_that_no_number_holds_are_out_of_range[moreau]",)),
    Mutation("gaps that are not known count as open", "Traced._refusal", "[jnp.any(jnp.isnan(x)) for x in numbers]", "[]", ("test_contract.py::test_what_the_host_refuses_has_a_status_inside_jit[moreau]",)),
    Mutation("an asymmetric mass passes inside jit", "is_allowed", "_is_symmetric(scene.mass)", "jnp.asarray(True)", ("test_contract.py::test_what_the_host_refuses_has_a_status_inside_jit[moreau]",)),
    Mutation("constraints may be broken inside jit", "Traced._refusal", """if self.constrained:
    allowed.append(jnp.all(_keeps_constraints(scene.constraints, v)))""", """if self.constrained:
    pass""", ("test_errors_of_core.py::test_what_the_host_refuses_has_a_status_inside_jit",)),
    Mutation("negative noise passes inside jit", "Traced._refusal", "(x >= 0) & (x < jnp.inf)", "x < jnp.inf", ("test_errors_of_core.py::test_what_the_host_refuses_has_a_status_inside_jit",)),
    Mutation("freedom counted with parameters, not rank", "uncertainty", "problem.values - rank", "problem.values - len(scale)", ("test_fit.py::test_one_shot_of_three_balls_determines_two_of_three",)),
    Mutation("rank tolerance too coarse", "", "{'float64': 1e-06, 'float32': 0.001}", "{'float64': 0.1, 'float32': 0.001}", ("test_fit.py::test_one_shot_of_three_balls_determines_two_of_three", "test_fit.py::test_what_is_seen_weakly_is_seen",)),
    Mutation("standard errors without noise", "uncertainty", "noise ** 2", "noise", ("test_fit.py::test_errors_from_the_residual_are_those_of_linear_regression",)),
    Mutation("rounding taken for the noise", "uncertainty", "minimum.sum_of_squares > problem.exact_squares", "True", ("test_fit.py::test_copies_of_a_shot_are_reported",)),
    Mutation("scaled copies are not seen", "_copies", "rows / np.where(size > 0, size, 1.0)", "rows", ("test_fit.py::test_copies_of_a_shot_are_reported",)),
    Mutation("repeated readings taken for noise of 0", "_pure_error", "(complete == complete[0]).all()", "False", ("test_fit.py::test_readings_that_repeat_hide_the_noise",)),
    Mutation("kilometres an hour", "", "1 / 3.6", "1 / 36", ("test_experiments.py",)),
    Mutation("micrometres", "", "{'m': 1.0, 'cm': 0.01, 'mm': 0.001, 'um': 1e-06}", "{'m': 1.0, 'cm': 0.01, 'mm': 0.001, 'um': 0.001}", ("test_experiments.py::test_units_of_gaps",)),
    Mutation("the seed of a chunk", "Run._drawn", "jax.random.fold_in(key, np.uint32(task.number))", "key", ("test_montecarlo.py::test_random_parameters_velocities_and_their_analytic_moments", "test_montecarlo.py::test_each_sample_is_the_impact_of_its_gaps",)),
    Mutation("given samples of the next chunk", "Run.task", "values[number * size:(number + 1) * size]", "values[(number + 1) * size:(number + 2) * size]", ("test_montecarlo.py::test_given_samples_are_used_row_by_row",)),
    Mutation("normal gaps truncated at their mean", "Normal.sample", "-mean / std", "0 * mean", ("test_montecarlo.py::test_truncated_normal_gaps",)),
    Mutation("random parameters draw the same numbers", "RandomLaw.__call__", "jax.random.fold_in(key, i)", "key", ("test_montecarlo.py::test_random_parameters_are_independent",)),
    Mutation("gap scale of a single ball", "gap_scale", "2 / diagonal(delassus_matrix(scene))", "1 / diagonal(delassus_matrix(scene))", ("test_contact_scales.py::test_gap_scale",)),
    Mutation("crossover in units of the smaller indentation", "crossover", "jnp.max(scale.delta)", "jnp.min(scale.delta)", ("test_contact_scales.py::test_offsets_of_gaps_are_in_units_of_the_larger_indentation",)),
    Mutation("bodies that pass each other are not reported", "_status", "progress.closing < 0", "False & (progress.closing < 0)", ("test_motion_stepped.py::test_bodies_that_pass_each_other_in_a_step_are_reported",)),
    Mutation("an impact at the beginning of its step", "_set_up", "half * by_loads", "0.0 * by_loads", ("test_motion_stepped.py::test_an_impact_is_in_the_middle_of_its_step",)),
    Mutation("sign of e_t in time stepping", "_offsets", "e_t[:, None]", "-e_t[:, None]", ("test_motion_stepped.py::test_a_superball_leaves_with_its_slip_reversed",)),
    Mutation("rebound of the last contact without e", "ContactFlow.at_work", "self.restitution * jnp.sqrt(stored)", "jnp.sqrt(stored)", FLOW),
    Mutation("audit forgets stored energy", "audit", "change - out.initial_energy", "change", ("test_consistency.py::test_stored_energy_is_not_an_energy_gain",)),
    Mutation("the median deviation taken for sigma", "", "MEDIAN = 1.4826", "MEDIAN = 1.0", ("test_fit.py::test_the_scale_of_robust_losses_is_that_of_normal_errors",)),
    Mutation("a hundred times the rounding of velocities", "precision", "4 * eps", "400 * eps", ("test_seams.py::test_ten_times_the_rounding_is_an_impact",)),
    Mutation("degrees of freedom of the F test swapped", "_f_test", "fdtrc(more, freedom, ratio)", "fdtrc(freedom, more, ratio)", ("test_selection.py::test_the_need_of_a_dependence_on_speed_is_tested",)),
    Mutation("moments of inertia of a box with 1/10", "Box.__init__", "(jnp.sum(squares) - squares) / 12", "(jnp.sum(squares) - squares) / 10", ("test_bodies.py::test_moments_of_inertia_of_homogeneous_solids",)),
    Mutation("a rod's inertia about its end", "_dimer", "rod * length ** 2 / 12", "rod * length ** 2 / 3", ("test_scenes.py",)),
    Mutation("sign of the Coriolis terms", "Body.inertial_force", "0.5 * gradient", "-0.5 * gradient", ("test_bodies_in_motion.py::test_inertial_forces_keep_the_energy",)),
    Mutation("velocities of boxes in the axes of space", "RigidBodies.contact_jacobian", "jnp.swapaxes(self.turns(at), -1, -2)", "self.turns(at)", ("test_bodies.py::test_contacts_of_a_box",)),
    Mutation("small turns twice as large", "RigidBodies.nearby", "[scalar, half]", "[scalar, 2 * half]", ("test_motion_in_space.py::test_derivatives_at_no_displacement_take_two_terms",)),
    Mutation("time of a hop halved", "_passed", "2 * jnp.abs(p)", "jnp.abs(p)", ("test_motion.py::test_finite_accumulation_is_passed",)),
    Mutation("plastic expansion with e for its square", "unloading", "e ** 2", "e", ("test_contact_forces.py::test_a_plastic_contact_returns_its_share",)),
    Mutation("contacts of contact forces that always stick", "_new_modes", "left >= reserve", "left >= left", ("test_contact_forces.py::test_friction_on_a_slope",)),
    Mutation("contacts stick together that no forces hold", "_new_modes", "growth <= within", "growth >= 0", ("test_known_faults_of_motion.py::test_a_block_on_springs_passes_the_flat_position",)),
    Mutation("a redundant contact does not come to rest with others", "_brought_slow_to_rest.resting", "jnp.abs(left) <= strike.rest", "stopped", ("test_motion_in_space.py::test_derivatives_of_a_thrown_brick_agree_with_differences",)),
    Mutation("sides that overhang do not touch", "polygon_on_polygon", "jnp.where(nearer, gap_a, gap_b)", "gap_a", ("test_bodies.py::test_gaps_are_distances",)),
    Mutation("normals that jump are no events", "MechanicalFlow.projected", "const.active & turned", "const.active & False", ("test_known_faults_of_motion.py::test_a_corner_that_slides_over_an_edge_takes_no_energy",)),
    Mutation("springs of motions hold beyond Coulomb's limit", "SpringMotionFlow.limit", "self.coulomb * x / self.steep", "2 * self.coulomb * x / self.steep", ("test_contact_springs.py::test_a_ball_bounces_as_by_an_impact",)),
    Mutation("springs of motions as stiff as the secant", "steepness", "kappa * jnp.asarray(exponent, kappa.dtype)", "kappa", ("test_contact_springs.py::test_a_ball_bounces_as_by_an_impact",)),
    Mutation("springs that drag do not lag", "SpringMotionFlow.directions", "jnp.sin(lag)", "0 * jnp.sin(lag)", ("test_contact_springs.py::test_a_box_that_strikes_on_its_corners_agrees_with_radau",)),
    Mutation("friction of contact forces pulls", "with_normal_forces", "-size", "size", ("test_contact_forces.py::test_friction_on_a_slope",)),
    Mutation("off-diagonal of a chain's Delassus matrix shifted", "tridiagonal_product", "vector[1:]", "vector[:-1]", ("test_scenes.py::test_chain_is_the_dense_scene",)),
    Mutation("an expansion as slow as a compression", "ImplicitSteps.moved", "jnp.where(expands, e_squared, 1.0)", "1.0", ("test_implicit.py",)),
    Mutation("second stage with the radius of the first", "ImplicitSteps.frictional_impulses", "self.friction * PART", "self.friction", ("test_implicit.py",)),
    Mutation("no convex problem for fast expansions", "ImplicitSteps.normal_impulses", "unloading > 0", "unloading > jnp.inf", ("test_implicit.py",)),
    Mutation("free flight ends late", "ImplicitSteps.coasted", "wait * self.omega", "1.01 * wait * self.omega", ("test_implicit.py",)),
    Mutation("unloading forgotten", "StepProblem.projected", "self.unloading * tried[:m]", "0 * tried[:m]", ("test_implicit.py",)),
    Mutation("signs judged finer than the law's accuracy", "judged_beyond", "ACCURACIES * accuracy", "0.0", ("test_friction_reports.py::test_what_rtol_allows_is_no_gain_of_energy",)),
    Mutation("vertical and horizontal bases exchanged", "HarmonicBase.__call__", "self.direction == 'vertical'", "self.direction == 'horizontal'", ("test_documents.py::test_docstrings_run[jimpact.motion.system]",)),
    Mutation("dispersion over the sum, not the mean", "energy_dispersion", "deviation / mean", "deviation / jnp.sum(share)", ("test_methods.py::test_energy_kept_and_its_dispersion",)),
    Mutation("integral of a history without its correction", "_integral", "h ** 2", "0 * h ** 2", ("test_compliant.py::test_history_of_one_ball_on_a_linear_spring",)),
    Mutation("approach is the opening", "_history", "-_integral(seconds, rates, growth)", "_integral(seconds, rates, growth)", ("test_compliant.py::test_history_of_one_ball_on_a_linear_spring",)),
    Mutation("elastic energy of a history doubled", "_history", "unit_energy * energy[..., 0]", "2 * unit_energy * energy[..., 0]", ("test_compliant.py::test_history_of_one_ball_on_a_linear_spring",)),
    Mutation("precompression by the printed exponent", "precompression_energy", "1 / eta", "1 / (eta + 1)", ("test_contact_scales.py::test_precompression_energy",)),
    Mutation("kinetic angles of free bodies", "kinetic_angles", "delassus_matrix(scene)", "delassus_matrix(without_constraints(scene))", ("test_scenes.py::test_kinetic_angles_of_tied_bodies",)),
    Mutation("correlated contacts that keep all they take up", "_correlated", "e ** 2", "e", ("test_systems.py::test_outcomes[correlation]",)),
    Mutation("correlated contacts that separate", "_correlated", "pressed & (qn <= rest)", "pressed", ("test_contract.py::test_promises[correlation]", "test_other_laws.py",)),
    Mutation("ratios up to the arithmetic mean", "interval", "-linear", "linear", ("test_impulse_ratios.py::test_the_interval_ends_where_a_contact_stays_closed",)),
    Mutation("coefficients of Routh averaged", "Routh.impulses", "e ** 2", "e", ("test_other_laws.py::test_unequal_coefficients_of_routh_are_one",)),
    Mutation("yielding that is stored", "ContactFlow.normal_constants", "moves & (phase != Phase.YIELD)", "moves", ("test_yielding.py",)),
    Mutation("a force above its bound", "ContactFlow.normal_margins", "self.limit - x", "1.0", ("test_yielding.py",)),
    Mutation("plastic trees that end", "han_gilmore", "ROUNDING < approach <= ZERO", "ZERO < approach <= ZERO", ("test_han_gilmore.py::test_plastic_balls_collide_without_end_and_it_says_so",)),
    Mutation("trees with restitution beside one contact", "_impact", "1 + problem.restitution[at]", "1 + problem.restitution[0] ** 2", ("test_han_gilmore.py::test_losses_in_exact_arithmetic",)),
    Mutation("trees that stick beyond the cone", "_impact", "mu[at] * pushes + ZERO", "np.inf", ("test_han_gilmore.py::test_friction_of_one_contact",)),
    Mutation("opening by the printed sign", "separation_times", "g + (g * g - g) / (root + 1)", "-g + (g * g - g) / (root + 1)", ("test_domains.py::test_separation_times",)),
    Mutation("blocks that gain energy", "RockingDomain.contains", "(a >= 0) & (b >= 0) & (a + b <= 1)", "(a >= 0) & (b >= 0) & (a <= 1) & (b <= 1)", ("test_domains.py",)),
    Mutation("Leine's coefficients as they are", "audit_coefficients", "(1 - each) / (1 + each)", "1 - each", ("test_domains.py::test_unequal_coefficients_of_moreau",)),
    Mutation("the farthest side of a corner", "reentrant_corner", "approach.min", "approach.max", ("test_domains.py::test_reentrant_corner",)),
    Mutation("factor 2 of Theorem 6.2", "friction_bounds", "2 * _norm(coupling.tangential)", "_norm(coupling.tangential)", ("test_consistency.py::test_least_ratio_is_sharp_for_one_contact",)),
    Mutation("quasi-velocities without the mass", "to_quasi_velocities", "momentum(scene, v)", "v", ("test_quasi.py",)),
    Mutation("a basis that does not turn", "_terms.quasi", "s * v", "0 * s * v", ("test_accelerations.py",)),
    Mutation("one-sided confidence intervals", "Estimate.quantile", "0.5 + 0.5 * level", "level", ("test_fit.py::test_errors_from_the_residual_are_those_of_linear_regression",)),
    Mutation("bootstrap without the noise", "bootstrap", "fit.noise * np.moveaxis(z, 0, -1)", "np.moveaxis(z, 0, -1)", ("test_fit.py::test_bootstrap_scatters_as_much_as_the_standard_error",)),
    Mutation("a prior is no measured value", "FitProblem.values", "int(measured.sum() - lost) + len(self.priors)", "int(measured.sum() - lost)", ("test_fit.py::test_a_prior_weighs_like_one_more_measured_value",)),
    Mutation("Akaike's criterion without the noise", "Estimate.aic", "len(self.names) + 1", "len(self.names)", ("test_fit.py::test_parameters_by_name_and_criteria",)),
    Mutation("small-sample correction of AIC", "_aicc", "2 * k * (k + 1) / (n - k - 1)", "2 * k * (k + 1) / (n - k)", ("test_selection.py::test_the_criterion_without_sigma_is_corrected_for_few_values",)),
    Mutation("spheres of the inertia of discs", "Sphere", "0.4 * radius ** 2", "0.5 * radius ** 2", ("test_piles.py::test_spheres_are_a_body_like_others",)),
    Mutation("levers of spheres on the wrong side", "RigidBodies.contact_jacobian", "cross(lever, along)", "cross(along, lever)", ("test_piles.py::test_directions_are_velocities_of_the_points_that_touch",)),
    Mutation("MuJoCo's normals from the second geom", "_contacts", "second - first", "first - second", ("test_mujoco.py::test_gap_velocities_are_rates_of_distances",)),
    Mutation("MuJoCo's frictionless contacts rub", "_friction", "c.friction[0] if c.dim > 1 else 0.0", "c.friction[0]", ("test_mujoco.py::test_contacts_without_friction_have_none",)),
    Mutation("MuJoCo's impedance acts once on stiffness", "_restitution", "stiffness * d", "stiffness", ("test_mujoco.py::test_restitution_is_that_of_mujoco",)),
    Mutation("MuJoCo's time constants below two steps", "_stiffness_and_damping", "max(first, 2 * timestep)", "first", ("test_mujoco.py::test_restitution_is_that_of_mujoco",)),
]
# fmt: on


@functools.cache
def scopes(folder):
    """Of every qualified name of the package: the files and nodes; "" are statements of modules."""
    found = {}

    def enter(path, node, name):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                inner = f"{name}.{child.name}" if name else child.name
                found.setdefault(inner, []).append((path, child))
                enter(path, child, inner)
            elif not name and isinstance(node, ast.Module):
                found.setdefault("", []).append((path, child))
            else:
                enter(path, child, name)

    for path in sorted(folder.rglob("*.py")):
        enter(path, ast.parse(path.read_text(encoding="utf-8")), "")
    return found


def matches(mutation, scope):
    """The nodes of a scope that are the expression, or the statement, of a mutation."""
    wanted = ast.parse(mutation.expression).body[0]
    wanted = wanted.value if isinstance(wanted, ast.Expr) else wanted
    alike = [x for x in ast.walk(scope) if type(x) is type(wanted)]
    return [x for x in alike if ast.unparse(x) == mutation.expression]


def replaced(text, node, new):
    """The text with another source at the place of the node."""
    lines = [line.encode() for line in text.splitlines(keepends=True)]
    start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    indented = new.replace("\n", "\n" + " " * node.col_offset)
    source = indented if isinstance(node, ast.stmt) else f"({indented})"
    whole = text.encode()
    return (whole[:start] + source.encode() + whole[end:]).decode()


def places(mutation, folder=ROOT / "jimpact"):
    """Files and their new texts, one entry for each place that the mutation matches."""
    return [
        (path, replaced(path.read_text(encoding="utf-8"), node, mutation.replacement))
        for path, scope in scopes(folder).get(mutation.function, ())
        for node in matches(mutation, scope)
    ]


def node_of(test):
    """The node id of 'file.py::test': the folder is that of the one file of this name."""
    (path,) = (ROOT / "tests").glob(f"*/{test.partition('::')[0]}")
    return f"{path.parent.relative_to(ROOT)}/{test}"


def run(mutation):
    """Run the tests on a mutated copy: (verdict, seconds, what noticed it)."""
    at = places(mutation)
    if len(at) != 1:
        return f"{len(at)} places", 0.0, ""
    (path, text), begin = at[0], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        for part in COPIED:
            if (ROOT / part).is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(ROOT / part, folder / part, ignore=ignored)
            else:
                shutil.copy(ROOT / part, folder / part)
        (folder / path.relative_to(ROOT)).write_text(text, encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:xdist",
            "-x",
            "-q",
            "--no-header",
        ]
        command += ["-o", "addopts=--import-mode=importlib", "--tb=no", "-rfE"]
        command += [node_of(test) for test in mutation.tests]
        environment = os.environ | {"PYTHONPATH": name, "JAX_PLATFORMS": "cpu"}
        options = {
            "cwd": folder,
            "env": environment,
            "capture_output": True,
            "text": True,
        }
        try:
            session = subprocess.run(command, timeout=ENDLESS, **options)
        except subprocess.TimeoutExpired:
            return "caught", time.monotonic() - begin, "does not end"
    seconds = time.monotonic() - begin
    failures = re.findall(r"^(?:FAILED|ERROR) (\S+)", session.stdout, re.M)
    if session.returncode == pytest.ExitCode.OK:
        return "MISSED", seconds, ""
    if session.returncode in (
        pytest.ExitCode.USAGE_ERROR,
        pytest.ExitCode.NO_TESTS_COLLECTED,
    ):
        return "NO TEST", seconds, ""
    return (
        "caught",
        seconds,
        failures[0] if failures else session.stdout.splitlines()[-1],
    )


def main():
    """Print a row for each mutation; exit with 1 if one is not caught."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "names", nargs="*", help="parts of names of mutations; default: all"
    )
    parser.add_argument(
        "--places", action="store_true", help="only print the place of each"
    )
    options = parser.parse_args()
    chosen = [
        m
        for m in MUTATIONS
        if not options.names or any(x in m.name for x in options.names)
    ]
    uncaught = 0
    print("| mutation | verdict | seconds | noticed by |\n|---|---|---|---|")
    for mutation in chosen:
        if options.places:
            files = [str(path.relative_to(ROOT)) for path, _ in places(mutation)]
            verdict = (
                files[0] if len(files) == 1 else f"no such place ({len(files)} matches)"
            )
            uncaught += len(files) != 1
            print(f"| {mutation.name} | {verdict} | | |")
            continue
        verdict, seconds, test = run(mutation)
        uncaught += verdict != "caught"
        print(f"| {mutation.name} | {verdict} | {seconds:.0f} | {test} |", flush=True)
    return uncaught


if __name__ == "__main__":
    sys.exit(min(main(), 1))
