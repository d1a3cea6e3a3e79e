"""``habitus compare``: two results of one capture side by side."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.files import write_text
from habitus.io.people import person_file
from habitus.jobs.exporting import read_moving
from habitus.report.comparison.differences import Differences, differences
from habitus.report.comparison.numbers import numbers
from habitus.report.comparison.page import comparison_page
from habitus.results.save import write_json
from habitus.types import PathLike

PAGE = "compare.html"
NUMBERS = "compare.json"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two results of one capture, and how far they are apart.

    ``names`` tell them apart, ``differences`` holds every distance at every moment, ``numbers``
    what compare.json holds (mm, degrees, m), ``reports`` are their pages where they lie beside the
    results.
    """

    names: tuple[str, str]
    differences: Differences
    numbers: Mapping[str, Any]
    reports: tuple[Path | None, Path | None] = (None, None)

    @property
    def notes(self) -> tuple[str, ...]:
        """What must be known of the distances: other rates, ranges, worlds, meshes."""
        return tuple(self.numbers["notes"])

    def rows(self) -> list[tuple[str, str, str, str]]:
        """What is apart, by how much: name, mean, what 95 % are below, and most, as text."""
        named = {
            "skin_mm": "skin",
            "joints_mm": "joints",
            "joints_root_aligned_mm": "joints, pelvis on pelvis",
        }
        named |= {
            "joint_rotations_degrees": "joints' rotations",
            "shape_at_rest_mm": "shape at rest",
        }
        distances = {what: self.numbers[key] for key, what in named.items()}
        distances["markers, predicted"] = (self.numbers["markers"] or {}).get("distance_mm")
        rows = []
        for what, values in distances.items():
            if values and values["mean"] is not None:
                unit = "°" if "rotations" in what else " mm"
                rows.append((what, *(f"{values[key]:.1f}{unit}" for key in ("mean", "p95", "max"))))
        return rows

    def save(self, folder: PathLike) -> Path:
        """Write compare.html and compare.json into a folder and return the page's path.

        Each is written whole or not at all; what else the folder holds stays. Raises HabitusError
        where it cannot be written to.
        """
        target = Path(folder)
        links = tuple(None if page is None else _way(target, page) for page in self.reports)
        write_text(
            target / PAGE, comparison_page(self.differences, self.numbers, self.names, links)
        )
        write_json(target / NUMBERS, self.numbers)
        return target / PAGE


def compare(
    a: Moving | PathLike,
    b: Moving | PathLike,
    *,
    out: PathLike | None = None,
    body_a: BodyModel | PathLike | None = None,
    body_b: BodyModel | PathLike | None = None,
    offset: float = 0.0,
    align: str = "auto",
) -> Comparison:
    """Compare two results of one capture: two fits, or those of two tools.

    a, b: fits, motions, a folder that ``habitus mosh`` wrote, its body.npz, or an npz as AMASS's.
    out: a folder for compare.html and compare.json. body_a, body_b: the models that their betas
    belong to, where the files name none that comes along. offset: seconds from A's first frame to
    B's. align: "auto" turns and moves B as a whole where the two plainly stand in different worlds,
    "rigid" always, "none" never. Raises HabitusError for files that cannot be read, and where the
    two have no moment, or no joint, in common.
    """
    sides = [_read(source, body) for source, body in ((a, body_a), (b, body_b))]
    names = distinct_names(a, b)
    result = differences(sides[0], sides[1], offset=offset, align=align)
    pages = tuple(
        None if isinstance(source, Moving) else _report(Path(source)) for source in (a, b)
    )
    comparison = Comparison(names, result, numbers(result, names), (pages[0], pages[1]))
    if out is not None:
        comparison.save(out)
    return comparison


def distinct_names(a: Moving | PathLike, b: Moving | PathLike) -> tuple[str, str]:
    """Short names of the two: the parts of their paths in which these differ, or the captures'
    names.
    """
    if isinstance(a, Moving) or isinstance(b, Moving):
        return tuple(
            m.capture_name if isinstance(m, Moving) else person_file(Path(m)).name for m in (a, b)
        )  # type: ignore[return-value]
    parts = [list(person_file(Path(source)).resolve().parts) for source in (a, b)]
    if parts[0] == parts[1]:
        return Path(a).name, Path(b).name
    while min(map(len, parts)) > 1 and parts[0][-1] == parts[1][-1]:
        parts = [words[:-1] for words in parts]
    while min(map(len, parts)) > 1 and parts[0][0] == parts[1][0]:
        parts = [words[1:] for words in parts]
    return "/".join(parts[0]), "/".join(parts[1])


def _report(source: Path) -> Path | None:
    page = person_file(source).parent / "report.html"
    return page if page.is_file() else None


def _read(source: Moving | PathLike, body: BodyModel | PathLike | None) -> Moving:
    if isinstance(source, Moving):
        return source
    return read_moving(source, body)


def _way(folder: Path, page: Path) -> str:
    """How a page in a folder links to another one."""
    try:
        return Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive of Windows
        return page.resolve().as_uri()
