# SPDX-License-Identifier: GPL-3.0-or-later
"""A person in Blender: an armature, a mesh with its skin, and shape keys that follow shape, bones
and motion.
"""

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from .bones import resting
from .core import Body
from .smpl import read_body
from .tailor import NAMES, measure, tailored

BETAS, KEY, TISSUE = 24, "correctives", "soft_tissue_"
UPRIGHT = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
"""From the body's space (+y up) to Blender's (+z up)."""
SHIPPED = ("neutral", "female", "male")
TONES = ("light", "medium", "dark")
"""Of the skins that came with the add-on."""
ROUGHNESS = 0.6
"""Of the skin, as in habitus' glTF files."""
_loaded: dict = {}
_busy: set = set()


def body_called(name: str) -> Body:
    """One that came with the add-on, or that of a file; read once."""
    if name not in _loaded:
        _loaded[name] = (
            Body.packed(Path(__file__).parent / f"{name}.npz")
            if name in SHIPPED
            else read_body(name)
        )
    return _loaded[name]


def body_of(person) -> Body:
    """The body that a person is made of."""
    return body_called(person.habitus_file or person.habitus_sex)


def is_person(thing) -> bool:
    """Whether an object is a mesh that `add_person` made."""
    return thing is not None and bool(thing.get("habitus")) and thing.parent is not None


def add_person(context, name="neutral", betas=(), age=0.0):
    """A new person: an armature, and under it the mesh with its skin and its live blend shapes. The
    mesh comes back.
    """
    model = body_called(name)
    armature = bpy.data.objects.new("habitus", bpy.data.armatures.new("habitus"))
    mesh = bpy.data.meshes.new("habitus body")
    mesh.from_pydata(model.rest(betas).tolist(), [], model.arrays["faces"].tolist())
    person = bpy.data.objects.new("habitus body", mesh)
    for each in (armature, person):
        context.collection.objects.link(each)
    if "uv" in model.arrays:
        layer = mesh.uv_layers.new(name="UVMap")
        layer.data.foreach_set(
            "uv", model.arrays["uv"][model.arrays["face_uv"]].ravel().astype(np.float32)
        )
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    _make_bones(context, armature, model)
    _make_skin(person, model)
    person.parent = armature
    person.modifiers.new("skin", "ARMATURE").object = armature
    person.shape_key_add(name="Basis")
    person.shape_key_add(name=KEY).value = 1.0
    armature.matrix_world = UPRIGHT
    person["habitus"] = 1
    set_shape(context, person, betas, age, name)
    wear_skin(person)
    return person


def wear_skin(person, _context=None):
    """Give a person the material of the chosen skin; none for the body of a file."""
    person.data.materials.clear()
    if person.habitus_skin in TONES and not person.habitus_file:
        person.data.materials.append(_skin_material(person.habitus_skin))


def _skin_material(tone):
    """The material of a tone, the same for all people."""
    name = f"habitus skin {tone}"
    if name in bpy.data.materials:
        return bpy.data.materials[name]
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes = material.node_tree.nodes
    picture = nodes.new("ShaderNodeTexImage")
    picture.image = bpy.data.images.load(str(Path(__file__).parent / f"skin_{tone}.png"))
    picture.image.pack()  # files stay whole without the add-on
    surface = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    surface.inputs["Roughness"].default_value = ROUGHNESS
    material.node_tree.links.new(picture.outputs["Color"], surface.inputs["Base Color"])
    return material


def snap_to_ground(context, person):
    """Move the person up or down so that the lowest point of this frame is at height 0."""
    correct(person)
    seen = person.evaluated_get(context.evaluated_depsgraph_get())
    mesh = seen.to_mesh()
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", points)
    world = np.array(seen.matrix_world)
    lowest = (points.reshape(-1, 3) @ world[2, :3] + world[2, 3]).min()
    person.parent.location.z -= float(lowest)
    seen.to_mesh_clear()


def set_shape(context, person, betas, age=None, name=None):
    """Give a person betas, and if told an age (years; 0: none) and a body."""
    with _quietly(person):
        if name is not None:
            person.habitus_file = "" if name in SHIPPED else name
            person.habitus_sex = name if name in SHIPPED else "neutral"
        if age is not None:
            person.habitus_age = age
        padded = np.zeros(BETAS)
        padded[: len(betas)] = np.asarray(betas)[:BETAS]
        person.habitus_betas = padded.tolist()
    reshape(person, context)


def _make_skin(person, model):
    groups = [person.vertex_groups.new(name=name) for name in model.joint_names]
    skin = model.arrays["skinning_index"], model.arrays["skinning_value"]
    for vertex, (index, value) in enumerate(zip(*skin, strict=True)):
        for joint, weight in zip(index.tolist(), value.tolist(), strict=True):
            if weight > 0:
                groups[joint].add([vertex], weight, "ADD")


