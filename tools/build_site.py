"""Builds the documentation as a site that opens offline: python tools/build_site.py build/site.

The pages are docs/*.md and the few texts that lie elsewhere; the reference of the public face is
built beside them. Warnings (a link that leads nowhere, a page that no menu has) are errors.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import build_reference
import notebooks

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "benchmarks/README.md": "benchmarks.md",
    "src/habitus/render/README.md": "renderer.md",
}
"""Texts outside docs/, and the pages that they become."""
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)]*)?\)")


MENU = {
    "For whom": ("tutorial", "for-studios", "for-laboratories", "for-vision", "for-trainers"),
    "Captures to bodies": (
        "captures",
        "labelling",
        "discovering-a-layout",
        "adding-a-marker-layout",
        "results",
        "comparing",
        "exporting",
        "in-your-program",
        "archives",
        "live",
        "measurements",
        "viewing",
        "exaggerating-and-retargeting",
        "virtual-markers",
        "selecting-markers",
        "amass",
    ),
    "Bodies and models": (
        "default-body",
        "adding-a-body-model",
        "training",
        "evaluating",
        "dynamics",
    ),
    "Images and scans": ("registering-scans", "rgbd", "rendering", "gallery", "renderer"),
    "Notebooks": ("markers_to_body", "differentiable_rendering", "people_from_measurements"),
    "How it works": (
        "mosh",
        "your-own-term",
        "equations",
        "glossary",
        "conventions",
        "architecture",
    ),
    "How good it is": ("how-accurate", "evaluation-of-mosh", "compared", "benchmarks"),
    "Project": ("readme", "contributing", "changes"),
}
"""The site's menu; a page that is in none is an error."""


def build(site: Path) -> list[Path]:
    """Write the site into a folder, in the place of an older one, and return its pages.

    Raises CalledProcessError with what Sphinx said where it warns.
    """
    shutil.rmtree(site, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        gather(Path(folder) / "docs")
        command = [
            sys.executable,
            "-m",
            "sphinx",
            "-W",
            "--keep-going",
            "-q",
            "-b",
            "html",
            "docs",
            site.resolve(),
        ]
        subprocess.run(command, check=True, capture_output=True, text=True, cwd=folder)
    shutil.rmtree(site / ".doctrees", ignore_errors=True)
    build_reference.build(site / "reference")
    return sorted(site.rglob("*.html"))


def gather(source: Path) -> None:
    """All pages and pictures in one folder, links between them put right, and the menu in the first
    page.
    """
    shutil.copytree(ROOT / "docs", source)
    for path, page in ELSEWHERE.items():
        shutil.copy(ROOT / path, source / page)
    homes = {page: (ROOT / path).parent for path, page in ELSEWHERE.items()}
    for path in notebooks.FOLDER.glob("*.ipynb"):
        (source / f"{path.stem}.md").write_text(notebooks.page(notebooks.read(path)), "utf-8")
        homes[f"{path.stem}.md"] = path.parent
    for page in sorted(source.glob("*.md")):
        home = homes.get(page.name, ROOT / "docs")
        text = (
            page.read_text("utf-8")
            .replace("](docs/images/", "](images/")
            .replace("](../docs/images/", "](images/")
        )
        page.write_text(LINK.sub(lambda link, home=home: _link(link, home), text), "utf-8")
    with (source / "index.md").open("a", encoding="utf-8") as index:
        for caption, pages in MENU.items():
            index.write(
                "\n```{toctree}\n:hidden:\n:caption: "
                + caption
                + "\n\n"
                + "\n".join(pages)
                + "\n```\n"
            )


def _link(link: re.Match[str], home: Path) -> str:
    """A link of a page that lay in ``home``: to a page of the site, or where it leads to code, its
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
