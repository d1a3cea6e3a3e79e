"""The body in an FBX file: mesh, skeleton, skin and blend channels, in centimetres."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.surface_files import SKIN_COLOUR
from habitus.export.animation import Animation
from habitus.export.fbx.nodes import Node
from habitus.export.fbx.scene import ROOT, Objects, prop, props
from habitus.export.seams import polygons_of
from habitus.mesh.normals import vertex_normals

CM = 100.0
PICTURE = "skin.png"
_SKINNING = {"lbs": "Linear", "dqbs": "DualQuaternion"}


def add_skeleton(objects: Objects, animation: Animation) -> list[np.int64]:
    """A limb a bone, as the person rests: its axes are a PreRotation, so that it rests unturned."""
    models: list[np.int64] = []
    skeleton = animation.skeleton
    rows = zip(skeleton.names, skeleton.parents, skeleton.local_rest, strict=True)
    for name, parent, local in rows:
        axes = Rotation.from_matrix(local[:3, :3]).as_euler("xyz", degrees=True)
        nodes = _model_nodes(CM * local[:3, 3], axes)
        model = objects.add("Model", name, "LimbNode", nodes)
        form = [props(prop("Size", "double", "Number", "", 3.0)), Node("TypeFlags", ("Skeleton",))]
        objects.link(objects.add("NodeAttribute", name, "LimbNode", form), model)
        objects.link(model, models[parent] if parent >= 0 else ROOT)
        models.append(model)
    return models


def add_mesh(
    objects: Objects, animation: Animation, name: str, picture: bytes | None = None
) -> tuple[np.int64, np.int64]:
    """The body's mesh at rest, with its material, and a PNG as its texture where one is given; the
    numbers of its model and its geometry.
    """
    model = objects.add("Model", name, "Mesh", _model_nodes(np.zeros(3)))
    geometry = objects.add("Geometry", name, "Mesh", _geometry_nodes(animation))
    material = objects.add("Material", "skin", "", _material_nodes(picture is not None))
    objects.link(model, ROOT)
    objects.link(geometry, model)
    objects.link(material, model)
    if picture is not None:
        _add_texture(objects, material, picture)
    return model, geometry


def _add_texture(objects: Objects, material: np.int64, picture: bytes) -> None:
    """A picture inside the file, and the texture that shows it."""
    files = [Node(name, (PICTURE,)) for name in ("FileName", "RelativeFilename")]
    path = props(prop("Path", "KString", "XRefUrl", "", PICTURE))
    clip = [Node("Type", ("Clip",)), path, Node("UseMipMap", (0,)), *files]
    video = objects.add("Video", "skin", "Clip", [*clip, Node("Content", (picture,))])
    nodes = [
        Node("Type", ("TextureVideoClip",)),
        Node("Version", (202,)),
        Node("TextureName", ("skin\0\1Texture",)),
        props(prop("UVSet", "KString", "", "", "UVMap"), prop("UseMaterial", "bool", "", "", 1)),
        Node("Media", ("skin\0\1Video",)),
        *files,
    ]
    texture = objects.add("Texture", "skin", "", nodes)
    objects.link(texture, material, "DiffuseColor")
    objects.link(video, texture)


def add_skin(
    objects: Objects,
    animation: Animation,
    mesh: np.int64,
    geometry: np.int64,
    limbs: list[np.int64],
) -> None:
    """Which limb carries which vertex, and where all stood when that was said."""
    skinning = Node("SkinningType", (_SKINNING[animation.body.skinning],))
    skin = objects.add(
        "Deformer",
        "skin",
        "Skin",
        [Node("Version", (101,)), Node("Link_DeformAcuracy", (50.0,)), skinning],
    )
    objects.link(skin, geometry)
    weights = animation.body.skinning_weights
    binds = [_matrix(rest) for rest in animation.skeleton.rest]
    weights = weights / weights.sum(axis=1, keepdims=True)
    for joint, bone in enumerate(animation.skeleton.own):
        carried = np.flatnonzero(weights[:, joint])
        if len(carried):
            nodes = _cluster_nodes(carried, weights[carried, joint], animation.skeleton.rest[bone])
            name = animation.skeleton.names[bone]
            cluster = objects.add("Deformer", name, "Cluster", nodes, "SubDeformer")
            objects.link(cluster, skin)
            objects.link(limbs[bone], cluster)
    posed = [(mesh, _matrix(np.eye(4))), *zip(limbs, binds, strict=True)]
    pose = [
        Node("PoseNode", (), [Node("Node", (number,)), Node("Matrix", (bind,))])
        for number, bind in posed
    ]
    header = [
        Node("Type", ("BindPose",)),
        Node("Version", (100,)),
        Node("NbPoseNodes", (len(posed),)),
    ]
    objects.add("Pose", "bind", "BindPose", [*header, *pose])


def add_channels(objects: Objects, animation: Animation, geometry: np.int64) -> list[np.int64]:
    """A blend channel a morph, each of one shape at 100 percent; their numbers."""
    if not len(animation.morphs):
        return []
    blend = objects.add("Deformer", "correctives", "BlendShape", [Node("Version", (100,))])
    objects.link(blend, geometry)
    channels = []
    for name, morph in zip(animation.morph_names, animation.morphs, strict=True):
        full = Node("FullWeights", (np.array([100.0]),))
        nodes = [Node("Version", (100,)), Node("DeformPercent", (0.0,)), full]
        channel = objects.add("Deformer", name, "BlendShapeChannel", nodes, "SubDeformer")
        shape = objects.add("Geometry", name, "Shape", _shape_nodes(morph))
        objects.link(channel, blend)
        objects.link(shape, channel)
        channels.append(channel)
    return channels


def _model_nodes(
    offset: Float[np.ndarray, " 3"], axes: Float[np.ndarray, " 3"] | None = None
) -> list[Node]:
    placed = prop("Lcl Translation", "Lcl Translation", "", "A", *map(float, offset))
    turned = prop("Lcl Rotation", "Lcl Rotation", "", "A", 0.0, 0.0, 0.0)
    scaled = prop("Lcl Scaling", "Lcl Scaling", "", "A", 1.0, 1.0, 1.0)
    which = prop("DefaultAttributeIndex", "int", "Integer", "", 0)
    inherit = prop("InheritType", "enum", "", "", 1)
    before = (
        [prop("PreRotation", "Vector3D", "Vector", "", *map(float, axes))]
        if axes is not None and axes.any()
        else []
    )
    active = prop("RotationActive", "bool", "", "", 1)
    return [
        Node("Version", (232,)),
        props(active, *before, inherit, which, placed, turned, scaled),
        Node("Shading", (True,)),
        Node("Culling", ("CullingOff",)),
    ]


def _geometry_nodes(animation: Animation) -> list[Node]:
    faces = polygons_of(animation.body)
    corners = faces.corners.astype(np.int32)
    corners[:, -1] = ~corners[:, -1]  # a face's last corner ends it
    normals = vertex_normals(animation.rest_vertices, animation.body.faces)
    layers = [_layer("LayerElementNormal", "", "ByVertice", "Direct", Node("Normals", (normals,)))]
    if faces.uv is not None and faces.uv_corners is not None:
        index = Node("UVIndex", (faces.uv_corners.astype(np.int32),))
        layers.append(
            _layer(
                "LayerElementUV",
                "UVMap",
                "ByPolygonVertex",
                "IndexToDirect",
                Node("UV", (faces.uv,)),
                index,
            )
        )
    smooth = Node("Smoothing", (np.ones(len(corners), np.int32),))
    layers.append(_layer("LayerElementSmoothing", "", "ByPolygon", "Direct", smooth))
    material = Node("Materials", (np.zeros(1, np.int32),))
    layers.append(_layer("LayerElementMaterial", "", "AllSame", "IndexToDirect", material))
    elements = [
        Node("LayerElement", (), [Node("Type", (layer.name,)), Node("TypedIndex", (0,))])
        for layer in layers
    ]
    return [
        Node("GeometryVersion", (124,)),
        Node("Vertices", (_rounded(CM * animation.rest_vertices),)),
        Node("PolygonVertexIndex", (corners,)),
        *layers,
        Node("Layer", (0,), [Node("Version", (100,)), *elements]),
    ]


def _layer(name: str, called: str, mapping: str, reference: str, *values: Node) -> Node:
    version = 102 if name in ("LayerElementNormal", "LayerElementSmoothing") else 101
    texts = (
        ("Name", called),
        ("MappingInformationType", mapping),
        ("ReferenceInformationType", reference),
    )
    return Node(
        name,
        (0,),
        [Node("Version", (version,)), *(Node(key, (text,)) for key, text in texts), *values],
    )


def _material_nodes(textured: bool) -> list[Node]:
    colour = (1.0, 1.0, 1.0) if textured else SKIN_COLOUR[:3]
    return [
        Node("Version", (102,)),
        Node("ShadingModel", ("lambert",)),
        Node("MultiLayer", (0,)),
        props(
            prop("DiffuseColor", "Color", "", "A", *colour),
            prop("Diffuse", "Vector3D", "Vector", "", *colour),
        ),
    ]


def _cluster_nodes(carried: np.ndarray, weights: np.ndarray, rest: np.ndarray) -> list[Node]:
    return [
        Node("Version", (100,)),
        Node("UserData", ("", "")),
        Node("Indexes", (carried.astype(np.int32),)),
        Node("Weights", (_rounded(weights),)),
        Node("Transform", (_matrix(np.linalg.inv(rest)),)),
        Node("TransformLink", (_matrix(rest),)),
    ]


def _shape_nodes(morph: Float[np.ndarray, "V 3"]) -> list[Node]:
    moved = np.flatnonzero(morph.any(axis=1))
    offsets = _rounded(CM * morph[moved])
    return [
        Node("Version", (100,)),
        Node("Indexes", (moved.astype(np.int32),)),
        Node("Vertices", (offsets,)),
        Node("Normals", (np.zeros_like(offsets),)),
    ]


def _rounded(values: np.ndarray) -> np.ndarray:
    """Doubles of no more digits than a float has: half as large when packed."""
    return values.astype(np.float32).astype(np.float64)


def _matrix(rest: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 16"]:
    """A transform (m) as FBX writes it, in cm, column after column."""
    matrix = rest.T.copy()
    matrix[3, :3] *= CM
    return matrix.reshape(-1)
