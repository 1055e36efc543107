"""The site: `sphinx-build -W --keep-going docs build/site`. No network, nothing is executed.

Pages of laws, the API, the gallery and the notebooks are written into docs/generated, from the
registry, the public names, `gallery.py` and the stored outputs of the notebooks.
"""

import ast
import re
import shutil
import sys
from operator import attrgetter
from pathlib import Path

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT)]

import formulas  # noqa: E402

import jimpact as ji  # noqa: E402

project = "jimpact"
author = "The jimpact developers"
copyright = author
version = release = ji.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb", "sphinx_design"]
nitpicky = True
nitpick_ignore_regex = [("py:class", ".*")]  # types of fields: of other packages, mostly
exclude_patterns = ["paper.md"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # else taken from the network
nb_merge_streams = True
suppress_warnings = ["mystnb.unknown_mime_type"]
default_role = "code"  # single backticks of docstrings
highlight_language = "none"
autodoc_typehints = "none"  # docstrings tell shapes and units
autodoc_member_order = "bysource"
autodoc_default_options = {"members": False}
napoleon_custom_sections = [("Class attributes", "params_style"), "Status", "Limits"]
napoleon_use_rtype = False
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "jimpact"
html_math_renderer = "mathml"
html_favicon = "static/icon.svg"
html_static_path = ["static"]
html_css_files = ["jimpact.css"]
html_show_sphinx = False
html_copy_source = False


# ------------------------------------------------------------------------ formulas, as MathML

LONG = 30  # signs


def mathml(node, block=False):
    """MathML of a formula; one that is none is a warning that names it."""
    try:
        return tex2mathml(node.astext(), as_block=block)
    except (MathError, AttributeError) as wrong:  # AttributeError: a new row outside of a table
        logging.getLogger(__name__).warning(
            "no formula: %s (%s)", node.astext(), wrong, location=node
        )
        return node.astext()


def _inline(writer, node):
    formula = mathml(node)
    signs = re.sub(r"\s|<[^>]*>", "", formula)  # a long one scrolls within itself on a phone
    writer.body.append(f'<span class="math">{formula}</span>' if len(signs) > LONG else formula)
    raise nodes.SkipNode


def _block(writer, node):
    writer.body.append(f'<div class="math">{mathml(node, block=True)}</div>')
    raise nodes.SkipNode


# --------------------------------------------------------------------------- pages made of data

GENERATED = DOCS / "generated"
API = {  # a page, and the modules whose public names it holds
    "Impacts": ("impacts", "audits", "histories", "comparison", "status"),
    "Scenes and bodies": ("scene", "bodies", "contact"),
    "Laws": ("law", "registry", "laws.lzb", "laws.kinematic", "laws.poisson", "laws.binary",
             "laws.compliant", "laws"),
    "Contact forces": ("laws.forces", "laws.calibration", "laws.materials"),
    "Shots and fits": ("experiments", "fits", "study"),
    "Monte Carlo": ("montecarlo",),
    "Motions": ("motion",),
    "Methods": ("methods",),
    "Pictures": ("plot",),
    "Theory": ("theory",),
}  # fmt: skip

DATA = {
    "REGISTRY": "All laws by name, `REGISTRY[name].law` is the class; `register` adds one.",
    "STATUS": "Rows `(name, message, failure)` of the status codes, told below.",
}


def public_names() -> dict[str, list[str]]:
    """Public names by page, from the stubs that list them."""
    found: dict[str, list[str]] = {title: [] for title in API}
    for package, prefix in (("", ""), ("plot", "plot."), ("theory", "theory.")):
        stub = ROOT / "jimpact" / package / "__init__.pyi"
        for line in ast.parse(stub.read_text(encoding="utf-8")).body:
            if not isinstance(line, ast.ImportFrom) or line.module is None:
                continue
            module = package or line.module
            fits = [(len(x), title) for title, all_x in API.items() for x in all_x
                    if module == x or module.startswith(x + ".")]  # fmt: skip
            if not fits:
                raise ValueError(f"API must have a page for {module}: see docs/conf.py")
            found[max(fits)[1]] += [prefix + name.name for name in line.names]
    return found


def slug(title: str) -> str:
    return title.lower().replace(" ", "_")


def api_pages() -> dict[str, str]:
    laws = {row.law.__name__: name for name, row in ji.REGISTRY.items()}
    pages = {}
    for title, names in public_names().items():
        text = [f"# {title}", ""]
        for name in names:
            if name in laws:
                text += [f"- [`ji.{name}`](../laws/{laws[name]}.md): its own page", ""]
                continue
            if name in DATA:
                text += ["```{eval-rst}", f".. py:data:: jimpact.{name}", "", f"   {DATA[name]}"]
                text += ["```", ""]
                continue
            kind = "class" if isinstance(attrgetter(name)(ji), type) else "function"
            text += ["```{eval-rst}", f".. auto{kind}:: jimpact.{name}"]
            text += ["   :members:"] * (kind == "class") + ["```", ""]
        if title == "Impacts":
            text += status_table()
        pages[f"api/{slug(title)}.md"] = "\n".join(text)
    return pages


def status_table() -> list[str]:
    """What the codes of `Impact.status` say."""
    rows = [f"| {code} | `{x.name}` | {'yes' if x.failure else ''} | {x.message} |"
            for code, x in enumerate(ji.STATUS)]  # fmt: skip
    return [
        "## Status codes",
        "",
        "| code | name | failure | says |",
        "|---|---|---|---|",
        *rows,
        "",
    ]


def law_pages() -> dict[str, str]:
    """One page a law: what the registry, the declarations and the docstring say of it."""
    pages = {}
    for name, row in ji.REGISTRY.items():
        law = row.law.__name__
        promises = ", ".join(sorted(row.promises)).replace("_", " ") or "none"
        text = [
            f"# {law}", "", f"{row.summary[0].upper()}{row.summary[1:]}.", "",
            f"Right when\n: {row.right_when}", "",
            f"Fails when\n: {row.fails_when}", "",
            f"Keeps on every scene\n: {promises}", "",
            f"In a study\n: `[law]` `name = \"{name}\"`; " + ", ".join(
                f"`{x}`" for x in row.parameters), "",
            f"Source\n: {row.source}", "",
            *picture_of(f"law_{name}"),
            "```{eval-rst}", f".. autoclass:: jimpact.{law}", "```", "",
            "## To cite", "", "```bibtex", row.bibtex.strip(), "```", "",
        ]  # fmt: skip
        pages[f"laws/{name}.md"] = "\n".join(text)
    return pages


def pictures() -> dict[str, str]:
    """Name and caption of each picture: the functions of `gallery.py`."""
    tree = ast.parse((DOCS / "gallery.py").read_text(encoding="utf-8"))
    made = [x for x in tree.body if isinstance(x, ast.FunctionDef) and x.decorator_list]
    return {x.name: " ".join((ast.get_docstring(x) or "").split()) for x in made}


def picture_of(name: str) -> list[str]:
    """A picture that links to its code in the gallery; nothing where there is none."""
    caption = pictures().get(name)
    return [] if caption is None else [
        f":::{{figure}} ../../pictures/{name}.png", f":target: ../gallery.html#{anchor(name)}",
        f":alt: {caption}", "", caption, ":::", ""]  # fmt: skip


def anchor(name: str) -> str:
    return name.replace("_", "-")


def gallery_page() -> dict[str, str]:
    """All pictures in a grid; each links to its code below."""
    grid, code = ["::::{grid} 1 2 2 3", ":gutter: 3", ""], []
    for name, caption in pictures().items():
        law = ji.REGISTRY.get(name.removeprefix("law_"))
        title = law.law.__name__ if law else name.replace("_", " ").capitalize()
        file = f"../pictures/{name}.png"
        grid += [f":::{{grid-item-card}} {title}", f":img-top: {file}", f":img-alt: {caption}",
                 f":link: {name}", ":link-type: ref", ":::", ""]  # fmt: skip
        code += [f"({name})=", f"## {title}", "", caption, "", f"![{caption}]({file})", "",
                 "```{literalinclude} ../gallery.py", ":language: python",
                 f":pyobject: {name}", "```", ""]  # fmt: skip
    top = ["# Gallery", "", "Every picture leads to the code that makes it: "
           "`python docs/gallery.py NAME` from a clone.", ""]  # fmt: skip
    return {"gallery.md": "\n".join([*top, *grid, "::::", "", *code])}


def index_pages() -> dict[str, str]:
    """The API and the course of notebooks, as lists."""
    lists = {
        "api": ("API", "Public names: `ji.` with its pictures in `ji.plot` and the theory of the "
                "source in `ji.theory`.", [slug(title) for title in API]),
        "notebooks": ("Notebooks", "One course, in `notebooks/` of a clone. The tests run it; the "
                      "outputs here are the stored ones.",
                      sorted(x.stem for x in (ROOT / "notebooks").glob("*.ipynb"))),
    }  # fmt: skip
    return {
        f"{name}/index.md": "\n".join(
            [f"# {title}", "", text, "", "```{toctree}", ":maxdepth: 1", "", *pages, "```", ""]
        )
        for name, (title, text, pages) in lists.items()
    }


def write_pages() -> None:
    """Write what changed, so that Sphinx builds again only that."""
    pages = law_pages() | api_pages() | gallery_page() | index_pages()
    for name, text in pages.items():
        path = GENERATED / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        shutil.copy2(path, GENERATED / "notebooks")


def _typeset(app, what, name, obj, options, lines):
    formulas.typeset(lines)
    for i, line in enumerate(lines):  # |x| is no substitution
        if "|" in line and not line.lstrip().startswith(">>>"):
            spans = re.split(r"(:math:`[^`]*`|`[^`]*`)", line)
            lines[i] = "".join(x if x.endswith("`") else x.replace("|", r"\|") for x in spans)


def _skip(app, what, name, obj, skip, options):
    """Fields of named tuples are told by the docstring of the class."""
    return True if (getattr(obj, "__doc__", "") or "").startswith("Alias for field") else skip


def setup(app):
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("autodoc-process-docstring", _typeset, priority=100)
    app.connect("autodoc-skip-member", _skip)
    write_pages()
