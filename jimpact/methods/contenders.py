"""Contenders of the chart and of the map: ways to integrate an LZB impact, one value
each.

A contender of your own is a function and its settings, and stands in the chart beside
the others:

>>> import jimpact as ji
>>> from jimpact.methods.contenders import Contender, Solution
>>> def newton(law, scene, velocity, setting):
...     return Solution(ji.impact(ji.Newton(law.restitution), scene, velocity).impulse)
>>> mine = Contender("mine", newton, "rtol", (1e-3,))
>>> pair, options = ji.chain([1.0, 1.0]), {"laws": {}, "batch": 4, "gradients": False}
>>> chart = ji.work_precision(ji.LZB(0.5), pair, [1.0, 0.0], [mine], **options)
>>> chart.points["mine"][0].error["velocity"] < 1e-10  # one contact: all laws agree
True
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.impacts import Impact, impact
from jimpact.core.law import Impulses, Law
from jimpact.core.scene import Scene
from jimpact.laws.lzb import LZB
from jimpact.methods import schemes
from jimpact.methods.points import Outcomes, Solution as Solution
from jimpact.methods.schemes import Solve
from jimpact.tools.checks import check_choice, needed, short_repr

if TYPE_CHECKING:
    import diffrax
else:  # what impacts do without
    diffrax = needed("diffrax", "pip install diffrax")

SETTING_KINDS = ("rtol", "step", "impulse step")  # what `Contender.setting` may be


class Contender(NamedTuple):
    """A way to integrate an LZB impact.

    Attributes:
        name: in tables and options.
        solve: `solve(law, scene, velocity, setting) -> Solution`.
        setting: the kind of number that `solve` takes: 'rtol', a tolerance on
            velocities relative to the largest |v-|; 'step', the time step in units of
            `schemes.time_scale`; or 'impulse step', the step in the primary impulse, in
            units of the impact's momentum.
        ladder: settings from coarse to fine.
        label: in pictures; '': the name.
        divides: by e, which must not be 0.
        friction: whether it has Coulomb friction.
        springs: whether it has tangential springs below Coulomb's limit.
        jax: whether `solve` can be jitted, vmapped and differentiated forward, over the
            setting too; otherwise it gets concrete values.
        duration_apart: whether the duration takes a run of its own.
    """

    name: str
    solve: Solve
    setting: str
    ladder: tuple[float, ...]
    label: str = ""
    divides: bool = True
    friction: bool = False
    springs: bool = False
    jax: bool = True
    duration_apart: bool = False

    def supports(self, law: LZB) -> str | None:
        """None, or the reason why it cannot integrate this law, to follow the word
        "it": friction or tangential springs that it has not, a restitution of 0.
        """
        if law.friction is not None and not self.friction:
            return "has no friction"
        if law.tangential_stiffness is not None and not self.springs:
            return "has no tangential springs"
        refused = self.divides and np.any(law.restitution == 0)
        if refused:
            return "divides by e^2, and a restitution is 0"
        return None


class _KnownImpulses(Law):
    """A law whose impulses are known beforehand."""

    impulse: jax.Array
    tangential: jax.Array | None
    code: jax.Array
    initial_energy: jax.Array

    def impulses(self, contact: Contact) -> Impulses:
        """These impulses, whatever the contacts are."""
        return Impulses(self.impulse, self.tangential, self.code)


def outcome(law: LZB, scene: Scene, velocity: Any, solution: Solution) -> Impact:
    """The `Impact` of a solution's impulses: velocities, energy, status by `impact`'s
    checks.
    """
    if law.friction is not None and solution.tangential is None:
        raise ValueError(
            "A contender with friction must return `tangential` impulses (t,)."
        )
    code = jax.numpy.asarray(solution.code)
    known = _KnownImpulses(
        solution.impulse, solution.tangential, code, law.initial_energy
    )
    return impact(known, scene, velocity)


def solved(
    contender: Contender, law: LZB, scene: Scene, velocity: Any, setting: Any
) -> tuple[Impact, Outcomes]:
    """Impact by a contender at one setting, and the same as `Outcomes`, to be
    compared.
    """
    solution = contender.solve(law, scene, velocity, setting)
    out = outcome(law, scene, velocity, solution)
    return out, Outcomes.of(out, solution)


_TIME_STEPS = (0.2, 0.1, 0.03, 0.01, 0.003)  # in units of `time_scale`, coarse to fine
_TO_NINE = (1e-3, 1e-5, 1e-7, 1e-9)  # relative tolerances, coarse to fine
_TO_ELEVEN = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)  # the same, finer
_ALL = (
    Contender(
        *(
            "impulse_euler",
            schemes.impulse_euler,
            "impulse step",
            (1e-2, 3e-3, 1e-3, 3e-4),
        ),
        label="impulse, Euler (published)",
        divides=False,
    ),
    Contender(
        *("rk4", schemes.in_time(schemes.rk4, 4), "step", _TIME_STEPS),
        label="time, fixed Runge-Kutta 4",
    ),
    Contender(
        *("verlet", schemes.in_time(schemes.verlet, 1), "step", _TIME_STEPS),
        label="time, velocity Verlet",
        friction=True,
    ),
    Contender(
        *("time", schemes.aligned, "rtol", _TO_ELEVEN),
        label="event-aligned Dormand-Prince 8 (default)",
        divides=False,
        friction=True,
        springs=True,
        duration_apart=True,
    ),
    Contender(
        *("implicit", schemes.implicit, "rtol", (1e-2, 1e-3, 1e-4, 1e-5)),
        label="without events, implicit friction",
        divides=False,
        friction=True,
    ),
    *(
        Contender(
            *(name, schemes.by_diffrax(solver, stages), "rtol", ladder),
            label=f"diffrax {type(solver).__name__} with Event",
        )
        for name, solver, stages, ladder in (
            ("tsit5", diffrax.Tsit5(), 6, _TO_NINE),
            ("dopri8", diffrax.Dopri8(), 13, _TO_ELEVEN),
            ("kvaerno5", diffrax.Kvaerno5(), None, _TO_NINE[:3]),
        )
    ),
    *(
        Contender(
            *(f"scipy_{solver.lower()}", schemes.by_scipy(solver), "rtol", ladder),
            label=f"scipy {solver} with event",
            friction=True,
            jax=False,
        )
        for solver, ladder in (
            ("DOP853", _TO_NINE),
            ("LSODA", (1e-3, 1e-4, 1e-5)),
            ("Radau", _TO_NINE[:3]),
        )
    ),
)
CONTENDERS: dict[str, Contender] = {each.name: each for each in _ALL}


def contenders_of(
    argument: str, methods: Sequence[str | Contender], known: Mapping[str, Contender]
) -> list[Contender]:
    """Contenders by name among those `known`, or a user's own with other names, each
    once.

    `argument` is the name of the caller's argument in errors.
    """
    if isinstance(methods, str | Contender):
        raise TypeError(
            f"Argument `{argument}` must be a list, but is {short_repr(methods)}."
        )
    chosen = [_contender_of(argument, method, known) for method in methods]
    names = [each.name for each in chosen]
    if not names or len(set(names)) < len(names):
        raise ValueError(
            f"Argument `{argument}` must have one contender or more, each once, but "
            f"has {names}."
        )
    return chosen


def _contender_of(
    argument: str, method: str | Contender, known: Mapping[str, Contender]
) -> Contender:
    """The known contender of a name; a user's own is checked and returned."""
    if not isinstance(method, Contender):
        check_choice(argument, method, known)
        return known[method]
    check_choice(f"{argument}.setting", method.setting, SETTING_KINDS)
    if CONTENDERS.get(method.name, method) is not method:
        raise ValueError(
            f"Argument `{argument}` must have contenders of new names, but has "
            f"{method.name!r}."
        )
    return method