def _make_bones(context, armature, model):
    axes, lengths = resting(model, model.joints(np.zeros(model.num_betas)))
    rows = zip(model.joint_names, model.parents, axes, lengths, strict=True)
    with _editing(context, armature):
        for name, parent, turn, length in rows:
            bone = armature.data.edit_bones.new(name)
            bone.head, bone.tail = (0, 0, 0), (0, length, 0)
            bone.matrix = Matrix(turn.tolist()).to_4x4()
            if parent >= 0:
                bone.parent = armature.data.edit_bones[model.joint_names[parent]]
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"


class _editing:
    """The armature in edit mode, and everything as it was afterwards."""

    def __init__(self, context, armature):
        self.context, self.armature = context, armature

    def __enter__(self):
        layer = self.context.view_layer
        self.before = layer.objects.active
        if self.before is not None and self.before.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = self.armature
        bpy.ops.object.mode_set(mode="EDIT")

    def __exit__(self, *_):
        bpy.ops.object.mode_set(mode="OBJECT")
        self.context.view_layer.objects.active = self.before or self.armature


class _quietly:
    """A person's properties may be set without their updates."""

    def __init__(self, person):
        self.name = person.name_full

    def __enter__(self):
        self.first = self.name not in _busy
        _busy.add(self.name)

    def __exit__(self, *_):
        if self.first:
            _busy.discard(self.name)


def reshape(person, context):
    """Bring vertices, bones and measurements to the person's betas, age and sex."""
    if person.name_full in _busy:
        return
    model, betas, age, armature = (
        body_of(person),
        np.array(person.habitus_betas),
        person.habitus_age,
        person.parent,
    )
    points = model.rest(betas, age).astype(np.float32)
    keys = person.data.shape_keys.key_blocks
    before = points_of(keys["Basis"])
    person.data.vertices.foreach_set("co", points.ravel())
    keys["Basis"].data.foreach_set("co", points.ravel())
    for key in keys:
        if key.name.startswith(TISSUE):  # it goes along
            key.data.foreach_set("co", (points_of(key) - before + points).ravel())
    with _editing(context, armature):
        for name, place in zip(model.joint_names, model.joints(betas, age), strict=True):
            bone = armature.data.edit_bones[name]  # keys stay true: it keeps how it is turned
            along = np.array(bone.tail) - np.array(bone.head)
            bone.head, bone.tail = place, place + along
    if "densities" in model.arrays:
        with _quietly(person):
            for name, value in zip(NAMES, measure(model, betas, age)[0], strict=True):
                if name not in known(person):
                    setattr(person, f"habitus_{name}", float(value))
    correct(person)


def by_hand(person, context):
    """The betas were set: what was known of the person is not, any more."""
    if person.name_full not in _busy:
        with _quietly(person):
            person.habitus_known = [False] * len(NAMES)
        reshape(person, context)


def tell(name):
    """What happens when a measurement is set: it is known from then on, and the likeliest such
    person is shown.
    """

    def fit(person, context):
        if person.name_full not in _busy:
            with _quietly(person):
                person.habitus_known[NAMES.index(name)] = True
            fit_measures(person, context)

    return fit


def known(person) -> list:
    """The names of the measurements that the person shall have."""
    return [name for name, wanted in zip(NAMES, person.habitus_known, strict=True) if wanted]


def fit_measures(person, context):
    """Bring the person to the likeliest shape with the measurements that are known."""
    if person.name_full in _busy:
        return
    wanted = {name: getattr(person, f"habitus_{name}") for name in known(person)}
    model = body_of(person)
    if wanted and "densities" in model.arrays:
        try:
            betas = tailored(model, wanted, person.habitus_age)
        except (ValueError, np.linalg.LinAlgError):
            person["habitus_said"] = "nobody is like that"
            return
        person["habitus_said"] = ""
        with _quietly(person):
            person.habitus_betas = np.pad(betas, (0, BETAS - len(betas))).tolist()
    reshape(person, context)


def points_of(key) -> np.ndarray:
    """Where a shape key has the vertices (V, 3)."""
    points = np.empty(3 * len(key.data), np.float32)
    key.data.foreach_get("co", points)
    return points.reshape(-1, 3)


def rotations_of(person) -> np.ndarray:
    """How the bones are turned against their parents, in the body's axes (J, 3, 3)."""
    return np.stack(
        [_local(person.parent.pose.bones[name]) for name in body_of(person).joint_names]
    )


def correct(person):
    """Bring the live blend shape to how the bones are turned."""
    if person.get("habitus_baked"):
        return
    keys = person.data.shape_keys.key_blocks
    betas = np.array(person.habitus_betas)
    moved = body_of(person).correctives(rotations_of(person), betas, person.habitus_age)
    moved = (points_of(keys["Basis"]) + moved).astype(np.float32)
    if np.abs(moved - points_of(keys[KEY])).max() > 1e-7:
        keys[KEY].data.foreach_set("co", moved.ravel())
        person.data.update_tag()
        person.data.shape_keys.update_tag()


def _local(bone):
    rest = np.array(bone.bone.matrix_local.to_3x3())
    return rest @ np.array(bone.matrix_basis.to_quaternion().to_matrix()) @ rest.T
