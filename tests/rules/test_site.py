"""The site that `sphinx-build` makes, in files and in a browser, without a network.

JIMPACT_SITE names a built site, as in CI: then nothing is skipped. Else it is built here.
"""

import doctest
import os
import re
import shutil
import subprocess
import sys
import threading
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import jimpact as ji

ROOT = Path(__file__).parents[2]
SITE = os.environ.get("JIMPACT_SITE")
PHONE = 390  # CSS pixels
OPTIONS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
]

pytestmark = pytest.mark.slow


def lacking(what):
    """Skip with a message; fail in CI."""
    if SITE:
        pytest.fail(f"{what} is missing")
    pytest.skip(f"no {what} here")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    if SITE:
        return Path(SITE)
    try:
        import myst_nb  # noqa: F401
        import sphinx  # noqa: F401
    except ImportError:
        lacking("Sphinx (pip install '.[docs]')")
    out = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        ROOT / "docs",
        out,
    ]
    done = subprocess.run([str(x) for x in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return out


class Page(HTMLParser):
    """Links, loaded files and anchors of a page, and pictures without a text."""

    def __init__(self, path):
        super().__init__()
        self.links, self.loads, self.anchors, self.without_words = (
            [],
            [],
            {"", "top"},
            [],
        )
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors |= {values[x] for x in ("id", "name") if values.get(x)}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"])
        elif tag == "link" and values.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(values["href"])
        elif tag in ("script", "img", "source", "iframe") and values.get("src"):
            self.loads.append(values["src"])
        if tag == "img" and not values.get("alt"):
            self.without_words.append(values.get("src", "")[:80])


def test_links_lead_somewhere_and_nothing_is_loaded_from_elsewhere(site):
    pages = {path: Page(path) for path in site.rglob("*.html")}
    assert len(pages) > 30
    wrong = []
    for path, page in pages.items():
        name = path.relative_to(site)
        for target in page.links + page.loads:
            parts = urlsplit(target)
            if parts.scheme in ("data", "mailto") or (
                target in page.links and parts.netloc
            ):
                continue
            if parts.netloc:
                wrong.append(f"{name} loads {target}")
                continue
            to = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not to.exists():
                wrong.append(f"{name} -> {target}: no such file")
            elif to in pages and unquote(parts.fragment) not in pages[to].anchors:
                wrong.append(f"{name} -> {target}: no such anchor")
        wrong += [f"{name}: {picture} without words" for picture in page.without_words
                  if "notebooks" not in str(name)]  # fmt: skip
    assert not wrong, "\n".join(wrong[:30])


def test_what_is_public_is_in_the_site(site):
    """Every public name in the API or on its law's page; every law has a page and a picture."""
    anchors = set().union(
        *(Page(x).anchors for x in (site / "generated").rglob("*.html"))
    )
    inner = ("data", "plot", "theory", "tracks", "__version__")
    missing = [
        x for x in ji.__all__ if x not in inner and f"jimpact.{x}" not in anchors
    ]
    missing += [f"{part.__name__}.{x}" for part in (ji.plot, ji.theory, ji.data, ji.tracks) for x in part.__all__
                if f"{part.__name__}.{x}" not in anchors]  # fmt: skip
    assert not missing
    for name, row in ji.REGISTRY.items():
        page = (site / "generated" / "laws" / f"{name}.html").read_text(
            encoding="utf-8"
        )
        assert row.law.__name__ in page
        assert f"law_{name}.png" in page
        assert "<math" in page
        assert "Derivatives" in page


def test_names_link_to_where_they_are_documented(site):
    """Laws in tables, `ji.name` anywhere; the home page installs and runs something."""
    laws = (site / "laws.html").read_text(encoding="utf-8")
    for name, row in ji.REGISTRY.items():
        link = rf'<td><p><a [^>]*href="generated/laws/{name}.html#[^>]*>(?:<[^>]*>)*{row.law.__name__}<'
        assert re.search(link, laws), name
    motions = (site / "motions.html").read_text(encoding="utf-8")
    assert 'href="generated/api/motions.html#jimpact.simulate"' in motions
    home = (site / "index.html").read_text(encoding="utf-8")
    assert "pip install" in home
    assert "jax.grad" in re.sub(r"<[^>]*>", "", home)
    assert "<svg" in (site / "step_by_step.html").read_text(encoding="utf-8")


def test_every_picture_of_the_docs_has_its_code():
    code = (ROOT / "docs" / "gallery.py").read_text(encoding="utf-8")
    made = set(re.findall(r"@picture\n(?:@.*\n)*def (\w+)", code))
    assert made == {path.stem for path in (ROOT / "docs" / "pictures").glob("*.png")}


def test_paper_cites_what_it_lists():
    paper, listed = (
        (ROOT / "docs" / x).read_text(encoding="utf-8")
        for x in ("paper.md", "paper.bib")
    )
    cited = set(re.findall(r"@([a-z]+\d{4})", paper))
    assert cited == set(re.findall(r"@\w+\{(\w+),", listed))


def test_formulas_of_docstrings_become_formulas(monkeypatch):
    pytest.importorskip("docutils")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import formulas

    assert doctest.testmod(formulas).failed == 0
    lines = [
        "Equation: `gamma+ = -e gamma-`, by `ji.impact`",
        "and `W p`.",
        "",
        "`W p`",
    ]
    formulas.typeset(lines)
    assert lines[0].count(":math:") == 2
    assert lines[-1] == "`W p`"


# ----------------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def address(site):
    """The site, served on this machine alone."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    try:
        from selenium import webdriver
    except ImportError:
        lacking("selenium (pip install '.[docs]')")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not chromium or not driver:
        lacking("Chromium with its driver (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    profile = tmp_path_factory.mktemp("profile")
    for option in [*OPTIONS, f"--user-data-dir={profile}", "--window-size=1280,900"]:
        options.add_argument(option)
    # requests to the network fail, and count as errors of the page
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    started = webdriver.Chrome(options, webdriver.ChromeService(driver))
    started.set_page_load_timeout(30)
    yield started
    started.quit()


def width(browser, pixels):
    """As a phone's screen: windows of a headless browser do not become that narrow."""
    size = {
        "width": pixels,
        "height": 844,
        "deviceScaleFactor": 1,
        "mobile": pixels <= PHONE,
    }
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


ERRORS = "SEVERE", "WARNING"
BROKEN = """return [...document.images].filter(i => !(i.complete && i.naturalWidth)
    && i.loading !== 'lazy').map(i => i.src.slice(0, 100))"""
# elements beyond the edge of the screen that do not scroll: the theme would cut them off
TOO_WIDE = """const edge = document.documentElement.clientWidth + 1;
    const scrolls = x => x.tagName != 'ARTICLE' && (/auto|scroll/.test(getComputedStyle(x).overflowX)
        || scrolls(x.parentElement));
    return [...document.querySelectorAll('article *')].filter(x => !scrolls(x)
        && x.getBoundingClientRect().right > edge && x.getBoundingClientRect().width)
        .slice(0, 3).map(x => x.outerHTML.slice(0, 120))"""
FORMULAS = """return [...document.querySelectorAll('math')].filter(m => m.offsetParent !== null)
    .filter(m => { const b = m.getBoundingClientRect(); return b.width < 2 || b.height < 4 }).length"""


def test_pages_open_without_errors_wide_and_narrow(address, site, browser):
    wrong = []
    for path in sorted(site.rglob("*.html")):
        name = path.relative_to(site)
        width(browser, 1280)
        browser.get(f"{address}/{name}")
        said = [
            x["message"] for x in browser.get_log("browser") if x["level"] in ERRORS
        ]
        wrong += [f"{name}: {x}" for x in [*said, *browser.execute_script(BROKEN)]]
        for pixels in (1280, PHONE):
            width(browser, pixels)
            flat = browser.execute_script(FORMULAS)
            wrong += [
                f"{name} at {pixels}: too wide: {x}"
                for x in browser.execute_script(TOO_WIDE)
            ]
            wrong += (
                [f"{name} at {pixels}: {flat} formulas do not show"] if flat else []
            )
        assert browser.title, name
    assert not wrong, "\n".join(wrong[:30])


PLATE = """return [...document.querySelectorAll('article img')].map(i =>
    (getComputedStyle(i).backgroundColor.match(/\\d+/g) || []).slice(0, 3).map(Number))"""


def test_pictures_lie_on_a_light_plate_in_the_dark(address, browser):
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    for page in (
        "index",
        "motions",
        "generated/gallery",
        "generated/notebooks/00_five_minutes",
    ):
        browser.get(f"{address}/{page}.html")
        page_colour = browser.execute_script(
            "return getComputedStyle(document.body).backgroundColor"
        )
        assert max(int(x) for x in re.findall(r"\d+", page_colour)[:3]) < 80, page
        plates = browser.execute_script(PLATE)
        assert plates, page
        assert all(min(colour) > 200 for colour in plates), page
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_search_finds_a_law(address, browser):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    width(browser, 1280)
    browser.get(f"{address}/search.html?q=bistiffness")
    found = WebDriverWait(browser, 20).until(
        lambda x: x.find_elements(By.CSS_SELECTOR, "ul.search a[href*='laws/lzb']")
    )
    browser.get(found[0].get_attribute("href"))
    assert "LZB" in browser.find_element(By.TAG_NAME, "h1").text
    picture = browser.find_element(By.CSS_SELECTOR, "figure img")
    assert int(picture.get_attribute("naturalWidth")) > 300
    picture.click()  # to its code
    assert "gallery" in browser.current_url
    assert "def law_lzb" in browser.find_element(By.TAG_NAME, "article").text
