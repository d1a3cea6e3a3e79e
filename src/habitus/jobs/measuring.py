"""Measurements of what a file holds: a body model, a person of one, a fit, or a mesh."""

import csv
import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from habitus.body.measurement_names import DEFINITIONS, LEVEL_ARMS, Definition, posture_of
from habitus.body.measurements import DENSITY, is_closed, surface_area, volume
from habitus.body.model import BodyModel
from habitus.body.recentred import is_of, misfit, turned_by
from habitus.body.seated import SEATED, SEATED_POSTURE, UNRELIABLE
from habitus.body.segments import SegmentMasses, surface_masses
from habitus.errors import HabitusError
from habitus.export.measurements import program_of, write_measurements
from habitus.files import write_text
from habitus.io.meshes import ENDINGS as MESHES
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import load_body
from habitus.io.people import read_shape
from habitus.report.diagrams import tape_picture
from habitus.results.save import measurements_csv
from habitus.types import PathLike

POSE = (
    "upright, arms level to the sides (T-pose); with hanging arms and heels together where "
    "the posture says so"
)
UNLOADED = (
    "flesh under load is not simulated; docs/measurements.md lists the error of each dimension"
)
_SEGMENTS = {
    "pelvis": "trunk", "hip": "thigh", "knee": "shank", "ankle": "foot", "foot": "toes",
    "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "hand": "fingers",
}  # fmt: skip
"""What moves with these joints; the trunk includes the spine and the collar bones."""
SPACES = ("neutral", "female", "male")
SEXES = ("female", "male")
_PERSON = (0.3, 2.6)  # metres from sole to crown
_END = 0.05  # of the height: within it a hole is at the end of a body
_MAX_CUT = 0.3  # of the height: a wider hole is a cut through a body; below a skirt it is narrower
_TURNED = np.deg2rad(8.0)  # a bone of a mesh at rest lies this near to the body's own


