"""Pages of the site that are generated: laws, API, constants, gallery, lists.

`conf.py` writes them into docs/generated before Sphinx reads the pages. Nothing here
needs Sphinx, so the default tests check the texts, too.
"""

import ast
import functools
import inspect
import io
import re
import shutil
import tokenize
from operator import attrgetter
from pathlib import Path
from typing import get_args, get_origin

import jimpact as ji

DOCS = Path(__file__).parent
ROOT = DOCS.parent
GENERATED = DOCS / "generated"

# ------------------------------------------------------------------------------------
# the API

# a page, and the modules whose public names it holds: the longest match decides
API = {
    "Impacts": ("core.impacts", "core.audits", "laws.histories", "tools"),
    "Scenes": (
        "core.scene",
        "bodies.functions.scene_from_gaps",
        "bodies.mujoco_scene",
        "core.contact",
    ),
    "Bodies": ("bodies",),
    "Laws": ("core.law", "core.registry", "laws"),
    "Contact forces": ("laws.forces", "laws.calibration"),
    "Shots and fits": ("shots", "fits", "cli", "saved"),
    "Tracks": ("tracks",),
    "Monte Carlo": ("montecarlo", "core.distributions"),
    "Motions": ("motion",),
    "Methods": ("methods",),
    "Pictures": ("plot",),
    "Theory": ("theory",),
    "Measured data": ("data",),
}

DATA = {
    "REGISTRY": (
        "All laws by name: `REGISTRY[name].law` is the class. `register` adds a law."
    ),
    "data.ENGINE_SCENES": (
        "Scenes of `engine_impacts` by name: masses [kg], wall, the e asked for."
    ),
    "STATUS": "Rows `(name, message, failure)` of the status codes, listed below.",
}


def public_names() -> dict[str, list[str]]:
    """Public names by page, from the stubs that list them."""
    pages: dict[str, list[str]] = {title: [] for title in API}
    for package, prefix in (
        ("", ""),
        ("plot", "plot."),
        ("theory", "theory."),
        ("data", "data."),
        ("tracks", "tracks."),
    ):
        stub = ROOT / "jimpact" / package / "__init__.pyi"
        for line in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(line, ast.ImportFrom) and line.module:
                module = line.module
                names = [alias.name for alias in line.names]
            else:
                continue
            for name in names:
                place = f"{package or module}.{name}"
                matches = [
                    (len(start), title)
                    for title, starts in API.items()
                    for start in starts
                    if place.startswith(start + ".") or place == start
                ]
                if not matches:
                    raise ValueError(
                        f"API must have a page for {place}: see docs/pages.py"
                    )
                pages[max(matches)[1]].append(prefix + name)
    return pages


def slug(title: str) -> str:
    """File name of a page."""
    return title.lower().replace(" ", "_")


def law_names() -> dict[str, str]:
    """Names in a study by class name."""
    return {row.law.__name__: name for name, row in ji.REGISTRY.items()}


def first_line(name: str) -> str:
    """The summary line of a public name."""
    if name in DATA:
        return DATA[name]
    return (inspect.getdoc(attrgetter(name)(ji)) or "").partition("\n")[0]


def in_table(text: str) -> str:
    """Text that does not break the row of a table."""
    return text.replace("|", r"\|")


def names_page() -> str:
    """`docs/names.md`: every public name in one line, by task."""
    top = (
        "Every public name, by task, as `import jimpact as ji` shows it. Classes of "
        "results are "
        "described on the pages of the functions that return them."
    )
    text = ["<!-- written by `python docs/pages.py` -->", "", "# Names", "", top, ""]
    for title, names in public_names().items():
        text += [f"## {title}", "", "| name | |", "|---|---|"]
        for name in sorted(names, key=str.lower):
            text.append(f"| `ji.{name}` | {in_table(first_line(name))} |")
        text.append("")
    return "\n".join(text)


def results_of(names: list[str]) -> dict[str, type]:
    """Classes without a public name that these functions return, by module and name."""
    public = {
        attrgetter(name)(ji)
        for names in public_names().values()
        for name in names
        if name not in DATA
    }
    found = {}
    for name in names:
        value = DATA.get(name) or attrgetter(name)(ji)
        if inspect.isfunction(value):
            returns = [inspect.signature(value).return_annotation]
        else:
            returns = []
        for kind in (part for each in returns for part in (get_args(each) or (each,))):
            kind = get_origin(kind) or kind
            ours = inspect.isclass(kind) and kind.__module__.startswith("jimpact.")
            if ours and kind not in public:
                found[f"{kind.__module__}.{kind.__name__}"] = kind
    return found


