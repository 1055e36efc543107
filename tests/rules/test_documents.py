"""README, docs, docstrings and notebooks run as printed, in one process that shares programs."""

import ast
import doctest
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import jax
import jupytext
import matplotlib
import matplotlib.pyplot as plt
import nbformat
import pytest
from IPython.core.interactiveshell import InteractiveShell

import jimpact as ji

ROOT = Path(__file__).parents[2]
DOCS = sorted((ROOT / "docs").glob("*.md"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
MODULES = ["jimpact", *(m.name for m in pkgutil.walk_packages(ji.__path__, "jimpact."))]
TESTS = "".join(
    path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")
)
README = (ROOT / "README.md").read_text(encoding="utf-8")


def examples(name):
    """The examples of a module."""
    module = importlib.import_module(name)
    tests = doctest.DocTestFinder(exclude_empty=True).find(module, name)
    return [test for test in tests if test.examples]


WITH_EXAMPLES = [name for name in MODULES if ">>>" in Path(
    importlib.util.find_spec(name).origin
).read_text(encoding="utf-8")]  # fmt: skip


@pytest.fixture(autouse=True)
def as_a_user_runs_them(tmp_path, monkeypatch):
    """x64, the promotion rules of JAX, and a temporary folder."""
    monkeypatch.chdir(tmp_path)
    laws = dict(ji.REGISTRY)  # some examples register a law
    jax.config.update("jax_numpy_rank_promotion", "allow")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    yield
    jax.config.update("jax_enable_x64", True)
    plt.close("all")
    ji.REGISTRY.clear()
    ji.REGISTRY.update(laws)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.mark.slow
@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_docstrings_run(module):
    runner = doctest.DocTestRunner(optionflags=OPTIONS)
    tests = examples(module)
    assert tests
    for test in tests:
        runner.run(test)
    assert runner.summarize(verbose=False).failed == 0


def test_readme_runs():
    done = doctest.testfile(
        str(ROOT / "README.md"), module_relative=False, optionflags=OPTIONS
    )
    assert done.attempted > 10
    assert done.failed == 0


def test_readme_is_short():
    """At most 900 words, code and tables included, and no line above 120 columns."""
    assert len(README.split()) <= 900
    assert max(map(len, README.splitlines())) <= 120


def captions():
    """Names of the pages under each caption of the sidebar."""
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    trees = re.findall(r":caption: ([\w-]+)\n:hidden:\n\n(.*?)```", index, re.S)
    return {caption: names.split() for caption, names in trees}


def test_pages_but_references_are_short():
    """At most 2 000 words: who reads a page from its top comes to its end."""
    pages = captions()
    assert list(pages) == ["Tutorials", "How-to", "Reference", "Background"]
    for name in pages["Tutorials"] + pages["How-to"] + pages["Background"]:
        path = ROOT / "docs" / f"{name}.md"
        if path.exists():  # others are generated
            assert len(path.read_text(encoding="utf-8").split()) <= 2000, name


def test_every_page_has_a_kind():
    named = {name for names in captions().values() for name in names}
    assert {path.stem for path in DOCS} - {"index", "paper"} <= named  # a manuscript


def test_figures_have_scripts():
    """What `docs/figures.md` lists is printed by a file that exists."""
    page = (ROOT / "docs" / "figures.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[.*$", page, re.M)
    assert len(rows) > 10
    for row in rows:
        script = row.split("|")[3].split("`")[1].split()[0]
        assert script == "jimpact" or (ROOT / script).exists(), row


def runs_here(block):
    """Whether the modules that a block imports are installed: engines may not be."""
    names = re.findall(r"^(?:>>> )?(?:import|from) (\w+)", block, re.M)
    return all(importlib.util.find_spec(name) for name in names)


def code_of(path):
    """Python code of a page: fenced blocks without prompts, and one doctest of those with them."""
    blocks = re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.S)
    blocks = [block for block in blocks if runs_here(block)]
    own = [block for block in blocks if ">>>" not in block and "tcp://" not in block]
    return own, "\n".join(
        b for b in blocks if ">>>" in b
    )  # (a cluster does not exist here)


def documents(paths, long_run=()):
    """Pages and notebooks that run: those that take longest wait for the release."""
    return [
        pytest.param(
            path,
            id=path.stem,
            marks=[
                pytest.mark.release
                if path.stem.startswith(LONGEST)
                else pytest.mark.slow,
                *(
                    [pytest.mark.long_run]
                    if path.stem.startswith(tuple(long_run))
                    else []
                ),
            ],
        )
        for path in paths
    ]


LONGEST = ("mujoco", "gradient_descent", "speed_accuracy", "waves", "motions")
LONGEST += ("01", "02", "03", "05", "06", "07", "08", "09")
LONGEST += ("10", "11", "12", "13", "14", "15", "16", "17", "18", "19")


@pytest.mark.parametrize("path", documents(p for p in DOCS if any(code_of(p))))
def test_docs_run(path):
    """In single precision, JAX's default: a page whose digits need double precision sets it."""
    jax.config.update("jax_enable_x64", False)
    blocks, prompts = code_of(path)
    space = {}
    for block in blocks:
        exec(compile(block, str(path), "exec"), space)
    if prompts:
        runner = doctest.DocTestRunner(optionflags=OPTIONS)
        runner.run(
            doctest.DocTestParser().get_doctest(prompts, {}, path.name, str(path), 0)
        )
        done = runner.summarize(verbose=False)
        assert done.attempted > 0
        assert done.failed == 0


def test_code_of_pages_fits_the_column():
    """Lines of code have at most 88 characters, as many as a column of the site shows at 1280 px.

    What an example prints is excepted: the program decides where its lines end.
    """
    for path in [ROOT / "README.md", *DOCS]:
        for block in re.findall(
            r"^```.*?^```", path.read_text(encoding="utf-8"), re.M | re.S
        ):
            lines = block.splitlines()
            if ">>>" in block:
                lines = [line for line in lines if line.startswith((">>>", "..."))]
            long = [line for line in lines if len(line) > 88]
            assert not long, (path.name, long)


def test_no_line_of_a_page_is_a_comment():
    """A line that begins with % is left out of the site: 5 % that breaks there, too."""
    for path in DOCS:
        text = re.sub(r"^```.*?^```", "", path.read_text("utf-8"), flags=re.M | re.S)
        assert not re.search(r"^ *%", text, re.M), path.name


def test_docs_name_what_exists():
    """Every `ji.name` of the texts is a public name; every path a file."""
    for path in [ROOT / "README.md", *DOCS]:
        text = path.read_text(encoding="utf-8")
        for name in set(re.findall(r"\bji\.([A-Za-z_]\w*)", text)):
            assert hasattr(ji, name), (path.name, name)
        for name in set(re.findall(r"\]\(((?!http)[^)#]+)\)", text)):
            assert (path.parent / name).exists(), (path.name, name)


def test_docs_name_files_that_exist():
    """A page that names a file of the package, or of the tests, names one that is there."""
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS]:
        names = re.findall(
            r"`((?:jimpact|tests|docs|notebooks)/[\w/.-]+)`", path.read_text("utf-8")
        )
        missing = [x for x in names if not (ROOT / x).exists()]
        missing += [
            x
            for x in re.findall(r"`(test_\w+)`", path.read_text("utf-8"))
            if f"def {x}(" not in TESTS
        ]
        assert not missing, (path.name, missing)


