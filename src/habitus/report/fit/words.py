"""Words of the report for what programs name briefly: files, terms of the energy, names out of
files.
"""

from collections.abc import Mapping, Sequence

from habitus.errors import shown
from habitus.report.facts import LONGEST_NAME
from habitus.report.parts import file_links

_FILES = {
    "body.npz": "shape, pose and markers in every frame, for Python (AMASS names)",
    "body.glb": "the moving body, for Blender, game engines and web viewers",
    "metrics.json": "the numbers of this page, for programs",
    "obj": "a folder with a mesh a frame",
}
_TERMS = {
    "data": "Markers, observed and predicted",
    "surface": "Markers' distance from the skin",
    "start": "Markers' distance from the layout's places",
    "betas": "Shapes that few people have",
    "pose": "Poses that people seldom take",
    "soft_tissue": "Soft tissue away from rest",
    "acceleration": "Changes of soft tissue from frame to frame",
    "frames": "All terms, frame after frame",
}


def isolated(name: object) -> str:
    """A name out of a file, as a part of a sentence: shown safely, and its direction of writing
    kept to itself.
    """
    return f"\u2068{shown(name, LONGEST_NAME)}\u2069"


def downloads(files: Sequence[str]) -> str:
    """Links to the files that lie beside the page; nothing where there are none."""
    return file_links({name: _FILES.get(name, "") for name in files})


def term_rows(costs: Mapping[str, float]) -> list[tuple[str, str]]:
    """What each term of the energy came to in the end, in words: the shape stage's first."""
    return [(_term(str(name)), f"{value:,.4g}") for name, value in costs.items()]


def _term(name: str) -> str:
    bare = name.removeprefix("shape_")
    told = _TERMS.get(bare, shown(bare, LONGEST_NAME).replace("_", " "))
    return f"Shape stage: {told[:1].lower()}{told[1:]}" if name.startswith("shape_") else told
