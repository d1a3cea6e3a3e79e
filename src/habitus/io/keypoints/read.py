"""Reads the detections of several cameras: a folder with a folder or a file for each camera.

    trial/cam01_json/*.json      OpenPose and what writes its form (rtmlib): a file a frame
    trial/cam01.json             MMPose (``instance_info``), AlphaPose or COCO (a list over images)
    trial/cam01.csv              DeepLabCut: a row a frame, names in its second line
    trial/cam01.csv              SLEAP's analysis: a row a person and frame, names in its heads
    trial/cam01/*.npz            SAM 3D Body: a file a frame
    trial/points2d.npy           FreeMoCap: (cameras, frames, points, 2 or 3)

The order of points is never taken from their number alone: names in the file, then the person's
proportions (`habitus.body.keypoints.convention_of`), else the files are refused.
"""

import csv
import io
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.keypoints import CONVENTIONS, convention_of, keypoint_place
from habitus.errors import HabitusError, listed, shown
from habitus.io.archives import read_npy
from habitus.io.keypoints.archives import (
    MAX_FRAMES,
    MAX_PEOPLE,
    MAX_PIXEL,
    MHR70,
    Frame,
    checked,
    sam3d_frames,
)
from habitus.io.limits import (
    MAX_NAMES,
    Allowance,
    check_count,
    read_json,
    read_text_file,
)
from habitus.io.names import numeric_order, plain_name
from habitus.observe.detections import Detections
from habitus.types import PathLike

INNER = ("pose", "keypoints", "json")
"""Folders in which detections of all cameras may lie."""
SLEAP_FRAME = "frame_idx"
"""Column by which SLEAP's analysis is known."""
SAMPLE = 200
"""People by whom the convention is decided."""


def read_detections(
    source: PathLike,
    rate_hz: float,
    convention: str | None = None,
    names: Mapping[str, str] | PathLike | None = None,
) -> Detections:
    """The detections of all cameras in a folder, or of one in a file.

    rate_hz: frames a second, which no such file says. convention: of the points' order, one of
    `habitus.body.keypoints.CONVENTIONS`; by itself by the files' names or the people's proportions.
    names: keypoints by the files' own names, {"knee_L": "left_knee"}, or a .toml of such lines.
    Raises HabitusError with the file named.
    """
    path = Path(source)
    own_names = read_names(names)
    if not 0.0 < rate_hz < 1e5:
        raise HabitusError(f"the frame rate is {rate_hz!r}; expected frames a second")
    if convention is not None and convention not in CONVENTIONS:
        raise HabitusError(
            f"convention is {convention!r}; expected one of {', '.join(CONVENTIONS)}"
        )
    try:
        if path.suffix.lower() == ".npy":
            return _freemocap(path, rate_hz, convention)
        cameras = dict(_cameras(path))
        read = {name: _camera(where) for name, where in cameras.items()}
    except OSError as error:
        raise HabitusError(
            f"{path}: {shown(error.strerror or error)}; expected a folder with detections of each "
            "camera"
        ) from error
    everybody = (row for frames, _ in read.values() for people in frames.values() for row in people)
    if not any((row[:, 2] > 0.0).any() for row in everybody):
        raise HabitusError(
            f"{path}: no person was detected in {listed(read)}; expected OpenPose's, MMPose's, "
            "AlphaPose's or DeepLabCut's detections"
        )
    named = {names for _, names in read.values() if names is not None}
    everyone = [frames for frames, _ in read.values()]
    chosen, known = _convention(path, everyone, named, convention, own_names)
    return _stacked(path, read, rate_hz, chosen, known)


def read_names(names: Mapping[str, str] | PathLike | None) -> Mapping[str, str]:
    """Keypoints by a file's own names, of a dictionary or a .toml. Raises HabitusError for unknown
    keypoints.
    """
    if names is None:
        return {}
    if isinstance(names, Mapping):
        table, where = dict(names), "names"
    else:
        where = str(names)
        try:
            table = tomllib.loads(read_text_file(Path(names)))
        except (OSError, UnicodeDecodeError, ValueError) as error:
            raise HabitusError(f"{where}: is no TOML ({shown(error, 80)})") from error
    for own, name in table.items():
        if not isinstance(name, str) or not known_keypoint(name):
            raise HabitusError(
                f"{where}: {shown(own)} is {shown(name)}; expected a keypoint such as left_knee"
            )
    return {own: known_keypoint(name) for own, name in table.items()}


