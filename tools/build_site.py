"""Build the documentation as a site that opens offline: python tools/build_site.py build/site.

The pages are docs/*.md, a few texts that lie elsewhere, and a reference that is generated from
docstrings and from the help of each command. Warnings (a broken link, a page that no menu lists)
are errors.
"""

import importlib
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout, suppress
from pathlib import Path

import notebooks

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "benchmarks/README.md": "benchmarks.md",
    "src/habitus/render/README.md": "renderer.md",
    "lab/README.md": "making-the-default-body.md",
}
"""Texts outside docs/, and the pages that they become."""
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)]*)?\)")
LIVE_REPORT = "<!-- live report -->"
"""Where the first page shows the report of the demo's fit."""


MENU = {
    "Tutorials": (
        "tutorial",
        "markers_to_body",
        "differentiable_rendering",
        "people_from_measurements",
    ),
    "For your work": ("for-studios", "for-laboratories", "for-vision", "for-trainers"),
    "How-to: markers": (
        "captures",
        "labelling",
        "discovering-a-layout",
        "adding-a-marker-layout",
        "archives",
        "live",
        "comparing",
        "virtual-markers",
        "selecting-markers",
        "your-own-term",
    ),
    "How-to: several sensors": ("several-sensors",),
    "How-to: cameras, scans and images": (
        "cameras",
        "from-cameras-to-blender",
        "registering-scans",
        "rgbd",
        "rendering",
        "gallery",
    ),
    "How-to: bodies": (
        "measurements",
        "for-tailors",
        "viewing",
        "adding-a-body-model",
        "training",
        "evaluating",
        "dynamics",
    ),
    "How-to: other programs": (
        "exporting",
        "in-your-program",
        "exaggerating-and-retargeting",
        "motion-in",
        "robots",
        "other-bodies",
        "amass",
    ),
    "Reference": ("reference/index", "results", "conventions", "glossary", "equations"),
    "Explanation": (
        "mosh",
        "default-body",
        "making-the-default-body",
        "renderer",
        "architecture",
        "how-accurate",
        "numbers",
        "accuracy-of-scans-and-depth",
        "accuracy-of-measurements",
        "accuracy-of-marker-workflows",
        "accuracy-of-training",
        "accuracy-of-rendering",
        "evaluation-of-mosh",
        "compared",
        "benchmarks",
    ),
    "Project": ("readme", "contributing", "changes"),
}
"""The site's menu by purpose; a page that no group lists is an error."""

REFERENCE = {
    "results": (
        "Results",
        "What fits return.",
        (
            "habitus.fit.markers.result",
            "habitus.fit.markers.live",
            "habitus.fit.points.scan_result",
            "habitus.fit.points.depth_result",
            "habitus.fit.body_fit",
        ),
    ),
    "bodies": (
        "Bodies",
        "The body model, its state and its surface.",
        ("habitus.body.model", "habitus.body.state"),
    ),
    "data": (
        "Captures, layouts, registrations",
        "What fits and training take.",
        ("habitus.io.captures.read", "habitus.markers.layouts", "habitus.mesh.registrations"),
    ),
    "terms": (
        "Terms and solvers",
        "Residual terms, and the function that minimises them.",
        (
            "habitus.residuals.terms",
            "habitus.residuals.surface_terms",
            "habitus.residuals.points",
            "habitus.solve.terms",
            "habitus.solve.minimize",
        ),
    ),
    "renderer": (
        "Renderer and cameras",
        "From triangles to images and their derivatives.",
        ("habitus.observe.camera", "habitus.render.draw", "habitus.render.frame"),
    ),
    "settings": (
        "Settings",
        "Tuning constants of each recipe, with units and reasons.",
        ("habitus.fit.markers.settings", "habitus.fit.points.settings"),
    ),
}
"""Pages of the reference beside the public face: title, first sentence, modules."""


