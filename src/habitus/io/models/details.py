"""What the project's own body files hold besides SMPL's arrays: ages, quads and textures, two levels of detail."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from habitus.body.ages import Ages
from habitus.body.mesh import BodyMesh
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.io.models.arrays import ModelArrays

DETAILS = ("coarse", "full")


def read_pose_joints(arrays: ModelArrays, joints: int) -> tuple[int, ...] | None:
    """The joints that drive the pose blend shapes, where a file names some."""
    if "posedirs_joints" not in arrays:
        return None
    return tuple(arrays.index("posedirs_joints", joints, None).tolist())


def read_mesh(arrays: ModelArrays, vertices: int) -> BodyMesh | None:
    """Quads and a texture's coordinates, where the file has them."""
    if "quads" not in arrays:
        return None
    uv = arrays.number("uv", None, 2)
    quads = arrays.index("quads", vertices, None, 4)
    hidden = arrays.index("hidden_quads", 2, len(quads)) != 0
    return BodyMesh(quads, uv, arrays.index("quad_uv", len(uv), len(quads), 4), hidden)


def read_ages(arrays: ModelArrays, template: np.ndarray) -> Ages | None:
    """The ages that the file knows. Raises HabitusError where they do not rise."""
    if "age_years" not in arrays:
        return None
    years = arrays.number("age_years", None)
    if len(years) < 2 or not (np.diff(years) > 0).all():
        raise HabitusError(f"array 'age_years' is {years.tolist()}; expected ages that rise")
    directions = arrays.number("agedirs", *template.shape, len(years), dtype=np.float32)
    adult = float(np.ptp(template[:, 1]))
    if "age_statures" in arrays:  # of a body that was saved without its full level
        return Ages(years, directions, arrays.number("age_statures", len(years)), float(arrays.number("age_adult")))
    statures = np.ptp(template[:, 1, None] + directions[:, 1], axis=0)
    return Ages(years, directions, statures, adult)


def ages_form(ages: Ages | None) -> dict[str, np.ndarray]:
    """The arrays that `read_ages` reads."""
    if ages is None:
        return {}
    named = {"age_years": ages.years, "agedirs": ages.directions, "age_statures": ages.statures}
    return {**named, "age_adult": np.array(ages.adult)}


def mesh_form(mesh: BodyMesh | None) -> dict[str, np.ndarray]:
    """The arrays that `read_mesh` reads."""
    if mesh is None:
        return {}
    return {"quads": mesh.quads, "uv": mesh.uv, "quad_uv": mesh.quad_uv, "hidden_quads": mesh.hidden}


def coarse_level(arrays: ModelArrays, full: BodyModel) -> BodyModel:
    """The coarse body that a file names some of its vertices for; it holds the full one.

    Raises HabitusError where its vertices do not suffice: for its mirror image, its landmarks or its joints.
    """
    rows = arrays.index("coarse_vertices", full.num_vertices, None)
    if not (np.diff(rows) > 0).all():
        raise HabitusError("array 'coarse_vertices' does not rise; expected sorted vertex numbers")
    place = np.full(full.num_vertices, -1)
    place[rows] = np.arange(len(rows))
    mirror = None if full.mirror is None else place[full.mirror[rows]]
    lost = [name for name, vertex in full.landmarks.items() if place[vertex] < 0]
    regressor = full.joint_regressor[:, rows]
    short = np.abs(regressor.sum(1) - full.joint_regressor.sum(1)) > 1e-6
    left_out = [name for name, lacks in zip(full.joint_names, short, strict=True) if lacks]
    if lost or left_out or (mirror is not None and (mirror < 0).any()):
        what = f"landmark {lost[0]}" if lost else f"joint {left_out[0]}" if left_out else "mirror image"
        raise HabitusError(f"the coarse level lacks vertices for the {what}; expected all in 'coarse_vertices'")
    ages = full.ages and replace(full.ages, directions=full.ages.directions[rows])
    return replace(
        full,
        v_template=full.v_template[rows],
        shapedirs=full.shapedirs[rows],
        posedirs=None if full.posedirs is None else full.posedirs[rows],
        expressiondirs=None if full.expressiondirs is None else full.expressiondirs[rows],
        joint_regressor=np.ascontiguousarray(regressor),
        skinning_index=full.skinning_index[rows],
        skinning_value=full.skinning_value[rows],
        faces=arrays.index("coarse_faces", len(rows), None, 3),
        landmarks=MappingProxyType({name: int(place[vertex]) for name, vertex in full.landmarks.items()}),
        part=None if full.part is None else full.part[rows],
        mirror=mirror,
        ages=ages,
        mesh=None,
        full=full,
        full_vertices=rows,
    )
