"""Binary glTF 2.0: the shaped body as a skinned mesh with its motion, for Blender, game engines and
web viewers.
"""

import os
from typing import TYPE_CHECKING

import numpy as np
import pygltflib as gl
from scipy.spatial.transform import Rotation

from habitus import __version__
from habitus.body.surface_files import (
    GltfBuffer,
    add_picture,
    glb_parts,
    gltf_material,
    gltf_primitive,
    unit_float32,
)
from habitus.errors import shown
from habitus.export.animation import Animation, animate, body_at, one_sided
from habitus.export.faces import face_weights, with_face
from habitus.export.rigging import Bones, rigged
from habitus.export.seams import seams_of
from habitus.export.skins import ROUGHNESS, Painted, painted
from habitus.files import atomic_write

if TYPE_CHECKING:
    from habitus.body.motion import Moving

GLB_FRAMES = 36_000
"""Most frames that an animation is given by itself: readers hold every key of every joint in
memory.
"""


def write_glb(
    fit: "Moving",
    path: str | os.PathLike[str],
    *,
    stride: int | None = None,
    correctives: str = "auto",
    detail: str = "full",
    face: bool = False,
    skin: str | float | None = None,
    bones: Bones | None = None,
) -> Animation:
    """Write a ``MarkerFit`` as one .glb file, atomically.

    Metres, +y up (the capture's up axis is turned there), the capture's rate (every ``stride``-th
    frame; by itself all of up to `GLB_FRAMES` frames, and of longer captures as many as stay below
    that). The mesh is the shaped body at zero pose, at its full level of detail where it has one;
    joints are nodes with rotation tracks and the root with a translation track. Soft tissue and
    pose blend shapes become morph targets (``correctives``:
    `habitus.export.correctives.morphs_of`), each a pair, forth and back, with weights between 0 and
    1, named by what they hold (``soft_tissue_01``, ``left_knee_01_back``). Where the body has
    texture coordinates, so has the mesh, with vertices doubled along the seams. With soft tissue
    every joint has a translation track, because shape moves joints. glTF knows linear blend
    skinning only, so a "dqbs" body is approximate near strongly twisted joints. ``detail``: "full",
    or "coarse", the mesh that was fitted. ``face``: with a morph target for each of the face's
    units (`habitus.export.faces`). ``skin``: a tone of the default body's skin as its texture
    (`habitus.body.skin.skin_tone`); other bodies and the coarse mesh stay plain. What was written
    comes back. ``bones``: their names, axes and rest pose (`habitus.export.rigging`). Raises
    HabitusError for another skin, and where the file cannot be written.
    """
    shown_body = body_at(fit, detail)
    animation = one_sided(
        animate(fit, stride=stride or glb_stride(fit), correctives=correctives, body=shown_body)
    )
    if face:
        animation = with_face(animation, face_weights(fit, stride or glb_stride(fit)))
    animation = rigged(animation, bones or Bones())
    covered = painted(animation, skin)
    write_document(document_of(covered, shown(fit.capture_name, 200)), path)
    return animation