def build(site: Path, report: Path | None = None) -> list[Path]:
    """Write the site into a folder, in the place of an older one, and return its pages.

    report: a fit's report.html for the first page; by default the demo makes one. Raises
    CalledProcessError with what Sphinx said where it warns.
    """
    shutil.rmtree(site, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "docs"
        gather(source)
        write_reference(source / "reference")
        command = "-m sphinx -W --keep-going -q -b html docs".split()
        subprocess.run(
            [sys.executable, *command, site.resolve()],
            check=True,
            capture_output=True,
            text=True,
            cwd=folder,
        )
        shutil.copy(report or demo_report(Path(folder)), site / "demo-report.html")
    shutil.rmtree(site / ".doctrees", ignore_errors=True)
    return sorted(site.rglob("*.html"))


def demo_report(folder: Path) -> Path:
    """The report of a fit to the demo's synthetic capture."""
    command = [sys.executable, str(ROOT / "examples" / "demo.py"), "--out", str(folder / "demo")]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return next((folder / "demo").rglob("report.html"))


def gather(source: Path) -> None:
    """All pages and pictures in one folder, links between them corrected, the menu in the first."""
    shutil.copytree(ROOT / "docs", source)
    for path, page in ELSEWHERE.items():
        shutil.copy(ROOT / path, source / page)
    homes = {page: (ROOT / path).parent for path, page in ELSEWHERE.items()}
    for path in notebooks.FOLDER.glob("*.ipynb"):
        (source / f"{path.stem}.md").write_text(notebooks.page(notebooks.read(path)), "utf-8")
        homes[f"{path.stem}.md"] = path.parent
    for page in sorted(source.glob("*.md")):
        home = homes.get(page.name, ROOT / "docs")
        text = page.read_text("utf-8")
        text = text.replace("](docs/images/", "](images/").replace("](../docs/images/", "](images/")
        page.write_text(LINK.sub(lambda link, home=home: _link(link, home), text), "utf-8")
    index = (source / "index.md").read_text("utf-8").replace(LIVE_REPORT, _frame())
    menu = (_toctree(pages, caption) for caption, pages in MENU.items())
    (source / "index.md").write_text(index + "".join(menu), "utf-8")


def write_reference(folder: Path) -> None:
    """The pages of the reference: the public face, the modules behind it, the command line."""
    import habitus

    folder.mkdir()
    kinds = {name: getattr(habitus, name) for name in habitus.__all__ if name[0] != "_"}
    functions = [name for name, value in kinds.items() if not isinstance(value, type)]
    face = [
        "# Public face\n\n`import habitus as hb` loads nothing; each name is loaded when first "
        "used.\n",
        *(_directive("autofunction", f"habitus.{name}") for name in functions if name != "terms"),
        *(
            _directive("autoclass", f"habitus.{name}", members=True)
            for name, value in kinds.items()
            if isinstance(value, type)
        ),
    ]
    pages = {"public": "\n".join(face), "commands": "\n".join(_commands())}
    for name, (title, first, modules) in REFERENCE.items():
        parts = (_directive("automodule", each, True, _public(each, kinds)) for each in modules)
        pages[name] = "\n".join([f"# {title}\n\n{first}\n", *parts])
    for name, text in pages.items():
        (folder / f"{name}.md").write_text(text, "utf-8")
    order = ("public", *REFERENCE, "commands")
    index = "# Reference\n\nGenerated from docstrings and from the help of each command.\n"
    (folder / "index.md").write_text(index + _toctree(order, hidden=False), "utf-8")


def _public(module: str, kinds: Mapping[str, object]) -> str:
    """The names of a module that stand on the page of the public face."""
    values = vars(importlib.import_module(module))
    return ", ".join(name for name, value in kinds.items() if values.get(name) is value)


def _commands() -> Iterator[str]:
    """The help of each command, as it is printed."""
    from habitus.cli.main import COMMANDS, main

    os.environ["COLUMNS"] = "96"
    yield "# Command line\n\nExit codes: 0; 1, one of several captures failed; 2, bad input; 3, "
    yield "`--strict` and a failed verdict; 130, stopped by Ctrl-C.\n"
    for name, purpose in COMMANDS.items():
        with redirect_stdout(io.StringIO()) as text, suppress(SystemExit):
            main([name, "--help"])
        plain = re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue()).strip()
        yield f"## habitus {name}\n\n{purpose}\n\n```text\n{plain}\n```\n"


def _directive(kind: str, name: str, members: bool = False, without: str = "") -> str:
    """without: names, separated by commas, that stand on another page."""
    options = "\n   :members:" * members + f"\n   :exclude-members: {without}" * bool(without)
    return f"```{{eval-rst}}\n.. {kind}:: {name}{options}\n```\n"


def _toctree(pages: tuple[str, ...], caption: str | None = None, hidden: bool = True) -> str:
    options = [":hidden:"] * hidden + ([f":caption: {caption}"] if caption else [])
    return "\n```{toctree}\n" + "\n".join([*options, "", *pages]) + "\n```\n"


def _frame() -> str:
    """The demo's report inside a page."""
    return (
        "```{raw} html\n"
        '<iframe src="demo-report.html" title="Report of a fit" loading="lazy" '
        'class="live-report"></iframe>\n'
        "```\n"
    )


def _link(link: re.Match[str], home: Path) -> str:
    """A link of a page that lay in ``home``: to a page of the site, or, where it leads to code, its
    words alone.
    """
    words = link[1]
    target = link[2]
    anchor = link[3] or ""
    if "://" in target or target.startswith("mailto:"):
        return link[0]
    path = (home / target).resolve()
    name = path.relative_to(ROOT).as_posix()
    if name in ELSEWHERE:
        return f"[{words}]({ELSEWHERE[name]}{anchor})"
    if path.parent == notebooks.FOLDER and path.exists():
        return f"[{words}]({path.stem}.md)"
    if path.parent == ROOT / "docs" and path.suffix == ".md":
        return f"[{words}]({path.name}{anchor})"
    return words if path.exists() else link[0]


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    try:
        print(f"{len(build(Path(sys.argv[1])))} pages in {sys.argv[1]}")
    except subprocess.CalledProcessError as error:
        sys.exit(error.stderr)
