"""A fit as text (verdict, parameters, quality, minima, warnings, shots), as data, and
in a file.
"""

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic

import jax
import numpy as np

import jimpact
from jimpact.core.law import AnyLaw, value_of
from jimpact.fits.encoding import decoded, encoded, grouped, instance_of, versions
from jimpact.fits.findings import of_sentences
from jimpact.fits.intervals import pieces_in_words
from jimpact.fits.result import FitResult
from jimpact.fits.search import Solution
from jimpact.fits.uncertainty import Uncertainty
from jimpact.tools.checks import check_kind, suggesting_names
from jimpact.tools.records import as_data, counted, degrees, formatted, with_error
from jimpact.tools.status import STATUS

# parameters in whatever unit that are printed as 0: rounding, as minima end in it
_ZERO = 1e-12
# share of the largest velocity that is printed as 0: impacts are good to 1e-8
_ROUNDING = 1e-7
_VELOCITIES_SHOWN = 24  # in the table of shots
# Correlations of two parameters from this size on are printed, as lmfit does; ten times
# more: none.
_CORRELATED = 0.1
_CORRELATIONS_SHOWN = 6  # the largest ones; 10 parameters have 45
_MINIMA_SHOWN = 5  # in the list of minima, the lowest first
_PARAMETERS_NAMED = 6  # in one sentence; of more, the least certain
# each contact may have its own
OF_A_CONTACT = (
    "restitution",
    "friction",
    "tangential_restitution",
    "tangential_stiffness",
)
# Degrees of freedom up to which intervals are visibly wider than two standard errors:
# with ten times more they are wider by 2 %.
FEW_DEGREES = 8
UNSEEN = "start value; not determined by the data"  # note on a value in brackets
FORMAT = 1  # of the file; it changes where older files could not be read any more


