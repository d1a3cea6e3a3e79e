"""Reads and writes templates: the mesh that registrations are aligned to, its parts and its
tree.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, shown
from habitus.files import atomic_write
from habitus.io.archives import NpzArchive
from habitus.io.limits import MAX_TOML_BYTES, check_joints, open_file, read_text_file, read_toml
from habitus.io.meshes import ENDINGS, read_mesh
from habitus.io.models.arrays import ModelArrays
from habitus.io.models.bodies import SHIPPED, load_body, named_vertices
from habitus.io.names import inside, plain_name
from habitus.io.units import METRES, unit_of
from habitus.mesh.mirror import mirrored_joints
from habitus.mesh.template import Template


def load_template(
    path: str | Path, *, detail: str = "coarse", joints: str | None = None
) -> Template:
    """The template in a file, in metres.

    An ``.npz`` has ``vertices`` (V, 3), ``faces`` (F, 3), ``part`` (V,), ``parents`` (J,),
    ``joint_names`` (J,) and, if told, ``mirror`` (V,), ``joint_mirror`` (J,), ``landmark_names``
    and ``landmark_vertices`` (n,). A ``.toml`` has ``mesh`` (a PLY or OBJ file beside it), ``unit``
    and for each joint a table ``[[joint]]`` with ``name``, ``parent`` (none for the root, which
    comes first) and ``vertices``, the numbers of those that belong to it; a mesh is read with the
    ``.toml`` of the same name. Any other file, or ``"default"``, ``"female"``, ``"male"``, is a
    body model: its template, each vertex part of its strongest joint; ``detail`` and ``joints`` as
    in `load_body`. Raises HabitusError, naming the file, where it is none of these or its parts do
    not fit together.
    """
    return template_and_body(path, detail=detail, joints=joints)[0]


def template_and_body(
    path: str | Path, *, detail: str = "coarse", joints: str | None = None
) -> tuple[Template, BodyModel | None]:
    """The template in a file, as `load_template` gives it, and the body model that it is of, where
    it is of one.
    """
    if str(path) in SHIPPED:
        body = load_body(path, detail=detail, joints=joints)
        return body_template(body), body
    source = Path(path)
    try:
        if source.suffix.lower() in (".toml", *ENDINGS):
            if source.exists() and not source.with_suffix(".toml").exists():
                raise HabitusError(
                    f"no {source.stem}.toml beside it; expected one with the mesh' parts and joints"
                )
            return _from_toml(source.with_suffix(".toml")), None
        if _is_template(source):
            return _from_npz(source), None
        body = load_body(source, detail=detail, joints=joints)
        return body_template(body), body
    except HabitusError as error:
        raise HabitusError(
            str(error) if str(source.with_suffix("")) in str(error) else f"{source}: {error}"
        ) from error
    except OSError as error:
        raise HabitusError(
            f"{source}: {error.strerror or error}; expected a template, or 'default'"
        ) from error


def body_template(body: BodyModel) -> Template:
    """The template of a body model, each vertex part of its strongest joint; joints are mirrored by
    name.
    """
    strongest = body.skinning_weights.argmax(1) if body.part is None else body.part
    try:
        joint_mirror = mirrored_joints(body.joint_names, body.parents)
    except HabitusError:
        joint_mirror = None
    return Template(
        vertices=body.v_template,
        faces=body.faces,
        part=strongest,
        parents=body.parents,
        joint_names=body.joint_names,
        mirror=body.mirror,
        joint_mirror=joint_mirror,
        landmarks=body.landmarks,
    )


def save_template(template: Template, path: str | Path) -> None:
    """Write a template as ``.npz``, whole or not at all. Raises HabitusError where nothing can be
    written.
    """
    target = Path(path)
    if target.suffix != ".npz":
        raise HabitusError(f"{target}: ending {target.suffix!r}; expected .npz")
    arrays = {
        "vertices": template.vertices,
        "faces": template.faces,
        "part": template.part,
        "parents": np.array(template.parents),
        "joint_names": np.array(template.joint_names),
    }
    arrays |= {
        key: value
        for key in ("mirror", "joint_mirror")
        if (value := getattr(template, key)) is not None
    }
    if template.landmarks:
        arrays["landmark_names"] = np.array(list(template.landmarks))
        arrays["landmark_vertices"] = np.array(list(template.landmarks.values()))
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _is_template(path: Path) -> bool:
    with open_file(path) as file:
        if file.read(2) != b"PK":
            return False
        return "vertices" in NpzArchive(file)


def _from_npz(path: Path) -> Template:
    with open_file(path) as file:
        arrays = ModelArrays(file)
        vertices = arrays.number("vertices", None, 3)
        check_joints(arrays["parents"].size)
        v = len(vertices)
        parents = tuple(int(parent) for parent in arrays.number("parents", None, dtype=np.int64))
        maps = {
            key: arrays.index(key, n, n)
            for key, n in (("mirror", v), ("joint_mirror", len(parents)))
            if key in arrays
        }
        return Template(
            vertices=vertices,
            faces=arrays.index("faces", v, None, 3),
            part=arrays.index("part", len(parents), v),
            parents=parents,
            joint_names=arrays.text("joint_names"),
            landmarks=named_vertices(arrays, v),
            **maps,
        )


def _from_toml(path: Path) -> Template:
    try:
        words = read_toml(read_text_file(path, MAX_TOML_BYTES))
    except (HabitusError, UnicodeDecodeError) as error:
        raise HabitusError(
            f"{path}: no TOML ({error}); expected mesh, unit and a table [[joint]] each"
        ) from error
    mesh = words.get("mesh")
    unit = unit_of(str(words.get("unit", "m")))
    joints = words.get("joint")
    if unit is None:
        raise HabitusError(
            f"{path}: unit is {shown(words['unit'])!r}; expected one of {', '.join(METRES)}"
        )
    if (
        not isinstance(joints, list)
        or not all(isinstance(joint, Mapping) for joint in joints)
        or not joints
    ):
        raise HabitusError(
            f"{path}: no joints in it; expected a table [[joint]] with name, parent and vertices "
            "each"
        )
    vertices, faces = read_mesh(_mesh_beside(path, mesh))
    check_joints(len(joints))
    names = [plain_name(joint.get("name", "")) for joint in joints]
    return Template(
        vertices=vertices * METRES[unit],
        faces=faces,
        part=_parts(path, names, joints, len(vertices)),
        parents=_parents(path, names, joints),
        joint_names=tuple(names),
    )


def _mesh_beside(path: Path, mesh: object) -> Path:
    if isinstance(mesh, str):
        return path.parent / inside(mesh)
    meshes = [path.with_suffix(ending) for ending in ENDINGS if path.with_suffix(ending).exists()]
    if not meshes:
        raise HabitusError(
            f'{path}: it names no mesh; expected mesh = "….ply", or a mesh of the same name '
            "beside it"
        )
    return meshes[0]


def _parents(path: Path, names: list[str], joints: list[Mapping[str, Any]]) -> tuple[int, ...]:
    parents = []
    place = {name: k for k, name in reversed(list(enumerate(names)))}
    for k, joint in enumerate(joints):
        above = joint.get("parent", "")
        above = plain_name(above) if isinstance(above, str) else above
        if k and not (isinstance(above, str) and place.get(above, k) < k):
            raise HabitusError(
                f"{path}: the parent of joint {names[k]!r} is {shown(above)!r}; expected a joint "
                "above it"
            )
        if not k and above not in ("", None):
            raise HabitusError(
                f"{path}: the first joint {names[0]!r} has a parent {shown(above)!r}; expected "
                "the root first"
            )
        parents.append(place[str(above)] if k else -1)
    return tuple(parents)


def _parts(
    path: Path, names: list[str], joints: list[Mapping[str, Any]], count: int
) -> Int[np.ndarray, " V"]:
    part = np.full(count, -1)
    for k, joint in enumerate(joints):
        numbers = joint.get("vertices", [])
        if not isinstance(numbers, list) or not all(
            type(n) is int and 0 <= n < count for n in numbers
        ):
            raise HabitusError(
                f"{path}: the vertices of joint {names[k]!r} are no list of numbers from 0 to "
                f"{count - 1}"
            )
        twice = [n for n in numbers if part[n] not in (-1, k)]
        if twice:
            raise HabitusError(
                f"{path}: vertex {twice[0]} belongs to {names[part[twice[0]]]!r} and "
                f"{names[k]!r}; choose one"
            )
        part[numbers] = k
    alone = np.flatnonzero(part < 0)
    if len(alone):
        raise HabitusError(
            f"{path}: {len(alone)} of {count} vertices (first {alone[0]}) belong to no joint; add "
            "them to one"
        )
    return part
