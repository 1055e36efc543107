"""Speed against accuracy: every way to compute an impact, on one chart."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_shape, check_values, in_common_dtype
from jimpact.comparison import registered_laws
from jimpact.law import Law, check_law
from jimpact.laws.lzb import LZB
from jimpact.methods.chart_programs import (
    FINEST,
    SECOND,
    Case,
    Moment,
    Programs,
    errors_of,
    in_turns,
    law_programs,
    method_programs,
    moment_of,
    reference_of,
)
from jimpact.methods.chart_record import Point, Timing, WorkPrecision
from jimpact.methods.contenders import METHODS, Method, checked
from jimpact.progress import stage_bar
from jimpact.scene import Scene, as_velocity
from jimpact.status import STATUS

Row = tuple[str, float | None]  # a method and its setting, or a law
ALGEBRAIC = ("newton", "moreau", "poisson", "binary")

SPREAD = 10.0  # stiffnesses of a batch lie within this factor, half of it to either side
SAMPLE = 16  # impacts of the batch on which errors are measured: one alone may be luckily right


def work_precision(
    scene: Scene,
    velocity: Any,
    law: LZB,
    methods: Sequence[str] | None = None,
    settings: Mapping[str, Sequence[float]] | None = None,
    laws: Mapping[str, Law] | None = None,
    reference: str | None = None,
    *,
    batch: int = 256,
    repeats: int = 5,
    gradients: bool = True,
    progress: bool | None = None,
) -> WorkPrecision:
    """Error against time and against field evaluations of many ways to integrate one impact.

    Errors are relative, the largest over a sample of impacts with the stiffness of every contact
    spread at random over a factor of 10, the impact itself among them: `max |dv| / max |v-|`,
    `max |dp| / max |p|`, `|d(T+ - T-)| / T-`, duration, and the Jacobian
    `(d v+ / d ln k, d v+ / d e)` by forward mode, its error over `max |v-|`. Times are per impact,
    one alone and in a batch, taken in turns; compile times apart.

    Args:
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s], at least one contact approaching.
        law: the `LZB` law; its own `method` and `rtol` play no part, its `max_steps` does.
        methods: names in `jimpact.methods.contenders.METHODS`; None: all that support the impact.
        settings: settings by method where its own ladder is not wanted.
        laws: algebraic laws by name, points with their *model* error against LZB on this impact;
            None: Newton, Moreau, Poisson and Binary with the law's restitution.
        reference: method that errors are measured from, at rtol 1e-14; None: the
            event-aligned order 8. Its uncertainty is its distance from
            a second solution: order 8 at 1e-12.
        batch: impacts in a batch. repeats: of every time. gradients: measure them, too.
        progress: bar on stderr; None: on a terminal.

    Raises:
        ValueError: a method unknown or unable (the reason is told), nothing approaches, single
            precision, bad sizes. TypeError: a law that is not LZB.

    >>> import jimpact as ji
    >>> pair, law, ladder = ji.chain([1.0, 2.0]), ji.LZB(0.5), {"verlet": [0.1, 0.01]}
    >>> options = {"laws": {}, "batch": 4, "gradients": False}
    >>> found = ji.work_precision(pair, [1.0, 0.0], law, ["verlet"], ladder, **options)
    >>> [f"{point.error['velocity']:.0e}" for point in found.points["verlet"]]
    ['2e-04', '4e-06']
    """
    case = case_of(scene, velocity, law, batch, repeats)
    chosen, left_out = chosen_methods(methods, case)
    ladders = ladders_of(chosen, settings or {})
    exact, second = reference_method(reference, case), METHODS["dop853"]
    if laws is None:
        known = registered_laws({"restitution": law.restitution})[0]
        laws = {name: known[name] for name in ALGEBRAIC}
    rows: list[Row] = [(name, value) for name, ladder in ladders.items() for value in ladder]
    rows += [(name, None) for name in laws]
    with stage_bar(progress) as (stage, advance):
        needed = {m.name: m for m in (*chosen, exact, second)}
        stage("compiling", len(needed) + len(laws))
        programs: dict[str, Programs] = {}
        for name, method in needed.items():
            wanted = gradients and not method.no_gradient
            programs[name] = method_programs(method, case, wanted, timed=name in ladders)
            advance()
        for name, other in laws.items():
            programs[name] = law_programs(in_common_dtype(other, case.velocity)[0], case)
            advance()
        truth, other_truth = (
            moment_of(programs[m.name], rtol) for m, rtol in ((exact, FINEST), (second, SECOND))
        )
        stage("measuring errors", len(rows))
        moments = []
        for name, value in rows:
            moments.append(moment_of(programs[name], value))
            advance()
        times = _times(rows, programs, repeats, stage, advance)
    labels = {m.name: m.label for m in chosen} | {name: f"law: {name}" for name in laws}
    points: dict[str, list[Point]] = {name: [] for name, _ in rows}
    for row, moment, timing in zip(rows, moments, times):
        error = errors_of(case, moment, truth)
        points[row[0]].append(_point(row, labels[row[0]], error, moment, timing))
    return WorkPrecision(
        velocity=np.asarray(case.velocity),
        points={name: tuple(row) for name, row in points.items()},
        reference=reference_of(case, exact, second, truth, other_truth),
        compile_time={name: programs[name].compile_time for name in points},
        left_out=left_out,
        batch=batch,
        sample=case.sample,
        spread=SPREAD,
        repeats=repeats,
        without_gradient={m.name: m.no_gradient for m in chosen if m.no_gradient and gradients},
    )


def _point(
    row: Row,
    label: str,
    error: dict[str, float],
    moment: Moment,
    timing: tuple[Timing, Timing, Timing | None],
) -> Point:
    answer = moment[0]
    return Point(
        name=row[0],
        label=label,
        setting=row[1],
        error=error,
        evaluations=float(np.mean(np.asarray(answer.evaluations))),
        single=timing[0],
        batched=timing[1],
        gradient=timing[2],
        status=STATUS[int(np.max(np.asarray(answer.status)))].name,
    )


def _times(
    rows: list[Row],
    programs: dict[str, Programs],
    repeats: int,
    stage: Callable[[str, int], None],
    advance: Callable[[], None],
) -> list[tuple[Timing, Timing, Timing | None]]:
    """Single, batched and gradient time of every row, all in turns."""
    tasks: list[tuple[Callable[[], Any], int]] = []
    places: list[list[int]] = []
    for name, value in rows:
        timed = programs[name]
        own: list[tuple[Callable[[Any], Any] | None, int]] = [
            (timed.single, 1),
            (timed.batched, timed.batch),
            (timed.gradient, min(SAMPLE, timed.batch)),
        ]
        places.append([])
        for run, impacts in own:
            if run is not None:
                places[-1].append(len(tasks))
                tasks.append((lambda run=run, value=value: run(value), impacts))  # type: ignore[misc]
    stage("timing", len(tasks) * repeats)
    taken = in_turns(tasks, repeats, advance)
    of_rows = []
    for place in places:
        single, batched, *gradient = (taken[i] for i in place)
        of_rows.append((single, batched, gradient[0] if gradient else None))
    return of_rows


def case_of(scene: Scene, velocity: Any, law: LZB, batch: int, repeats: int) -> Case:
    """The impact in double precision, one parameter per contact, with a batch around it."""
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    if not isinstance(law, LZB):
        raise TypeError(f"Argument `law` must be an LZB law, but is {type(law).__name__}.")
    for name, value in (("batch", batch), ("repeats", repeats)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"Argument `{name}` must be a whole number >= 1, but is {value!r}.")
    law, scene, v = in_common_dtype(law, scene, v)
    if v.dtype != jnp.float64:
        raise ValueError(
            f"Argument `velocity` must be in double precision, but has dtype {v.dtype}: "
            "enable jax_enable_x64."
        )
    check_law(law, scene, v.dtype)
    if not bool(law.contact(scene, v).happens):
        raise ValueError("Argument `velocity` must let a closed contact approach.")
    m = scene.contacts
    for name in ("restitution", "stiffness"):
        value = getattr(law, name)
        if value.shape not in ((), (m,)):
            check_shape(name, value, (m,), "one entry per contact, or a scalar")
    law = eqx.tree_at(
        lambda old: (old.restitution, old.stiffness),
        law,
        (jnp.broadcast_to(law.restitution, (m,)), jnp.broadcast_to(law.stiffness, (m,))),
    )
    exponents = np.random.default_rng(0).uniform(-0.5, 0.5, (batch, m))
    exponents[0] = 0.0  # the impact itself
    stiffness = law.stiffness[None, :] * jnp.asarray(SPREAD**exponents)
    return Case(law, scene, v, stiffness, min(SAMPLE, batch))


def chosen_methods(names: Sequence[str] | None, case: Case) -> tuple[list[Method], dict[str, str]]:
    """Methods asked for; without names all that can, and why the others cannot."""
    if names is None:
        why = {n: m.supports(case.law, case.scene) for n, m in METHODS.items()}
        left_out = {name: reason for name, reason in why.items() if reason is not None}
        return [m for n, m in METHODS.items() if n not in left_out], left_out
    chosen = [_method("methods", name) for name in names]
    for method in chosen:
        checked(case.law, case.scene, method)
    return chosen, {}


def _method(argument: str, name: str) -> Method:
    if name not in METHODS:
        raise ValueError(
            f"Argument `{argument}` must be among {', '.join(METHODS)}, but has {name!r}."
        )
    return METHODS[name]


def ladders_of(
    chosen: list[Method], settings: Mapping[str, Sequence[float]]
) -> dict[str, tuple[float, ...]]:
    """Settings by method."""
    for name, values in settings.items():
        if name not in [method.name for method in chosen]:
            raise ValueError(f"Argument `settings` must be of chosen methods, but has {name!r}.")
        check_values(f"settings[{name!r}]", values, low=0.0, open_low=True)
    return {m.name: tuple(settings.get(m.name, m.ladder)) for m in chosen}


def reference_method(name: str | None, case: Case) -> Method:
    """The method that errors are measured from."""
    method = _method("reference", name or "dop853")
    checked(case.law, case.scene, method)
    if method.setting != "rtol":
        raise ValueError(f"Argument `reference` must take an rtol, but is {name!r}.")
    return method