def _cameras(path: Path) -> Iterator[tuple[str, Path]]:
    """Names of cameras and where their detections are."""
    if path.is_file():
        yield plain_name(path.stem), path
        return
    if not path.is_dir():
        raise HabitusError(f"{path}: no such folder; expected detections of each camera")
    inner = sorted(path.iterdir(), key=lambda p: numeric_order(p.name))
    folders = [p for p in inner if p.is_dir() and (any(p.glob("*.json")) or any(p.glob("*.npz")))]
    files = [p for p in inner if p.is_file() and p.suffix.lower() in (".json", ".csv")]
    if not folders and not files:
        deeper = [
            p for p in inner if p.is_dir() and p.name.lower() in ("pose", "keypoints", "json")
        ]
        for one in deeper:
            yield from _cameras(one)
        if not deeper:
            raise HabitusError(
                f"{path}: holds no detections; expected a folder with *.json, or a .json or .csv, "
                "for each camera"
            )
    if folders:
        yield from ((plain_name(p.name), p) for p in folders)
    elif len(files) > 1 and all(_number(p) is not None for p in files) and _is_frame(files[0]):
        yield plain_name(path.name), path
    else:
        yield from ((plain_name(p.stem), p) for p in files)


def _number(path: Path) -> int | None:
    """The last number in a file's name."""
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1][-9:]) if digits else None


def _is_frame(path: Path) -> bool:
    """Whether a file holds one frame, as OpenPose writes it."""
    table = _json(path) if path.suffix.lower() == ".json" else None
    return isinstance(table, Mapping) and "people" in table


def _json(path: Path) -> Any:
    try:
        return read_json(read_text_file(path))
    except (HabitusError, UnicodeDecodeError) as error:
        raise HabitusError(f"{path}: is no JSON ({shown(error, 120)}); get it again") from error


def _camera(where: Path) -> tuple[dict[int, Frame], tuple[str, ...] | None]:
    """The frames of one camera, and the names of its points where the files have them."""
    if where.is_file() and where.suffix.lower() == ".csv":
        return _table(where)
    if where.is_file():
        return _whole(where)
    if any(where.glob("*.npz")):
        return sam3d_frames(where)
    frames: dict[int, Frame] = {}
    paths = sorted(where.glob("*.json"), key=lambda p: numeric_order(p.name))
    check_count(len(paths), MAX_FRAMES, f"{where}: frames")
    for k, path in enumerate(paths):
        number = _number(path)
        table = _json(path)
        people = table.get("people") if isinstance(table, Mapping) else None
        if not isinstance(people, list):
            raise HabitusError(f"{path}: has no people; expected a frame in OpenPose's form")
        frames[k if number is None else number] = _people(people, path)
    return frames, None


def _whole(path: Path) -> tuple[dict[int, Frame], tuple[str, ...] | None]:
    """A file that holds all frames of a camera: MMPose's, AlphaPose's, COCO's; or one frame."""
    table = _json(path)
    if isinstance(table, Mapping) and "instance_info" in table:
        return _mmpose(table, path)
    if isinstance(table, Mapping) and "people" in table:
        return {0: _people(table["people"], path)}, None
    rows = table.get("annotations") if isinstance(table, Mapping) else table
    if not isinstance(rows, list):
        raise HabitusError(
            f"{path}: is in no form that is understood; expected MMPose's instance_info, "
            "AlphaPose's list, COCO's annotations or OpenPose's people"
        )
    frames: dict[int, Frame] = {}
    for row in rows:
        if not isinstance(row, Mapping) or "keypoints" not in row:
            raise HabitusError(f"{path}: an entry has no keypoints; expected AlphaPose's or COCO's")
        digits = re.findall(r"\d+", str(row.get("image_id", "")))
        if not digits:
            raise HabitusError(f"{path}: an entry has no image_id with a number; expected one")
        frames.setdefault(int(digits[-1][-9:]), []).extend(_people([row], path))
    return frames, None