def write_document(document: gl.GLTF2, path: str | os.PathLike[str]) -> None:
    """Write a glTF document in its binary form, atomically."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.writelines(glb_parts(document))


def glb_stride(fit: "Moving") -> int:
    """How many frames of the capture make one of the animation that `write_glb` writes by
    itself.
    """
    return max(1, -(-len(fit.pose) // GLB_FRAMES))


def thinning_note(fit: "Moving") -> tuple[str, ...]:
    """A sentence where the animation leaves frames out."""
    stride = glb_stride(fit)
    if stride == 1:
        return ()
    return (
        f"{len(fit.pose):,} frames are too many for one animation: body.glb holds one in {stride} "
        f"({fit.rate_hz / stride:.3g} Hz), body.npz holds all",
    )


def document_of(covered: Painted, name: str, moving: bool = True) -> gl.GLTF2:
    """The bones, which are the first nodes, the mesh and its skin, and, ``moving``, its motion."""
    animation = covered.animation
    bones = len(animation.skeleton.names)
    document = gl.GLTF2(
        asset=gl.Asset(version="2.0", generator=f"habitus {__version__}"),
        scene=0,
        scenes=[gl.Scene(name=name, nodes=[0, bones])],
        nodes=[*_bone_nodes(animation), gl.Node(name=name, mesh=0, skin=0)],
        materials=[gltf_material()],
    )
    buffer = GltfBuffer(document)
    document.meshes.append(_mesh(animation, buffer))
    document.skins.append(_skin(animation, buffer))
    if moving:
        document.animations.append(_tracks(animation, buffer, name))
    buffer.closed()
    if covered.picture is not None:
        add_picture(document, covered.picture, ROUGHNESS)
    return document


def _bone_nodes(animation: Animation) -> list[gl.Node]:
    skeleton = animation.skeleton
    local = skeleton.local_rest
    turns = unit_float32(Rotation.from_matrix(local[:, :3, :3]).as_quat())
    return [
        gl.Node(
            name=name,
            translation=local[bone, :3, 3].tolist(),
            rotation=turns[bone].tolist(),
            children=[c for c, p in enumerate(skeleton.parents) if p == bone],
        )
        for bone, name in enumerate(skeleton.names)
    ]


def _mesh(animation: Animation, buffer: GltfBuffer) -> gl.Mesh:
    seams = seams_of(animation.body)
    array = gl.ARRAY_BUFFER
    primitive = gltf_primitive(animation.rest_vertices, animation.body.faces, buffer, seams)
    for k, (index, value) in enumerate(_influences(animation)):
        setattr(
            primitive.attributes, f"JOINTS_{k}", buffer.add(index[seams.source], gl.VEC4, array)
        )
        setattr(
            primitive.attributes, f"WEIGHTS_{k}", buffer.add(value[seams.source], gl.VEC4, array)
        )
    targets = [
        gl.Attributes(POSITION=buffer.add_morph(morph.astype("f4", copy=False), seams.source))
        for morph in animation.morphs
    ]
    primitive.targets = targets
    extras = {"targetNames": list(animation.morph_names)} if targets else {}
    return gl.Mesh(name="body", primitives=[primitive], weights=[0.0] * len(targets), extras=extras)


def _influences(animation: Animation) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joint indices and weights in groups of four, heaviest first; weights of a vertex sum to one
    in float32.
    """
    given = animation.body.skinning_index
    count = len(animation.body.parents)
    dense = np.zeros((len(given), count))
    np.add.at(
        dense, (np.arange(len(given))[:, None], given), animation.body.skinning_value
    )  # no joint twice
    index = np.argsort(-dense, axis=1, kind="stable")[:, : given.shape[1]]
    value = np.take_along_axis(dense, index, axis=1)
    value = (value / value.sum(axis=1, keepdims=True)).astype("f4")
    value[:, 0] = 1.0 - value[:, 1:].sum(axis=1, dtype=np.float64)
    bones = len(animation.skeleton.names)
    index = np.where(value > 0, animation.skeleton.own[index], 0)
    padding = ((0, 0), (0, -value.shape[1] % 4))
    index = np.pad(index, padding)
    value = np.pad(value, padding)
    small = "u1" if bones <= 256 else "u2"
    return [
        (index[:, k : k + 4].astype(small), value[:, k : k + 4])
        for k in range(0, value.shape[1], 4)
    ]


def _skin(animation: Animation, buffer: GltfBuffer) -> gl.Skin:
    rest = animation.skeleton.rest
    inverse = np.linalg.inv(rest).transpose(0, 2, 1)  # glTF matrices are column-major
    bind = buffer.add(inverse.reshape(len(rest), 16).astype("f4"), gl.MAT4)
    return gl.Skin(
        name="skeleton", joints=list(range(len(rest))), skeleton=0, inverseBindMatrices=bind
    )


def _tracks(animation: Animation, buffer: GltfBuffer, name: str) -> gl.Animation:
    motion = animation.tracks[0]
    frames, bones = motion.quaternions.shape[:2]
    roots = animation.skeleton.own[0]
    bones_move = np.ptp(motion.joint_translations[:, roots + 1 :], axis=0).max(initial=0.0) > 1e-9
    times = buffer.add((np.arange(frames) / animation.rate_hz).astype("f4"), gl.SCALAR, bounds=True)
    tracks = gl.Animation(name=name, samplers=[], channels=[])

    def track(node: int, path: str, values: np.ndarray, kind: str) -> None:
        tracks.samplers.append(
            gl.AnimationSampler(
                input=times, output=buffer.add(values, kind), interpolation="LINEAR"
            )
        )
        target = gl.AnimationChannelTarget(node=node, path=path)
        tracks.channels.append(gl.AnimationChannel(sampler=len(tracks.samplers) - 1, target=target))

    quaternions = unit_float32(motion.quaternions)
    translations = motion.joint_translations.astype("f4")
    for bone in range(bones):
        track(bone, "rotation", quaternions[:, bone], gl.VEC4)
        if bone <= roots or bones_move:
            track(bone, "translation", translations[:, bone], gl.VEC3)
    if motion.morph_weights.shape[1]:
        track(bones, "weights", motion.morph_weights.astype("f4"), gl.SCALAR)
    return tracks
