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

import pytest

ROOT = Path(__file__).parent.parent
COPIED = ("jimpact", "tests", "docs", "notebooks", "README.md", "pyproject.toml")

# [s] Tests that run longer than this do not end: the mutation made a loop endless. It is many times
# what the slowest tests take on a slow machine, so that no verdict depends on speed.
ENDLESS = 3600


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


def examples(module):
    """The examples in the docstrings of a module of the package."""
    return f"test_documents.py::test_docstrings_run[jimpact.{module}]"


# The cheapest tests first: a run ends with the first that fails.
FLOW = (
    examples("impacts"),
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
    Mutation("slopes of rest by way of all closings", r"jnp\.where\(carries, 0\.0, p\)\)\n( +of_rest =)", r"p)\n\1 p +", ("test_values.py::test_slopes_of_plastic_contacts",)),
    Mutation("sign in the flow", r"-ratio \* self\.omega", "ratio * self.omega", FLOW),
    Mutation("wrong exponent of the force", r"const\.stiffness \* power\(x, self\.exponent\)", "const.stiffness * power(x, plus_one(self.exponent))", FLOW),
    Mutation(
        "missing square of e",
        r"(return jnp\.where\(modes\[: self\.contacts\] == EXPANSION, )self\.restitution",
        r"\1jnp.sqrt(self.restitution)",
        FLOW,
        "contact_flow.py",
    ),
    Mutation("(eta + 1)/2 becomes eta/2", r"\(per_row\(self\.exponent, self\.omega\) \+ 1\) / 2", "per_row(self.exponent, self.omega) / 2", FLOW),
    Mutation("no recompression", r"after = jnp\.where\(by_g & \(phase == EXPANSION\), COMPRESSION, after\)", "pass", FLOW, "contact_flow.py"),
    Mutation("no re-closing", r"closed = \(by_x \| by_g\) & \(phase == OPEN\)", "closed = by_x & (phase == OPEN)", FLOW),
    Mutation("gaps forgotten", r"apart = 0\.0 if problem\.gap is None else -problem\.gap", "apart = 0.0 if problem.gap is None else -0.5 * problem.gap", (*FLOW, "test_compliant.py::test_gapped_chains_against_scipy")),
    Mutation("slopes in the exponent go unwatched", r"watches=tighten < 1 and problem\.exponent is not None", "watches=False", ("test_values.py::test_slopes_in_the_exponent_of_linear_springs",)),
    # --- the stepper
    Mutation(  # the last event first, and none watched on the way; either alone repairs itself
        "events in the wrong order",
        r"(?s)free = ~s\.target\n(.*)    first = jnp\.min\(order, axis=0, keepdims=True\)",
        r"free = ~s.target & ~lands\n\1    first = jnp.max(jnp.where(order <= AHEAD, order, -jnp.inf), axis=0, keepdims=True); first = jnp.where(first > -jnp.inf, first, jnp.min(order, axis=0, keepdims=True))",
        FLOW,
        "stepper.py",
    ),
    Mutation("impacts of a queue end in the first slots", r"x\.at\[\.\.\., s\.impact\]", "x.at[..., jnp.arange(SLOTS)]", ("test_friction.py::test_lzb_of_a_real_cube[1]",), "queues.py"),
    Mutation("results known before their tangents are not taken apart", r"if not count or all\(known\) or not all\(known\[:count\]\):", "if True:", ("test_fast_paths.py::test_values_and_forward_derivatives_are_one_program",), "batches.py"),
    Mutation("a new impact in a slot keeps the flow of the last", r"return _Slots\(impact, following, new_flow,", "return _Slots(impact, following, s.flow,", ("test_friction.py::test_lzb_of_a_real_cube[1]",), "queues.py"),
    Mutation("columns of a Jacobian are those of its first argument", r"        first \+= count\n", "", ("test_contract.py::test_derivatives[lzb]",), "sensitivity.py"),
    Mutation("dips switched off", r"dipped = turns & .*", "dipped = turns & False", ("test_motion.py::test_no_event_is_missed_between_two_looks",), "stepper.py", "slow"),
    Mutation("crossings are missed", r"crossed, turns = free & \(c1 < -zero\)", "crossed, turns = free & (c1 < -1e3 * zero)", FLOW),
    Mutation("tolerance does not fall with passes", r"flow\.tolerance \* \(full / jnp\.maximum\(passes, full\)\)", "flow.tolerance * jnp.ones_like(passes)", ("test_methods.py::test_right_or_flagged_with_more_steps[3-0.7]",), "stepper.py", "slow"),
    Mutation("every step accepted", r"ok = error2 <= 1\n", "ok = error2 <= 1e6\n", FLOW),
    Mutation("cotangents of the last step only", r"return jax\.tree\.map\(jnp\.add, sums, change\), before", "return change, before", ("test_reverse.py::test_steps_that_are_run_again_have_their_derivatives",), "reverse_mode.py"),
    Mutation("steps are run again from the wrong state", r"progress\]\), slot\)", "progress]), jnp.maximum(slot - 1, 0))", ("test_reverse.py::test_steps_that_are_run_again_have_their_derivatives",), "kept_steps.py"),
    # --- complementarity
    Mutation("LCP: the least ratio becomes the first", r"jnp\.argmin\(ratio\)", "jnp.argmax(candidates)", KINEMATIC),
    Mutation("LCP: no solution is not reported", r"end\.ray, CODE\[\"infeasible\"\]", 'end.ray, CODE["ok"]', KINEMATIC),
    Mutation("LCP: signs at the end are not checked", r"& wrong, CODE\[\"max_steps\"\]", '& False, CODE["max_steps"]', ("test_complementarity.py::test_ties_within_rounding",)),
    Mutation("LCP: pivots of rounding", r"_ROUNDING = 640\.0", "_ROUNDING = 6.4", ("test_complementarity.py::test_ties_within_rounding",)),
    Mutation("LCP: a vast solution is believed", r"jnp\.all\(signs\) & \(noise < 1\)", "jnp.all(signs)", ("test_complementarity.py::test_ties_within_rounding",)),
    Mutation("LCP: least norm forgotten", r"return jnp\.where\(singular, rest \+ projector @ y, z\), singular", "return z, singular", ("test_complementarity.py::test_redundant_contacts_share_in_equal_parts",)),
    # --- laws
    Mutation("1 + e becomes 1 + 2 e", r"return \(1 \+ e\) \* gamma\n", "return (1 + 2 * e) * gamma\n", KINEMATIC),
    Mutation("Poisson without the supplement", r"compression\.z \+ returned \+ supplement\.z", "compression.z + returned", KINEMATIC),
    Mutation("fastest becomes first", r"level = rivals & \(speed \+ noise >= fastest\)", "level = rivals", ("test_binary.py::test_against_the_plain_reference[fastest]",)),
    # --- friction
    Mutation("friction along the slip", r"drag = -(\w+\.astype\(self\.friction\.dtype\))", r"drag = \1", ("test_friction.py::test_disk_in_closed_form[lzb]",)),
    Mutation("slip that stopped is held by any force", r"jnp\.minimum\(jnp\.abs\(hold\), mu\)", "jnp.abs(hold)", ("test_friction.py::test_a_single_contact_in_closed_form",), "friction_flow.py"),
    Mutation("a single contact never turns back while it expands", r"back = square <= 0 .*", "back = square < -jnp.inf", ("test_friction.py::test_a_single_contact_in_closed_form",), "friction_flow.py"),
    Mutation("a single contact slips to its end", r"length = jnp\.where\(stops, -u / [^\n]*", "length = jnp.full_like(u, jnp.inf)", ("test_friction.py::test_a_single_contact_in_closed_form",), "friction_flow.py"),
    Mutation("a single contact expands as it is compressed", r"share = jnp\.where\(expands & ~unloaded, e\*\*2, 1\.0\)", "share = 1.0", ("test_friction.py::test_a_single_contact_in_closed_form",), "friction_flow.py"),
    Mutation("ratios of known scenes are read from traced ones", r"with jax\.ensure_compile_time_eval\(\):.*", "with jax.named_scope('check'):", ("test_other_laws.py::test_ratios_are_checked_inside_jit",), "impulse_correlation.py"),
    Mutation("friction of the other contact", r"(drag = [^\n]* \* self\.friction)\n", r"\1[::-1]\n", ("test_friction.py::test_lzb_in_the_plane",)),
    # --- impact
    Mutation("a law around another one has no capabilities", r"setattr\(around, name, _forwarded\(name\)\)", "setattr(around, name, getattr(around, name))", ("test_own_law.py",)),
    Mutation("a contact force that is not used", r"force = law\.contact_force\n", "force = getattr(law, 'force', None)\n", ("test_own_law.py",)),
    Mutation("energy gain is not reported", r"change > total \+ outcome\.noise", "change > total + jnp.inf", ("test_seams.py::test_groups_are_judged_on_the_scale_of_their_impact",)),
    Mutation("pulling is not reported", r"pull = jnp\.any\(p \* root < -floor\)", "pull = jnp.any(p * root < -1e9 * floor)", (examples("impacts"),)),
    Mutation("energy change without v+", r"change = 0\.5 \* momentum\(scene, jump\) @ \(v \+ v_plus\)", "change = momentum(scene, jump) @ v", ("test_seams.py::test_groups_are_judged_on_the_scale_of_their_impact",)),
    Mutation("open contacts take part", r"part = happens & \(contact\.closed \| law\.uses_gaps\)", "part = happens & (contact.closed | True)", ("test_own_law.py::test_what_every_law_gets_for_nothing",)),
    Mutation("any number of contacts with friction is tried", r"scene\.contacts > MOST_WITH_FRICTION", "scene.contacts > 10 * MOST_WITH_FRICTION", ("test_errors.py::test_bad_input",), "lzb.py"),
    Mutation("loops begin without the axes of a mesh", r"return start if same else .*\n", "return start\n", ("test_executors.py::test_shard_map_takes_laws[friction-moreau]",), "loops.py"),
    Mutation("impacts of a batch vary over no axis of a mesh", r"return kinds_like\((.*), kinds\[0\]\)", r"return \1", ("test_executors.py::test_shard_map_takes_laws[lzb]",), "batches.py"),
    Mutation("impacts know of the mesh", r"context\.replace\(avals_in=alone\)", "context", ("test_executors.py::test_shard_map_takes_laws[lzb]",), "batches.py"),
    Mutation("dependent tangents are not reported", r"\(least < _DEPENDENT\) & \(n >= unit\.shape\[1\]\)", "least < 0", ("test_scenes.py::test_tangents_that_distort_friction_are_reported",), "scene.py"),
    Mutation("oblique tangents are not reported", r"oblique \|= known & ", "oblique |= known & False & ", ("test_scenes.py::test_tangents_that_distort_friction_are_reported",), "scene.py"),
    Mutation("histories of what is refused", r"= self\._refusal\(\*arguments\)", "= code", ("test_compliant.py::test_the_status_of_a_history_is_that_of_the_impact",), "impacts.py"),
    Mutation("histories that are not finite", r"live\(code\[0\]\), size, finite", "live(code[0]), size, True", ("test_compliant.py::test_the_status_of_a_history_is_that_of_the_impact",)),
    Mutation("squares of extreme units", r"\(jnp\.sqrt\(\(eta \+ 1\) / 2\) \* q / jnp\.sqrt\(stiffness\)\) \*\* \(2 /", "((eta + 1) * q**2 / (2 * stiffness)) ** (1 /", ("test_contract.py::test_energies_that_no_number_holds_are_out_of_range[lzb]",)),
    Mutation("energies that no number holds pass", r"_has_scale\(size, arguments\[2\]\)", "True", ("test_contract.py::test_energies_that_no_number_holds_are_out_of_range[moreau]",), "impacts.py"),
    Mutation("gaps that are not known count as open", r"unknown = \[jnp\.any\(jnp\.isnan\(x\)\) for x in numbers\]", "unknown = []", ("test_contract.py::test_what_the_host_refuses_has_a_status_inside_jit[moreau]",), "impacts.py"),
    Mutation("an asymmetric mass passes inside jit", r"else _is_symmetric\(scene\.mass\)\]", "else jnp.asarray(True)]", ("test_contract.py::test_what_the_host_refuses_has_a_status_inside_jit[moreau]",), "scene.py"),
    Mutation("a normal of zero passes inside jit", r"allowed\.append\(jnp\.all\(_has_body\(scene\.normals\)\)\)", "pass", ("test_contract.py::test_what_the_host_refuses_has_a_status_inside_jit[moreau]",), "scene.py"),
    Mutation("constraints may be broken inside jit", r"allowed\.append\(jnp\.all\(_keeps_constraints\(scene\.constraints, v\)\)\)", "pass", ("test_errors.py::test_what_the_host_refuses_has_a_status_inside_jit",), "impacts.py"),
    Mutation("negative noise passes inside jit", r"\(x >= 0\) & \(x < jnp\.inf\)", "x < jnp.inf", ("test_errors.py::test_what_the_host_refuses_has_a_status_inside_jit",), "impacts.py"),
    # --- fits
    Mutation("a stiffness that nobody freed is fitted", r"fields\.remove\(\"stiffness\"\)", "pass", ("test_fit.py",)),
    Mutation("a correction that is not of momentum goes unreported", r"if data\.lost\[k\] and one is None", "if False", ("test_experiments.py::test_a_correction_leaves_the_errors_before_in_what_it_conserves",)),
    Mutation("errors before that a correction took are kept", r"slope\[k\] = kept @ slope\[k\]", "pass", ("test_experiments.py::test_a_correction_leaves_the_errors_before_in_what_it_conserves",)),
    Mutation("momentum lost from both ends cancels", r"shapes = \[np\.sign\(weight\), .*\]", "shapes = [np.sign(weight)]", ("test_experiments.py::test_momentum_lost_from_both_ends_is_seen",)),
    Mutation("a momentum that all shots gain goes unseen", r"shapes = \[np\.sign\(weight\), ", "shapes = [", ("test_experiments.py::test_momentum_lost_from_both_ends_is_seen",)),
    Mutation("two tests at the level of one", r"min\(chances\) < level / len\(shapes\)", "min(chances) < 4 * level", ("test_experiments.py::test_honest_momentum_is_seldom_reported",)),
    Mutation("gross defects are tested", r"GROSS = 0\.5", "GROSS = 1e9", ("test_experiments.py::test_gross_defects_need_no_test",)),
    Mutation("scaled copies are not seen", r"rows / np\.where\(size > 0, size, 1\.0\)", "rows", ("test_fit.py::test_copies_of_a_shot_are_reported",)),
    Mutation("repeated readings taken for noise of 0", r"if \(whole == whole\[0\]\)\.all\(\):", "if False:", ("test_fit.py::test_readings_that_repeat_hide_the_noise",)),
    Mutation("only sets of copies alone are named", r"2 \* copies > total > 1", "copies == total > 1", ("test_fit.py::test_readings_that_repeat_hide_the_noise",)),
    Mutation("fitted parts of a scene are not used", r"return law\.law, jax\.vmap\(law\.in_scene\)\(scenes\)", "return law.law, scenes", ("test_fit.py::test_a_mass_with_a_prior_is_fitted_with_the_law",)),
    Mutation("a tilt turns tangents the wrong way", r"tangents \* cos - normals \* sin", "tangents * cos + normals * sin", ("test_fit.py::test_parts_of_a_scene_move_it",)),
    Mutation("parts of a scene need no prior", r"if i not in priors:", "if False:", ("test_fit.py::test_bad_parts_of_a_scene",)),
    Mutation("priors far from the scene are taken", r"if not low\[i\] <= start\[i\] <= high\[i\]:", "if False:", ("test_fit.py::test_bad_parts_of_a_scene",)),
    Mutation("correlations of scatter are left out", r"rows\[np\.tril_indices\(q, -1\)\] = ", "rows[np.tril_indices(q, -1)] = 0 * ", ("test_selection.py::test_scatter_of_two_parameters",)),
    Mutation("intervals of scatter at 68 %", r"_LIMIT = 3\.8415", "_LIMIT = 1.0", ("test_selection.py::test_scatter_of_two_parameters",)),
    Mutation("rounding taken for the noise", r"elif noise is None and reproduced\(problem, minimum\):", "elif False:", ("test_fit.py::test_copies_of_a_shot_are_reported",)),
    Mutation("freedom counted with parameters, not rank", r"freedom = values - rank\n", "freedom = values - len(names)\n", ("test_fit.py::test_one_shot_of_three_balls_determines_two_of_three",)),
    Mutation("rank tolerance too coarse", r"\"float64\": 1e-6", '"float64": 1e-1', ("test_fit.py::test_one_shot_of_three_balls_determines_two_of_three", "test_fit.py::test_what_is_seen_weakly_is_seen")),
    Mutation("standard errors without noise", r"covariance = noise\*\*2 \* ", "covariance = noise * ", ("test_fit.py::test_errors_from_the_residual_are_those_of_linear_regression",)),
    Mutation("a bound of a parameter", r"(restitution: [^\n]* = parameter\(low=0\.0, high=)1\.0\)(\n    stiffness)", r"\g<1>2.0)\2", ("test_errors.py",)),
    # --- data, sampling, motion
    Mutation("a unit", r"\"in/s\": 0\.0254", '"in/s": 0.254', ("test_experiments.py",)),
    Mutation("the seed of a chunk", r"jax\.random\.fold_in\(key, np\.uint32\(task\.number\)\)", "key", ("test_montecarlo.py::test_random_parameters_velocities_and_their_analytic_moments", "test_montecarlo.py::test_each_sample_is_the_impact_of_its_gaps")),
    Mutation("variance by n", r"self\.products / \(self\.count - 1\)", "self.products / self.count", ("test_montecarlo.py::test_chunks_of_unequal_size_are_merged",)),
    Mutation("restitution not in the base's frame", r"relative = state\.v - carried\n    out = impact", "relative = state.v\n    out = impact", ("test_motion.py::test_the_base_works_at_its_own_speed",)),
    Mutation("what was not reached has derivatives 0", r"nan_derivatives\(problem, known\)", "0 * known[:, None]", ("test_motion.py::test_a_bad_motion_ends_alone",)),
    Mutation("unknown derivatives hide behind each other", r"huge \* \(huge \* times_infinity\)", "times_infinity", ("test_motion.py::test_what_a_motion_does_not_reach_has_no_derivatives",)),
    Mutation("energies not reached have derivatives 0", r"values, at\.t\.reshape\(each\)", "values, jnp.nan", ("test_motion.py::test_a_bad_motion_ends_alone",)),
    Mutation("a motion without duration is ok", r"end <= at\.t", "end < at.t", ("test_motion.py::test_a_motion_back_in_time_is_reported",)),
    Mutation("soft impacts within three steps are coarse", r"-HARD \* setup\.speed", "0 * setup.speed", ("test_motion.py::test_time_stepping_of_many_beads_comes_to_rest[law0]",)),
    Mutation("bodies beside a fast one pass each other unnoticed", r"TURN \* speeds", "TURN * jnp.max(speeds)", ("test_motion_stepped.py::test_bodies_that_pass_each_other_in_a_step_are_reported",)),
    Mutation("works of a motion that goes on begin anew", r"if name\.endswith\(\"_work\"\) else", 'if name.endswith("_works") else', ("test_reports.py::test_a_motion_goes_on",)),
    Mutation("events after the end of a motion are kept", r"known = (np\.asarray\(self\.events\.kind > 0\)) & .*", r"known = \1", ("test_reports.py::test_a_motion_goes_on",)),
    Mutation("files of another version are read", r"if int\(found\) != FORMAT", "if False", ("test_reports.py::test_files_that_hold_no_motion_are_refused",)),
    Mutation("films forget the velocities", r"return begin \* q\[k\] \+ end \* q\[k \+ 1\] \+ turns", "return begin * q[k] + end * q[k + 1]", ("test_reports.py::test_positions_between_states_follow_their_velocities",)),
    Mutation("slow films are as long as fast ones", r"int\(\(at\[-1\] - at\[0\]\) / speed \* rate", "int((at[-1] - at[0]) * rate", ("test_reports.py::test_films_run_in_time",)),
    Mutation("pictures enlarge rounding", r"if high - low < _FLAT \* scale", "if False", ("test_reports.py::test_pictures_of_many_bodies_show_those_that_move_most",)),
    Mutation("pictures show the bodies that move least", r"reverse=True\)\[:_FEW\]", "reverse=False)[:_FEW]", ("test_reports.py::test_pictures_of_many_bodies_show_those_that_move_most",)),
    Mutation("a contact changes its place where sides change", r"number % 2 == 1", "number < 0", ("test_bodies.py::test_a_contact_keeps_its_place_where_sides_change",)),
    Mutation("edges of boxes pass for faces", r"jnp\.sum\(beyond > 0, axis=1\) < 2", "jnp.sum(beyond > 0, axis=1) < 4", ("test_spatial_bodies.py::test_gaps_of_spheres_boxes_planes_and_walls",)),
    Mutation("bodies in space slip at their middles", r"point\[:, None\] - at\[None, :, :3\]", "0 * point[:, None] - 0 * at[None, :, :3]", ("test_spatial_bodies.py::test_slip_is_that_of_the_points_in_contact",)),
    Mutation("odd polygons forget their full turns", r"number \+= _full_turns", "number += 0 * _full_turns", ("test_bodies.py::test_contacts_of_odd_polygons_keep_their_places",)),
    Mutation("polygons in touch pass the cut", r"return jnp\.maximum\(off, apart", "return jnp.maximum(1.0, apart", ("test_bodies.py::test_contacts_of_odd_polygons_keep_their_places",)),
    Mutation("second bodies move as the first", r"first\.astype\(float\) - second", "first.astype(float) + second", ("test_spatial_bodies.py::test_gaps_of_spheres_boxes_planes_and_walls",), "bodies/base.py"),
    Mutation("normals of boxes turn the other way", r"cross\(points, up", "-cross(points, up", ("test_bodies.py::test_contacts_of_a_box",), "solids.py"),
    Mutation("sides that face each other least", r"jnp\.argmin\(opposite\[side_a\]\)", "jnp.argmax(opposite[side_a])", ("test_bodies.py::test_polygons_choose_their_sides",)),
    Mutation("only the first polygon's sides keep apart", r"by_b = jnp\.max\(beyond_b\) > .*", "by_b = jnp.max(beyond_b) > jnp.inf", ("test_bodies.py::test_polygons_choose_their_sides",)),
    Mutation("the mass is blamed for a start of the wrong length", r"check_shape\(\"q0\", q, mass\.shape\[:1\]", 'check_shape("q0", q, q.shape', ("test_errors.py::test_bad_motions",)),
    Mutation("bodies that pass each other are not reported", r"struck_again \| \(\(progress", "struck_again | (False & (progress", ("test_motion_stepped.py::test_bodies_that_pass_each_other_in_a_step_are_reported",), "stepping.py"),
    Mutation("rebound of the last contact without e", r"rebound = self\.restitution \* jnp\.sqrt", "rebound = jnp.sqrt", FLOW),
    # --- the command line
    Mutation("the newest programs go first", r"in sorted\(files\):", "in sorted(files, reverse=True):", ("test_program_cache.py::test_the_least_recently_used_files_go_first",), "program_cache.py"),
    Mutation("unwritable places pass", r"with tempfile\.TemporaryFile\(dir=above\):", "if above:", ("test_commands.py::test_unwritable_places_are_refused_before_anything_is_computed",), "options.py"),
    Mutation("NaN cells go unreported", r"if not_numbers:", "if not not_numbers:", ("test_commands.py::test_nan_cells_are_reported_once",), "shots_file.py"),
    Mutation("bodies at rest collide", r"(before\)\)) >= 0", r"\1 > 0", ("test_commands.py::test_velocities_without_an_impact_are_refused",), "commands.py"),
    Mutation("ranges wait for the classes", r"\n    _check_ranges\(arguments, declared\)", "", ("test_commands.py::test_typos_are_reported_before_jax_is_imported",), "study_file.py"),
    # --- mistakes that no default test noticed in version 0.2
    Mutation("audit forgets stored energy", r"gain = \(change - out\.initial_energy\)", "gain = change", ("test_consistency.py::test_stored_energy_is_not_an_energy_gain",)),
    Mutation("an impact at the beginning of its step", r"jnp\.where\(strikes, 0\.5 \* h", "jnp.where(strikes, 0.0 * h", ("test_motion_stepped.py::test_an_impact_is_in_the_middle_of_its_step",)),
    Mutation("hops below the rounding of gaps are resolved", r"jnp\.maximum\(slowly, jnp\.sqrt\(least_hop\)\)", "slowly", ("test_motion.py::test_hops_below_the_rounding_of_gaps_are_passed",)),
    Mutation("the median deviation taken for sigma", r"MEDIAN = 1\.4826", "MEDIAN = 1.0", ("test_fit.py::test_the_scale_of_robust_losses_is_that_of_normal_errors",)),
    Mutation("5/4 becomes 3/2 in the indentation of Hertz", r"1\.25 \* mass \* speed\*\*2", "1.5 * mass * speed**2", ("test_compliant.py::test_linear_forces_reach_the_indentation_of_hertz",)),
    Mutation("size of grouped impacts a million times too large", r"noise \+ jnp\.sum\(part\.noise\)", "noise + 1e12 * jnp.sum(part.noise)", ("test_seams.py::test_groups_are_judged_on_the_scale_of_their_impact",)),
    Mutation("a hundred times the rounding of velocities", r"\nROUNDINGS = 4\n", "\nROUNDINGS = 400\n", ("test_seams.py::test_ten_times_the_rounding_is_an_impact",)),
    Mutation("degrees of freedom of the F test swapped", r"fdtrc\(more, rest, ratio\)", "fdtrc(rest, more, ratio)", ("test_selection.py::test_the_need_of_a_dependence_on_speed_is_tested",)),
    Mutation("crossover in units of the smaller indentation", r"delta = jnp\.max\(scale\.delta\)", "delta = jnp.min(scale.delta)", ("test_compliant.py::test_offsets_of_gaps_are_in_units_of_the_larger_indentation",)),
    Mutation("parameters of contacts before a right wall in wrong order", r"m - 1 - copied\[::-1\]", "copied", ("test_seams.py::test_a_padded_chain_contains_itself",)),
    Mutation("sign of e_t in Poisson's expansion", r"\(1 \+ e_t\) \* contact\.", "(1 - e_t) * contact.", ("test_friction.py::test_disk_in_closed_form[poisson]",)),
    Mutation("nested accumulations without the root", r"jnp\.sqrt\(settings\.accumulation\)", "settings.accumulation", ("test_motion.py::test_nested_accumulations_are_passed_below_the_root_of_slow",), marks="slow"),
    Mutation("moments of inertia of a box with 1/10", r"\(jnp\.sum\(square\) - square\) / 12", "(jnp.sum(square) - square) / 10", ("test_bodies.py::test_moments_of_inertia_of_homogeneous_solids",)),
    # --- bodies
    Mutation("a disc rolls backwards", r"q\[0\] \+ self\.rim \* q\[2\]", "q[0] - self.rim * q[2]", ("test_bodies.py::test_an_unbalanced_disc",)),
    Mutation("disk and balls roll in the same sense", r"- self\.disk_radius \* q\[2\]", "+ self.disk_radius * q[2]", ("test_scenes.py::test_balls_roll_around_a_disk",)),
    Mutation("a rod's inertia about its end", r"self\.length\*\*2 / 12", "self.length**2 / 3", ("test_scenes.py",)),
    Mutation("inertia of a dimer about its axis halved", r"0\.8 \* body\.sphere_mass", "0.4 * body.sphere_mass", ("test_scenes.py::test_dimer_in_space",)),
    Mutation("pendulums without the square of their length", r"self\.masses \* self\.length\*\*2", "self.masses * self.length", (examples("bodies.pendulums"),)),
    Mutation("sign of the Coriolis terms", r"0\.5 \* (jax\.grad\(lambda x: v @ momentum\(x\)\)\(q\) - change)", r"-0.5 * \1", ("test_bodies.py::test_inertial_forces_keep_the_energy",)),
    Mutation("lever arm of the ellipse on the wrong side", r"\(b\*\*2 - a\*\*2\)", "(a**2 - b**2)", ("test_experiments.py::test_measured_drops",), "fits/measured.py"),
    Mutation("nearly clean impacts of the cube are left out", r"Experiments\.join\(parts\) if nearly_clean else parts\[0\]", "parts[0]", ("test_experiments.py::test_nearly_clean_impacts_of_the_cube",), "cli/study.py"),
    Mutation("closed contacts of a measured height counted from zero", r"gaps <= gaps\.min\(axis=1, keepdims=True\) \+ near", "gaps <= near", ("test_experiments.py::test_the_cube",)),
    # --- contacts and scenes
    Mutation("tangents of open contacts confused in space", r"rows = jnp\.repeat\(part, each\)", "rows = jnp.tile(part, each)", ("test_seams.py::test_open_contacts_in_space_have_no_slip",)),
    Mutation("kinetic angles without pi", r"jnp\.pi - jnp\.arccos\(jnp\.clip", "jnp.arccos(jnp.clip", ("test_scenes.py::test_normalized_quantities_and_kinetic_angles",)),
    Mutation("norm of constrained contacts", r"moved = solve_mass\(without_constraints\(scene\), scene\.normals\)", "moved = solve_mass(scene, scene.normals)", ("test_scenes.py::test_constraints_reduce_and_distort",)),
    Mutation("impulses at the other wall", r"jnp\.pad\(impulse, \(int\(not left\), int\(not right\)\)\)", "jnp.pad(impulse, (int(not right), int(not left)))", ("test_scenes.py::test_chain_is_the_dense_scene",)),
    # --- laws
    Mutation("yield speed not squared", r"y\*\*2 \+ \(1 - y\*\*2\) \* power\*\*2", "y + (1 - y) * power**2", ("test_selection.py::test_restitution_by_speed_is_what_it_says",)),
    Mutation("reference speed upside down", r"ratio = safe / self\.reference_speed", "ratio = self.reference_speed / safe", ("test_selection.py::test_restitution_by_speed_is_what_it_says",)),
    Mutation("Hertz stiffness without the root of the radius", r"\(compliance \* jnp\.sqrt\(curvature\)\)", "(compliance * curvature)", ("test_compliant.py::test_hertz_stiffness_of_the_steel_beads",)),
    Mutation("damping of Kuwabara and Kono", r"root \* \(x \+ 1\.5 \* self", "root * (x + 1.0 * self", (examples("laws.forces"),)),
    Mutation("critical damping", r"series = -2 - 4 / 3", "series = -2 + 4 / 3", ("test_compliant.py::test_restitution_of_a_damped_spring",)),
    # --- Monte Carlo
    Mutation("mean of merged chunks weighed the other way", r"a\.mean \+ d \* \(b\.count / count\)", "a.mean + d * (a.count / count)", ("test_montecarlo.py::test_chunks_of_unequal_size_are_merged",)),
    Mutation("products of merged chunks", r"\(a\.count \* b\.count / count\)", "(a.count + b.count) / 4", ("test_montecarlo.py::test_chunks_of_unequal_size_are_merged",)),
    Mutation("values outside the bins counted inside", r"np\.clip\(place, -1, bins\)", "np.clip(place, 0, bins - 1)", ("test_montecarlo.py::test_histograms_hold_what_lies_outside_the_first_range",)),
    Mutation("normal gaps truncated at their mean", r"key, -mean / std, jnp\.inf", "key, 0 * mean, jnp.inf", ("test_montecarlo.py::test_truncated_normal_gaps",)),
    Mutation("random parameters draw the same numbers", r"jax\.random\.fold_in\(key, i\)", "key", ("test_montecarlo.py::test_random_parameters_are_independent",)),
    Mutation("numbers of bad samples", r"task\.number \* len\(samples\[\"status\"\]\) \+ lanes", "task.number * count + lanes", ("test_montecarlo.py::test_bad_samples_are_numbered_over_all_chunks",)),
    Mutation("gap scale of a single ball", r"work = 2 / diagonal", "work = 1 / diagonal", ("test_compliant.py::test_gap_scale",)),
    # --- fits
    Mutation("degrees of freedom of the noise swapped", r"fdtrc\(rest, count, ratio\)", "fdtrc(count, rest, ratio)", ("test_fit.py::test_lack_of_fit_is_reported_from_its_level_on",)),
    Mutation("a lower minimum stays with the profile that found it", r"self\._lower\(\*best\)", "self.least = best[0]", ("test_fit.py::test_a_lower_minimum_of_one_profile_is_that_of_all",)),
    Mutation("profiles after lack of fit", r"fit\.linearization_misleads and not fit\.shows_lack_of_fit", "fit.linearization_misleads", ("test_fit.py::test_lack_of_fit_gets_no_profiles_of_itself",)),
    Mutation("errors of v- as if v+ had them", r"slopes=\[solution\.slopes\]", "slopes=None", ("test_fit.py::test_a_saved_fit_is_the_same_fit",)),
    Mutation("scatter that accounts for all of chi^2", r"share=1 - squares / model", "share=1 - 0 * squares / model", ("test_selection.py::test_scatter_between_shots",)),
    Mutation("masses of nothing in files", r"column\.kind == \"mass\" and number <= 0", "False", ("test_experiments.py::test_bad_further_columns",)),
    Mutation("predictions of what is no number", r" {4}check_values\(\"shots\", data\)\n", "", ("test_fit.py::test_further_shots_are_predicted_with_errors",)),
    Mutation("holes of a scan are left", r"not self\.fill_holes\(\) and", "True and", ("test_fit.py::test_holes_that_a_scan_left_are_filled",)),
    Mutation("outliers hide in the noise of a robust loss", r"_beyond_median if robust else _beyond_others", "_beyond_others", ("test_fit.py::test_outliers_do_not_hide_each_other_from_a_robust_loss",)),
    Mutation("priors leave errors as they are", r"np\.vstack\(\[size \* minimum\.jacobian, of_priors \* scale\]\)", "size * minimum.jacobian", ("test_fit.py::test_a_prior_weighs_like_one_more_measured_value",)),
    Mutation("a prior is no measured value", r"int\(here\.sum\(\)\) \+ len\(priors\)", "int(here.sum())", ("test_fit.py::test_a_prior_weighs_like_one_more_measured_value",)),
    Mutation("density of the data with that of priors", r"jnp\.sum\(self\._of_data\(x\) \*\* 2\)", "jnp.sum(self.residual(x) ** 2)", ("test_fit.py::test_a_prior_weighs_like_one_more_measured_value",)),
    Mutation("bootstrap without the errors of priors", r"fit\.noise \* prior\.std \* drawn", "0 * drawn", ("test_fit.py::test_a_prior_weighs_like_one_more_measured_value",)),
    Mutation("priors held against their own errors alone", r"left = 1 - float\(known\[row\] @ known\[row\]\)", "left = 1.0", ("test_fit.py::test_a_prior_that_the_data_contradict_is_named",)),
    Mutation("the next shot without priors", r"known = known \+ from_priors\.T @ from_priors", "pass", ("test_fit.py::test_what_only_a_prior_knows_is_said_to_be_its",)),
    Mutation("tied entries stay free", r"labels\[field\]\.flat\[at\] = 0", "pass", ("test_fit.py::test_ties_reach_across_fields_in_any_order",)),
    Mutation("a tie sees the start of another", r"flat = flat\.at\[np\.array\(tied\)\]\.set\(self\._follow\(other\)\)", "flat = flat if self.waiting else flat.at[np.array(tied)].set(self._follow(other))", ("test_fit.py::test_ties_reach_across_fields_in_any_order",)),
    Mutation("bands without the noise of a measurement", r"quantile \* np\.hypot\(error, noise\)", "quantile * error", ("test_fit.py::test_further_shots_are_predicted_with_errors",)),
    Mutation("predictions in any scene", r"or counts - \{scene\.contacts\}", "", ("test_fit.py::test_further_shots_are_predicted_with_errors",)),
    Mutation("a saved fit forgets its priors", r"parts\[\"free\"\], bounds, parts\[\"priors\"\]", 'parts["free"], bounds', ("test_fit.py::test_a_saved_fit_is_the_same_fit",)),
    Mutation("a saved fit of any format is read", r'record\["format"\] != FORMAT', "False", ("test_fit.py::test_a_saved_fit_is_the_same_fit",)),
    Mutation("rounding counts twice in joined data", r"resolution = changed\.pop\(\"resolution\", self\.resolution\)", "resolution = changed.get(\"resolution\", self.resolution)", ("test_experiments.py::test_data_sets_are_joined",)),
    Mutation("joined shots lose what a correction took", r"lost = \[k for data in many for k in data\.lost\]", "lost = 0", ("test_experiments.py::test_data_sets_are_joined",)),
    Mutation("matrices projected on a ray", r"return nearest\(self, y\)", "return self.retract(y)", ("test_matrix_fit.py::test_the_projection_is_the_nearest_admissible_matrix",)),
    Mutation("regions of a corner plot as of one parameter", r"chdtri\(2, 1 - share\)", "chdtri(1, 1 - share)", ("test_pictures.py::test_regions_of_a_corner_plot_hold_what_they_say",)),
    Mutation("entries counted from 0", r"tuple\(int\(i\) - 1 for i in part", "tuple(int(i) - 0 for i in part", ("test_fit.py::test_entries_are_named_as_in_the_report",)),
    Mutation("bounds of an entry are those of the first", r"ends\[:, first \+ np\.array\(at\)\]", "ends[:, [first] * len(at)]", ("test_fit.py::test_entries_are_named_as_in_the_report",)),
    Mutation("Akaike's criterion without the noise", r"np\.log\(squares / values\) \+ 2 \* \(len\(self\.names\) \+ 1\)", "np.log(squares / values) + 2 * len(self.names)", ("test_fit.py::test_parameters_by_name_and_criteria",)),
    Mutation("predictions from starts have errors", r"np\.where\(blind, np\.inf, np\.sqrt\(variance\)\)", "np.sqrt(variance)", ("test_fit.py::test_further_shots_are_predicted_with_errors",)),
    Mutation("a start is printed as a value", r"if seen else f\"\(\{value:\{digits\}\}\)\"", 'if True else ""', ("test_reports.py::test_values_that_the_data_do_not_determine_are_marked",)),
    Mutation("a profile of anything counts as a value", r"seen\[i\] &= each\.words != \"anything\"", "pass", ("test_reports.py::test_values_that_the_data_do_not_determine_are_marked",)),
    Mutation("reservations are left out of the sentence", r"    if reserved:\n        sentence \+=", "    if False:\n        sentence +=", ("test_reports.py::test_a_sentence_to_quote_holds_its_reservations",)),
    Mutation("assumptions are left out of the sentence", r"if parts and assumed:", "if False:", ("test_reports.py::test_a_sentence_to_quote_holds_its_reservations",)),
    Mutation("a law fails in some where it fails in all", r"if failing == len\(fit\.status\):", "if False:", ("test_reports.py::test_a_sentence_to_quote_holds_its_reservations",)),
    Mutation("many shots tested each at the full level", r"LEVEL / len\(shots\)", "LEVEL", ("test_fit.py::test_honest_shots_are_seldom_suspicious",)),
    Mutation("region of two parameters with estimated noise", r"\(-2 / freedom\) - 1\)", "(-1 / freedom) - 1)", ("test_fit.py::test_contours_of_linear_problems_are_ellipses",)),
    Mutation("chance of scatter not halved", r"chance=0\.5 \* float\(chdtrc", "chance=float(chdtrc", ("test_selection.py::test_the_chance_of_scatter_is_half_that_of_chi_squared",)),
    Mutation("one-sided test of a trend", r"return 2 \* float\(stdtr", "return float(stdtr", ("test_selection.py::test_a_trend_over_the_shots_has_two_sides",)),
    Mutation("small-sample correction of AIC", r"2 \* k \* \(k \+ 1\) / \(n - k - 1\)", "2 * k * (k + 1) / (n - k)", ("test_selection.py::test_the_criterion_without_sigma_is_corrected_for_few_values",)),
    Mutation("height of a bounce", r"v \* jnp\.abs\(v\) / \(2 \* STANDARD_GRAVITY\)", "v * jnp.abs(v) / STANDARD_GRAVITY", ("test_observables.py::test_energies_and_bounces",)),
    Mutation("worth of angular errors upside down", r"masses\[~turns\]\.mean\(\) / masses\[turns\]\.mean\(\)", "masses[turns].mean() / masses[~turns].mean()", ("test_fit.py::test_turning_weighs_by_kinetic_energy",)),
    Mutation("a scan takes no step of the others", r' \+ np\.einsum\("krp,kp->kr", jacobian, ahead\)', "", ("test_fit.py::test_a_scan_finds_the_valleys_of_other_parameters_after_their_step",)),
    Mutation("slopes of a scan with the others held", r'slope = slope - np\.einsum\("kro,ko->kr", others, follow\)', "pass", ("test_fit.py::test_a_scan_finds_the_valleys_of_other_parameters_after_their_step",)),
    Mutation("starts far behind go on as long as others", r"np\.where\(behind, BEHIND_PASSES, SLOW_PASSES\)", "SLOW_PASSES", ("test_fit.py::test_starts_far_behind_the_best_are_given_up_sooner",)),
    Mutation("fits of their own are rivals", r"rivals & \(states\.cost", "(states.cost", ("test_fit.py::test_starts_far_behind_the_best_are_given_up_sooner",)),
    Mutation("all motions of a fit begin alike", r"one\)\(self\.q0\[at\]", "one)(self.q0[0 * at]", ("test_motion.py::test_several_motions_are_fitted_at_once",), "motion/fitting_motion.py"),
    Mutation("the last lot of motions is cut short", r"-\(-count // lanes\) \* lanes\), count - 1", "(count // lanes) * lanes), count - 1", ("test_motion.py::test_several_motions_are_fitted_at_once",), "motion/fitting_motion.py"),
    Mutation("the best shot for another parameter", r"merit = -np\.linalg\.inv\(after\)\[:, i, i\]", "merit = -np.linalg.inv(after)[:, 0, 0]", ("test_fit.py::test_the_next_shot_is_the_one_that_tells_most",)),
    # --- packings
    Mutation("masses of the other body in a packing", r"moved = self\.directions / self\._at_bodies\(mass\)", "moved = self.directions / self._at_bodies(mass)[:, ::-1]", ("test_piles.py::test_a_packing_has_the_contacts_of_its_body",)),
    Mutation("walls of a packing move", r"directions\[:, :, 1\] \*= \(bodies\[:, 1\] >= 0\)\[:, None, None\]", "pass", ("test_piles.py::test_a_packing_has_the_contacts_of_its_body",)),
    Mutation("open contacts of a packing in its derivatives", r"matrix\.scaled\(scale\)\.within\(support\)", "matrix.scaled(scale)", ("test_piles.py::test_a_packing_is_struck",)),
    Mutation("coupling of a packing without its diagonal", r"return f \+ neighbour_sum\(self\.entries, f", "return neighbour_sum(self.entries, f", ("test_piles.py::test_dynamics_of_a_packing_are_those_of_the_dense_scene",), marks="slow"),
    Mutation("forces on walls end at the centre", r"on_wall = centres\[first\] - ", "on_wall = centres[first] - 0 * ", ("test_pictures.py::test_force_chains_are_as_thick_as_impulses",)),
    # --- theory
    Mutation("dissipation matrix transposed", r"matrix\.T @ jnp\.linalg\.solve\(delassus, matrix\)", "matrix @ jnp.linalg.solve(delassus, matrix.T)", ("test_consistency.py::test_energy_change_expressions", "test_consistency.py")),
    Mutation("bound of the singular values without the root", r"1 / np\.sqrt\(np\.linalg\.cond\(g\)\)", "1 / np.linalg.cond(g)", ("test_consistency.py::test_open_contacts_are_left_out", "test_consistency.py")),
    Mutation("rocking and half-rocking exchanged", r"leaves\[\.\.\., 1\] \+ 2 \* leaves\[\.\.\., 0\]", "leaves[..., 0] + 2 * leaves[..., 1]", ("test_rocking_dispersion.py",)),
    Mutation("slip of a rocking block", r"after\[0\] \+ a / 2 \* after\[2\]", "after[0] - a / 2 * after[2]", ("test_rocking_dispersion.py",)),
    Mutation("Carnot's factor upside down", r"\(1 - e\) / \(1 \+ e\) \* kinetic_energy", "(1 + e) / (1 - e) * kinetic_energy", ("test_consistency.py::test_carnot",)),
    # --- files
    Mutation("micrometres", r"\"um\": 1e-6", '"um": 1e-3', ("test_experiments.py::test_units_of_gaps",)),
    Mutation("digits of a value with its error", r"error < 2 \* 10\.0\*\*power", "error < 5 * 10.0**power", (examples("files.records"),)),
    # --- audits
    Mutation("momentum audit with the wrong sign of friction", r"residual = residual - scene\.tangents", "residual = residual + scene.tangents", ("test_consistency.py::test_friction_is_part_of_the_momentum",)),
    Mutation("open contacts audited", r"least = jnp\.where\(scene\.closed, ", "least = jnp.where(scene.closed | True, ", ("test_consistency.py::test_open_contacts_may_approach",)),
    Mutation("tolerance of signs a hundred times wider", r"\"float64\": 1e-7, \"float32\": 2e-3", '"float64": 1e-5, "float32": 2e-3', ("test_seams.py::test_groups_are_judged_on_the_scale_of_their_impact",)),
    # --- methods
    Mutation("advice in a norm that mixes units", r"\(change @ mass\) \* change", "change * change", ("test_methods.py::test_distance_is_a_ratio_of_energy_norms",)),
    Mutation("far contacts take part in an advice", r"far = opened & ~_can_close\(", "far = opened & ~opened & ~_can_close(", ("test_methods.py::test_far_contacts_take_no_part",)),
    Mutation("friction does not couple contacts", r"if not friction:\n", "if True:\n", ("test_methods.py::test_friction_couples_contacts_with_decoupled_normals",)),
    Mutation("advice takes LZB for the truth where contacts re-close", r"apart > tolerance / SMALL_PART", "apart > 1", ("test_methods.py::test_contacts_that_close_again",), marks="slow"),
    Mutation("contacts of the largest errors are left out", r"argsort\(np\.nan_to_num\(errors\[working\]", "argsort(-np.nan_to_num(errors[working]", ("test_methods.py::test_contacts_that_an_impact_needs",)),
    Mutation("unwatched velocities count", r"dv = change\[:, self\.watched\]", "dv = change[:, : len(self.watched)] if len(self.watched) > 1 else change[:, -1:]", ("test_methods.py::test_contacts_that_an_impact_needs",)),
    Mutation("one direction of friction across its impulse", r"tangents \* way\[None\]", "tangents * way[None, :, ::-1]", ("test_methods.py::test_friction_that_an_impact_needs",)),
    Mutation("the law farthest from the measured velocities", r"min\(self\.distances\.values\(\)", "max(self.distances.values()", ("test_pictures.py::test_the_law_closest_to_the_measured_velocities_is_named",)),
    Mutation("halves of a chain off by one", r"jnp\.arange\(contacts\) >= \(contacts", "jnp.arange(contacts) > (contacts", ("test_methods.py::test_halves_of_a_chain",)),
    Mutation("regularized friction as coarse at small steps", r"force \* step \* stiffest", "force * 0.1 * stiffest", ("test_methods.py::test_verlet_with_friction",)),
    Mutation("friction along the slip of scipy's field", r"-\(drag\[:, None\] \* u\)", "(drag[:, None] * u)", ("test_methods.py::test_scipy_with_friction",)),
    # --- events, motion, solvers
    Mutation("contacts that break loose slide the wrong way", r"jnp\.where\(broke, -jnp\.sign\(side\)", "jnp.where(broke, jnp.sign(side)", ("test_friction.py::test_lzb_of_a_flat_block", "test_friction.py::test_lzb_in_the_plane", "test_friction.py::test_lzb_of_a_real_cube",)),
    Mutation("the base moves the wrong way", r"moved\(q, -_displaced\(system, t\)\)", "moved(q, _displaced(system, t))", ("test_motion.py::test_gaps_are_seen_from_the_base",)),
    Mutation("work of the base with the wrong sign", r"push @ carried, out\.status", "-(push @ carried), out.status", ("test_motion.py::test_the_base_works_at_its_own_speed",)),
    Mutation("time of a hop halved", r"2 \* jnp\.abs\(p\) / safe", "jnp.abs(p) / safe", ("test_motion.py::test_finite_accumulation_is_passed",)),
    Mutation("plastic expansion with e for its square", r"rate / e\*\*2, rate", "rate / e, rate", ("test_contact_forces.py::test_a_plastic_contact_returns_its_share",)),
    Mutation("off-diagonal of a chain's Delassus matrix shifted", r"off_diagonal \* vector\[1:\], none", "off_diagonal * vector[:-1], none", ("test_scenes.py::test_chain_is_the_dense_scene",)),
    Mutation("elimination takes the pivot's row for the others", r"return jnp\.where\(number == k, row, rows - factor \* row\)", "return jnp.where(number == 0, row, rows - factor * row)", ("test_friction_solver.py::test_dense_solves_are_those_of_numpy",), "dense.py"),
    Mutation("two rows: the upper unknown ignores the lower one", r"jnp\.stack\(\[x - above \* last, last\]\)", "jnp.stack([x, last])", ("test_friction_solver.py::test_dense_solves_are_those_of_numpy",), "dense.py"),
    Mutation("normal velocities of sliding contacts are those of a convex problem", r"missed\.at\[:, 0\]\.add\(slip\)", "missed", ("test_friction_solver.py::test_four_corners_that_nearly_stick_have_impulses",), "interior_points.py"),
    Mutation("contacts that take no part are looked at", r"alone\.astype\(rate\.dtype\)", "0", ("test_friction_solver.py::test_four_corners_that_nearly_stick_have_impulses",), "interior_points.py"),
    Mutation("one attempt to find impulses in their cones", r"np\.array\(\[100\.0, 1\.0\]\)", "np.array([100.0])", ("test_friction_solver.py::test_four_corners_that_nearly_stick_have_impulses",), "interior_points.py"),
    Mutation("a contact below the surface ends each step", r"gap = contacts\.normal\.value - below", "gap = contacts.normal.value", ("test_motion_in_space.py::test_a_contact_that_lies_below_the_surface_may_leave_it",)),
    Mutation("corners of an edge pull each other", r"jnp\.repeat\(rows\.mean\(axis=1\), rows\.shape\[1\]\)", "sizes[m:]", ("test_motion_in_space.py::test_corners_of_an_edge_do_not_pull_each_other",)),
    Mutation("the lowest point of a coin is its highest one", r"self\._rims\(lengths\(down", "self._rims(lengths(-down", ("test_motion_in_space.py::test_forces_of_a_coin_that_rolls_steadily",)),
    Mutation("one of two corners at the rim of their cones sticks", r"starts = starts \| \(at_rim & jnp\.any\(broken\)\)", "pass", ("test_motion_in_space.py::test_who_sticks_and_who_slides",)),
    Mutation("redundant forces are shared equally", r"return jnp\.maximum\(share, least\) if least > 0 else share", "return jnp.ones_like(share)", ("test_friction_solver.py::test_shares_of_redundant_forces",), "dense.py"),
    Mutation("friction of many contacts in a box, not a disc", r"length = jnp\.sqrt\(jnp\.sum\(side\*\*2, axis=1, keepdims=True\)\)", "length = jnp.max(jnp.abs(side), axis=1, keepdims=True)", ("test_friction_solver.py::test_friction_of_many_contacts_has_a_round_cone",)),
    # --- method 'implicit'
    Mutation("an expansion as slow as a compression", r"jnp\.where\(expands, square, 1\.0\)", "1.0", ("test_implicit.py",)),
    Mutation("an opening may lose what it stored", r"jnp\.where\(gone, jnp\.minimum\(root, faster\), 0\.0\)", "0.0 * root", ("test_implicit.py",)),
    Mutation("second stage with the radius of the first", r"self\.friction \* PART\)", "self.friction)", ("test_implicit.py",)),
    Mutation("a look ahead without a margin", r"dp - s\.impulse < MARGIN \* own", "dp - s.impulse < -MARGIN * own", ("test_long_chains.py",)),
    Mutation("looks that conclude nothing", r"return asked & end\.clear & ", "return ~asked & end.clear & ", ("test_long_chains.py",)),
    Mutation("a block of no contacts", r"> visible\)\) & any_of\(block\)", "> visible))", ("test_long_chains.py",)),
    Mutation("a turn within a step in the middle of it", r"return h / 2 \* self\.omega \* kink \* part", "return 0 * h * self.omega * kink * part", ("test_implicit.py",)),
    Mutation("descent in a chain too long", r"ones / jnp\.max\(row_sums, axis=0", "3 * ones / jnp.max(row_sums, axis=0", ("test_implicit.py",)),
    Mutation("no convex problem for fast expansions", r"some = jnp\.any\(unloading > 0\)", "some = jnp.any(unloading > jnp.inf)", ("test_implicit.py",)),
    Mutation("free flight ends late", r"x - wait \* self\.omega \* gamma", "x - 1.01 * wait * self.omega * gamma", ("test_implicit.py",)),
    Mutation("second derivatives of steps without events", r"without_derivatives\(value_of\(leaves\), NotImplementedError\(NO_SECOND\)\)", "value_of(leaves)", ("test_implicit.py::test_derivatives",)),
    Mutation("second derivatives of steps that are walked back", r"without_derivatives\(primals\[0\], NotImplementedError\(NO_SECOND\)\)", "primals[0]", ("test_implicit.py::test_reverse_mode_of_many_numbers",)),
    Mutation("reverse mode beyond the steps it can walk", r"most = min\(most, implicit_steps\.MOST_KEPT\)", "most = most", ("test_implicit.py::test_reverse_mode_of_many_numbers",)),
    Mutation("the square of a tiny indentation", r"some = x > float\(jnp\.finfo\(x\.dtype\)\.tiny\) \*\* 0\.5", "some = x > 0", ("test_implicit.py::test_reverse_mode_of_many_numbers",)),
    Mutation("tangents of a step by the normal rows alone", r"rows\[owner, kind\]", "rows[owner, 0]", ("test_implicit.py::test_tangents_of_the_impulses_of_a_step",)),
    Mutation("nothing said about the method that ends", r"try \"\n", "\"\n", ("test_implicit.py::test_what_does_not_end_says_so",), "status.py"),
    Mutation("an inverse in place keeps its pivot column", r"jnp\.where\(there, 0\.0, rows\) - column", "rows - column", ("test_implicit.py::test_tangents_of_the_impulses_of_a_step",)),
    Mutation("one change of the sweeps for two", r"both = aa \* bb - ab\*\*2 > ", "both = aa * bb - ab**2 > jnp.inf + ", ("test_implicit.py::test_sweeps_of_contacts_that_stick_end_soon",)),
    Mutation("sweeps without extrapolation", r"- first \* change\.reached - second \* before\.reached", "", ("test_implicit.py::test_sweeps_of_contacts_that_stick_end_soon",)),
    Mutation("a tolerance beyond the noise", r"PART_OF_NOISE \* s >= COARSE", "100 * s >= COARSE", ("test_implicit.py::test_a_fit_takes_the_tolerance_that_the_noise_allows",)),
    Mutation("a tolerance for a method that errs by none", r"0 < law\.accuracy\(shapes\)", "0 <= law.accuracy(shapes)", ("test_implicit.py::test_a_fit_takes_the_tolerance_that_the_noise_allows",)),
    Mutation("what sweeps leave is no error", r"loss \+ left\b", "loss + 0 * left", ("test_implicit.py::test_what_the_sweeps_of_a_step_leave_is_part_of_its_error",)),
    Mutation("sweeps beyond what is right", r"right = s\.error <= tolerance", "right = s.error < 0 * tolerance", ("test_implicit.py::test_an_impact_in_a_batch_is_what_it_is_alone",)),
    Mutation("a force that acts until its contact turns is dropped", r"turns = opened & \(before < 0\)", "turns = opened & (before < 0) & False", ("test_implicit.py::test_a_force_that_acts_until_its_contact_turns_is_not_forgotten",)),
    Mutation("descent too long", r"size \* jnp\.minimum\(row_sum, norm\)", "size * 0.3 * jnp.minimum(row_sum, norm)", ("test_implicit.py",)),
    Mutation("friction waits for normal rows that are known", r"if friction_only:", "if False:", ("test_implicit.py",)),
    Mutation("friction of the last load", r"rate\[m:\] / carried \* loads", "rate[m:]", ("test_implicit.py",)),
    Mutation("unloading forgotten", r"self\.unloading \* tried\[:m\]", "0 * tried[:m]", ("test_implicit.py",)),
    Mutation("many contacts in space event by event", r"contact\.contacts > exact", "contact.contacts > 100", ("test_implicit.py",)),
    Mutation("signs judged finer than the law's accuracy", r"ACCURACIES \* law\.accuracy\(contact\)", "0.0", ("test_implicit.py",)),
    # --- further rooms
    Mutation("the exit code of the module is lost", r"sys\.exit\(program\(\)\)", "program()", ("test_commands.py::test_the_module_ends_with_the_exit_code_of_the_command",)),
    Mutation("shots of the command line counted from zero", r"\.shot - 1\n", ".shot\n", ("test_commands.py::test_compare",), marks="slow"),
    Mutation("vertical and horizontal bases exchanged", r"\(0 \* y, y\) if self\.direction == \"vertical\"", '(0 * y, y) if self.direction == "horizontal"', (examples("motion.system"),)),
    Mutation("limits of validity from the wrong end", r"if law == \"moreau\" else slice", 'if law == "binary" else slice', ("test_methods.py::test_limits_are_of_the_unbroken_run_from_their_end",)),
    Mutation("dispersion over the sum, not the mean", r"return deviation / mean\n", "return deviation / jnp.sum(share)\n", ("test_methods.py::test_energy_kept_and_its_dispersion",)),
    Mutation("integral of a history without its correction", r"step\*\*2 / 12 \* \(rates", "0 * step**2 / 12 * (rates", ("test_compliant.py::test_history_of_one_ball_on_a_linear_spring",)),
    Mutation("approach is the opening", r"approach=-_integral", "approach=_integral", ("test_compliant.py::test_history_of_one_ball_on_a_linear_spring",)),
    Mutation("pictures of figures without their number", r"return self\.number or \"\"", 'return ""', ("test_commands.py::test_figure",)),
    Mutation("pulses as long as of cos^4", r"0\.5 \*\* \(1 / 6\)", "0.5 ** (1 / 4)", ("test_waves.py::test_a_pulse_that_travels",)),
    Mutation("peaks of pulses at samples", r"shift = -slope / bend if", "shift = 0.0 if", ("test_waves.py::test_a_pulse_that_travels",)),
    Mutation("glued trains exchanged", r"\[\(m - n\) / \(m \+ n\), 2 \* m", "[(n - m) / (m + n), 2 * m", ("test_waves.py::test_trains_in_words",)),
    Mutation("solitary waves slow in heavy chains", r"\(k / m\) \*\* 0\.4", "(k * m) ** 0.4", (examples("theory.waves"),)),
    Mutation("springs of Reinsch's chain", r"\(j\[:-1\] \+ 0\.5\) \* \(n - j", "(j[:-1] + 1.0) * (n - j", ("test_waves.py::test_a_chain_that_disperses_nothing",)),
    Mutation("dispersion of n instead of n - 1", r"jnp\.asarray\(scene\.size - 1, spread\.dtype\)", "jnp.asarray(scene.size, spread.dtype)", ("test_methods.py::test_dispersion_index_and_energy_ratio",)),
    Mutation("Newby's ratio", r"\(3 \* n\*\*4 - 2 \* n\*\*2", "(3 * n**4 + 2 * n**2", (examples("theory.linear_chain"),)),
    Mutation("sign of e_t in binary collisions", r"\(1 \+ friction\.restitution\[contact\]\)", "(1 - friction.restitution[contact])", ("test_friction.py::test_disk_in_closed_form[binary]",)),
    Mutation("sign of e_t in time stepping", r"e_t\[:, None\] \* slip", "-e_t[:, None] * slip", ("test_motion_stepped.py::test_a_superball_leaves_with_its_slip_reversed",)),
    Mutation("precompression by the printed exponent", r"\(\(eta \+ 1\) \* stiffness \*\* \(1 / eta\)\)", "((eta + 1) * stiffness ** (1 / (eta + 1)))", ("test_compliant.py::test_precompression_energy",)),
    Mutation("kinetic angles of free bodies", r"return _angles\(delassus_matrix\(scene\)\)", "return _angles(delassus_matrix(without_constraints(scene)))", ("test_scenes.py::test_kinetic_angles_of_tied_bodies",)),
    Mutation("correlated contacts that keep all they take up", r"\(1 - inputs\.restitution\*\*2\) \* stored", "(1 - inputs.restitution) * stored", ("test_systems.py::test_outcomes[correlation]",)),
    Mutation("correlated contacts that separate", r"pressed & \(at\.qn <= rest_of\(inputs\)\) & ~chosen", "pressed & ~chosen", ("test_contract.py::test_promises[correlation]", "test_other_laws.py")),
    Mutation("ratios up to the arithmetic mean", r"\(-linear \+ np\.sqrt", "(linear + np.sqrt", ("test_other_laws.py::test_the_interval_ends_where_a_contact_stays_closed",)),
    Mutation("ratios that nobody checks", r"if not least <= ratio\[i, j\] <= most", "if not least <= ratio[i, j]", ("test_other_laws.py",)),
    Mutation("coefficients of Routh averaged", r"jnp\.sum\(e\*\*2 \* work\)", "jnp.sum(e * work)", ("test_other_laws.py::test_unequal_coefficients_of_routh_are_one",)),
    Mutation("yielding that is stored", r"moves & \(phase != YIELD\)", "moves", ("test_yielding.py",)),
    Mutation("a force above its bound", r"self\.limit - x, by_x", "1.0, by_x", ("test_yielding.py",)),
    Mutation("motions with a force that yields", r"if force\.bound is not None:\n        raise TypeError", "if False:\n        raise TypeError", ("test_yielding.py",)),
    Mutation("plastic trees that end", r"< -ROUNDING\)", "< -ZERO)", ("test_han_gilmore.py::test_plastic_balls_collide_without_end_and_it_says_so",)),
    Mutation("trees with restitution beside one contact", r"target\[:count\] \*= 1 \+ problem\.restitution\[at\]", "target[:count] *= 1 + problem.restitution[0]**2", ("test_han_gilmore.py::test_losses_in_exact_arithmetic",)),
    Mutation("trees that stick beyond the cone", r"np\.abs\(sides\) > mu\[at\] \* pushes \+ ZERO", "np.abs(sides) > np.inf", ("test_han_gilmore.py::test_friction_of_one_contact",)),
    Mutation("opening by the printed sign", r"g \+ \(g \* g - g\) / \(root \+ 1\)", "-g + (g * g - g) / (root + 1)", ("test_domains.py::test_separation_times",)),
    Mutation("blocks that gain energy", r"\(a \+ b <= 1\)", "(a <= 1) & (b <= 1)", ("test_domains.py",)),
    Mutation("Leine's coefficients as they are", r"d = \(1 - each\) / \(1 \+ each\)", "d = 1 - each", ("test_domains.py::test_unequal_coefficients_of_moreau",)),
    Mutation("the farthest side of a corner", r"approach\.min\(\) \* \(1 \+ EQUAL\)", "approach.max() * (1 + EQUAL)", ("test_domains.py::test_reentrant_corner",)),
    Mutation("a basis that does not turn", r"scene = scene_at\(s \* v\)", "scene = scene_at(0 * s * v)", ("test_accelerations.py",)),
    Mutation("constraints that contacts do not press", r"rest = self\.normal\[:b\] - self\.matrix\[:b, b:\] @ push", "rest = self.normal[:b] + 0 * self.matrix[:b, b:] @ push", ("test_accelerations.py::test_force_of_a_bilateral_constraint",)),
    Mutation("open contacts in the contact problem", r"jnp\.where\(held, free, 1\.0\)\)\.z", "jnp.where(held, free, free)).z", ("test_accelerations.py::test_contact_problem_of_a_block",)),
    Mutation("quasi-velocities without the mass", r"tangent\.T @ momentum\(scene, v\)", "tangent.T @ v", ("test_quasi.py",)),
    Mutation("factor 2 of Theorem 6.2", r"reach = 2 \* _norm", "reach = _norm", ("test_consistency.py::test_least_ratio_is_sharp_for_one_contact",)),
    Mutation("kilometres an hour", r"1 / 3\.6", "3.6", ("test_experiments.py",)),
    Mutation("one-sided confidence intervals", r"0\.5 \+ 0\.5 \* level\n", "level\n", ("test_fit.py::test_errors_from_the_residual_are_those_of_linear_regression",)),
    Mutation("bootstrap without the noise", r"fit\.noise \* np\.moveaxis", "np.moveaxis", ("test_fit.py::test_bootstrap_scatters_as_much_as_the_standard_error",)),
    Mutation("given samples of the next chunk", r"values\[number \* size : \(number \+ 1\) \* size\]", "values[(number + 1) * size : (number + 2) * size]", ("test_montecarlo.py::test_given_samples_are_used_row_by_row",)),
    Mutation("the ridge is felt where a contact jams", r"_JAMS = 1e-2", "_JAMS = 0.0", ("test_paroxysms.py::test_its_derivatives[jamming]",), "persistent_contact.py", "slow"),
    Mutation("friction that pushes along the sliding", r"along \* mu\[:, None\], 0\.0", "-along * mu[:, None], 0.0", ("test_motion.py::test_sliding_block_comes_to_stick",), marks="slow"),
    Mutation("small turns twice as large", r"half @ half\)\)\[None\], half\]", "half @ half))[None], 2 * half]", ("test_motion_in_space.py::test_derivatives_at_no_displacement_take_two_terms",), "solids.py"),
    Mutation("redundant contacts share by their slip", r"weight, _sizes\(w, contacts\.delassus, m\)\)", "weight, jnp.diagonal(w))", ("test_motion_in_space.py::test_forces_of_a_brick_that_slides_flat_have_derivatives",)),
    Mutation("steps that end slip in one go", r"jnp\.sum\(u \* growth, axis=1\)", "0.0 * jnp.sum(u * growth, axis=1)", ("test_motion_in_space.py::test_derivatives_of_a_sphere_that_begins_to_roll",), "*.py", "release"),
    Mutation("derivatives do not see what a contact forgets", r"flow\.switch\(aim\.modes, y, aim\.target\)\[1\]", "y", ("test_contact_forces.py::test_ball_on_a_linear_spring",), "flow.py"),
    Mutation("impulses of contact forces without derivatives", r"opened = \(\(aim\.modes != OPEN\)", "opened = ((aim.modes == OPEN)", ("test_contact_forces.py::test_ball_on_a_linear_spring",)),
    Mutation("after a contact that is needed all others are kept", r"kept \+ left\[:needed\], left\[needed:\]", "kept + left, []", ("test_methods.py::test_one_of_two_contacts_at_the_same_place_is_left_out",), "scene_advice.py"),
    Mutation("steps longer than the stiffness allows", r"\nSTABLE = 0\.5", "\nSTABLE = 50.0", ("test_contact_forces.py::test_a_body_may_rest_on_its_springs",), "compliant_flow.py"),
    Mutation("velocities that are rounding turn contact forces", r"jnp\.maximum\(share, noise / scales\.speed\)", "share", ("test_contact_forces.py::test_a_body_may_rest_on_its_springs",), "compliant_flow.py"),
    Mutation("K motions of a fit from one velocity", r" or begin\.shape\[:-1\] != q0\.shape\[:-1\]", "", ("test_errors.py::test_bad_input",), "fitting_motion.py"),
    Mutation("contacts of contact forces that always stick", r"~still\.stick \| \(left >= least\)", "~still.stick | (left >= left)", ("test_contact_forces.py::test_friction_on_a_slope",), "compliant_contact.py"),
    Mutation("friction of contact forces pulls", r"set\(-size \* push\)", "set(size * push)", ("test_contact_forces.py::test_friction_on_a_slope",), "persistent_contact.py"),
    Mutation("slip in space stops with a rest", r"flow\.stopped\(stopped, flown\.state\)", "flown.state", ("test_contact_forces.py::test_a_box_strikes_on_its_corners_with_friction",), "compliant_contact.py", "slow"),
    Mutation("friction of contact forces along the axes of a step", r'jnp\.einsum\("mj,mjk->mk", each, slip_frames\(self\.axes\.along\)\)', "each", ("test_contact_forces.py::test_a_ball_in_space_slides_and_rolls",), "compliant_flow.py", "slow"),
    Mutation("lost derivatives are not reported", r"lost = plan\.lost & \(end", "lost = False & (end", ("test_motion.py::test_lost_derivatives_are_reported",)),
    Mutation("slip in space turned to the wrong side", r"jnp\.where\(straight, 0\.0, u\[:, 1\]\)", "jnp.where(straight, 0.0, -u[:, 1])", ("test_motion_in_space.py::test_a_sphere_slides_until_it_rolls",), "*.py", "slow"),
    Mutation("slip in space that begins held along itself", r"jnp\.stack\(\[stick, across\], axis=1\)", "jnp.stack([across, stick], axis=1)", ("test_motion_in_space.py::test_a_sphere_that_is_pulled_begins_to_slide",), "*.py", "slow"),
    Mutation("elastic energy of a history doubled", r"0\.5 \* units\.velocity\*\*2 \* energy", "units.velocity**2 * energy", ("test_compliant.py::test_history_of_one_ball_on_a_linear_spring",)),
    # --- pictures
    Mutation("histogram in shares, not per cent", r"100 \* bars / max", "bars / max", ("test_pictures.py::test_a_histogram_is_in_per_cent",)),
    Mutation("measured and fitted exchanged in a picture", r"first\.plot\(fit\.predicted\[here\], measured\[here\]", "first.plot(measured[here], fit.predicted[here]", ("test_pictures.py::test_residuals_are_drawn_over_what_was_fitted",)),
    Mutation("residual indentation in a picture with e", r"1 - float\((\w+)\.restitution\) \*\* 2", r"1 - float(\1.restitution)", ("test_pictures.py::test_a_loop_encloses_the_energy_lost",)),
    Mutation("grid without the row beside", r"if row < \(0,\) \* \(d - 1\)", "if row != (0,) * (d - 1)", ("test_piles.py::test_the_grid_meets_every_near_pair_once",), "bodies/neighbours.py"),
    Mutation("grid's crowd one too many", r"ends - starts > crowd", "ends - starts > crowd + 1", ("test_piles.py::test_the_grid_meets_every_near_pair_once",), "bodies/neighbours.py"),
    Mutation("contacts of a pile that close within the step", r"for x in \(q, later\)\]\n        closed = near", "for x in (q, q)]\n        closed = near", ("test_piles.py::test_closed_contacts_are_those_with_small_gaps",), "bodies/piles.py"),
    Mutation("cells of the grid without the way of a step", r"below \+ farther\)", "below)", ("test_piles.py::test_pairs_that_meet_within_a_step_may_be_two_cells_apart",), "bodies/piles.py"),
    Mutation("least gap of near bodies where none are near", r"lax\.cond\(found, lambda: least, of_all\)", "lax.cond(True, lambda: least, of_all)", ("test_piles.py::test_a_mixed_pile_finds_its_contacts_by_the_grid",), "bodies/piles.py", "slow"),
    Mutation("a disc pushes a polygon the wrong way", r"first\[:, None\], n, -n", "first[:, None], n, n", ("test_piles.py::test_a_mixed_pile_has_the_contacts_of_planar_bodies",), "bodies/planar_piles.py"),
    Mutation("corners that only fill a row touch walls", r"jnp\.where\(again\[:, None\], jnp\.inf, height\)", "height", ("test_piles.py::test_a_mixed_pile_has_the_contacts_of_planar_bodies",), "bodies/planar_piles.py"),
    Mutation("levers of a mixed pile", r"lever\[\.\.\., 0\] \* ways\[\.\.\., 1\] - lever", "lever[..., 0] * ways[..., 1] + lever", ("test_piles.py::test_a_mixed_pile_has_the_contacts_of_planar_bodies",), "bodies/planar_piles.py"),
    Mutation("friction of a pile acts on the other body", r"ways\[:, 1:, 0, :places\]", "ways[:, 1:, 1, :places]", ("test_piles.py::test_a_step_of_a_packing_is_an_impact",), "motion/pile_contacts.py"),
    Mutation("a pile does not go on from where it ends", r"_OVERLAP = 0\.1", "_OVERLAP = 0.0", ("test_piles.py::test_a_mixed_pile_comes_to_rest_and_goes_on",), "bodies/piles.py", "slow"),
    Mutation("piles by events take friction", r"if mu is not None:\n        raise ValueError\(\n            f\"Argument `friction` must be 0", "if False:\n        raise ValueError(\n            f\"Argument `friction` must be 0", ("test_piles.py::test_piles_by_events_are_refused_with_friction",), "motion/arguments.py"),
    Mutation("piles by events say nothing of many contacts", r"if m > MANY:", "if m < 0:", ("test_piles.py::test_piles_of_many_contacts_warn_by_events",), "motion/arguments.py"),
    Mutation("arms of spheres on the wrong side", r"jnp\.stack\(\[t2, -t1\], axis=1\)", "jnp.stack([-t2, t1], axis=1)", ("test_piles.py::test_directions_are_velocities_of_the_points_that_touch",), "bodies/piles.py"),
    Mutation("spheres of the inertia of discs", r"inertia_factor = 0\.4", "inertia_factor = 0.5", ("test_piles.py::test_spheres_are_a_body_like_others",), "bodies/piles.py"),
    Mutation("bodies at rest pass each other", r"TURN \* speeds \+ setup\.slow", "TURN * speeds", ("test_motion_stepped.py::test_pulses_overturn_the_blocks_that_housner_says",), marks="slow"),
    Mutation("MuJoCo's normals from the second geom", r"\(second - first\)", "(first - second)", ("test_mujoco.py::test_gap_velocities_are_rates_of_distances",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's balls apart by rounding", r"_TOUCHING = 1e-9", "_TOUCHING = 0.0", ("test_mujoco.py::test_balls_that_touch_but_for_rounding_touch",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's model keeps the margin", r"model, data = copy\.copy\(model\), copy\.copy\(data\)", "data = copy.copy(data)", ("test_mujoco.py::test_a_margin_finds_gaps",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's planar models in space", r"if \(mobility\[:, 0\] <= least\)\.all\(\)", "if False", ("test_mujoco.py::test_a_planar_model_has_planar_tangents",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's constraints repeat each other", r"sizes > _REPEATED \* sizes", "sizes >= 0.0 * sizes", ("test_mujoco.py::test_equality_constraints_are_bilateral_constraints",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's velocity projected without the mass", r"return np\.linalg\.solve\(root\.T, scaled - broken\)", "return velocity - constraints @ np.linalg.lstsq(constraints, velocity)[0]", ("test_mujoco.py::test_equality_constraints_are_bilateral_constraints",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's frictionless contacts rub", r"c\.friction\[0\] if c\.dim > 1 else 0\.0", "c.friction[0]", ("test_mujoco.py::test_contacts_without_friction_have_none",), "bodies/mujoco_scene.py"),
    Mutation("MuJoCo's time constants below two steps", r"time = max\(first, 2 \* timestep\)", "time = first", ("test_mujoco.py::test_restitution_is_that_of_mujoco",), "laws/mujoco_contact.py"),
    Mutation("MuJoCo's impedance acts once on stiffness", r"stiffness \* d \* r\)", "stiffness * r)", ("test_mujoco.py::test_restitution_is_that_of_mujoco",), "laws/mujoco_contact.py"),
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
    if session.returncode == pytest.ExitCode.OK:
        return "MISSED", seconds, ""
    if session.returncode in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
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
