"""From the files of sessions to one set of registrations, and the table of what the gates measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.errors import HabitusError
from habitus.io.files import atomic_write

from .poses import mirrored_pose


def gather(folder: Path, out: Path) -> list[dict]:
    """Write the poses that pass, and their mirror images, to `out`; gives what was measured of all.

    The file has what `habitus train` reads (vertices, faces, subject, sex, set, name) and poses (N, 55, 3), betas and
    ages besides. Every person's rest comes first. Mirror images are of the mirrored person, who is another one.
    """
    files = sorted(path for path in folder.glob("*/*.npz"))
    if not files:
        raise HabitusError(f"{folder}: no sessions in it; simulate first")
    body = load_body("female", detail="full", joints="smplx")
    rows: dict[str, list] = {key: [] for key in ("vertices", "poses", "subject", "sex", "set", "name", "betas", "age")}
    measured: list[dict] = []
    known: set[str] = set()
    for path in files:
        person = path.parent.name
        with np.load(path) as found:
            told = [json.loads(str(text)) for text in found["gauges"]]
            measured += [one | {"person": person, "name": str(n)} for one, n in zip(told, found["names"], strict=True)]
            good = [k for k, one in enumerate(told) if one["passes"]]
            items = [(found["vertices"][k], found["poses"][k], str(found["names"][k])) for k in good]
            if person not in known:
                known.add(person)
                items.insert(0, (found["rest"], np.zeros(found["poses"].shape[1:]), "rest"))
            for vertices, pose, name in items:
                turned = vertices[body.mirror] * np.float32([-1, 1, 1])
                both = ((vertices, pose, ""), (turned, mirrored_pose(pose, body.joint_names), "m"))
                for points, turns, mark in both:
                    values = points, turns, person + mark, person[:-2], "pose", name, found["betas"], found["age"]
                    for key, value in zip(rows, values, strict=True):
                        rows[key].append(value)
    _write(out, rows, body.faces)
    return measured


def _write(out: Path, rows: dict[str, list], faces: np.ndarray) -> None:
    order = np.argsort(np.array(rows["subject"]), kind="stable")
    with atomic_write(out) as temporary, temporary.open("wb") as file:
        np.savez(file, faces=faces, **{key: np.array(value)[order] for key, value in rows.items()})


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