def _mmpose(
    table: Mapping[str, Any], path: Path
) -> tuple[dict[int, Frame], tuple[str, ...] | None]:
    meta = table.get("meta_info")
    names = meta.get("keypoint_id2name") if isinstance(meta, Mapping) else None
    order = None
    if isinstance(names, Mapping):
        keys = sorted(names, key=lambda key: numeric_order(str(key)[:20]))
        order = tuple(str(names[key]) for key in keys)
    frames: dict[int, Frame] = {}
    for k, info in enumerate(table["instance_info"]):
        people = []
        for one in info.get("instances", ()) if isinstance(info, Mapping) else ():
            at = _array(one.get("keypoints"), path)
            sure = _array(one.get("keypoint_scores"), path).ravel()
            if at.ndim != 2 or at.shape[1] < 2 or len(sure) != len(at):
                raise HabitusError(f"{path}: keypoints and scores do not fit each other")
            people.append(checked(np.column_stack([at[:, :2], sure])))
        number = info.get("frame_id", k) if isinstance(info, Mapping) else k
        frames[number if isinstance(number, int) else k] = people[:MAX_PEOPLE]
    return frames, order


def _people(people: Sequence[Any], path: Path) -> Frame:
    """People as OpenPose and COCO write them: flat lists of u, v, confidence."""
    found = []
    for person in people[:MAX_PEOPLE] if isinstance(people, list) else ():
        if not isinstance(person, Mapping):
            continue
        flat = _array(
            next((person[k] for k in ("pose_keypoints_2d", "keypoints") if k in person), None), path
        ).ravel()
        if len(flat) and len(flat) % 3 == 0:
            found.append(checked(flat.reshape(-1, 3)))
    return found


