"""``habitus export``: a motion, or a person at rest, as a file for other programs."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.errors import HabitusError
from habitus.export.motion import Exported, check_motion_path, export_motion
from habitus.export.rates import at_rate
from habitus.export.topology import check_topology_path, write_topology
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.io.motions.open import ENDINGS as RIG_ENDINGS
from habitus.io.people import BodyShape, Mesh, open_person
from habitus.io.topologies import load_topology
from habitus.jobs.topologies import solve_model
from habitus.types import PathLike


def export_file(
    source: Moving | PathLike,
    to: PathLike,
    *,
    body: BodyModel | PathLike | None = None,
    fps: float | None = None,
    correctives: str = "auto",
    detail: str = "full",
    frame: int | None = None,
    npz_style: str = "habitus",
    face: bool = False,
    skin: str | float | None = None,
    rig: str | None = None,
    bones: str = "along",
    root_bone: bool = False,
    light: bool = False,
    topology: str | None = None,
    model: BodyModel | PathLike | None = None,
) -> Exported:
    """Write a fit, a motion, or the npz of one as the format that the ending of ``to`` names.

    The formats are those of `habitus.export.motion.export_motion`. A person without a motion (the
    npz of ``habitus body``, a body model, or "neutral", "female", "male" for the mean person) gives
    a rig: two frames at rest, standing on the ground, +y up; with ``rig`` and as .vrm it has the
    joints of fingers, jaw and eyes. body: the model that the betas belong
    to, where the file names no shipped one. topology: "smpl", "smplx" or "mhr", for vertices in its
    order (`habitus.export.topology.write_topology`: .npz, .obj, .ply, a folder). model: your own
    SMPL, SMPL-H or SMPL-X (npz, pkl), whose parameters are solved and written as an npz in AMASS's
    names, `Exported.error_mm` from our surface (docs/other-bodies.md). Raises HabitusError.
    """
    if topology is not None or model is not None:
        given = (correctives, detail, npz_style, face, skin) != (
            "auto",
            "full",
            "habitus",
            False,
            None,
        )
        if given or (topology is not None and model is not None):
            raise HabitusError(
                "topology and model go alone: leave out blend shapes, detail, style, face and "
                "skin, and give one of the two"
            )
        moving = at_rate(read_moving(source, body), fps)
        return (
            _as_topology(moving, to, topology, frame) if topology else _as_model(moving, to, model)
        )
    check_motion_path(to)
    with_fingers = rig is not None or Path(to).suffix.lower() == ".vrm"
    return export_motion(
        read_moving(source, body, with_fingers=with_fingers),
        to,
        fps=fps,
        correctives=correctives,
        detail=detail,
        frame=frame,
        npz_style=npz_style,
        face=face,
        skin=skin,
        rig=rig,
        bones=bones,
        root_bone=root_bone,
        light=light,
    )


def _as_topology(moving: Moving, to: PathLike, topology: str, frame: int | None) -> Exported:
    """Vertices in another topology."""
    path = Path(to)
    check_topology_path(path)
    places = load_topology(topology, moving.finest_body)
    return Exported(path, write_topology(moving, path, places, frame), float(moving.rate_hz))


def _as_model(moving: Moving, to: PathLike, model: BodyModel | PathLike | None) -> Exported:
    """Parameters of the user's own model."""
    path = Path(to)
    if path.suffix.lower() != ".npz":
        raise HabitusError(f"cannot write parameters of a model to {path.name}: expected .npz")
    assert model is not None
    solved = solve_model(moving, model)
    solved.save(path)
    return Exported(
        path,
        moving.num_frames,
        float(moving.rate_hz),
        error_mm=solved.error_mm,
        verdict=solved.verdict,
    )


def read_moving(
    source: Moving | PathLike,
    body: BodyModel | PathLike | None = None,
    *,
    with_fingers: bool = False,
) -> Moving:
    """The motion of a source that `open_person` reads, with its markers where it is a fit's.

    A `Moving` is returned unchanged; a person without a motion stands at rest. with_fingers: of a
    shipped body, with joints of fingers, jaw and eyes. Raises HabitusError.
    """
    if isinstance(source, Moving):
        return source
    person = open_person(source, body)
    if isinstance(person, Mesh):
        raise HabitusError(
            f"{source}: a mesh, which has no skeleton; expected a fit, a motion or a body model"
        )
    if isinstance(person, BodyModel):
        name = Path(source).stem
        person = BodyShape(name, person, np.zeros(person.num_betas), str(source))
    if not isinstance(person, BodyShape):
        return person
    return (_with_fingers(person) if with_fingers else person).standing()


def _with_fingers(person: BodyShape) -> BodyShape:
    """The person with all joints of the shipped body, where that is its body."""
    body = person.body
    if body.name not in SHIPPED:
        return person
    whole = load_body(body.name, joints="smplx", num_betas=body.num_betas)
    same = np.array_equal(whole.v_template, body.v_template)
    return replace(person, body=whole) if same else person


def reading_notes(source: PathLike, moving: Moving) -> tuple[str, ...]:
    """What was decided in reading somebody else's skeleton, in sentences; nothing of other
    sources.
    """
    foreign = Path(source).suffix.lower() in RIG_ENDINGS
    return moving.made if foreign and isinstance(moving, BodyMotion) else ()
