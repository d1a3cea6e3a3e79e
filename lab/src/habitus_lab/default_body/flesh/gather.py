"""From the files of sessions to registrations that `habitus train` reads, and the table of what the
gates measured.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.learn.posing.rig import Rig
from habitus.learn.posing.surface import posed

from .gates import judged
from .poses import mirrored_pose
from .studio import SKIN, below
from .touching import averaging, drawn_apart

HELD_PERSON = 6
HELD_POSE = 7
"""Every so manieth person, and of the others every so manieth pose, is of the set "test"; sessions
have other numbers of stops, so that no stop is always held out.
"""
FIRM = 0.95
RAMP = (
    0.6  # skin this much of head, hands and feet is not simulated; weights fall to 0 over the ramp
)
SLIGHT = 0.004
DEAREST = (
    3.0  # m by which skinning is off: so much counts twice, and nothing more than so many times
)


def gather(folder: Path, out: Path) -> list[dict]:
    """Write the poses that pass, a file a person in a folder a sex, as `habitus train` reads them;
    gives all gauges.

    Each person is followed by the mirror image, who is another one. A file has vertices, faces,
    subject, sex, set, name, pose (N, 55, 3), trans, the rest surface, and weights (N, V): 0 where
    skin only follows the bones, and most where skinning is far off, in the creases. Touching skin
    is drawn apart in what is learned from, not in the set "test". A person whose sessions are older
    than the file is not written again.
    """
    found = {
        person.name: sorted(person.glob("*.npz")) for person in sorted(folder.glob("*male[0-9]*"))
    }
    if not any(found.values()):
        raise HabitusError(f"{folder}: no sessions in it; simulate first")
    measured: list[dict] = []
    for person, files in ((name, files) for name, files in found.items() if files):
        sex = person.rstrip("0123456789")
        vertices, poses, names, rest, gauges = _sessions(files)
        measured += [
            one | {"person": person, "name": name} for one, name in zip(gauges, names, strict=True)
        ]
        last = out / sex / f"{person}m.npz"
        if last.exists() and last.stat().st_mtime > max(path.stat().st_mtime for path in files):
            continue
        good = np.flatnonzero([one["passes"] for one in gauges])
        held = int(person.removeprefix(sex)) % HELD_PERSON == HELD_PERSON - 1
        tested = held | (np.arange(len(good)) % HELD_POSE == HELD_POSE - 1)
        _write_person(
            out / sex,
            person,
            _Person(sex, rest, vertices[good], poses[good], tested),
            np.array(names)[good],
        )
    return measured


@dataclass(frozen=True, eq=False)
class _Person:
    """Rest surface (V, 3), posed ones (N, V, 3), poses (N, J, 3), and which are of the set "test"
    (N,).
    """

    sex: str
    rest: np.ndarray
    vertices: np.ndarray
    poses: np.ndarray
    tested: np.ndarray


def _write_person(folder: Path, name: str, person: _Person, names: np.ndarray) -> None:
    body = load_body(person.sex, detail="full", joints="smplx")
    weights = _weights(body, person)
    vertices = _apart(body, person)
    turned = mirrored_pose(person.poses, body.joint_names)
    for mark, points, poses, still, counts in (
        ("", vertices, person.poses, person.rest, weights),
        (
            "m",
            _mirrored(vertices, body.mirror),
            turned,
            _mirrored(person.rest, body.mirror),
            weights[:, body.mirror],
        ),
    ):
        rows = {
            "subject": np.full(len(names), name + mark),
            "sex": np.full(len(names), person.sex),
            "set": np.where(person.tested, "test", "pose"),
            "name": np.array([f"{name}{mark}-{one}" for one in names]),
        }
        rows |= {
            "vertices": points,
            "pose": poses,
            "weights": counts,
            "rest": still[None],
            "faces": body.faces,
        }
        rows["trans"] = np.zeros((len(names), 3))  # a simulated pelvis stays where it is
        _write(folder / f"{name}{mark}.npz", rows)


def _apart(body: BodyModel, person: _Person) -> np.ndarray:
    """The surfaces that are learned from with touching skin drawn apart, the others as they are."""
    faces = body.faces[(body.faces < SKIN).all(1)]
    neighbours = averaging(faces, SKIN)
    found = person.vertices.copy()
    for k in np.flatnonzero(~person.tested):
        found[k, :SKIN] = drawn_apart(
            person.vertices[k, :SKIN].astype(float), person.rest[:SKIN], faces, neighbours
        )
    return found


def _weights(body: BodyModel, person: _Person) -> np.ndarray:
    """(N, V) how much each vertex of each surface counts: more where skinning is far off, alike in
    the set "test".
    """
    index = np.asarray(body.skinning_index)
    value = np.asarray(body.skinning_value, float)
    rig = Rig(tuple(body.parents), "lbs", "rotations", 0, index, value, None)
    rest = person.rest.astype(float)
    known = simulated(body)
    joints = body.joint_regressor @ rest
    found = np.empty(person.vertices.shape[:2], np.float32)
    for k, (vertices, pose) in enumerate(zip(person.vertices, person.poses, strict=True)):
        away = vertices - posed(rig, pose).vertices(rest, joints)
        off = np.linalg.norm(away - np.median(away, 0), axis=1) / SLIGHT
        found[k] = known if person.tested[k] else known * np.minimum(1 + off**2, DEAREST) / DEAREST
    return found


def simulated(body: BodyModel) -> np.ndarray:
    """(V,) 0 for skin of head, hands, feet and for eyeballs, which follow the bones, 1 elsewhere, a
    ramp between.
    """
    ends = np.zeros(body.num_vertices)
    for name in ("head", "left_foot", "right_foot", "left_wrist", "right_wrist"):
        joints = below(body, name)[name.endswith("wrist") :]  # of a wrist, the hand
        ends += body.skinning_weights[:, joints].sum(axis=1)
    weights = np.clip((FIRM - ends) / RAMP, 0, 1).astype(np.float32)
    weights[SKIN:] = 0
    return weights


def _sessions(
    files: list[Path],
) -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray, list[dict]]:
    """Vertices, poses, names, rest and gauges of one person."""
    parts = []
    for path in files:
        with np.load(path) as one:
            parts.append(
                {key: one[key] for key in ("vertices", "poses", "names", "rest", "gauges")}
            )
    names = [
        f"{path.stem}-{name}"
        for path, part in zip(files, parts, strict=True)
        for name in part["names"]
    ]
    gauges = [judged(json.loads(str(text))) for part in parts for text in part["gauges"]]
    vertices, poses = (
        np.concatenate([part[key] for part in parts]) for key in ("vertices", "poses")
    )
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
    lines = [
        f"{len(measured)} poses of {len({one['person'] for one in measured})} people, "
        f"{good.mean():.1%} pass"
    ]
    lines.append(f"inverted tetrahedra in {(column('inverted') > 0).sum()} poses")
    for key, unit in (("whole", "%"), ("limb", "%"), ("pairs", ""), ("steps", "")):
        low, middle, high = np.percentile(column(key), (5, 50, 95))
        lines.append(
            f"{key}: {low:.2f} / {middle:.2f} / {high:.2f} {unit} (5th, 50th, 95th percentile)"
        )
    for group in measured[0]["bones"]:
        each = np.array([one["bones"][group] for one in measured])
        lines.append(
            f"bones of {group}: median {np.median(each):.1f} mm, 95th percentile "
            f"{np.percentile(each, 95):.1f}"
        )
    return "\n".join(lines)
