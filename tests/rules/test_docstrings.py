"""Docstrings of public names state arguments with units, results, errors, and an example.

Examples are run by test_documents.py.
"""

import ast
import inspect
import re
import textwrap

import pytest

import jimpact as ji

MODULES = {"": ji, "plot.": ji.plot, "theory.": ji.theory, "data.": ji.data}
PUBLIC = {
    prefix + name: getattr(module, name)
    for prefix, module in MODULES.items()
    for name in module.__all__
}
FUNCTIONS = {name: x for name, x in PUBLIC.items() if inspect.isfunction(x)}
CLASSES = {name: x for name, x in PUBLIC.items() if inspect.isclass(x)}

# Units of arguments with these names, wherever they occur.
UNITS = {
    "velocity": "[m/s",
    "before": "[m/s]",
    "speed": "[m/s]",
    "impulse": "[N s]",
    "force": "",
    "masses": "[kg]",
    "gaps": "[m]",
    "radius": "[m]",
    "radii": "[m]",
    "length": "[m]",
    "width": "[m]",
    "height": "[m]",
    "density": "[kg/m^3]",
    "energy": "[J]",
    "acceleration": "[m/s^2]",
    "t_end": "[s]",
    "angle": "[rad]",
    "time": "[s]",
}
EXTRA = (
    "posterior",
)  # needs what an extra installs: examples could not run without it
CHECKS = re.compile(r"^_?check_|^as_velocity$|^as_whole$|^as_float_array$")


def section(doc, *titles):
    """Entries of sections of a docstring, by name."""
    found = {}
    for title in titles:
        part = re.search(
            rf"^{title}:\n((?: {{4}}.*\n|\n(?= {{4}}))*)", doc + "\n", re.M
        )
        for row in (
            re.split(r"^(?=\S)", textwrap.dedent(part[1]), flags=re.M) if part else ()
        ):
            names, _, text = row.partition(":")
            found |= {name.strip(): text for name in names.split(",") if text}
    return found


def raises(function):
    """Whether the function itself raises, or checks what it is given."""
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(function)))):
        called = getattr(getattr(node, "func", None), "id", "")
        if isinstance(node, ast.Raise) or CHECKS.match(called):
            return True
    return False


def lacks_line(doc, lines=1):
    """A docstring begins with a sentence of so many lines, and an empty one."""
    sentence = doc.split("\n\n")[0]
    if sentence.endswith((".", ":", "?")) and sentence.count("\n") < lines:
        return []
    return ["a first line"]


def lacks(function):
    """What the docstring of a function lacks."""
    doc, parameters = (
        inspect.getdoc(function) or "",
        inspect.signature(function).parameters,
    )
    described = section(doc, "Args")
    missing = [f"argument `{name}`" for name in parameters if name not in described]
    missing += [
        f"`{name}` is not an argument" for name in described if name not in parameters
    ]
    missing += [
        f"the unit {unit} of `{name}`"
        for name, unit in UNITS.items()
        if name in described
        and name in parameters
        and unit not in described[name]
        and parameters[name].annotation is not bool
    ]
    missing += (
        [] if re.search(r"^(Returns|Yields):$", doc, re.M) else ["what it returns"]
    )
    if raises(function) and not re.search(r"^Raises:$", doc, re.M):
        missing.append("what it raises")
    missing += [] if ">>>" in doc or function.__name__ in EXTRA else ["an example"]
    place = function.__module__
    is_theory = (
        place.startswith("jimpact.theory") and place != "jimpact.theory.pictures"
    )
    if is_theory and "Source" not in doc:
        missing.append("its source")
    return missing + lacks_line(doc)


def lacks_of_class(kind):
    """What the docstring of a class lacks about its arguments or fields."""
    doc = inspect.getdoc(kind) or ""
    described = section(doc, "Args", "Attributes")
    named = described.keys() | set(re.findall(r"`(\w+)`", doc))
    wanted = [
        name for name in inspect.signature(kind).parameters if not name.startswith("_")
    ]
    missing = [f"`{name}`" for name in wanted if name not in named]
    if "Args:" in doc and ">>>" not in doc:
        missing.append("an example")
    if issubclass(kind, ji.Law) and kind is not ji.Law and "Source:" not in doc:
        missing.append("its source")
    for name, method in vars(kind).items():
        overrides = any(
            name in vars(base) for base in kind.__mro__[1:]
        )  # described there
        if name.startswith("_") or overrides or not callable(getattr(kind, name)):
            continue
        method = getattr(kind, name)
        method_doc = inspect.getdoc(method) or ""
        missing += [
            f"`{p}` of `{name}`"
            for p in inspect.signature(method).parameters
            if p not in ("self", "cls") and not re.search(rf"\b{p}\b", method_doc)
        ]
    return missing + lacks_line(doc)


def records():
    """Classes that functions return, public by name or not."""
    for function in FUNCTIONS.values():
        kind = inspect.signature(function).return_annotation
        if inspect.isclass(kind) and kind.__module__.startswith("jimpact"):
            yield kind.__name__, kind


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_of_functions_are_complete(name):
    assert not lacks(FUNCTIONS[name])


@pytest.mark.parametrize("name", sorted({**CLASSES, **dict(records())}))
def test_docstrings_of_classes_are_complete(name):
    assert not lacks_of_class({**CLASSES, **dict(records())}[name])


def test_a_bare_docstring_is_noticed():
    def bare(scene, velocity):
        """Does something

        Args:
            velocity: v- (n,).
            speed: of nothing.
        """
        raise ValueError

    assert lacks(bare) == [
        "argument `scene`",
        "`speed` is not an argument",
        "the unit [m/s of `velocity`",
        "what it returns",
        "what it raises",
        "an example",
        "a first line",
    ]