@dataclass(frozen=True, eq=False)
class Measurements:
    """What a file's person measures: ``values`` by name (m, kg), and what must be known of them.

    ``body`` and ``rest_vertices`` (V, 3) are what was measured; None where the mesh is of no known
    body. ``posture``: "standing" or "seated".
    """

    source: str
    values: Mapping[str, float]
    notes: tuple[str, ...] = ()
    body: BodyModel | None = None
    rest_vertices: Float[np.ndarray, "V 3"] | None = None
    posture: str = "standing"

    @property
    def definitions(self) -> Mapping[str, Definition]:
        """What each measurement is in this posture."""
        return SEATED if self.posture == "seated" else DEFINITIONS

    def save(self, path: PathLike, program: str = "") -> None:
        """Write them as .json or .csv, or for a pattern program: "garmentcode" (.yaml), "seamly"
        (.smis, .vit) or "freesewing" (.json), which but for .json the ending says.

        Raises HabitusError for another ending or where nothing can be written.
        """
        target = Path(path)
        program = program or program_of(target)
        if program and program != "habitus":
            if self.posture != "standing":
                raise HabitusError(
                    f"{target.name}: pattern programs take standing people; expected .json or .csv "
                    "for seated measurements"
                )
            sex = "" if self.body is None or self.body.name not in SEXES else self.body.name
            write_measurements(self.values, target, program, sex)
            return
        make = {".json": self._json, ".csv": self._csv}.get(target.suffix.lower())
        if make is None:
            raise HabitusError(
                f"cannot write measurements to {target.name}: expected a name in .json, .csv, "
                ".smis, .vit, .yaml"
            )
        write_text(target, make())

    @cached_property
    def segments(self) -> SegmentMasses | None:
        """Volume, mass, centre of mass and inertia of each part at rest, of the whole mass of the
        person, whatever the posture; None where nothing but a mesh is known.

        Raises HabitusError for a surface that is not closed.
        """
        if self.body is None or self.rest_vertices is None:
            return None
        standing = self.posture == "standing"
        values = self.values if standing else self.body.measure_rest(self.rest_vertices)
        mass = values.get("mass_kg")
        source = "volume times the density of adults of such a waist"
        return surface_masses(self.body, self.rest_vertices, mass, source, whole_trunk=True)

    def segment_rows(self) -> dict[str, dict[str, Any]]:
        """What is known of each segment with a volume: ``volume_m3``, ``mass_kg``, ``centre_m``
        (3,) in body space at rest, ``inertia_kg_m2`` (3, 3) about it. Raises HabitusError where
        there are none.
        """
        parts = self.segments
        if parts is None or self.body is None:
            raise HabitusError(
                f"{self.source}: a mesh of no known body has no segments; expected a body of "
                "habitus, its fit or its mesh"
            )
        return {
            _segment(name): {
                "volume_m3": float(parts.volume[k]),
                "mass_kg": float(parts.mass[k]),
                "centre_m": parts.centre[k].tolist(),
                "inertia_kg_m2": parts.inertia[k].tolist(),
            }
            for k, name in enumerate(self.body.joint_names)
            if parts.volume[k] > 0.0
        }

    def save_segments(self, path: PathLike) -> None:
        """Write the segments as .json or .csv. Raises HabitusError for another ending, and where
        there are none.
        """
        target = Path(path)
        make = {".json": self._segments_json, ".csv": self._segments_csv}.get(target.suffix.lower())
        if make is None:
            raise HabitusError(
                f"cannot write segments to {target.name}: expected a name in .json, .csv"
            )
        write_text(target, make())

    def _segments_json(self) -> str:
        rows = self.segment_rows()
        facts = {
            "source": self.source,
            "pose": LEVEL_ARMS,
            "frame": "body space at rest: metres, x to the body's left, y up, z ahead",
            "mass": self.segments.source if self.segments else "",
            "segments": rows,
        }
        return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"

    def _segments_csv(self) -> str:
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        axes = [f"i{each}_kg_m2" for each in ("xx", "yy", "zz", "xy", "xz", "yz")]
        rows.writerow(("segment", "volume_m3", "mass_kg", "x_m", "y_m", "z_m", *axes))
        for name, part in self.segment_rows().items():
            (xx, xy, xz), (_, yy, yz), (_, _, zz) = part["inertia_kg_m2"]
            numbers = (part["volume_m3"], part["mass_kg"], *part["centre_m"])
            rows.writerow((name, *(f"{v:.6g}" for v in (*numbers, xx, yy, zz, xy, xz, yz))))
        return text.getvalue()

    def draw(self, path: PathLike) -> None:
        """Write a picture (.svg) of the person with every tape. Raises HabitusError where there is
        none to draw.
        """
        target = Path(path)
        if target.suffix.lower() != ".svg":
            raise HabitusError(
                f"cannot draw {target.name}: expected a name in .svg, which browsers open"
            )
        if self.posture != "standing":
            raise HabitusError(
                f"cannot draw {target.name}: expected posture standing; seated dimensions have no "
                "picture"
            )
        if self.body is None or self.rest_vertices is None:
            raise HabitusError(f"{self.source}: no tapes were laid on it, so there is none to draw")
        write_text(target, tape_picture(self.body, self.rest_vertices, self.values))

    def _json(self) -> str:
        facts = {
            "source": self.source,
            "pose": POSE if self.posture == "standing" else SEATED_POSTURE,
            "notes": list(self.notes),
            "measurements": dict(self.values),
            "postures": {
                name: posture_of(name) if self.posture == "standing" else SEATED_POSTURE
                for name in self.values
            },
        }
        return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"

    def _csv(self) -> str:
        return measurements_csv(self.values, self.definitions)


def _segment(joint: str) -> str:
    """A segment's name, of its joint's."""
    side, _, plain = joint.rpartition("_")
    return f"{side}_{_SEGMENTS[plain]}".lstrip("_") if plain in _SEGMENTS else joint


def measure_file(
    path: PathLike, body: PathLike | BodyModel | None = None, posture: str = "standing"
) -> Measurements:
    """The measurements of the person in a file.

    A body model (npz, pkl; its mean person), or "default", "female", …; an npz with ``betas`` (a
    fit's body.npz, AMASS); a mesh (ply, obj; metres, y up). body: that which betas or mesh belong
    to, where the file does not say it. posture: "standing", or "seated" (`habitus.body.seated`).
    Of a mesh of a body of habitus all is measured if it is at rest; of another only what needs no
    anatomy, height and mass, standing. Raises HabitusError for a file that is none of these, and
    for a posed mesh.
    """
    source = Path(path)
    if source.suffix.lower() in MESHES:
        return _of_mesh(source, body, posture)
    person = read_shape(source, body)
    rest = person.rest_vertices()
    return _measured(str(path), person.body, rest, posture)


