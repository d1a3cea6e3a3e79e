"""Builds the reference of the public face from its docstrings: python tools/build_reference.py
build/reference.

Opens offline: build/reference/index.html. Warnings (an annotation or a docstring that cannot be
read) are errors.
"""

import re
import sys
import warnings
from pathlib import Path

import pdoc

import habitus

MODULES = (
    "habitus",
    "habitus.residuals.terms",
    "habitus.fit.markers.result",
    "habitus.fit.markers.live",
    "habitus.io.captures.read",
    "habitus.body.model",
    "habitus.body.state",
    "habitus.markers.layouts",
    "habitus.mesh.registrations",
)
"""The public face, and the modules of what its functions take and give."""
HIDDEN = "!habitus.evaluate"  # the package; the function of this name is the public one


def build(folder: Path) -> list[Path]:
    """Write the pages into a folder and return them. Raises a warning as an error, and for names
    that are not there.
    """
    pdoc.render.configure(
        docformat="markdown", footer_text="habitus", show_source=False, search=True
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        warnings.simplefilter("error", RuntimeWarning)
        for name in habitus.__all__:
            getattr(habitus, name)  # pdoc shows what is loaded
        pdoc.pdoc(*MODULES, HIDDEN, output_directory=folder)
    pages = sorted(folder.rglob("*.html"))
    for page in pages:
        text = page.read_text("utf-8")
        for target in re.findall(r'href="([^"#:]+\.html)', text):
            if not (page.parent / target).resolve().exists():
                raise FileNotFoundError(f"{page}: links to {target}")
    return pages


if __name__ == "__main__":
    for path in build(Path(sys.argv[1])):
        print(path)
