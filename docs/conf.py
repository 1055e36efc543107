"""The site: `sphinx-build -W --keep-going docs build/site`. No network, nothing is
executed.

`pages.py` writes the generated pages into docs/generated: laws, API, constants,
gallery, notebooks.
"""

import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.util import logging

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT)]

import formulas  # noqa: E402
import pages  # noqa: E402

import jimpact as ji  # noqa: E402

project = "jimpact"
author = "The jimpact developers"
copyright = author
version = release = ji.__version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb", "sphinx_design"]
nitpicky = True
# types of fields: of other packages, mostly
nitpick_ignore_regex = [("py:class", ".*")]
exclude_patterns = ["paper.md"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # else taken from the network
nb_merge_streams = True
suppress_warnings = ["mystnb.unknown_mime_type"]
default_role = "code"  # single backticks of docstrings
highlight_language = "none"
autodoc_typehints = "none"  # docstrings state shapes and units
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


# ------------------------------------------------------------------------ formulas, as
# MathML

LONG = 30  # characters beyond which a formula scrolls within itself on a phone


def mathml(node, block=False):
    """MathML of a formula; a warning names a text that is not a formula."""
    try:
        return tex2mathml(node.astext(), as_block=block)
    # AttributeError: a new row outside of a table
    except (MathError, AttributeError) as wrong:
        logging.getLogger(__name__).warning(
            "not a formula: %s (%s)", node.astext(), wrong, location=node
        )
        return node.astext()


def _inline(writer, node):
    formula = mathml(node)
    signs = re.sub(r"\s|<[^>]*>", "", formula)
    writer.body.append(
        f'<span class="math">{formula}</span>' if len(signs) > LONG else formula
    )
    raise nodes.SkipNode


def _block(writer, node):
    writer.body.append(f'<div class="math">{mathml(node, block=True)}</div>')
    raise nodes.SkipNode


# ---------------------------------------------------------------------------- texts and
# links


def _typeset(app, what, name, obj, options, lines):
    """Typeset the formulas of a docstring."""
    formulas.typeset(lines)
    for i, line in enumerate(lines):  # |x| is not a substitution
        if "|" in line and not line.lstrip().startswith(">>>"):
            spans = re.split(r"(:math:`[^`]*`|`[^`]*`)", line)
            lines[i] = "".join(
                x if x.endswith("`") else x.replace("|", r"\|") for x in spans
            )


def _skip(app, what, name, obj, skip, options):
    """Leave out fields of named tuples: the docstring of the class describes them."""
    if (getattr(obj, "__doc__", "") or "").startswith("Alias for field"):
        return True
    return skip


PUBLIC = {
    f"ji.{name}": name for names in pages.public_names().values() for name in names
}
PUBLIC |= {name: name for name in pages.law_names()}  # LZB, Newton, ...


def _link_names(app, doctree):
    """Link `ji.name`, and names of laws in tables, to where they are documented."""
    for literal in list(doctree.findall(nodes.literal)):
        name = re.sub(r"\(.*", "", literal.astext())
        parents = []
        node = literal
        while node.parent is not None:
            node = node.parent
            parents.append(node)
        if any(
            isinstance(x, nodes.reference | nodes.title | addnodes.pending_xref)
            for x in parents
        ):
            continue
        in_table = any(isinstance(x, nodes.entry) for x in parents)
        if name not in PUBLIC or not (name.startswith("ji.") or in_table):
            continue
        link = addnodes.pending_xref(
            "",
            refdomain="py",
            reftype="obj",
            reftarget=f"jimpact.{PUBLIC[name]}",
            refexplicit=True,
        )
        link["refdoc"] = app.env.docname
        literal.replace_self(link)
        link += literal


def _strip_examples(app, doctree):
    """Remove the empty last line that examples with prompts need in the source."""
    for block in list(doctree.findall(nodes.literal_block)):
        text = block.astext()
        if text.startswith(">>>") and text.endswith("\n"):
            block.rawsource = text.rstrip()
            block.children = []
            block += nodes.Text(block.rawsource)


def setup(app):
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("autodoc-process-docstring", _typeset, priority=100)
    app.connect("autodoc-skip-member", _skip)
    app.connect("doctree-read", _link_names)
    app.connect("doctree-read", _strip_examples)
    pages.write()
