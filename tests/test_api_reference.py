"""The documentation is built as a site without a warning; its reference holds the whole public
face.
"""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import habitus

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import build_site
    finally:
        sys.path.pop(0)
    folder = tmp_path_factory.mktemp("site")
    report = tmp_path_factory.mktemp("demo") / "report.html"
    report.write_text("<title>a report</title>")
    try:
        build_site.build(folder, report)
    except subprocess.CalledProcessError as error:
        pytest.fail(error.stderr)
    return folder


@pytest.fixture(scope="module")
def pages(site):
    return sorted((site / "reference").rglob("*.html"))


def test_every_page_is_in_the_site_and_none_leads_to_the_checkout(site):
    written = {page.stem for page in (ROOT / "docs").glob("*.md")}
    assert written <= {page.stem for page in site.glob("*.html")}
    links = [
        link
        for page in site.glob("*.html")
        for link in re.findall(r'href="(?!http)([^"#]+)', page.read_text("utf-8"))
    ]
    lost = {link for link in links if not (site / link.split("?")[0]).exists()}
    assert len(links) > 1000 and not lost


def test_the_first_page_shows_a_report(site):
    assert '<iframe src="demo-report.html"' in (site / "index.html").read_text("utf-8")
    assert (site / "demo-report.html").read_text("utf-8") == "<title>a report</title>"


def test_the_reference_holds_the_public_face(pages):
    (text,) = (page.read_text("utf-8") for page in pages if page.name == "public.html")
    names = [name for name in habitus.__all__ if name != "terms" and name[0] != "_"]
    assert not [name for name in names if f'id="habitus.{name}"' not in text]


def test_the_reference_holds_terms_renderer_and_settings(pages):
    text = "".join(page.read_text("utf-8") for page in pages)
    for name in (
        "Term",
        "residuals.terms.Markers",
        "Camera.project",
        "render.frame.Frame.image",
        "fit.markers.settings.MoshSettings",
    ):
        assert f'id="habitus.{name}"' in text, name


def test_the_reference_holds_the_help_of_every_command(pages):
    from habitus.cli.main import COMMANDS

    (text,) = (page.read_text("utf-8") for page in pages if page.name == "commands.html")
    assert not [name for name in COMMANDS if f"<h2>habitus {name}" not in text]
    assert text.count("--help") >= len(COMMANDS)


def test_public_methods_are_told():
    from habitus.fit.markers.live import LiveFit
    from habitus.fit.markers.result import MarkerFit

    for kind in (habitus.Mosh, habitus.MoshWeights, MarkerFit, LiveFit):
        members = {name: member for name, member in vars(kind).items() if not name.startswith("_")}
        untold = [
            name for name, one in members.items() if callable(one) and not inspect.getdoc(one)
        ]
        assert not untold