@pytest.fixture
def pages(monkeypatch):
    """The module that writes generated pages."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("pages")


def test_the_gallery_draws_a_picture_of_each_of_its_functions(
    pages, tmp_path, monkeypatch
):
    gallery = importlib.import_module("gallery")
    assert {*gallery.DRAWN} == {path.stem for path in gallery.PICTURES.glob("*.png")}
    monkeypatch.setattr(gallery, "PICTURES", tmp_path)
    gallery.main(["drops", "law_newton"])  # those that cost least
    assert {path.stem for path in tmp_path.iterdir()} == {"drops", "law_newton"}


def test_every_public_name_has_a_place_in_the_api(pages):
    names = [name for page in pages.public_names().values() for name in page]
    everything = [
        x
        for x in ji.__all__
        if x not in ("data", "plot", "theory", "tracks", "__version__")
    ]
    everything += [f"{part.__name__.removeprefix('jimpact.')}.{name}"
                   for part in (ji.plot, ji.theory, ji.data, ji.tracks) for name in part.__all__]  # fmt: skip
    assert sorted(names) == sorted(everything)
    index = (ROOT / "docs" / "names.md").read_text(encoding="utf-8")
    assert index == pages.names_page(), "run `python docs/pages.py`"
    for name in names:
        assert re.search(rf"\| `ji.{re.escape(name)}` \| \S.* \|", index), name


def test_constants_are_complete_and_explained(pages, tmp_path):
    """Every number in capitals at the top of a module is in the table, with a meaning."""
    module = tmp_path / "example.py"
    module.write_text(
        "# [m] above\nA = 1.0\nB = 2  # beside\n\nC: float = 3.0\nD, E = 0, 1\nname = 4\n"
    )
    assert pages.constants_of(module) == [
        ("A", "1.0", "[m] above"), ("B", "2", "beside"), ("C", "3.0", ""),
    ]  # fmt: skip
    assert pages.unit_of("[m] above") == "m"
    unexplained = [(path, name) for path, rows in pages.constants().items()
                   for name, _, comment in rows if not comment]  # fmt: skip
    assert not unexplained, "add a comment: unit, meaning, what ten times more would do"
    page = pages.constants_page()["constants.md"]
    for path in (ROOT / "jimpact").rglob("*.py"):
        if path.name == "tableaux.py":
            continue
        for line in ast.parse(path.read_text(encoding="utf-8")).body:
            value = getattr(line, "value", None)
            target = (
                line.targets[0]
                if isinstance(line, ast.Assign)
                else getattr(line, "target", 0)
            )
            number = isinstance(value, ast.Constant) and isinstance(
                value.value, int | float
            )
            if isinstance(target, ast.Name) and target.id.isupper() and number:
                row = f"| `{target.id}` | `{value.value}` |"
                assert row in page, (path, target.id)


def test_every_law_is_in_the_tables_as_in_the_registry():
    page = (ROOT / "docs" / "laws.md").read_text(encoding="utf-8")
    for row in ji.REGISTRY.values():
        line = f"| `{row.law.__name__}` | {row.right_when} |"
        assert line in README
        assert f"{line} {row.fails_when} |" in page


def test_public_names():
    """Docstrings with examples; no module hides a public name."""
    without = []
    for name in ji.__all__:
        value = getattr(ji, name)
        assert type(value).__name__ != "module" or name in (
            "data",
            "plot",
            "theory",
            "tracks",
        ), name
        if callable(value) and not (value.__doc__ or "").strip():
            without.append(name)
    assert not without
    functions = [
        x for x in map(ji.__dict__.get, ji.__all__) if type(x).__name__ == "function"
    ]
    bare = [x.__name__ for x in functions if ">>>" not in (x.__doc__ or "")]
    assert not bare, bare
    with pytest.raises(AttributeError, match=r"no name `Lzb`\. Did you mean LZB"):
        _ = ji.Lzb


def run_python(code):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )


def test_import_sets_nothing_and_is_lazy():
    code = (
        "import sys, jimpact; assert 'jax' not in sys.modules; import jax;"
        "before = jax.config.jax_enable_x64; jimpact.LZB, jimpact.fit, jimpact.history;"
        "assert jax.config.jax_enable_x64 == before == False; print('ok')"
    )
    assert run_python(code).stdout.strip() == "ok"


# -------------------------------------------------------------------------------- notebooks


def code_and_text(notebook):
    return [(cell.cell_type, cell.source.strip()) for cell in notebook.cells]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_and_script_agree(path):
    notebook = nbformat.read(path, as_version=4)
    assert code_and_text(notebook) == code_and_text(
        jupytext.read(path.with_suffix(".py"))
    )
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.output_type == "error" for output in outputs)


class Shell(InteractiveShell):
    """IPython in this process, so that notebooks share programs; test_commands runs kernels."""

    def enable_gui(self, gui=None):
        """There are no windows: pictures are inline."""


@pytest.fixture
def shell():
    backend = matplotlib.get_backend()
    yield Shell.instance()
    Shell.clear_instance()
    matplotlib.use(backend)


# running takes most of the time of these
@pytest.mark.parametrize("path", documents(NOTEBOOKS, long_run=("01", "11", "17")))
def test_notebook_runs(path, shell):
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            shell.run_cell(cell.source).raise_error()


def test_every_script_has_its_notebook():
    scripts = sorted((ROOT / "notebooks").glob("[0-9]*.py"))
    assert [path.stem for path in NOTEBOOKS] == [path.stem for path in scripts]
    assert NOTEBOOKS


def test_notebooks_are_one_course():
    """Each begins with its aim and a drawing of the system, and links to the next."""
    scripts = [jupytext.read(path.with_suffix(".py")) for path in NOTEBOOKS]
    for k, (path, script) in enumerate(zip(NOTEBOOKS, scripts, strict=True)):
        head, drawing = (
            script.cells[0].source,
            nbformat.read(path, as_version=4).cells[1],
        )
        assert f"*Course, part {k}." in head
        assert "You will" in head
        assert any(
            "image/png" in output.get("data", {}) for output in drawing.outputs
        ), path.stem
        links = re.findall(
            r"\]\((\d\w+\.ipynb)\)", "".join(cell.source for cell in script.cells)
        )
        for link in links:
            assert (ROOT / "notebooks" / link).exists(), (path.stem, link)
        if k + 1 < len(NOTEBOOKS):
            assert NOTEBOOKS[k + 1].name in script.cells[-1].source, path.stem
        code = "\n".join(
            cell.source for cell in script.cells if cell.cell_type == "code"
        )
        own = set(re.findall(r"^(?:from|import) (jimpact\.\S+)", code, re.M))
        assert not own, "notebooks use public names only"
