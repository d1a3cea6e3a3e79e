"""Captures among files and folders: which there are, what their results are called, which are one
subject's.
"""

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.captures.read import PARSERS, Capture
from habitus.io.captures.trc import is_fit_export
from habitus.io.names import file_name, name_key, shown_stem

SURE = (".c3d", ".trc")
"""Endings that only captures have; tables and archives may hold anything."""
EXPORTED = (
    "habitus export wrote it from a fit: it is skipped, as it is no capture; name the file itself "
    "to read it as one"
)


@dataclass(frozen=True)
class GroupingSettings:
    """Whether two captures show one person with the same markers. Tuned on 19 real captures."""

    frames: int = 200
    """Frames, evenly spaced, whose distances between markers are compared, about."""
    rigid: float = 0.02
    """Share of its median by which a distance on one segment varies, at the median."""
    near: float = 0.06
    """Metres: markers closer to each other are on one plate, the same on everybody."""
    far: float = 0.3
    """Metres: markers further apart sit on different segments, and keep their distance only while
    a person keeps still."""
    min_labels: int = 8
    """Labels that both captures have: with fewer it is undecided."""
    min_pairs: int = 10
    """Rigid distances that both captures have: with fewer it is undecided."""
    same: float = 0.025
    """Median relative difference of these distances below which it is one person: at most 0.015
    for one person in one session, and at least 0.076 for two people."""


GROUPING = GroupingSettings()


@dataclass(frozen=True)
class CaptureFile:
    """A file that may be a capture; results go to ``place``, relative to the folder for all, and
    are called ``name``.

    ``given``: named by itself, not found in a folder. ``exported``: found in a folder, and written
    by `habitus export`.
    """

    path: Path
    place: Path
    name: str
    given: bool
    exported: bool = False


def find_captures(paths: Sequence[Path], out: Path) -> list[CaptureFile]:
    """Files as they are given, and every capture below the folders among them, in order of their
    names.

    Hidden files and folders, ``out`` and what fits have written are left out. Raises HabitusError
    for a folder without captures and for results that would have one name.
    """
    folders = [path for path in paths if path.is_dir()]
    captures = []
    for path in paths:
        if path.is_dir():
            start = Path(file_name(path.resolve().name)) if len(folders) > 1 else Path()
            below = [
                CaptureFile(
                    file,
                    start / _safe(file.parent.relative_to(path)),
                    "",
                    False,
                    is_fit_export(file),
                )
                for file in _below(path, out)
            ]
            if not below:
                raise HabitusError(
                    f"{path}: there is no capture in this folder ({', '.join(PARSERS)}); check "
                    "the path"
                )
            captures += below
        else:
            captures.append(CaptureFile(path, Path(), "", True))
    return _named(captures, name_key(out))


def _below(folder: Path, out: Path) -> Iterator[Path]:
    results = os.path.realpath(out)  # Path.resolve fails on links in a loop
    for root, inner, names in os.walk(folder):
        inner[:] = sorted(
            x
            for x in inner
            if not x.startswith(".") and os.path.realpath(Path(root) / x) != results
        )
        fitted = {"body.npz"} if "metrics.json" in names else set()
        for name in sorted(set(names) - fitted):
            if Path(name).suffix.lower() in PARSERS and not name.startswith("."):
                yield Path(root) / name


def _safe(relative: Path) -> Path:
    return Path(*(file_name(part) for part in relative.parts))


def _named(captures: Sequence[CaptureFile], key: Callable[[str], str]) -> list[CaptureFile]:
    """With the names of their results: those of one folder that differ in their endings have these
    in their names.
    """
    stems = Counter(
        (capture.place, key(capture.path.stem)) for capture in captures if not capture.exported
    )
    repeated = {key for key, count in stems.items() if count > 1}
    named = [
        replace(
            capture,
            name=_stem(
                capture.path,
                capture.exported
                or (not capture.given and (capture.place, key(capture.path.stem)) in repeated),
            ),
        )
        for capture in captures
    ]
    twice = [
        key
        for key, count in Counter(
            (capture.place, key(capture.name)) for capture in named if not capture.exported
        ).items()
        if count > 1
    ]
    if twice:
        raise HabitusError(
            f"several captures are called {twice[0][1]}, so their results would overwrite each "
            "other; "
            "expected names that differ; rename one, or fit them in separate runs"
        )
    return named


def _stem(path: Path, with_ending: bool) -> str:
    return f"{shown_stem(path)}_{path.suffix[1:].lower()}" if with_ending else shown_stem(path)


@dataclass(frozen=True)
class MarkerSet:
    """What tells whether two captures show one person with the same markers: ``rigid``, medians (M,
    M) in metres of the distances between neighbouring markers that keep them, NaN for others.
    """

    subject: str | None
    labels: tuple[str, ...]
    rigid: Float[np.ndarray, "M M"]

    @staticmethod
    def of(capture: Capture, settings: GroupingSettings = GROUPING) -> "MarkerSet":
        """Of some of its frames."""
        markers = capture.markers[:: -(-len(capture) // settings.frames)]
        with np.errstate(all="ignore"):
            between = np.linalg.norm(markers[:, :, None] - markers[:, None], axis=3)
            distances = _median(between)
            kept = (distances > settings.near) & (distances < settings.far)
            kept &= _median(np.abs(between - distances)) < settings.rigid * distances
        return MarkerSet(capture.subject, capture.labels, np.where(kept, distances, np.nan))

    def matches(self, other: "MarkerSet", settings: GroupingSettings = GROUPING) -> bool:
        """Whether markers that keep their distance in both captures are as far apart in one as in
        the other.
        """
        difference = self.relative_difference(other, settings)
        return (
            self.subject == other.subject and difference is not None and difference < settings.same
        )

    def differs(self, other: "MarkerSet", settings: GroupingSettings = GROUPING) -> bool:
        """Whether such markers are not as far apart; False where too few can tell."""
        difference = self.relative_difference(other, settings)
        return difference is not None and difference >= settings.same

    def relative_difference(
        self, other: "MarkerSet", settings: GroupingSettings = GROUPING
    ) -> float | None:
        """The median of what such distances differ by, as a share; None where too few can tell."""
        common = [label for label in self.labels if label in other.labels]
        if len(common) < settings.min_labels:
            return None
        a = self._among(common)
        b = other._among(common)
        rigid = np.triu(np.isfinite(a) & np.isfinite(b), 1)
        return (
            float(np.median(np.abs(np.log(b[rigid] / a[rigid]))))
            if rigid.sum() >= settings.min_pairs
            else None
        )

    def _among(self, labels: Sequence[str]) -> np.ndarray:
        rows = [self.labels.index(label) for label in labels]
        return self.rigid[np.ix_(rows, rows)]


def _median(values: Float[np.ndarray, "T M M"]) -> Float[np.ndarray, "M M"]:
    """Over time, of what is there; NaN where nothing is."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, np.nan)


def grouped(captures: Sequence[tuple[CaptureFile, MarkerSet | None]]) -> list[list[CaptureFile]]:
    """Captures of one folder, of one recorded subject and with the same markers, together; each
    other one alone.
    """
    groups: dict[Path, list[tuple[MarkerSet | None, list[CaptureFile]]]] = defaultdict(list)
    for capture, seen in captures:
        here = groups[capture.path.parent]
        for first, members in here:
            if seen is not None and first is not None and first.matches(seen):
                members.append(capture)
                break
        else:
            here.append((seen, [capture]))
    return [members for here in groups.values() for _, members in here]