def api_pages() -> dict[str, str]:
    """A page for each group of public names, and their list."""
    laws = law_names()
    index = ["# API", "", "[Names](../../names.md) lists all of them.", ""]
    pages = {}
    described = set()
    for title, names in public_names().items():
        text = [f"# {title}", ""]
        for name in names:
            if name in laws:
                text += [f"- [`ji.{name}`](../laws/{laws[name]}.md): its own page", ""]
                continue
            if name in DATA:
                text += [
                    "```{eval-rst}",
                    f".. py:data:: jimpact.{name}",
                    "",
                    f"   {DATA[name]}",
                ]
                text += ["```", ""]
                continue
            if isinstance(attrgetter(name)(ji), type):
                kind = "class"
            else:
                kind = "function"
            text += ["```{eval-rst}", f".. auto{kind}:: jimpact.{name}"]
            if kind == "class":
                text.append("   :members:")
            text += ["```", ""]
        results = sorted(results_of(names).keys() - described)
        described.update(results)
        for place in results:
            text += [
                "```{eval-rst}",
                f".. autoclass:: {place}",
                "   :members:",
                "```",
                "",
            ]
        if title == "Impacts":
            text += status_table()
        pages[f"api/{slug(title)}.md"] = "\n".join(text)
    toctree = [
        "```{toctree}",
        ":hidden:",
        "",
        *[slug(title) for title in API],
        "```",
        "",
    ]
    pages["api/index.md"] = "\n".join([*index, *toctree])
    return pages


def status_table() -> list[str]:
    """What the codes of `Impact.status` mean."""
    rows = [
        f"| {code} | `{x.name}` | {'yes' if x.failure else ''} | {x.message} |"
        for code, x in enumerate(ji.STATUS)
    ]
    head = [
        "## Status codes",
        "",
        "| code | name | failure | meaning |",
        "|---|---|---|---|",
    ]
    return [*head, *rows, ""]


def law_pages() -> dict[str, str]:
    """One page for each law, from the registry and the docstring."""
    pages = {}
    for name, row in ji.REGISTRY.items():
        law = row.law.__name__
        promises = ", ".join(sorted(row.promises)).replace("_", " ") or "none"
        keys = ", ".join(f"`{x}`" for x in row.parameters)
        text = [
            f"# {law}",
            "",
            f"{row.summary[0].upper()}{row.summary[1:]}.",
            "",
            f"Right when\n: {row.right_when}",
            "",
            f"Fails when\n: {row.fails_when}",
            "",
            f"Promises on every scene\n: {promises}",
            "",
            f'In a study\n: `[law]` `name = "{name}"`; {keys}',
            "",
            f"Source\n: {row.source}",
            "",
            *picture_of(f"law_{name}"),
            "```{eval-rst}",
            f".. autoclass:: jimpact.{law}",
            "```",
            "",
            "## To cite",
            "",
            "```bibtex",
            row.bibtex.strip(),
            "```",
            "",
        ]
        pages[f"laws/{name}.md"] = "\n".join(text)
    return pages


# ---------------------------------------------------------------------------- the
# constants

# words of a comment that state a unit, and the unit; None: the words themselves
UNITS = (
    (r"\[([^\]]+)\]", None),
    (r"^(m/s\^2)", None),
    (r"^(?:(?:of|in) )?(?:the )?tolerances?\b", "tolerance"),
    (r"^seconds\b", "s"),
    (r"^(?:of )?eps\b|this many eps|multiple of (?:m )?eps|so many roundings", "eps"),
    (r"^(?:a )?(?:relative|share|factor)\b|\bthis (?:share|factor)\b", "1"),
)


def numbers_in(value: ast.expr) -> bool:
    """Whether an expression is made of numbers that somebody chose."""
    made_by_calls = [
        x for x in ast.walk(value) if isinstance(x, ast.Call | ast.comprehension)
    ]
    if any(
        getattr(getattr(x, "func", None), "id", "") != "MappingProxyType"
        for x in made_by_calls
    ):
        return False
    return not isinstance(value, ast.Subscript) and any(
        isinstance(x, ast.Constant)
        and isinstance(x.value, int | float)
        and not isinstance(x.value, bool)
        for x in ast.walk(value)
    )


