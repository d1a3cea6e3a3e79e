"""Reads a folder of depth and colour images of one person, with the cameras' intrinsics: an
`RgbdCapture`. Which files belong to which view: our own layout, Open3D's and TUM's.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from habitus.errors import HabitusError, listed, shown
from habitus.io.limits import check_text, read_file
from habitus.io.names import inside, numeric_order, plain_name
from habitus.io.rgbd.cameras import COLOUR, DEPTH, Rig, placed, read_rig, resized, scale_of
from habitus.io.rgbd.files import (
    DESCRIPTION_ENDINGS,
    IMAGE_ENDINGS,
    check_images,
    read_colour,
    read_depth,
    read_description,
    read_mask,
)
from habitus.io.rgbd.keypoints import read_keypoints
from habitus.io.rgbd.pcd import read_pcd
from habitus.observe.camera import Camera, DepthView, RgbdCapture
from habitus.types import PathLike

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
        sorted(
            p for p in folder.iterdir() if p.suffix.lower() in DESCRIPTION_ENDINGS and p.is_file()
        )
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
    endings = DESCRIPTION_ENDINGS[:1] if kind == "keypoints" else IMAGE_ENDINGS
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


MAX_VIEWS = 12
LIKELY = (0.3, 9.0)
"""Metres that the middle of a depth image lies away."""
MILLIMETRE = 0.001


@dataclass(frozen=True)
class _Description:
    """A description and the cameras in it."""

    path: Path
    table: Any


def read_views(
    folder: PathLike,
    views: Sequence[int] | None = None,
    depth_unit: float | None = None,
    cameras: PathLike | None = None,
) -> RgbdCapture:
    """The views in a folder: `docs/rgbd.md` tells the layouts (ours, Open3D's, TUM's) and the names
    in descriptions.

    views: which of them, counted from 0; by itself up to 12, spread evenly. depth_unit: metres of
    one step, where no file tells it or tells it wrongly. cameras: a description elsewhere. An
    organised point cloud (.pcd) is one view. Raises HabitusError with the file named.
    """
    source = Path(folder)
    if source.suffix.lower() == ".pcd":
        return read_pcd(source)
    try:
        return _read_views(source, views, depth_unit, cameras)
    except OSError as error:
        raise HabitusError(
            f"{source}: {shown(error.strerror or error)}; expected images of 16-bit depth and "
            "the cameras' intrinsics"
        ) from error


def _read_views(
    source: Path,
    views: Sequence[int] | None,
    depth_unit: float | None,
    cameras: PathLike | None,
) -> RgbdCapture:
    files = find_files(source)
    chosen = _chosen(files.views, views, source)
    notes = list(files.notes)
    if len(chosen) < len(files.views) and views is None:
        notes.append(
            f"{len(files.views)} views are there; {len(chosen)} of them, spread evenly, are used"
        )
    check_images(_image_paths(chosen, files))
    paths = files.descriptions if cameras is None else (Path(cameras),)
    shape = read_depth(chosen[0].depth, 1.0).shape
    rig = _rig(
        [_Description(path, read_description(path)) for path in paths], (shape[1], shape[0]), source
    )
    notes += rig.notes
    metres = next(
        (value for value in (depth_unit, rig.metres, files.metres) if value is not None), MILLIMETRE
    )
    if depth_unit is None and rig.metres is None and files.metres is None:
        notes.append("no file names the unit of depth; millimetres were assumed (--depth-unit)")
    background = None if files.background is None else read_depth(files.background, metres)
    empty = None if files.background_colour is None else read_colour(files.background_colour)
    made = tuple(_view(one, rig, metres, background, empty) for one in chosen)
    _check_distance(made, metres, source)
    if (
        rig.colour is None
        and any(one.colour for one in chosen)
        and all(view.colour is None for view in made)
    ):
        notes.append(
            "colour images were left out: no file describes their camera, and they are not of the "
            "depth's size"
        )
    return RgbdCapture(plain_name(source.resolve().name), made, tuple(notes))


def _chosen(
    views: tuple[ViewFiles, ...], numbers: Sequence[int] | None, source: Path
) -> list[ViewFiles]:
    if numbers is None:
        picked = np.unique(
            np.linspace(0, len(views) - 1, min(len(views), MAX_VIEWS)).round().astype(int)
        )
        return [views[k] for k in picked]
    for k in numbers:
        if not 0 <= k < len(views):
            raise HabitusError(
                f"{source}: there is no view {k}; it has {len(views)}, counted from 0"
            )
    return [views[k] for k in numbers]


def _rig(descriptions: list[_Description], size: tuple[int, int], source: Path) -> Rig:
    """The cameras out of all descriptions: one file for both, or one each."""
    apart = {"depth": DEPTH, "colour": COLOUR}
    named = {
        kind: [one for one in descriptions if any(w in one.path.stem.lower() for w in w_)]
        for kind, w_ in apart.items()
    }
    if named["depth"] and named["colour"] and named["depth"][0] is not named["colour"][0]:
        return _of_two(named["depth"][0], named["colour"][0], descriptions, size)
    problems = []
    notes = ()
    for one in descriptions:
        try:
            rig = read_rig(one.table, str(one.path), size)
        except HabitusError as error:
            problems.append(str(error))
            continue
        if rig.depth is not None:
            return rig
        if rig.colour is not None:
            notes = (*notes, f"{one.path}: describes only a colour camera; it was used for both")
            return Rig(rig.colour, rig.colour, rig.metres, (*rig.notes, *notes))
    if problems:
        raise HabitusError(problems[0])
    raise HabitusError(
        f"{source}: holds no intrinsics; expected a .json or .yaml with fx, fy, cx, cy or a "
        "camera matrix "
        "(docs/rgbd.md), or --cameras FILE"
    )


def _of_two(
    depth: _Description,
    colour: _Description,
    descriptions: list[_Description],
    size: tuple[int, int],
) -> Rig:
    one = read_rig(depth.table, str(depth.path), size)
    other = read_rig(colour.table, str(colour.path), size)
    assert one.depth is not None or one.colour is not None
    camera = other.colour or other.depth
    notes = (*one.notes, *other.notes)
    metres = one.metres or next((r for each in descriptions if (r := _metres(each, size))), None)
    for each in descriptions:
        if camera is not None:
            moved, more = placed(camera, each.table, str(each.path))
            camera = moved
            notes = (*notes, *more)
    return Rig(one.depth or one.colour, camera, metres, notes)


def _metres(one: _Description, size: tuple[int, int]) -> float | None:
    try:
        return read_rig(one.table, str(one.path), size).metres
    except HabitusError:
        return scale_of(one.table, str(one.path))


def _image_paths(views: list[ViewFiles], files: FolderFiles) -> list[Path]:
    """Every image that is read for these views."""
    paths = [files.background, files.background_colour]
    for view in views:
        paths += [view.depth, view.colour, view.mask]
    return [path for path in paths if path is not None]


def _view(
    one: ViewFiles,
    rig: Rig,
    metres: float,
    background: Float[np.ndarray, "H W"] | None,
    empty: UInt8[np.ndarray, "h w 3"] | None,
) -> DepthView:
    depth = read_depth(one.depth, metres)
    camera = _of_size(rig.depth, (depth.shape[1], depth.shape[0]), one.depth)
    colour = None if one.colour is None else read_colour(one.colour)
    colour_camera = (
        None if colour is None else _colour_camera(rig, camera, (colour.shape[1], colour.shape[0]))
    )
    return DepthView(
        depth,
        camera,
        colour if colour_camera is not None else None,
        colour_camera,
        background,
        empty if colour_camera is not None else None,
        None if one.mask is None else read_mask(one.mask),
        {} if one.keypoints is None else read_keypoints(one.keypoints),
        plain_name(one.depth.stem),
    )


def _of_size(camera: Camera | None, size: tuple[int, int], path: Path) -> Camera:
    """The camera for images of this size: as it is, or scaled where the sides are in one
    proportion.
    """
    assert camera is not None
    factor = size[0] / camera.width
    if (camera.width, camera.height) == size:
        return camera
    if abs(camera.height * factor - size[1]) > 1.0:
        raise HabitusError(
            f"{path}: {size[0]} x {size[1]} pixels, the intrinsics are for {camera.width} x "
            f"{camera.height}; "
            "give those of this resolution"
        )
    return camera.scaled(factor).replace(width=size[0], height=size[1])


def _colour_camera(rig: Rig, depth: Camera, size: tuple[int, int]) -> Camera | None:
    if rig.colour is None:
        return depth if (depth.width, depth.height) == size else None
    if (rig.colour.width, rig.colour.height) == size:
        return rig.colour
    camera = (
        resized(rig.colour, size) if (rig.colour.width, rig.colour.height) == (1280, 720) else None
    )
    return camera or _of_size(rig.colour, size, Path("colour"))


def _check_distance(views: tuple[DepthView, ...], metres: float, source: Path) -> None:
    for view in views:
        seen = view.depth[view.depth > 0]
        if not len(seen):
            raise HabitusError(
                f"{source}: {view.name}: no depth within 12 m at {metres:g} m a step; is the unit "
                "right (--depth-unit)?"
            )
        middle = float(np.median(seen))
        if not LIKELY[0] < middle < LIKELY[1]:
            raise HabitusError(
                f"{source}: {view.name}: the middle of its depth is {middle:.3g} m at {metres:g} "
                "m a step; expected "
                f"{LIKELY[0]:g} to {LIKELY[1]:g} m: is the unit right (--depth-unit)?"
            )
