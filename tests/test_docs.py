"""README, module docstrings and the stated conventions run as printed."""

import doctest
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jimpact

ROOT = Path(__file__).parent.parent
MODULES = ["jimpact", *(m.name for m in pkgutil.walk_packages(jimpact.__path__, "jimpact."))]
LONG = {  # all rheologies, laws or methods are compiled
    f"jimpact.{name}"
    for name in (
        "compliance.calibration",
        "pictures.rheology",
        "advice.validity",
        "pictures.validity",
        "stability.mapping",
        "advice.advising",
        "charts.chart",
        "motion.fitting_motion",
    )
}
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


@pytest.fixture(autouse=True)
def ordinary_flags():
    """Examples run as a user runs them: x64, and JAX's own promotion rules."""
    jax.config.update("jax_numpy_rank_promotion", "allow")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    yield
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.mark.parametrize(
    "name",
    [pytest.param(m, marks=[pytest.mark.slow] if m in LONG else []) for m in MODULES],
)
def test_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert doctest.testmod(importlib.import_module(name), optionflags=OPTIONS).failed == 0


@pytest.mark.slow
def test_readme_runs():
    result = doctest.testfile(str(ROOT / "README.md"), module_relative=False, optionflags=OPTIONS)
    assert result.attempted > 10
    assert result.failed == 0
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_every_law_is_in_the_readme_as_in_the_registry():
    text = (ROOT / "README.md").read_text()
    for row in jimpact.REGISTRY.values():
        assert f"| `{row.law.__name__}` | {row.right_when} | {row.fails_when} |" in text


def test_public_callables_have_examples():
    without = [
        name
        for name in jimpact.__all__
        if callable(getattr(jimpact, name)) and not (getattr(jimpact, name).__doc__ or "").strip()
    ]
    assert not without


def test_import_sets_nothing_and_is_lazy():
    code = (
        "import sys, jimpact; assert 'jax' not in sys.modules; import jax;"
        "before = jax.config.jax_enable_x64; jimpact.LZB, jimpact.fit, jimpact.history;"
        "assert jax.config.jax_enable_x64 == before == False; print('ok')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "ok", done.stderr
