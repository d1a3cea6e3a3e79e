"""Which files in a folder belong to which view: our own layout, Open3D's and TUM's."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from habitus.errors import HabitusError, listed
from habitus.io.limits import check_text, read_file
from habitus.io.names import inside, numeric_order
from habitus.io.rgbd.descriptions import ENDINGS as DESCRIPTIONS
from habitus.io.rgbd.images import ENDINGS as IMAGES

KINDS = {
    "depth": ("depth",),
    "colour": ("color", "colour", "rgb", "image", "images"),
    "mask": ("mask", "masks", "silhouette", "silhouettes", "segmentation"),
    "keypoints": ("keypoints", "pose", "poses2d", "openpose"),
}
EMPTY = ("background", "empty", "bg")
_BACKGROUND = re.compile(r"(?<![a-z])(background|empty|bg)(?![a-z])")
TUM_METRES = 1 / 5000
TUM_APART = 0.03
"""Seconds between a depth and a colour image that belong together."""


@dataclass(frozen=True)
class ViewFiles:
    """The files of one view; None where there is none."""

    depth: Path
    colour: Path | None = None
    mask: Path | None = None
    keypoints: Path | None = None


@dataclass(frozen=True)
class FolderFiles:
    """What a folder holds: views, the empty room's images, descriptions of cameras; metres of a
    step, if the layout fixes it.
    """

    views: tuple[ViewFiles, ...]
    background: Path | None = None
    background_colour: Path | None = None
    descriptions: tuple[Path, ...] = ()
    metres: float | None = None
    layout: str = "folder"
    notes: tuple[str, ...] = field(default=())


def find_files(folder: Path) -> FolderFiles:
    """The views of a folder. Raises HabitusError where it holds no depth image, or colour that does
    not pair up.
    """
    if not folder.is_dir():
        raise HabitusError(
            f"{folder}: is no folder; expected one with depth images and the cameras' intrinsics"
        )
    descriptions = tuple(
        sorted(p for p in folder.iterdir() if p.suffix.lower() in DESCRIPTIONS and p.is_file())
    )
    if (folder / "depth.txt").is_file():
        return _tum(folder, descriptions)
    files = {kind: _images(folder, kind) for kind in KINDS}
    depth, background = _without_background(files["depth"] + _in_empty(folder, "depth"))
    colour, background_colour = _without_background(files["colour"] + _in_empty(folder, "colour"))
    if not depth:
        raise HabitusError(
            f"{folder}: holds no depth image; expected depth/*.png, or *depth*.png, of 16 bits "
            "(docs/rgbd.md)"
        )
    views = zip(
        depth,
        _paired(depth, colour, "colour", folder),
        _paired(depth, files["mask"], "mask", folder),
        _paired(depth, files["keypoints"], "keypoint", folder),
        strict=True,
    )
    cameras = tuple(p for p in descriptions if not any(p == view for view in files["keypoints"]))
    return FolderFiles(
        tuple(ViewFiles(*view) for view in views), background, background_colour, cameras
    )


def _images(folder: Path, kind: str) -> list[Path]:
    """The files of a kind: all in a folder of its name, else those that have it in their own."""
    endings = DESCRIPTIONS[:1] if kind == "keypoints" else IMAGES
    for name in KINDS[kind]:
        for inner in folder.iterdir():
            if inner.is_dir() and inner.name.lower() == name:
                return _sorted(p for p in inner.iterdir() if p.suffix.lower() in endings)
    words = re.compile(rf"(?<![a-z])({'|'.join(KINDS[kind])})(?![a-z])")
    flat = [
        p for p in folder.iterdir() if p.suffix.lower() in endings and words.search(p.stem.lower())
    ]
    return _sorted(p for p in flat if p.is_file())


def _in_empty(folder: Path, kind: str) -> list[Path]:
    """Images of the empty room in a folder of their own."""
    images = []
    for inner in folder.iterdir():
        if inner.is_dir() and inner.name.lower() in EMPTY:
            images += [p for p in _images(inner, kind) if p not in images]
    return images


def _without_background(paths: list[Path]) -> tuple[list[Path], Path | None]:
    """Views, and the first image that is named as the empty room's."""
    empty = [
        p
        for p in paths
        if _BACKGROUND.search(p.stem.lower())
        or p.parent.name.lower() in EMPTY
        or p.parent.parent.name.lower() in EMPTY
    ]
    return [p for p in paths if p not in empty], empty[0] if empty else None


def _paired(depth: list[Path], others: list[Path], what: str, folder: Path) -> list[Path | None]:
    """The other image of each view: by the numbers in names, else by order."""
    if not others:
        return [None] * len(depth)
    numbered = {_number(path): path for path in others}
    if len(numbered) == len(others) and all(_number(path) in numbered for path in depth):
        return [numbered[_number(path)] for path in depth]
    if len(others) != len(depth):
        raise HabitusError(
            f"{folder}: {len(depth)} depth and {len(others)} {what} images whose names do not "
            "pair up "
            f"({listed(path.name for path in others)}); give each view one, with the same number "
            "in its name"
        )
    return list(others)


def _number(path: Path) -> str:
    """The last number in a name, without leading zeros."""
    digits = re.findall(r"\d+", path.stem)
    return digits[-1].lstrip("0") if digits else path.stem


def _sorted(paths: Iterable[Path]) -> list[Path]:
    """By numbers in names, as people count."""
    return sorted(paths, key=lambda path: numeric_order(path.name))


def _tum(folder: Path, descriptions: tuple[Path, ...]) -> FolderFiles:
    """Lists of time stamps and files, as TUM's RGB-D benchmark has them; colour of the nearest
    time.
    """
    depth = _list(folder / "depth.txt", folder)
    colour = []
    if (folder / "rgb.txt").is_file():
        colour = _list(folder / "rgb.txt", folder)
    views = []
    for time, path in depth:
        near = min(colour, key=lambda other: abs(other[0] - time), default=None)
        views.append(
            ViewFiles(
                path, near[1] if near is not None and abs(near[0] - time) < TUM_APART else None
            )
        )
    notes = ("TUM's layout: 5000 steps of depth a metre",)
    if not views:
        raise HabitusError(
            f"{folder / 'depth.txt'}: lists no image; expected lines of a time stamp and a file"
        )
    return FolderFiles(tuple(views), None, None, descriptions, TUM_METRES, "tum", notes)


def _list(path: Path, folder: Path) -> list[tuple[float, Path]]:
    check_text(path.stat().st_size, str(path))
    images = []
    for line in read_file(path).decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            images.append((float(words[0]), folder / inside(words[1])))
        except (ValueError, IndexError):
            raise HabitusError(
                f"{path}: the line {line[:60]!r}; expected a time stamp and a file"
            ) from None
    return images
