"""From the files of sessions to registrations that `habitus train` reads, and the table of what the gates measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.io.files import atomic_write

from .gates import judged
from .poses import mirrored_pose
from .studio import SKIN, below

HELD_PERSON, HELD_POSE = 6, 8  # every so manieth person, and of the others every so manieth pose, is of the set "test"
FIRM, RAMP = 0.95, 0.6  # skin this much of head, hands and feet is not simulated; weights fall to 0 over the ramp


def gather(folder: Path, out: Path) -> list[dict]:
    """Write the poses that pass, a file a person in a folder a sex, as `habitus train` reads them; gives all gauges.

    Each person is followed by the mirror image, who is another one. A file has vertices, faces, subject, sex, set,
    name, pose (N, 55, 3), the rest surface, and weights of vertices: 0 where skin only follows the bones.
    """
    found = {person.name: sorted(person.glob("*.npz")) for person in sorted(folder.glob("*male[0-9]*"))}
    if not any(found.values()):
        raise HabitusError(f"{folder}: no sessions in it; simulate first")
    measured: list[dict] = []
    for number, (person, files) in enumerate((name, files) for name, files in found.items() if files):
        sex = person.rstrip("0123456789")
        body = load_body(sex, detail="full", joints="smplx")
        vertices, poses, names, rest, gauges = _sessions(files)
        measured += [one | {"person": person, "name": name} for one, name in zip(gauges, names, strict=True)]
        good = np.array([one["passes"] for one in gauges])
        sets = np.where((np.arange(len(good)) % HELD_POSE == HELD_POSE - 1), "test", "pose")
        sets[:] = "test" if number % HELD_PERSON == HELD_PERSON - 1 else sets
        turned = np.array([mirrored_pose(pose, body.joint_names) for pose in poses])
        for mark, points, turns, still in (
            ("", vertices, poses, rest),
            ("m", _mirrored(vertices, body.mirror), turned, _mirrored(rest, body.mirror)),
        ):
            labels = [f"{person}{mark}-{name}" for name in names]
            words = {"subject": [person + mark] * len(good), "sex": [sex] * len(good), "set": sets, "name": labels}
            rows = {key: np.array(value)[good] for key, value in (words | {"vertices": points, "pose": turns}).items()}
            _write(
                out / sex / f"{person}{mark}.npz",
                rows | {"faces": body.faces, "rest": still[None], "weights": simulated(body)},
            )
    return measured


def simulated(body: BodyModel) -> np.ndarray:
    """(V,) 0 for skin of head, hands, feet and for eyeballs, which follow the bones, 1 elsewhere, a ramp between."""
    ends = np.zeros(body.num_vertices)
    for name in ("head", "left_foot", "right_foot", "left_wrist", "right_wrist"):
        joints = below(body, name)[name.endswith("wrist") :]  # of a wrist, the hand
        ends += body.skinning_weights[:, joints].sum(axis=1)
    weights = np.clip((FIRM - ends) / RAMP, 0, 1).astype(np.float32)
    weights[SKIN:] = 0
    return weights


def _sessions(files: list[Path]) -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray, list[dict]]:
    """Vertices, poses, names, rest and gauges of one person."""
    parts = []
    for path in files:
        with np.load(path) as one:
            parts.append({key: one[key] for key in ("vertices", "poses", "names", "rest", "gauges")})
    names = [f"{path.stem}-{name}" for path, part in zip(files, parts, strict=True) for name in part["names"]]
    gauges = [judged(json.loads(str(text))) for part in parts for text in part["gauges"]]
    vertices, poses = (np.concatenate([part[key] for part in parts]) for key in ("vertices", "poses"))
    return vertices, poses, names, parts[0]["rest"], gauges


def _mirrored(points: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    return points[..., mirror, :] * np.float32([-1, 1, 1])


def _write(out: Path, arrays: dict[str, np.ndarray]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(out) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def table(measured: list[dict]) -> str:
    """Shares and percentiles over all poses."""

    def column(key: str) -> np.ndarray:
        return np.array([one[key] for one in measured], float)

    good = np.array([one["passes"] for one in measured])
    lines = [f"{len(measured)} poses of {len({one['person'] for one in measured})} people, {good.mean():.1%} pass"]
    lines.append(f"inverted tetrahedra in {(column('inverted') > 0).sum()} poses")
    for key, unit in (("whole", "%"), ("limb", "%"), ("pairs", ""), ("steps", "")):
        low, middle, high = np.percentile(column(key), (5, 50, 95))
        lines.append(f"{key}: {low:.2f} / {middle:.2f} / {high:.2f} {unit} (5th, 50th, 95th percentile)")
    for group in measured[0]["bones"]:
        each = np.array([one["bones"][group] for one in measured])
        lines.append(
            f"bones of {group}: median {np.median(each):.1f} mm, 95th percentile {np.percentile(each, 95):.1f}"
        )
    return "\n".join(lines)