def _measured(source: str, body: BodyModel, rest: np.ndarray, posture: str) -> Measurements:
    values = body.measure_rest(rest, posture)
    if not values:
        lacking = "measurement landmarks" if posture == "standing" else "arms and legs to sit with"
        raise HabitusError(f"{source}: {body.name} has no {lacking}; use a human body")
    notes = () if posture == "standing" else (UNLOADED, f"not reliable: {', '.join(UNRELIABLE)}")
    return Measurements(source, values, notes, body, rest, posture)


def _loaded(body: PathLike | BodyModel) -> BodyModel:
    return body if isinstance(body, BodyModel) else load_body(os.fspath(body))


def _of_mesh(source: Path, body: PathLike | BodyModel | None, posture: str) -> Measurements:
    vertices, faces = read_mesh(source)
    models = [_loaded(name) for name in SPACES] if body is None else [_loaded(body)]
    levels = [level for model in models for level in (model, model.full) if level is not None]
    known = [level for level in levels if is_of(level, vertices, faces)]
    if known:
        level = min(known, key=lambda level: misfit(level, vertices))
        return _of_known(source, level, vertices, posture)
    if body is not None:
        raise HabitusError(
            f"{source}: its {len(faces)} triangles are not those of {models[0].name}; give its "
            "own body"
        )
    if posture != "standing":
        raise HabitusError(f"{source}: a mesh of no known body cannot sit; expected a body's mesh")
    return _of_unknown(source, vertices, faces)


def _of_known(source: Path, body: BodyModel, vertices: np.ndarray, posture: str) -> Measurements:
    turned = turned_by(body, vertices)
    if turned > _TURNED:
        raise HabitusError(
            f"{source}: is posed (a limb is {np.rad2deg(turned):.0f} degrees from rest); "
            "measurements are taken at "
            "rest: give the body.npz that it comes from, or export it in the rest pose"
        )
    return _measured(str(source), body, vertices, posture)


def _of_unknown(source: Path, vertices: np.ndarray, faces: np.ndarray) -> Measurements:
    used = vertices[np.unique(faces)]
    height = float(np.ptp(used[:, 1]))
    if not _PERSON[0] < height < _PERSON[1]:
        raise HabitusError(
            f"{source}: {height:.3g} high along y; expected a person in metres, y up, "
            f"{_PERSON[0]} to {_PERSON[1]} m"
        )
    values = {"height_m": height}
    notes = ["the mesh is of no known body: only what needs no anatomy was measured"]
    if is_closed(faces):
        values["surface_area_m2"] = float(surface_area(vertices, faces))
        values["volume_m3"] = abs(float(volume(vertices, faces)))
        values["mass_kg"] = DENSITY * values["volume_m3"]
    else:
        notes.append("its surface has holes, so it was not weighed")
        width = _open_end(used[:, 1].min(), height, vertices, faces)
        if width > _MAX_CUT * height:
            raise HabitusError(
                f"{source}: its upper or lower end is open over {width:.2f} m of {height:.2f} m: a "
                "part of a body, whose extent is nobody's stature; expected a whole person"
            )
        if width > 0.0:
            notes.append(
                f"WARNING: its upper or lower end is open over {width:.2f} m; its extent is the "
                "stature only if crown and soles are in it"
            )
    notes.append("height is its extent along y, as if the person stands upright")
    return Measurements(str(source), values, tuple(notes))


def _open_end(
    lowest: float, height: float, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> float:
    """How wide (m) the widest hole is that reaches the upper or lower end of a mesh, y up; 0 where
    there is none.
    """
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, index, count = np.unique(np.sort(sides, 1), axis=0, return_index=True, return_counts=True)
    rims = sides[index[count == 1]]
    if not len(rims):
        return 0.0
    graph = coo_array((np.ones(len(rims)), tuple(rims.T)), shape=(len(vertices),) * 2)
    _, hole = connected_components(graph, directed=False)
    widest = 0.0
    for one in np.unique(hole[rims]):
        points = vertices[hole == one]
        level = (points[:, 1] - lowest) / height
        if level.min() < _END or level.max() > 1.0 - _END:
            widest = max(widest, float(np.ptp(points[:, [0, 2]], axis=0).max()))
    return widest
