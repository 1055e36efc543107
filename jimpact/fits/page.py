"""A fit as one self-contained page: text, tables and pictures in a single HTML file."""

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from jimpact.fits.profiles import profile
from jimpact.fits.report import parameter_rows, report_blocks, shot_rows, verdict
from jimpact.fits.result import FitResult
from jimpact.fits.saved import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_VECTORS = 400  # values up to which a picture is drawn in vectors; beyond, points outweigh pixels
_DPI = 110  # pixels per inch of pictures with too many points for vectors
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
.verdict { font-size: 1.2rem; border-left: .3rem solid #0072B2; padding-left: .8rem; }
table { border-collapse: collapse; margin: .5rem 0; }
td, th { padding: .15rem .8rem .15rem 0; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child { text-align: left; }
img { max-width: 100%; }
.small { color: #555; font-size: .85rem; }
""".strip()
_PARAMETERS = ("parameter", "value", "standard error")
_SHOTS = ("shot", "velocity", "before", "measured", "fitted", "residual", "unit", "status")


def write_page(fit: FitResult, path: Path, profiles: bool) -> Path:
    """Write `Fit.report`."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"Argument `path` must end in .html, but is '{path}'.")
    if profiles and not fit.profiles and fit.can_be_profiled and not fit.shows_lack_of_fit:
        fit = replace(fit, profiles=profile(fit))
    text = page(fit)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def page(fit: FitResult) -> str:
    """The page as text."""
    blocks, kind = report_blocks(fit), "profile" if fit.profiles else "linearized"
    title = escape(blocks["headline"][0])
    parts = [
        f"<h1>{title}</h1>",
        f'<p class="verdict">{escape(verdict(fit))}</p>',
        "<h2>Parameters</h2>",
        _table((*_PARAMETERS, f"95 % interval, {kind}", ""), parameter_rows(fit)),
        _listed("What the data do not determine", fit.identifiability),
        _listed("Defects of the data, warnings", fit.warnings or ("None.",)),
        _listed("Scatter from shot to shot", [x.strip(" -") for x in blocks["scatter"][1:]]),
        _listed("Quality", [*blocks["quality"], *blocks["minima"]]),
        "<h2>Pictures</h2>",
        *_pictures(fit),
    ]
    if fit.experiments is not None:
        parts += ["<h2>Shots</h2>", _table(_SHOTS, shot_rows(fit))]
    parts += ["<h2>How</h2>", _table(("", ""), _made_by(fit))]
    body = "\n".join(part for part in parts if part)
    head = f'<meta charset="utf-8">\n<title>{title}</title>\n<style>{_STYLE}</style>'
    whole = f"<head>\n{head}\n</head>\n<body>\n{body}\n</body>"
    return f'<!DOCTYPE html>\n<html lang="en">\n{whole}\n</html>\n'


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = ["<table>"]
    if any(heads):
        lines.append(f"<tr>{''.join(f'<th>{escape(x)}</th>' for x in heads)}</tr>")
    lines += [f"<tr>{''.join(f'<td>{escape(x)}</td>' for x in row)}</tr>" for row in rows]
    return "\n".join([*lines, "</table>"])


def _listed(title: str, lines: Sequence[str]) -> str:
    """A list below its heading; an empty text if there are no lines."""
    if not lines:
        return ""
    items = "\n".join(f"<li>{escape(' '.join(line.split()))}</li>" for line in lines)
    return f"<h2>{escape(title)}</h2>\n<ul>\n{items}\n</ul>"


def _pictures(fit: FitResult) -> list[str]:
    """The pictures, each with its title."""
    from jimpact import plot

    drawn = []
    if fit.experiments is not None:
        drawn.append(("Measured and fitted velocities", plot.fit(fit)))
    drawn.append(("Residuals", plot.residuals(fit)))
    if fit.profiles:
        drawn.append(
            ("Profile likelihoods: shaded is the 95 % interval", plot.profiles(fit.profiles))
        )
    if len(fit.names) > 1:
        drawn.append(("Correlations of the errors", plot.correlation(fit)))
    few = np.size(fit.problem.measured) <= _VECTORS
    return [_inline(title, figure, few) for title, figure in drawn]


def _inline(title: str, figure: "Figure", vectors: bool) -> str:
    """A picture within the page."""
    whole = BytesIO()
    if vectors:
        figure.savefig(whole, format="svg", metadata={"Date": None})
    else:
        figure.savefig(whole, format="png", dpi=_DPI)
    kind = "svg+xml" if vectors else "png"
    data = b64encode(whole.getvalue()).decode()
    return (
        f'<p>{escape(title)}</p>\n<img alt="{escape(title)}" src="data:image/{kind};base64,{data}">'
    )


def _made_by(fit: FitResult) -> list[list[str]]:
    """Law, solver and versions, to compute the fit again."""
    rows = [
        ["law", eqx.tree_pformat(fit.law, short_arrays=False)],
        ["solver", f"{fit.method}, loss {fit.loss}, {fit.start_count} starts, seed {fit.seed}"],
        ["precision", fit.problem.precision],
    ]
    return rows + [list(row) for row in versions().items()]