def joined_words(parts: Sequence[str]) -> str:
    """Parts of a sentence, the last one after an "and".

    >>> from jimpact.fits.report import joined_words
    >>> joined_words(["a"]), joined_words(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    if len(parts) > 1:
        first = ", ".join(parts[:-1])
        return " and ".join([first, parts[-1]])
    return "".join(parts)


def _values_in_words(fit: "Fit") -> str:
    """Part of a sentence: values with errors, what they assume, what the data do not
    determine.
    """
    seen = fit.determined
    data = _data_name(fit)
    determined = np.flatnonzero(seen)
    unseen = np.flatnonzero(~seen)
    others = " and ".join(_full_name(fit, int(i)) for i in unseen)
    parts = [_with_error(fit, int(i)) for i in determined]
    if len(parts) > _PARAMETERS_NAMED:
        errors = fit.standard_error[determined]
        worst = int(np.argmax(np.nan_to_num(errors)))
        parts = [
            f"{len(parts)} parameters are fitted, the least certain {parts[worst]}"
        ]
    priors = {
        name: _prior(fit, i)
        for i, name in enumerate(fit.names)
        if not fit.from_prior[i]
    }
    assumed = _assumptions(fit)
    assumed += [f"the {prior} of {name}" for name, prior in priors.items() if prior]
    if parts and assumed:
        parts[-1] += f", assuming {joined_words(assumed)}"
    if others:
        parts.append(f"{others} cannot be determined from {data}")
    if fit.found("several_minima"):
        parts.append("other values fit equally well")
    return "; ".join(parts)


def _objection(fit: "Fit") -> str:
    """An objection to the law, as a verb phrase: it does not fit, or fails in shots;
    else ''.
    """
    data = _data_name(fit)
    if fit.shows_lack_of_fit:
        return f"does not fit {data}"
    if not fit.found("law_fails"):
        return ""
    if fit.experiments is None:
        measured = np.isfinite(fit.problem.measured)
        lost = ~np.isfinite(fit.predicted[measured])
        return f"fails in {'all' if lost.all() else 'some'} of these data"
    failing = sum(STATUS[int(code)].failure for code in fit.status)
    if failing == len(fit.status):
        return f"fails in {'this shot' if failing == 1 else f'all of {data}'}"
    return f"fails in {failing} of {data}"


def _assumptions(fit: "Fit") -> list[str]:
    """Assumptions on several contacts, as phrases: common values, stiffnesses,
    exponents.
    """
    if fit.experiments is None:
        return []
    law = fit.problem.law
    fitted = set(fit.problem.parameters.fields)
    contacts = fit.experiments.largest_scene(fit.problem.scene).contacts
    if contacts < 2:
        return []
    each = f"{'both' if contacts == 2 else f'all {contacts}'} contacts"
    assumed = [f"one {name} for {each}" for name in fit.names if name in OF_A_CONTACT]
    for name, words in (
        ("stiffness", "equal stiffnesses"),
        ("exponent", "the exponent {:g}"),
    ):
        value = value_of(law, name)
        if value is None or name in fitted:
            continue
        values = np.unique(np.asarray(value, float))
        if name == "exponent":
            kinds = {1.5: " (Hertz)", 1.0: " (linear)"}
        else:
            kinds = {}
        same = words.format(values[0]) + kinds.get(values[0], "")
        assumed.append(same if len(values) == 1 else f"the {name} of each contact")
    return assumed


def _data_name(fit: "Fit") -> str:
    """A noun for the data: "these data", "this shot", or "these 4 shots"."""
    if fit.experiments is None:
        return "these data"
    if fit.shot_count == 1:
        return "this shot"
    return f"these {fit.shot_count} shots"


def _full_name(fit: "Fit", i: int) -> str:
    """The name of a parameter; a stiffness is a ratio if that of contact 1 is fixed."""
    name = fit.names[i]
    ratio = name.startswith("stiffness[") and fit.problem.parameters.ratios
    if ratio:
        return f"the stiffness ratio {name} / stiffness[1]"
    return name


def _with_error(fit: "Fit", i: int) -> str:
    """Text of parameter i: value and error; its profile's interval if one-sided or in
    pieces.
    """
    value = fit.value[i]
    error = fit.standard_error[i]
    name = _full_name(fit, i)
    if np.isnan(error):
        return f"{name} = {value:.5g}, its error unknown"
    if fit.at_bound[i]:
        text = f"{name} = {value:g}"
    else:
        text = f"{name} = {with_error(value, error)}"
    if fit.from_prior[i]:
        return f"{text}, which is its prior"
    if fit.profiles:
        profile = fit.profiles[i]
    else:
        profile = None
    if (
        profile
        and profile.determines
        and (any(profile.open_ends) or len(profile.intervals) > 1)
    ):
        return f"{text}, {profile.words} ({100 * profile.level:g} %)"
    return f"{text}{', the end of what is allowed' if fit.at_bound[i] else ''}"


def of_bodies(fit: "Fit") -> bool:
    """True if each coordinate of a fit to shots is a body, as those of a chain are."""
    data = fit.experiments
    if data is None:
        return False
    return data.largest_scene(fit.problem.scene).walls is not None


def _headline(fit: "Fit") -> str:
    """First line of the report: the law, shots and bodies, the number of measured
    values, the method.

    Coordinates are bodies in a chain alone; elsewhere they are coordinates.
    """
    measured = np.isfinite(fit.problem.measured)
    law = type(fit.law).__name__
    values = int(measured.sum())
    if fit.experiments is None:
        return f"Fit of {law} to {values} measured values, {fit.method}"
    shots, size = fit.predicted.shape
    if measured.all():
        count = f"{values}"
    else:
        count = f"{values} of {measured.size}"
    if of_bodies(fit):
        what = counted(size, "body", "bodies")
    else:
        what = counted(size, "coordinate")
    seen = f"{count} {'velocity' if measured.size == 1 else 'velocities'} measured"
    return f"Fit of {law} to {counted(shots, 'shot')} of {what} ({seen}), {fit.method}"


def _prior(fit: "Fit", i: int) -> str:
    """Text of the prior of parameter i, with 'alone' where the data add nothing; ''
    without one.
    """
    for prior in fit.problem.priors:
        if prior.parameter == i:
            if fit.from_prior[i]:
                alone = " alone"
            else:
                alone = ""
            return f"prior{alone} {prior.mean:g} ± {prior.std:g}"
    return ""


def marked(value: float, seen: bool, digits: str) -> str:
    """A value of a table, in brackets where the data do not determine it."""
    text = formatted(value, digits)
    if seen:
        return text
    return f"({text})"


def named_values(fit: "Fit", values: np.ndarray) -> str:
    """Names and values (P,) of the parameters, in brackets what the data do not
    determine.
    """
    rounded = np.where(np.abs(values) <= _ZERO, 0.0, values)
    cells = zip(fit.names, rounded, fit.determined)
    return ", ".join(
        f"{name} {marked(value, seen, '.4g')}" for name, value, seen in cells
    )


def _parameters(fit: "Fit") -> list[str]:
    """Lines of the table of parameters: value, standard error, interval, notes; then of
    ties.
    """
    width = max(9, *(len(name) for name in fit.names))
    heads = f"{'parameter':{width}s} {'value':>12s} {'std. error':>12s}   95 % interval"
    lines = [heads + " (profile)" * bool(fit.profiles)]
    seen = fit.determined
    rows = zip(fit.names, fit.intervals())
    for i, (name, pieces) in enumerate(rows):
        error = fit.standard_error[i]
        if np.isnan(error):
            error_text = "unknown"
        else:
            error_text = f"{error:.3g}"
        if np.isinf(error):
            error_text = "undetermined"
        interval = "-"
        if np.isfinite(error) or fit.profiles:
            ends = (fit.bounds[0][i], fit.bounds[1][i])
            interval = pieces_in_words(pieces, ends)
        if fit.at_bound[i]:
            note = "at its bound"
        else:
            note = ""
        of_value = note if seen[i] else UNSEEN
        note = ", ".join(filter(None, [of_value, _prior(fit, i)]))
        value = marked(fit.value[i], seen[i], ".6g")
        cells = f"{name:{width}s} {value:>12s} {error_text:>12s}   {interval}   {note}"
        lines.append(cells.rstrip())
    lines += [
        f"{name} = {with_error(*pair)} is tied" for name, pair in fit.tied.items()
    ]
    freedom = fit.degrees_of_freedom
    if fit.problem.sigma is None and 0 < freedom <= FEW_DEGREES:
        lines.append(
            f"With {degrees(freedom)}, a 95 % interval is {fit.quantile(0.95):.2g} "
            f"standard errors to each side (Student's t), not 1.96."
        )
    if fit.linearization_misleads and not fit.profiles:
        lines.append(
            "These intervals take the sum of squares for a parabola, which may mislead "
            "here: `ji.profile(fit)` does not."
        )
    return lines


def _correlations(fit: "Fit") -> list[str]:
    """Lines for pairs of determined parameters with correlated errors, the largest
    sizes first.

    A correlation of size 1 would be a combination that the data do not determine.
    """
    determined = np.flatnonzero(fit.determined).tolist()
    pairs = itertools.combinations(determined, 2)
    sizes = {pair: float(fit.correlation[pair]) for pair in pairs}
    large = (x for x in sizes if abs(sizes[x]) >= _CORRELATED)
    worst = sorted(large, key=lambda x: -abs(sizes[x]))
    lines = [
        f"{fit.names[i]} and {fit.names[j]}: {sizes[i, j]:.3f}"
        for i, j in worst[:_CORRELATIONS_SHOWN]
    ]
    if len(worst) > len(lines):
        lines.append(f"... and {len(worst) - len(lines)} more, see `fit.correlation`")
    return _section(
        f"Correlations (below {_CORRELATED:g} in size: not listed)", tuple(lines)
    )


def _quality(fit: "Fit") -> list[str]:
    """Lines on the quality of the fit: residuals, chi^2 or noise, rank, solver."""
    if fit.experiments is not None:
        unit = " m/s"
        one = "velocity"
    else:
        unit = ""
        one = "value"
    exact = fit.starts[0].sum_of_squares <= fit.problem.exact_squares
    if exact:
        rms = "0 (the values are reproduced)"
    else:
        rms = f"{fit.rms:.4g}{unit}"
    lines = [f"rms residual   {rms}"]
    if fit.problem.sigma is not None:
        squares = (
            f"{fit.starts[0].sum_of_squares:.4g} with {degrees(fit.degrees_of_freedom)}"
        )
        lines.append(f"chi^2          {squares} (sigma given)")
        lines += _sigma_sources(fit)
        if fit.noise > 1 and fit.loss == "squares":
            freedom = max(fit.degrees_of_freedom, 1)
            ratio = np.sqrt(fit.starts[0].sum_of_squares / freedom)
            every = np.isclose(fit.noise, ratio, rtol=1e-3)
            if every:
                part = ""
            else:
                part = " (the factor is that of the residuals that are not momentum)"
            lines.append(
                f"errors         standard errors multiplied by {fit.noise:.3g}, "
                f"because chi^2 contradicts the stated sigma{part}"
            )
    elif np.isfinite(fit.noise):
        lines.append(
            f"noise          {fit.noise:.4g}{unit} a {one}, estimated with "
            f"{degrees(fit.degrees_of_freedom)}"
        )
    # bounded by intervals
    total = len(fit.names)
    bounded = int(fit.determined.sum())
    if bounded < fit.rank == total:
        fewer = f"; the errors leave {total - bounded} unbounded"
    else:
        fewer = ""
    if fit.converged:
        state = "converged"
    else:
        state = "NOT converged"
    rank = f"{fit.rank} of {counted(total, 'parameter')}"
    lines.append(f"determined     {rank} (rank of the derivatives{fewer})")
    return [
        *lines,
        f"solver         {state}, at most {counted(fit.steps, 'step')} a start",
    ]


def _sigma_sources(fit: "Fit") -> list[str]:
    """Lines on further errors in the stated sigma: resolution, and velocities
    before.
    """
    data = fit.experiments
    lines = []
    if data is not None and data.resolution is not None:
        steps = np.unique(np.asarray(data.resolution)[data.measured])
        if len(steps) == 1:
            size = f"{steps[0]:.3g}"
        else:
            size = f"{steps[0]:.3g} to {steps[-1]:.3g}"
        lines.append(
            f"               with that of readings in steps of {size}: step / sqrt(12)"
        )
    if data is not None and data.sigma_pre is not None and np.any(data.sigma_pre):
        if data.covariance is not None:
            errors = "their covariance with"
        else:
            errors = "those of"
        searched = "the velocities before, whose true values are searched for"
        lines.append(f"               with {errors} {searched}")
    return lines


def _section(title: str, lines: tuple[str, ...]) -> list[str]:
    """A titled list, a line for each entry; no lines if it is empty."""
    if lines:
        return [title, *(f"  - {line}" for line in lines)]
    return []


def _minima(fit: "Fit") -> list[str]:
    """Lines on the minima that starts ended in: sum of squares, number of starts,
    values.
    """
    total = fit.start_count
    lost = fit.lost_starts
    count = len(fit.starts)
    given_up = (
        f"{lost} of {counted(total, 'start')} {'was' if lost == 1 else 'were'} "
        f"given up."
    )
    if lost:
        unfinished = [given_up]
    else:
        unfinished = []
    if count == 1:
        ended = f"{total - lost} of {total} starts ended in this minimum."
        if total > 1:
            return [" ".join([ended, *unfinished])]
        return []
    if fit.rank == len(fit.names):
        where = f"{count} minima"
    else:
        where = f"{count} points of one valley"
    lines = [
        (
            f"{total - lost} of {total} starts ended in {where}:  sum of squares, "
            f"starts, values"
        )
    ]
    for minimum in fit.starts[:_MINIMA_SHOWN]:
        values = named_values(fit, minimum.value)
        squares = minimum.sum_of_squares
        if squares <= fit.problem.exact_squares:
            squares = 0.0
        lines.append(f"  {squares:12.5g} {minimum.count:4d}   {values}")
    if count > _MINIMA_SHOWN:
        lines.append(f"  ... and {count - _MINIMA_SHOWN} more")
    return lines + unfinished


def _shots(fit: "Fit") -> list[str]:
    """Lines of the table of the first shots: velocities before, measured and fitted;
    status.
    """
    data = fit.experiments
    if data is None:
        return []
    mixed = len(set(data.units)) > 1
    if mixed:
        common_unit = ""
    else:
        common_unit = f" [{data.units[0]}]"
    if of_bodies(fit):
        which = "body"
    else:
        which = "coord"
    shots, bodies = data.pre.shape
    shown = max(1, _VELOCITIES_SHOWN // bodies)
    wide = max(8, *map(len, data.shots[:shown]))
    columns = f"{which:>5s} {'before':>12s} {'measured':>12s} {'fitted':>12s}"
    lines = [f"{'shot':>{wide}s} {columns}{common_unit}"]
    before = np.asarray(data.pre, float)
    measured = np.asarray(data.post, float)
    sizes = np.abs(fit.predicted)
    largest = sizes.max(axis=1, keepdims=True)
    is_rounding = np.abs(fit.predicted) <= _ROUNDING * largest
    fitted = np.where(is_rounding, 0.0, fit.predicted)
    for k, i in np.ndindex(*before[:shown].shape):
        if i == 0:
            label = data.shots[k]
        else:
            label = ""
        if fit.status[k] and i == 0:
            status = STATUS[int(fit.status[k])].name
        else:
            status = ""
        if np.isnan(measured[k, i]):
            value = "-"
        else:
            value = formatted(measured[k, i], ".6g")
        pre, law = (formatted(x[k, i], ">12.6g") for x in (before, fitted))
        row = f"{label:>{wide}s} {i + 1:>5d} {pre} {value:>12s} {law}"
        if mixed:
            unit = f" {data.units[i]}"
        else:
            unit = ""
        lines.append(f"{row}{unit}   {status}".rstrip())
    if shots > shown:
        lines.append(f"     ... and {counted(shots - shown, 'more shot')}")
    return lines


# ---------------------------------------------------------------------------- the whole


def verdict(fit: "Fit") -> str:
    """The sentence of `Fit.verdict`: values, what speaks against the law, and
    reservations.
    """
    law = type(fit.law).__name__
    if not fit.converged:
        return f"No answer: the search for the parameters of {law} has not converged."
    reserved = joined_words(fit.reservations)
    sentence = _values_in_words(fit)
    against = _objection(fit)
    if against:
        if fit.determined.any():
            nearest = f"it comes nearest with {sentence}"
        else:
            nearest = sentence
        sentence = f"{law} {against}; {nearest}"
    if reserved:
        sentence += f"; {'and' if against else 'but'} {reserved}"
    return f"{sentence}."


def report(fit: "Fit") -> str:
    """The report, blocks of lines: verdict, head, tables of parameters, quality,
    minima, shots.
    """
    blocks = [
        [fit.verdict],
        [_headline(fit)],
        _parameters(fit),
        _correlations(fit),
        _quality(fit),
        _section("What the data do not determine", fit.identifiability),
        _minima(fit),
        _section("Warnings", fit.warnings),
        _shots(fit),
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def as_record(fit: "Fit") -> dict[str, Any]:
    """A fit as a dictionary of JSON data, for `Fit.to_dict`."""
    as_they_are = (
        *("method", "rms", "noise", "degrees_of_freedom", "rank", "identifiability"),
        *(
            "findings",
            "warnings",
            "verdict",
            "reservations",
            "seed",
            "converged",
            "covariance",
        ),
        *("correlation", "predicted", "residual"),
    )
    parameters = [
        {
            "name": name,
            "value": fit.value[i],
            "standard_error": fit.standard_error[i],
            "confidence_interval_95": ends,
            "at_bound": fit.at_bound[i],
            "seen": fit.determined[i],
            "profile_95": fit.profiles[i].intervals if fit.profiles else None,
        }
        for i, (name, ends) in enumerate(zip(fit.names, fit.confidence_interval()))
    ]
    of_minimum = ("sum_of_squares", "value", "count")
    record = {
        "law": type(fit.law).__name__,
        "parameters": parameters,
        "starts": [
            {name: getattr(each, name) for name in of_minimum} for each in fit.starts
        ],
        "shots": [] if fit.experiments is None else fit.experiments.shots,
        "status": [STATUS[code].name for code in fit.status],
    }
    return as_data(record | {name: getattr(fit, name) for name in as_they_are})


# ---------------------------------------------------------------------------- in a file


def save_fit(fit: "Fit", path: str | Path) -> Path:
    """Write a fit to a JSON file, for `Fit.save`: its format, versions, and encoded
    fields.

    Raises:
        ValueError: a fit to something else than shots, or with ties.
    """
    if fit.experiments is None:
        raise ValueError(
            "Argument `fit` must be to shots to be saved: functions cannot be."
        )
    if fit.problem.ties:
        raise ValueError(
            "Argument `fit` must have no ties to be saved: functions cannot be."
        )
    complete = dataclasses.replace(
        fit, known_findings=fit.findings, known_profiles=fit.profiles
    )
    record = {
        "format": FORMAT,
        "versions": versions(),
        "result": encoded(complete)["fields"],
    }
    path = Path(path)
    text = json.dumps(record, allow_nan=False, indent=1)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def load_fit(path: str | Path) -> "Fit":
    """The fit that `Fit.save` wrote, to the last digit; `ji.load` reads motions, too.

    The classes of its law and scene are imported by name, so read only files that you
    trust.

    Args:
        path: the file.

    Returns:
        `Fit`, with all that one can do with it.

    Raises:
        FileNotFoundError: no such file. ValueError: not a fit, one of another format,
            or a law that cannot be imported.

    >>> import pathlib, tempfile, jimpact as ji
    >>> data = ji.Experiments(
    ...     [[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]], sigma=0.02
    ... )
    >>> fit = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> path = fit.save(pathlib.Path(tempfile.mkdtemp()) / "fit.json")
    >>> ji.load(path).verdict == fit.verdict
    True
    """
    path = Path(path)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise ValueError(
            f"{path}: the file must be a saved fit or motion (`Fit.save`), but is no "
            "JSON."
        ) from None
    if not isinstance(record, dict) or "format" not in record:
        raise ValueError(f"{path}: the file must be a saved fit, but has no `format`.")
    writer = record.get("versions", {}).get("jimpact", "an unknown version")
    if record["format"] != FORMAT:
        raise ValueError(
            f"{path}: the file must be a fit saved in format {FORMAT}, but has format "
            f"{record['format']} (written by jimpact {writer}; this is "
            f"{jimpact.__version__})."
        )
    try:
        with jax.enable_x64(True):  # arrays keep the precision that they were saved in
            return instance_of(Fit, _of_this_build(record["result"]))
    except (KeyError, AttributeError, ImportError, TypeError) as error:
        raise ValueError(
            f"{path}: the fit, saved by jimpact {writer}, cannot be read: {error!r}. A "
            f"law of your own must be imported before."
        ) from error


def _of_this_build(result: dict[str, Any]) -> dict[str, Any]:
    """Encoded fields of a fit as this build names them, from those that an older build
    saved.

    Before 0.2 there were sentences in the place of findings; then fields of `search`
    and `errors` stood beside the others.
    """
    if "warnings" in result:
        lines, reservations = (
            decoded(result.pop(name)) for name in ("warnings", "reservations")
        )
        problem = result["problem"]["fields"]
        fixed = any(
            note.startswith("stiffness[1] is fixed")
            for note in decoded(problem["notes"])
        )
        problem["parameters"]["fields"]["ratios"] = fixed
        result = result | {"findings": encoded(of_sentences(lines, reservations))}
    if "search" not in result:
        result = grouped(result, {"search": Solution, "errors": Uncertainty})
        for name in ("findings", "profiles"):
            result[f"known_{name}"] = result.pop(name)
        for name in ("residual", "rms"):  # which follow from the others
            del result[name]
    return result


# ---------------------------------------------------------------------------- the
# result


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
@suggesting_names(
    restitution="law.restitution", stiffness="law.stiffness", friction="law.friction"
)
class Fit(FitResult[AnyLaw], Generic[AnyLaw]):
    """The result of `fit`. `print(fit)` gives its report.

    P free parameters, K shots of n velocities.

    Attributes:
        law: with the fitted parameters.
        method: of minimizing, see `fit`.
        names: of the parameters, contacts numbered from 1.
        value: (P,) in the units of each parameter, as the next two.
        standard_error: (P,); inf where the data do not determine a parameter, NaN where
            no degree of freedom is left to estimate the noise from.
        covariance: (P, P).
        correlation: (P, P), in [-1, 1].
        bounds: lowest and highest values (P,), (P,).
        at_bound: (P,) boolean.
        predicted: shaped like what was measured, (K, n) [m/s].
        residual: measured less predicted (K, n) [m/s]; NaN where no value was measured.
        rms: of the residual.
        noise: estimated standard error of one value; NaN where no degree of freedom is
            left, 1 if `sigma` is known, or, if chi^2 shows that sigma is too small, the
            factor that the standard errors are multiplied by.
        degrees_of_freedom: independent measured values less `rank`.
        rank: of the Jacobian; below P: see `identifiability`.
        singular_values: (P,) of the scaled Jacobian.
        identifiability: in words, what the data do not determine.
        starts: the distinct minima, best first.
        status: (K,) codes of `jimpact.STATUS` at the minimum.
        converged: whether the best start did.
        steps: iterations of the best start.
        lost_starts: how many were given up far above the best, or did not converge.
        stuck: whether no step lowers the sum of squares, although derivatives promise
            it.
        pre: true v- (K, n) that agree best with the law and the data, where v- have
            errors; else None. `predicted` is then `v+(pre) + slopes (v- - pre)`: the
            law at the measured v-, linearized.
        slopes: `dv+/dv-` (K, n, n) at these v-, or None.
        findings: what is wrong with data or fit, by kind, shots and numbers; computed
            on first access, as profiles are.
        warnings: the same in words.
        problem: what was solved.
        jacobian: derivatives of what was measured in the parameters (K, n, P), NaN
            where no value was measured.
        loss: see `fit`.
        seed: of the random starts.
        profiles: of all parameters, where intervals are theirs, see `fit`; else none.
        search: where it ended: `value`, `starts`, `predicted`, .. are its fields.
        errors: linearized: `standard_error`, `covariance`, `rank`, .. are its fields.
        reservations: in words, what has to be said where a value is quoted.
        judged: what the tests behind `findings` need; None of a fit that was read from
            a file.
        wants_profiles: the argument `profiles` of `fit`.
        progress: of profiles, see `Search`.
        known_findings: those that a file holds; None: computed on first access.
        known_profiles: those that a file holds; None: computed on first access.
    """

    def __str__(self) -> str:
        return report(self)

    @property
    def verdict(self) -> str:
        """The result in one sentence that can be quoted: the first one of `print(fit)`.

        Values with their errors, what they assume, and what speaks against them.
        """
        return verdict(self)

    def to_dict(self) -> dict[str, Any]:
        """Everything a JSON file can hold; numbers that are not finite become None."""
        return as_record(self)

    def save(self, path: str | Path) -> Path:
        """Write the fit to a file (JSON) that `ji.load` reads: problem, result,
        versions.

        Args:
            path: the file; an existing file is replaced.

        Returns:
            The path.

        Raises:
            ValueError: a fit of something else than shots, or with ties: functions
                cannot be saved.
        """
        return save_fit(self, path)


def check_squares(name: str, fit: Any) -> None:
    """Raise an error unless argument `name` is a fit by least squares."""
    check_kind(name, fit, Fit)
    if fit.loss != "squares":
        raise ValueError(
            f"Argument `{name}` must be by least squares, but has loss {fit.loss!r}."
        )