def _array(value: Any, path: Path) -> np.ndarray:
    try:
        return np.array([] if value is None else value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise HabitusError(
            f"{path}: keypoints are no numbers; expected u, v, confidence"
        ) from error


def _table(path: Path) -> tuple[dict[int, Frame], tuple[str, ...] | None]:
    """A table as CSV: DeepLabCut's, or SLEAP's."""
    try:
        rows = list(csv.reader(io.StringIO(read_text_file(path))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise HabitusError(f"{path}: is no table ({shown(error, 80)}); get it again") from error
    return _sleap(rows, path) if rows and SLEAP_FRAME in rows[0] else _deeplabcut(rows, path)


def _sleap(
    rows: Sequence[Sequence[str]], path: Path
) -> tuple[dict[int, Frame], tuple[str, ...] | None]:
    """SLEAP's analysis as CSV: a row for each animal and frame, columns NODE.x, NODE.y and, where
    there are scores, NODE.score.
    """
    column = {head: k for k, head in enumerate(rows[0])}
    names = tuple(h.removesuffix(".x") for h in rows[0] if h.endswith(".x"))
    check_count(len(names), MAX_NAMES, f"{path}: nodes")
    if not names or any(f"{name}.y" not in column for name in names):
        raise HabitusError(f"{path}: has no columns NODE.x and NODE.y; expected SLEAP's analysis")
    frames: dict[int, Frame] = {}
    for row in rows[1:]:
        number = row[column[SLEAP_FRAME]] if len(row) == len(rows[0]) else ""
        if not number.isdigit():
            continue
        table = np.zeros((len(names), 3))
        for k, name in enumerate(names):
            table[k, :2] = _float(row[column[f"{name}.x"]]), _float(row[column[f"{name}.y"]])
            score = column.get(f"{name}.score")
            table[k, 2] = np.isfinite(table[k, :2]).all() if score is None else _float(row[score])
        people = frames.setdefault(int(number[-9:]), [])
        if len(people) < MAX_PEOPLE:
            people.append(checked(table))
    return frames, names


def _deeplabcut(
    rows: Sequence[Sequence[str]], path: Path
) -> tuple[dict[int, Frame], tuple[str, ...] | None]:
    """DeepLabCut's table: lines ``scorer``, (``individuals``), ``bodyparts``, ``coords``."""
    firsts = [row[0].lower() if row else "" for row in rows[:5]]
    last = firsts.index("coords") if "coords" in firsts else -1
    heads = dict(zip(firsts[: last + 1], rows, strict=False))
    if "bodyparts" not in heads:
        raise HabitusError(
            f"{path}: has no lines bodyparts and coords; expected DeepLabCut's table"
        )
    parts, coords = heads["bodyparts"], heads["coords"]
    owners = heads.get("individuals", [""] * len(parts))
    names = tuple(dict.fromkeys(parts[1:]))
    check_count(len(names), MAX_NAMES, f"{path}: body parts")
    people = list(dict.fromkeys(owners[1:]))[:MAX_PEOPLE]
    if not len(parts) == len(coords) == len(owners):
        raise HabitusError(f"{path}: its head lines differ in length; get it again")
    place = {"x": 0, "y": 1, "likelihood": 2}
    if not set(coords[1:]) <= set(place):
        raise HabitusError(
            f"{path}: coords are {listed(set(coords[1:]))}; expected x, y, likelihood"
        )
    frames: dict[int, Frame] = {}
    for row in rows[last + 1 :]:
        if len(row) != len(parts):
            continue
        table = np.zeros((len(people), len(names), 3))
        for owner, part, coord, text in zip(
            owners[1:], parts[1:], coords[1:], row[1:], strict=True
        ):
            if owner in people:
                with_value = _float(text)
                table[people.index(owner), names.index(part), place[coord]] = with_value
        digits = re.findall(r"\d+", row[0])
        frames[int(digits[-1][-9:]) if digits else len(frames)] = [checked(one) for one in table]
    return frames, names


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _convention(
    path: Path,
    read: Sequence[dict[int, Frame]],
    named: set[tuple[str, ...]],
    asked: str | None,
    own_names: Mapping[str, str],
) -> tuple[str, tuple[str, ...]]:
    """The convention, and the names of all points, "" for those that are not used."""
    if named == {MHR70} and asked in (None, "mhr70"):
        return "mhr70", MHR70
    people = [row for frames in read for frame in frames.values() for row in frame]
    counts = {len(row) for row in people}
    if len(counts) > 1:
        raise HabitusError(
            f"{path}: people have {listed(map(str, sorted(counts)))} keypoints; expected one number"
        )
    (count,) = counts
    if not count:
        raise HabitusError(f"{path}: people have no keypoints; expected a detector's")
    if asked is not None:
        names = CONVENTIONS[asked]
        if count < len(names):
            raise HabitusError(f"{path}: {count} keypoints; {asked} has {len(names)}")
        return asked, (*names, *[""] * (count - len(names)))
    if len(named) > 1:
        raise HabitusError(f"{path}: cameras name their keypoints differently; expected one list")
    if named:
        said = next(iter(named))
        names = tuple(own_names.get(name, known_keypoint(name)) for name in said)
        if own_names and not set(own_names) <= set(said):
            raise HabitusError(
                f"{path}: has no {listed(sorted(set(own_names) - set(said)))}, which the names "
                f"map; its keypoints are {listed(said)}"
            )
        if len(names) == count and sum(map(bool, names)) >= 8:
            return "named", names
        if sum(map(bool, names)) < count:
            raise HabitusError(
                f"{path}: {sum(map(bool, names))} of its keypoints have known names; expected 8 or "
                f"more of {listed(said)}: map them (--names FILE)"
            )
    if count in (133, 136):  # COCO-WholeBody and Halpe with faces and hands: the body comes first
        own = "wholebody23" if count == 133 else "halpe26"
        return own, (*CONVENTIONS[own], *[""] * (count - len(CONVENTIONS[own])))
    some = people[:: max(1, len(people) // SAMPLE)]
    together = np.stack(some)
    try:
        chosen = convention_of(together[..., :2], together[..., 2])
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}; or name it (--convention)") from error
    return chosen, CONVENTIONS[chosen]


def known_keypoint(name: str) -> str:
    """A keypoint of the table by a file's name: ``LShoulder``, ``left shoulder``; "" for none."""
    low = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().replace(" ", "_").replace("-", "_")
    low = re.sub(r"^(l|r)_", lambda m: {"l": "left_", "r": "right_"}[m[1]], low)
    low = re.sub(r"^(l|r)(?=[a-z])(?!eft|ight)", lambda m: {"l": "left_", "r": "right_"}[m[1]], low)
    try:
        keypoint_place(low)
    except HabitusError:
        return ""
    return low


def _stacked(
    path: Path,
    read: Mapping[str, tuple[dict[int, Frame], tuple[str, ...] | None]],
    rate_hz: float,
    convention: str,
    names: tuple[str, ...],
) -> Detections:
    """All cameras over the frames from the first to the last that any has."""
    notes = []
    numbers = [set(frames) for frames, _ in read.values()]
    first = min(min(own) for own in numbers if own)
    last = max(max(own) for own in numbers if own)
    check_count(last - first + 1, MAX_FRAMES, f"{path}: frames")
    if last - first + 1 > 4 * max(map(len, numbers)) + 100:
        raise HabitusError(
            f"{path}: frames are numbered from {first} to {last}, but a camera has "
            f"{max(map(len, numbers))} at most; expected numbers that follow each other"
        )
    missing = {name: last - first + 1 - len(frames) for name, (frames, _) in read.items()}
    if any(missing.values()):
        some = listed([f"{name} {count}" for name, count in missing.items() if count])
        notes.append(f"frames without a file: {some}")
    kept = [k for k, name in enumerate(names) if name]
    most = max(len(people) for frames, _ in read.values() for people in frames.values())
    shape = (last - first + 1, len(read), max(1, most), len(kept))
    stored = sum(len(people) for frames, _ in read.values() for people in frames.values())
    Allowance(24 * stored * len(names)).take(int(np.prod(shape)) * 3, 8, f"{path}: its frames")
    pixels = np.full((*shape, 2), np.nan)
    confidence = np.zeros(shape)
    for c, (frames, _) in enumerate(read.values()):
        for number, people in frames.items():
            for p, row in enumerate(people):
                seen = row[kept, 2] > 0.0
                pixels[number - first, c, p] = np.where(seen[:, None], row[kept, :2] + 0.5, np.nan)
                confidence[number - first, c, p] = row[kept, 2]
    most_sure = float(confidence.max(initial=0.0))
    if most_sure > 1.0:
        notes.append(f"scores reach {most_sure:.3g}; they were divided by their 99th percentile")
        confidence = confidence / max(1.0, float(np.percentile(confidence[confidence > 0], 99)))
    return Detections(
        plain_name(path.resolve().name),
        convention,
        tuple(names[k] for k in kept),
        tuple(read),
        pixels,
        np.clip(confidence, 0.0, 1.0),
        float(rate_hz),
        tuple(notes),
        first,
    )


def _freemocap(path: Path, rate_hz: float, convention: str | None) -> Detections:
    """FreeMoCap's 2D points: (cameras, frames, points, 2 or 3)."""
    table = read_npy(path)
    if table.ndim != 4 or table.shape[3] not in (2, 3) or not np.issubdtype(table.dtype, np.number):
        raise HabitusError(
            f"{path}: an array of {table.shape}; expected (cameras, frames, points, 2 or 3)"
        )
    if table.shape[1] > MAX_FRAMES:
        raise HabitusError(f"{path}: {table.shape[1]} frames; expected {MAX_FRAMES} at most")
    own = convention or ("blazepose33" if table.shape[2] >= 33 else "")
    if own not in CONVENTIONS or table.shape[2] < len(CONVENTIONS[own]):
        raise HabitusError(
            f"{path}: {table.shape[2]} points without names; name their order (--convention)"
        )
    names = CONVENTIONS[own]
    at = np.moveaxis(table[:, :, : len(names), :2].astype(float), 0, 1)[:, :, None]
    with np.errstate(invalid="ignore"):
        seen = np.asarray(np.isfinite(at).all(-1) & (np.abs(at) < MAX_PIXEL).all(-1))
    if not seen.any():
        raise HabitusError(f"{path}: an array of {table.shape} without a point in any frame")
    sure = seen.astype(float)
    pixels = np.where(seen[..., None], at + 0.5, np.nan)
    cameras = tuple(f"cam{k}" for k in range(len(table)))
    return Detections(plain_name(path.stem), own, names, cameras, pixels, sure, float(rate_hz))
