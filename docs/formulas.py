"""Formulas of docstrings, written for a terminal, in the LaTeX that the site
typesets.
"""

import re

from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml

GREEK = (
    *(
        "alpha",
        "beta",
        "gamma",
        "delta",
        "eta",
        "theta",
        "lambda",
        "mu",
        "nu",
        "xi",
        "pi",
        "rho",
    ),
    *("sigma", "tau", "phi", "chi", "omega"),
    *("Gamma", "Delta", "Theta", "Lambda", "Xi", "Sigma", "Phi", "Omega"),
)
FUNCTIONS = ["sin", "cos", "tan", "arccos", "exp", "ln", "log", "max", "min"]
WORDS = {"grad": r"\nabla ", "in": r" \in ", "sum": r"\sum ", "pbar": r"{\bar p}"}
KNOWN = {*GREEK, *FUNCTIONS, *WORDS}
SIGNS = [  # longer ones first
    ("_|_", r" \perp "),
    ("<=", r" \le "),
    (">=", r" \ge "),
    ("!=", r" \ne "),
    ("->", r" \to "),
    ("+/-", r" \pm "),
    ("+=", r" {+}{=} "),
    ("{", r"\{"),
    ("}", r"\}"),
    ("~", r" \sim "),
]
# a name, its index, primes, and a sign that ends it: before (-) or after (+) the impact
NAME = re.compile(
    r"([A-Za-z]+)(?:_([A-Za-z]+\d*|\d+[a-z]*|\{[^}]*\}))?('*)([+-](?![\w(.]))?"
)


def _letters(word: str) -> str:
    """LaTeX of a word: a Greek letter, a function, a symbol or an operator name."""
    if word in GREEK:
        return rf"\{word} "
    if word in FUNCTIONS:
        return rf"\{word} "
    if word in WORDS:
        return WORDS[word]
    if re.fullmatch(r"q[nt]", word):
        return f"q_{word[1]}"
    if word[0] == "d" and word[1:] in GREEK:
        return rf"d\{word[1:]} "
    if len(word) < 3:
        return word
    return rf"\operatorname{{{word}}}"


def _closing(text: str, start: int) -> int:
    """Index after the bracket that closes the one at `start`."""
    depth = 0
    for i in range(start, len(text)):
        depth += {"(": 1, ")": -1}.get(text[i], 0)
        if depth == 0:
            return i + 1
    raise ValueError(f"{text!r} has an open bracket")


def _name(match: re.Match[str]) -> str:
    """LaTeX of a name with index, primes and sign."""
    word, index, primes, sign = match.groups()
    base = _letters(word)
    if index is not None:
        inner = index.strip("{}")
        if inner in GREEK:
            inner = rf"\{inner} "
        if base.startswith("q_"):
            base = rf"q_{{{word[1]},{inner}}}"
        else:
            base = rf"{base}_{{{inner}}}"
    return base + primes + (f"^{{{sign}}}" if sign else "")


def _translate(text: str) -> str:
    """LaTeX of a whole formula."""
    parts = []
    i = 0
    while i < len(text):
        root = text.startswith("sqrt(", i)
        if root or text.startswith("^(", i):
            start = i + (4 if root else 1)
            end = _closing(text, start)
            inner = _translate(text[start + 1 : end - 1])
            parts.append(rf"\sqrt{{{inner}}}" if root else f"^{{{inner}}}")
            i = end
        elif text[i] == "^":  # a number, or a name
            power = re.match(r"-?[\d.]+|-?[A-Za-z]+(?:_\w+)?|-", text[i + 1 :])
            if power is None:
                raise ValueError(f"{text!r} has a power that is not a number or name")
            parts.append(f"^{{{_translate(power[0])}}}")
            i += 1 + power.end()
        elif match := NAME.match(text, i):
            parts.append(_name(match))
            i = match.end()
        else:
            sign, tex = next(
                (x for x in SIGNS if text.startswith(x[0], i)), (text[i], text[i])
            )
            parts.append(tex)
            i += len(sign)
    return "".join(parts)


def tex(text: str) -> str | None:
    """LaTeX of a formula as docstrings write it; None if the text is not a formula.

    >>> tex("gamma+ = -e gamma-")
    '\\\\gamma ^{+} = -e \\\\gamma ^{-}'
    >>> tex("0 <= F_j  _|_  sqrt(k_j) >= 0")
    '0  \\\\le  F_{j}   \\\\perp   \\\\sqrt{k_{j}}  \\\\ge  0'
    >>> tex("ji.impact") is None
    True
    """
    words = [x for x in re.findall(r"\b[a-z]{3,}\b", text) if x not in KNOWN]
    if len(words) > 1 or text in words:  # a sentence, a name
        return None
    if re.search(r"\w\.[A-Za-z]|[`\"\\%&#$]|__", text) or not re.search(
        r"[A-Za-z]", text
    ):
        return None
    try:
        latex = _translate(text).strip()
        tex2mathml(latex)
    except (ValueError, MathError):
        return None
    return latex


def typeset(lines: list[str]) -> None:
    """Typeset in place the formulas of paragraphs that begin with `Equation`."""
    i = 0
    while i < len(lines):
        end = i
        while end < len(lines) and lines[end].strip():
            end += 1
        if end > i and lines[i].lstrip().startswith("Equation"):
            indent = lines[i][: len(lines[i]) - len(lines[i].lstrip())]
            whole = " ".join(line.strip() for line in lines[i:end])
            whole = re.sub(r"`([^`]+)`", _as_role, whole)
            lines[i:end] = [indent + whole, *[""] * (end - i - 1)]
        i = max(end, i + 1)


def _as_role(match: re.Match[str]) -> str:
    """A formula in backticks as a role of the site; other text unchanged."""
    formula = tex(match[1])
    if formula is None:
        return match[0]
    return f":math:`{formula}`"
