"""USD: the body as a UsdSkel rig with blend shapes, for Omniverse, Houdini, Maya, Unreal, Blender;
.usdz for phones.
"""
# pyright: reportAttributeAccessIssue=false
# (pxr's modules are compiled and come without stubs)

# The stubs of usd-core lack most of its names.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from habitus.body.surface_files import SKIN_COLOUR
from habitus.errors import HabitusError, require_extra, shown
from habitus.export.animation import Animation, animate, body_at, one_sided
from habitus.export.faces import face_weights, with_face
from habitus.export.rigging import Bones, rigged
from habitus.export.seams import polygons_of
from habitus.export.skins import ROUGHNESS, painted, picture_beside, write_picture
from habitus.files import atomic_write
from habitus.mesh.normals import vertex_normals
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

ENDINGS = (".usd", ".usdc", ".usda", ".usdz")
_ROOT = "/person"
_MESH = "/person/body"
_SKELETON = "/person/skeleton"
_FLESH = 0.4
"""No skin is further from the nearest joint than this (m): how extents are told."""


def write_usd(
    fit: "Moving",
    path: str | os.PathLike[str],
    *,
    correctives: str = "auto",
    detail: str = "full",
    face: bool = False,
    skin: str | float | None = None,
    bones: Bones | None = None,
) -> Animation:
    """Write a motion as .usd, .usdc, .usda or .usdz, atomically; what was written comes back.

    Metres, +y up, time codes are the motion's frames from 0 on, at its rate. One SkelRoot with a
    mesh (quads and texture coordinates where the body has them), a skeleton of the body's joints,
    and an animation of joints and blend shapes; the latter as for
    `habitus.export.fbx.write.write_fbx`. ``skin``: as for `habitus.export.glb.write_glb`; the
    texture is in the .usdz, and beside the other files as ``…_skin.png``. ``bones``: as for
    `habitus.export.rigging.rigged`, in names that USD allows (``mixamorig_Hips``). Needs usd-core:
    ``pip install 'habitus[usd]'``. Raises HabitusError where that is missing, for another skin,
    where pose blend shapes are not linear in vec(R - I), and where the file cannot be written.
    """
    require_extra("pxr", "USD files", "usd")
    animation = one_sided(animate(fit, correctives=correctives, body=body_at(fit, detail)))
    if face:
        animation = with_face(animation, face_weights(fit))
    animation = rigged(animation, bones or Bones())
    reach = _reach(fit)
    target = Path(path)
    covered = painted(animation, skin)
    with atomic_write(target) as temporary:
        packed = target.suffix.lower() == ".usdz"
        layer = temporary.with_suffix(".usdc") if packed else temporary
        picture = picture_beside(layer if packed else target)
        try:
            if covered.picture is not None:
                write_picture(picture, covered.picture)
            textured = None if covered.picture is None else f"./{picture.name}"
            _write_stage(covered.animation, layer, shown(fit.capture_name, 200), reach, textured)
            if packed:
                _package(layer, temporary, target.stem)
        finally:
            for left in (layer, picture) if packed else ():
                left.unlink(missing_ok=True)
    return animation


def _reach(fit: "Moving") -> Float[np.ndarray, "T 2 3"]:
    """The least and the largest corner (m, +y up) of what the body fills, frame by frame."""
    joints = fit.joints() @ up_rotation(fit.up_axis).T
    return np.stack([joints.min(axis=1) - _FLESH, joints.max(axis=1) + _FLESH], axis=1).astype(
        np.float32
    )


def _package(layer: Path, target: Path, name: str) -> None:
    """One uncompressed archive of the layer, under the file's name."""
    from pxr import Sdf, UsdUtils

    inside = f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name) or 'body'}.usdc"
    if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(target), inside):
        raise HabitusError(
            f"cannot write {target.name}: usd-core could not pack it; write a .usdc instead"
        )