def constants_of(path: Path) -> list[tuple[str, str, str]]:
    """(name, value, comment) of the numbers bound to NAMES_IN_CAPITALS at the top of a
    module.

    The comment is the one at the end of the line and the one on the lines above;
    constants that follow each other without a comment of their own share the one above
    the first.
    """
    source = path.read_text(encoding="utf-8")
    comments = {
        token.start[0]: token.string.lstrip("#: ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT and not token.string.startswith("# ---")
    }
    lines = source.splitlines()
    rows = []
    last_line = -1
    shared = ""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets = [node.target]
        else:
            continue
        names = [x.id for t in targets for x in ast.walk(t) if isinstance(x, ast.Name)]
        if (
            not names
            or not all(x.isupper() for x in names)
            or not numbers_in(node.value)
        ):
            continue
        # codes: 0, 1, 2
        if len(names) > 1 and not isinstance(node.value, ast.Constant):
            continue
        end = node.end_lineno
        above = []
        row = node.lineno - 1
        while row in comments and lines[row - 1].lstrip().startswith("#"):
            above.insert(0, comments[row])
            row -= 1
        same_line = [comments[k] for k in range(node.lineno, end + 1) if k in comments]
        same_line = [
            x for x in same_line if not x.startswith(("fmt:", "noqa", "type:"))
        ]
        if not above and not same_line and row == last_line:
            above = [shared]
        if node.lineno == end:
            comment = " ".join([*same_line, *above])
        else:
            comment = " ".join([*above, *same_line])
        rows.append((", ".join(names), ast.unparse(node.value), comment))
        last_line = end
        shared = " ".join(above)
    return rows


def unit_of(comment: str) -> str:
    """The unit that a comment states, or "" for counts and where it states none."""
    for pattern, unit in UNITS:
        match = re.search(pattern, comment)
        if match:
            if unit is None:
                return match[1]
            return unit
    return ""


@functools.cache
def constants() -> dict[str, list[tuple[str, str, str]]]:
    """Constants of all modules, by path in the package."""
    package = ROOT / "jimpact"
    found = {}
    for path in sorted(package.rglob("*.py")):
        if path.name == "tableaux.py":  # coefficients of published Runge-Kutta methods
            continue
        rows = constants_of(path)
        if rows:
            found[path.relative_to(package).as_posix()] = rows
    return found


def constants_page() -> dict[str, str]:
    """Every number that somebody chose, with what it means."""
    text = [
        "# Constants",
        "",
        "Every number bound to a name in capitals at the top of a module, with its "
        "comment in the "
        "source. Values are SI where nothing else is stated; `eps` is the rounding "
        "unit of the "
        "precision in use. A constant without a unit is a count, or its meaning states "
        "the unit. "
        "Coefficients of published Runge-Kutta methods are left out.",
        "",
    ]
    room = None
    for path, rows in constants().items():
        if "/" in path:
            folder = path.split("/")[0]
        else:
            folder = "top level"
        if folder != room:
            text += ["", f"## {folder}", "", "| name | value | unit | meaning | file |"]
            text.append("|---|---|---|---|---|")
            room = folder
        for name, value, comment in rows:
            if len(value) <= 60:
                shown = value
            else:
                shown = value[:57] + "..."
            meaning = in_table(re.sub(r"^\[[^\]]+\][,:;]? *", "", comment))
            meaning = re.sub(r"([<>*_$\[\]{}])", r"\\\1", meaning)
            file = path.split("/", 1)[-1]
            columns = (
                f"`{name}`",
                f"`{in_table(shown)}`",
                unit_of(comment),
                meaning,
                f"`{file}`",
            )
            text.append(f"| {' | '.join(columns)} |")
    text.append("")
    return {"constants.md": "\n".join(text)}


# --------------------------------------------------------------------------------- the
# rooms

# from above: (name, task); a room imports from rows below its own, and from itself
ROOMS = (
    (("cli", "commands"), ("saved", "saved results")),
    (("fits", "fits, verdicts"), ("methods", "comparison, charts")),
    (
        ("motion", "whole motions"),
        ("theory", "outcomes, bounds"),
        ("montecarlo", "random gaps"),
        ("tracks", "tracks to shots"),
        ("data", "measurements"),
    ),
    (
        ("shots", "measured shots and their files"),
        ("plot", "style of pictures, `ji.plot`"),
    ),
    (("laws", "one file for each law"),),
    (("events", "impact dynamics"), ("bodies", "gaps, tangents, mass")),
    (("core", "scene, contact, law, impact, audit, registry"),),
    (("numerics", "derivatives, steps, LCP, friction, linear systems"),),
    (("tools", "checks, compiling, loops, precision, progress, tables, statuses"),),
)
# Above the laws a room takes from these only names that a stub (`__init__.pyi`) states.
STATED = ("core", "events", "bodies", "laws")


def rooms_svg() -> str:
    """The rooms of the package, stacked; colours are those of the page, light or
    dark.
    """
    width = 640
    height = 40
    gap = 8
    total = len(ROOMS) * (height + gap) + 4
    ink = "var(--color-foreground-primary)"
    line = "var(--color-brand-primary)"
    parts = [
        f'<svg viewBox="0 0 {width} {total}" role="img" '
        f'style="max-width:{width}px;width:100%" '
        'aria-label="Rooms of the package, each resting on those below it">'
    ]
    for row, rooms in enumerate(ROOMS):
        y = row * (height + gap) + 2
        each = (width - 4 - gap * (len(rooms) - 1)) / len(rooms)
        for column, (room, task) in enumerate(rooms):
            x = 2 + column * (each + gap)
            parts.append(
                f'<rect x="{x:.0f}" y="{y}" width="{each:.0f}" height="{height}" '
                'rx="5" '
                f'fill="var(--color-background-secondary)" stroke="{line}"/>'
                f'<text x="{x + each / 2:.0f}" y="{y + 17}" '
                'text-anchor="middle" font-size="14" '
                f'font-weight="600" fill="{ink}">{room}</text>'
                f'<text x="{x + each / 2:.0f}" y="{y + 33}" '
                'text-anchor="middle" font-size="12" '
                f'fill="{ink}">{task}</text>'
            )
    parts.append("</svg>")
    return "\n".join(parts) + "\n"


# ----------------------------------------------------------------- pictures, notebooks,
# writing


def pictures() -> dict[str, str]:
    """Name and caption of each picture: the functions of `gallery.py`."""
    tree = ast.parse((DOCS / "gallery.py").read_text(encoding="utf-8"))
    made = [
        x
        for x in tree.body
        if isinstance(x, ast.FunctionDef)
        and any(ast.unparse(y) == "picture" for y in x.decorator_list)
    ]
    return {x.name: " ".join((ast.get_docstring(x) or "").split()) for x in made}


def picture_of(name: str) -> list[str]:
    """A picture that links to its code in the gallery; nothing where there is no such
    picture.
    """
    caption = pictures().get(name)
    if caption is None:
        return []
    return [
        f":::{{figure}} ../../pictures/{name}.png",
        f":target: ../gallery.html#{anchor(name)}",
        f":alt: {caption}",
        "",
        caption,
        ":::",
        "",
    ]


def anchor(name: str) -> str:
    """Anchor of a picture in the gallery."""
    return name.replace("_", "-")


def gallery_page() -> dict[str, str]:
    """All pictures in a grid; each links to its code below."""
    grid = ["::::{grid} 1 2 2 3", ":gutter: 3", ""]
    code = []
    for name, caption in pictures().items():
        law = ji.REGISTRY.get(name.removeprefix("law_"))
        if law:
            title = law.law.__name__
        else:
            title = name.replace("_", " ").capitalize()
        file = f"../pictures/{name}.png"
        grid += [
            f":::{{grid-item-card}} {title}",
            f":img-top: {file}",
            (f":img-alt: {caption}"),
            f":link: {name}",
            ":link-type: ref",
            ":::",
            "",
        ]
        code += [
            f"({name})=",
            f"## {title}",
            "",
            caption,
            "",
            f"![{caption}]({file})",
            "",
            "```{literalinclude} ../gallery.py",
            ":language: python",
            f":pyobject: {name}",
            "```",
            "",
        ]
    top = [
        "# Gallery",
        "",
        "Each picture links to its code. To draw one again, run "
        "`python docs/gallery.py NAME` in a clone.",
        "",
    ]
    return {"gallery.md": "\n".join([*top, *grid, "::::", "", *code])}


def notebooks_page() -> dict[str, str]:
    """The course of notebooks, in order."""
    names = sorted(x.stem for x in (ROOT / "notebooks").glob("*.ipynb"))
    text = [
        "# Notebooks",
        "",
        "One course, in the folder `notebooks/`. The tests run "
        "the "
        "notebooks; this site shows their stored outputs.",
        "",
        "```{toctree}",
        ":maxdepth: 1",
        "",
        *names,
        "```",
        "",
    ]
    return {"notebooks/index.md": "\n".join(text)}


def write() -> None:
    """Write the pages that changed, so that Sphinx builds only those again."""
    pages = (
        law_pages() | api_pages() | constants_page() | gallery_page() | notebooks_page()
    )
    pages["rooms.svg"] = rooms_svg()
    for name, text in pages.items():
        path = GENERATED / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        shutil.copy2(path, GENERATED / "notebooks")


if __name__ == "__main__":
    (DOCS / "names.md").write_text(names_page(), encoding="utf-8")