def _write_stage(
    animation: Animation, layer: Path, name: str, reach: np.ndarray, picture: str | None
) -> None:
    from pxr import Usd, UsdGeom, UsdSkel

    layer.unlink(missing_ok=True)
    stage: Any = Usd.Stage.CreateNew(str(layer))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(animation.rate_hz)
    stage.SetFramesPerSecond(animation.rate_hz)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(reach) - 1)
    root = UsdSkel.Root.Define(stage, _ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    root.GetPrim().SetDisplayName(name)
    joints = _skeleton(stage, animation)
    mesh = _mesh(stage, animation)
    _material(stage, mesh, picture)
    shapes = _blend_shapes(stage, mesh, animation)
    _motion(stage, animation, joints, shapes)
    extent = root.CreateExtentAttr()
    for frame, corners in enumerate(reach):
        extent.Set(_vectors(corners), frame)
    stage.GetRootLayer().Save()


def _skeleton(stage: Any, animation: Animation) -> list[str]:
    """The skeleton at rest; the bones' paths."""
    from pxr import Gf, Tf, UsdSkel

    paths: list[str] = []
    skeleton = animation.skeleton
    for name, parent in zip(skeleton.names, skeleton.parents, strict=True):
        valid = Tf.MakeValidIdentifier(name)
        paths.append(f"{paths[parent]}/{valid}" if parent >= 0 else valid)
    written = UsdSkel.Skeleton.Define(stage, _SKELETON)
    written.CreateJointsAttr(paths)
    # USD's matrices act on rows
    written.CreateBindTransformsAttr([Gf.Matrix4d(rest.T) for rest in skeleton.rest])
    written.CreateRestTransformsAttr([Gf.Matrix4d(local.T) for local in skeleton.local_rest])
    return paths


def _mesh(stage: Any, animation: Animation) -> Any:
    from pxr import Gf, Sdf, UsdGeom, UsdSkel, Vt

    faces = polygons_of(animation.body)
    points = animation.rest_vertices
    mesh = UsdGeom.Mesh.Define(stage, _MESH)
    mesh.CreatePointsAttr(_vectors(points))
    mesh.CreateExtentAttr(_vectors(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateFaceVertexCountsAttr(_integers(np.full(len(faces.corners), faces.corners.shape[1])))
    mesh.CreateFaceVertexIndicesAttr(_integers(faces.corners))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateNormalsAttr(_vectors(vertex_normals(points, animation.body.faces)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    coordinates = UsdGeom.PrimvarsAPI(mesh)
    if faces.uv is not None and faces.uv_corners is not None:
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        uv = coordinates.CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
        uv.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(faces.uv, np.float32)))
        uv.SetIndices(_integers(faces.uv_corners))
    skin = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    skin.CreateSkeletonRel().SetTargets([_SKELETON])
    index, value = _influences(animation)
    skin.CreateJointIndicesPrimvar(False, index.shape[1]).Set(_integers(index))
    skin.CreateJointWeightsPrimvar(False, index.shape[1]).Set(
        Vt.FloatArray.FromNumpy(value.reshape(-1))
    )
    skin.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    skin.CreateSkinningMethodAttr(
        UsdSkel.Tokens.classicLinear
        if animation.body.skinning == "lbs"
        else UsdSkel.Tokens.dualQuaternion
    )
    return mesh


def _material(stage: Any, mesh: Any, picture: str | None) -> None:
    """Plain skin, or the texture at a path beside the layer."""
    from pxr import Gf, Sdf, UsdShade

    path, kinds = f"{_ROOT}/skin", Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    colour = shader.CreateInput("diffuseColor", kinds.Color3f)
    shader.CreateInput("roughness", kinds.Float).Set(0.7 if picture is None else ROUGHNESS)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    if picture is None:
        colour.Set(Gf.Vec3f(*SKIN_COLOUR[:3]))
        return
    reader = UsdShade.Shader.Define(stage, f"{path}/coordinates")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    reader.CreateOutput("result", kinds.Float2)
    texture = UsdShade.Shader.Define(stage, f"{path}/texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(picture))
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    for axis in ("wrapS", "wrapT"):
        texture.CreateInput(axis, kinds.Token).Set("clamp")
    texture.CreateInput("st", kinds.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    texture.CreateOutput("rgb", kinds.Float3)
    colour.ConnectToSource(texture.ConnectableAPI(), "rgb")


def _influences(animation: Animation) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights (V, K), heaviest first, of sum one."""
    weights = animation.body.skinning_weights
    count = min(animation.body.skinning_index.shape[1], weights.shape[1])
    index = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    value = np.take_along_axis(weights, index, axis=1)
    value = (value / value.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(value > 0, animation.skeleton.own[index], 0), value


def _blend_shapes(stage: Any, mesh: Any, animation: Animation) -> list[str]:
    from pxr import Tf, UsdSkel

    names = [Tf.MakeValidIdentifier(name) for name in animation.morph_names]
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    paths = []
    for name, morph in zip(names, animation.morphs, strict=True):
        moved = np.flatnonzero(morph.any(axis=1))
        shape = UsdSkel.BlendShape.Define(stage, f"{_MESH}/{name}")
        shape.CreateOffsetsAttr(_vectors(morph[moved]))
        shape.CreateNormalOffsetsAttr(_vectors(np.zeros((len(moved), 3))))
        shape.CreatePointIndicesAttr(_integers(moved))
        paths.append(shape.GetPath())
    if names:
        binding.CreateBlendShapesAttr(names)
        binding.CreateBlendShapeTargetsRel().SetTargets(paths)
    return names


def _motion(stage: Any, animation: Animation, joints: list[str], shapes: list[str]) -> None:
    from pxr import UsdSkel, Vt

    track = animation.tracks[0]
    path = f"{_SKELETON}/motion"
    motion = UsdSkel.Animation.Define(stage, path)
    motion.CreateJointsAttr(joints)
    motion.CreateScalesAttr(Vt.Vec3hArray(len(joints), (1.0, 1.0, 1.0)))
    turns = motion.CreateRotationsAttr()
    places = motion.CreateTranslationsAttr()
    quaternions = track.quaternions.astype(np.float32)
    for frame, (turned, placed) in enumerate(
        zip(quaternions, track.joint_translations, strict=True)
    ):
        turns.Set(Vt.QuatfArray.FromNumpy(turned), frame)
        places.Set(_vectors(placed), frame)
    if shapes:
        motion.CreateBlendShapesAttr(shapes)
        weights = motion.CreateBlendShapeWeightsAttr()
        for frame, row in enumerate(np.ascontiguousarray(track.morph_weights, np.float32)):
            weights.Set(Vt.FloatArray.FromNumpy(row), frame)
    binding = UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath(_SKELETON))
    binding.CreateAnimationSourceRel().SetTargets([path])


def _vectors(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def _integers(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32).reshape(-1))
