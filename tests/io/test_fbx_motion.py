"""FBX in: our own files come back, foreign characters with all that a node's transformation may
hold, and what independent programs say of the same files.
"""

import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from foreign_rigs import MIXAMO, bvh_text, foreign, walk_motion
from made_fbx_character import as_text, write_fbx_character
from read_blender import PROGRAMS
from scipy.spatial.transform import Rotation

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.fbx.character import skin_of_scene
from habitus.export.fbx.nodes import Node, Value, document, kept
from habitus.export.fbx.scene import prop
from habitus.export.fbx.write import write_fbx
from habitus.io.models.bodies import load_body
from habitus.io.motions.fbx import ORDERS, read_fbx
from habitus.io.motions.fbx_curves import curve_of
from habitus.io.motions.fbx_motion import read_fbx_motion
from habitus.io.motions.fbx_nodes import FbxNode, read_document
from habitus.io.people import read_motion
from habitus.jobs.characters import retarget_to_character


@pytest.fixture(scope="module")
def walk() -> BodyMotion:
    return walk_motion()


@pytest.mark.parametrize(("name", "joints"), [("default", "smpl"), ("female", "smplx")])
def test_our_own_file_comes_back(name, joints, tmp_path):
    rng = np.random.default_rng(0)
    body = load_body(name, joints=joints)
    pose = np.cumsum(0.03 * rng.normal(size=(30, body.num_joints, 3)), axis=0)
    trans = np.cumsum(0.01 * rng.normal(size=(30, 3)), axis=0)
    motion = BodyMotion(body, rng.normal(size=body.num_betas), pose, trans, 120.0, "+y")
    write_fbx(motion, tmp_path / "own.fbx", correctives="none")
    back = read_motion(tmp_path / "own.fbx")
    assert back.rate_hz == 120.0
    assert "its skeleton is the body's own" in back.made
    np.testing.assert_allclose(back.vertices(), motion.vertices(), atol=1e-6)


BLENDER = """
import bpy, sys
out, path, scale, one, other = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="io_scene_fbx")
bpy.ops.import_anim.bvh(filepath=path, global_scale=float(scale), update_scene_fps=True,
                        update_scene_duration=True)
(rig,) = bpy.data.objects
bones = rig.data.bones
points = [[tuple(b.head_local), (*b.head_local[:2], b.head_local[2] + 0.1), (0, 0, 0)] for b in bones]
mesh = bpy.data.meshes.new("dots")
mesh.from_pydata(sum(points, []), [], [(3 * k, 3 * k + 1, 3 * k + 2) for k in range(len(bones))])
dots = bpy.data.objects.new("dots", mesh)
bpy.context.collection.objects.link(dots)
for k, bone in enumerate(bones):
    dots.vertex_groups.new(name=bone.name).add([3 * k, 3 * k + 1, 3 * k + 2], 1.0, "REPLACE")
dots.parent = rig
dots.modifiers.new("rig", "ARMATURE").object = rig
bpy.ops.export_scene.fbx(filepath=out, primary_bone_axis=one, secondary_bone_axis=other,
                         bake_anim_simplify_factor=0.0)
"""


@pytest.mark.parametrize(("scale", "axes"), [("0.01", ("Y", "X")), ("1.0", ("-Y", "Z"))])
def test_blenders_export_of_a_bvh_is_the_bvh(walk, scale, axes, tmp_path):
    if PROGRAMS["bpy"] is None:
        pytest.skip("no bpy here: pip install bpy")
    (tmp_path / "a.bvh").write_text(bvh_text(foreign(walk, MIXAMO)))
    (tmp_path / "convert.py").write_text(BLENDER)
    words = [tmp_path / "convert.py", "--", tmp_path / "a.fbx", tmp_path / "a.bvh", scale, *axes]
    subprocess.run([*PROGRAMS["bpy"], *map(str, words)], check=True, capture_output=True)
    one, other = (read_motion(tmp_path / f"a.{ending}") for ending in ("bvh", "fbx"))
    np.testing.assert_allclose(other.vertices(), one.vertices(), atol=1e-5)


def edited(source: Path, target: Path, change: Callable[[Node], Node]) -> None:
    """Write a binary FBX file again with every node changed."""
    read = read_document(source.read_bytes())

    def again(node: Node) -> Node:
        return change(Node(node.name, node.values, list(map(again, node.nodes)), node.scope))

    nodes = [again(kept(node)) for node in read.nodes]
    target.write_bytes(document(nodes, read.version))


def _property(name: str, *values: Value) -> Callable[[Node], Node]:
    """A change of one property."""

    def change(node: Node) -> Node:
        words = node.values
        is_it = node.name == "P" and bytes(words[0])[5:] == name.encode()
        return Node("P", (*words[:4], *values)) if is_it else node

    return change


def of_ufbx(path: Path) -> dict[str, np.ndarray]:
    """World matrices of a file's nodes by name, evaluated by ufbx; skips where it is missing."""
    ufbx = pytest.importorskip("ufbx", reason="no pyufbx here: pip install pyufbx")
    with ufbx.load_file(str(path)) as theirs:
        return {node.name: np.array(node.node_to_world).T for node in theirs.nodes}


def check_transformations(path: Path) -> None:
    """The nodes of a file are where ufbx has them."""
    scene, matrices = read_fbx(path), of_ufbx(path)
    linear, places = scene.world(scene.at_rest())
    for k, model in enumerate(scene.models):
        np.testing.assert_allclose(linear[k], matrices[model.name][:3, :3], atol=1e-9)
        np.testing.assert_allclose(places[k], matrices[model.name][:3, 3], atol=1e-9)


@pytest.mark.parametrize("options", [{}, {"scale": 1.0, "unit": 2.54, "version": 7700}])
def test_transformations_are_those_of_ufbx(options, tmp_path):
    """With pivots, PreRotation, PostRotation and all rotation orders."""
    write_fbx_character(tmp_path / "a.fbx", step=40, **options)
    assert {model.order for model in read_fbx(tmp_path / "a.fbx").models} == set(ORDERS)
    check_transformations(tmp_path / "a.fbx")


@pytest.mark.parametrize("inherit", [0, 1, 2])
def test_uneven_scales_are_inherited_as_by_ufbx(inherit, tmp_path):
    write_fbx_character(tmp_path / "a.fbx", step=40)
    inherits = _property("InheritType", inherit)
    scales = _property("Lcl Scaling", 0.8, 1.3, 1.1)
    edited(tmp_path / "a.fbx", tmp_path / "b.fbx", lambda node: scales(inherits(node)))
    check_transformations(tmp_path / "b.fbx")


CHARACTERS = [
    {},
    {"scale": 1.0, "unit": 2.54, "version": 7700, "seed": 1},
    {"scale": 0.01, "unit": 100.0, "arms": 0.0, "stretch": (0.7, 0.6, 0.7)},
]


@pytest.mark.parametrize("options", CHARACTERS)
def test_a_character_moves_as_it_was_solved(walk, options, tmp_path):
    write_fbx_character(tmp_path / "a.fbx", **options)
    moved = retarget_to_character(walk, tmp_path / "a.fbx", out=tmp_path / "b.fbx")
    back = read_fbx_motion(tmp_path / "b.fbx")
    assert back.rate_hz == 60.0
    at = {name.removeprefix("rig:"): k for k, name in enumerate(back.rig.names)}
    joints = dict(
        zip(moved.motion.body.joint_names, np.moveaxis(moved.motion.joints(), 1, 0), strict=True)
    )
    for ours, name in MIXAMO.items():
        np.testing.assert_allclose(back.places[:, at[name]], joints[ours], atol=1e-5)
    for one, other in pairwise(["left_shoulder", "left_elbow", "left_wrist"]):
        k, j = (walk.body.joint_names.index(each) for each in (one, other))
        theirs, source = joints[other] - joints[one], walk.joints()[:, j] - walk.joints()[:, k]
        cosine = (theirs * source).sum(1) / np.prod(
            [np.linalg.norm(each, axis=1) for each in (theirs, source)], axis=0
        )
        assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 1.0


SURFACE = """
import bpy, sys, numpy as np
out, path, operator = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="io_scene_fbx")
group, call = operator.split(".")
getattr(getattr(bpy.ops, group), call)(filepath=path)
scene = bpy.context.scene
body = next(o for o in bpy.data.objects if o.type == "MESH")
found = {}
for frame in (0, 20, 58):
    at = 1 + frame * scene.render.fps / scene.render.fps_base / 60.0
    scene.frame_set(int(at), subframe=at - int(at))
    posed = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = posed.to_mesh()
    points = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", points)
    whole = np.array(posed.matrix_world)
    found[str(frame)] = points.reshape(-1, 3) @ whole[:3, :3].T + whole[:3, 3]
np.savez(out, **found)
"""


@pytest.mark.parametrize("operator", ["import_scene.fbx", "wm.fbx_import"])
def test_blender_shows_the_character_as_it_was_solved(walk, operator, tmp_path):
    if PROGRAMS["bpy"] is None:
        pytest.skip("no bpy here: pip install bpy")
    write_fbx_character(tmp_path / "a.fbx", pivots=False)
    moved = retarget_to_character(walk, tmp_path / "a.fbx", out=tmp_path / "b.fbx")
    (tmp_path / "look.py").write_text(SURFACE)
    words = [tmp_path / "look.py", "--", tmp_path / "seen.npz", tmp_path / "b.fbx", operator]
    subprocess.run([*PROGRAMS["bpy"], *map(str, words)], check=True, capture_output=True)
    with np.load(tmp_path / "seen.npz") as seen:
        for frame in (0, 20, 58):
            x, up, back = seen[str(frame)].T[[0, 2, 1]]
            there = np.stack([x, up, -back], axis=1)
            np.testing.assert_allclose(there, moved.motion.vertices(frame), atol=1e-5)


def test_all_that_the_file_held_is_kept(walk, tmp_path):
    write_fbx_character(tmp_path / "a.fbx", frames=5)
    retarget_to_character(walk, tmp_path / "a.fbx", out=tmp_path / "b.fbx")
    one, other = (read_document((tmp_path / name).read_bytes()) for name in ("a.fbx", "b.fbx"))
    for name in ("Objects", "Connections"):
        before, after = one.first(name).nodes, other.first(name).nodes
        assert len(after) > len(before)
        for a, b in zip(before, after, strict=False):
            assert _flat(a) == _flat(b)
    assert _flat(one.first("GlobalSettings")) == _flat(other.first("GlobalSettings"))
    retarget_to_character(walk, tmp_path / "b.fbx", out=tmp_path / "c.fbx")
    third = read_document((tmp_path / "c.fbx").read_bytes())
    stacks = [n.value(1) for n in third.first("Objects").all("AnimationStack")]
    assert len(set(stacks)) == 3


def _flat(node: FbxNode) -> tuple:
    return node.name, node.encoded, node.scope, tuple(map(_flat, node.nodes))


def test_text_holds_what_binary_does(walk, tmp_path):
    write_fbx_character(tmp_path / "a.fbx", frames=20)
    (tmp_path / "b.fbx").write_text(as_text((tmp_path / "a.fbx").read_bytes()))
    one, other = (read_fbx_motion(tmp_path / name) for name in ("a.fbx", "b.fbx"))
    assert one.rig.names == other.rig.names
    np.testing.assert_allclose(other.places, one.places, atol=1e-6)
    np.testing.assert_allclose(other.turns, one.turns, atol=1e-6)
    with pytest.raises(HabitusError, match="save it as binary FBX"):
        retarget_to_character(walk, tmp_path / "b.fbx", out=tmp_path / "c.fbx")


def test_without_a_skin_joints_rest_where_only_their_axes_turn_them(tmp_path):
    """As a skeleton that Mixamo or Maya wrote: what turns a joint at rest is its PreRotation."""
    for name, posed in (("a.fbx", 0.3), ("b.fbx", 0.0)):
        write_fbx_character(tmp_path / name, skinned=False, plain=True, frames=9, posed=posed)
    one, other = (read_fbx_motion(tmp_path / name) for name in ("a.fbx", "b.fbx"))
    np.testing.assert_allclose(one.rig.turns, other.rig.turns, atol=1e-6)


def test_curves_are_the_polynomials_of_their_keys():
    """Cubic segments with stored slopes are a cubic; automatic ones a parabola inside; lines and
    steps are what they are.
    """
    second = 46_186_158_000
    times = np.array([0.0, 0.5, 1.5, 2.0, 3.0])
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.7])
    slope = cubic.deriv()
    fine = np.linspace(0.0, 3.0, 301)

    def curve(values, flags, leaving, arriving, weights=0.0):
        data = np.zeros((len(times), 4), np.float32)
        data[:, 0], data[:-1, 1], data[:, 2] = leaving, arriving[1:], weights
        node = FbxNode(
            "AnimationCurve",
            (),
            tuple(
                _array(name, array)
                for name, array in (
                    ("KeyTime", np.round(times * second).astype("<i8")),
                    ("KeyValueFloat", np.asarray(values, "<f4")),
                    ("KeyAttrFlags", np.full(len(times), flags, "<i4")),
                    ("KeyAttrDataFloat", data.ravel()),
                    ("KeyAttrRefCount", np.ones(len(times), "<i4")),
                )
            ),
        )
        return curve_of(node, second).at(fine * second, second)

    slopes = slope(times)
    user = curve(cubic(times), 0x8 | 0x400, slopes, slopes)
    np.testing.assert_allclose(user, cubic(fine), atol=1e-5)
    third = np.array([3333 | 3333 << 16], "<u4").view("<f4")[0]
    weighted = curve(cubic(times), 0x8 | 0x400 | 0x3000000, slopes, slopes, third)
    np.testing.assert_allclose(weighted, cubic(fine), atol=2e-3)
    line = curve(times, 0x4, slopes, slopes)
    np.testing.assert_allclose(line, fine, atol=1e-6)
    step = curve(times, 0x2, slopes, slopes)
    np.testing.assert_allclose(step, times[np.searchsorted(times, fine, "right") - 1], atol=1e-6)
    auto = curve(3.0 * times - 1.0, 0x8 | 0x100, np.zeros(5), np.zeros(5))
    np.testing.assert_allclose(auto, 3.0 * fine - 1.0, atol=1e-5)


def _array(name: str, array: np.ndarray) -> FbxNode:
    code = {"i8": b"l", "f4": b"f", "i4": b"i"}[array.dtype.str[1:]]
    sizes = np.array([len(array), 0, array.nbytes], "<u4").tobytes()
    return FbxNode(name, (code + sizes + array.tobytes(),))


def test_what_cannot_be_read_is_refused(walk, tmp_path):
    path = tmp_path / "a.fbx"
    write_fbx_character(path, frames=5)
    content = path.read_bytes()
    cases = {
        "expected 7.0 or later": content[:23] + b"\xd4\x17\0\0" + content[27:],
        "a node goes beyond what holds it": content[:1000],
        "neither binary nor text": b"\xff\xfe\xff" * 100,
        "expected an FBX file": b"solid cube",
    }
    for message, damaged in cases.items():
        path.write_bytes(damaged)
        with pytest.raises(HabitusError, match=message) as error:
            read_fbx_motion(path)
        assert str(path) in str(error.value)
    write_fbx_character(path)
    with pytest.raises(HabitusError, match="no animation rotates its joints"):
        read_fbx_motion(path)
    with pytest.raises(HabitusError, match=r"expected \.fbx for the character"):
        retarget_to_character(walk, path, out=tmp_path / "b.glb")


def test_a_geometric_transformation_moves_the_mesh_alone(tmp_path):
    """3ds Max keeps an object's offset as one: the same character with its vertices moved back."""
    write_fbx_character(tmp_path / "a.fbx", step=4)
    scaling, angles, shift = np.array([2.0, 0.5, 1.5]), [20.0, -30.0, 40.0], np.array([3.0, 5, -2])
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    names = ("GeometricTranslation", "GeometricRotation", "GeometricScaling")

    def offset(node: Node) -> Node:
        if node.name == "Vertices":
            points = FbxNode("Vertices", (bytes(node.values[0]),)).array().reshape(-1, 3)
            return Node("Vertices", (((points - shift) @ turn / scaling).ravel(),))
        if node.name == "Model" and bytes(node.values[2]).endswith(b"Mesh"):
            added = [
                prop(name, "Vector3D", "Vector", "", *map(float, values))
                for name, values in zip(names, (shift, angles, scaling), strict=True)
            ]
            given = [Node(n.name, n.values, [*n.nodes, *added], n.scope) for n in node.nodes[1:]]
            return Node(node.name, node.values, [node.nodes[0], *given], node.scope)
        return node

    edited(tmp_path / "a.fbx", tmp_path / "b.fbx", offset)
    one, other = (skin_of_scene(read_fbx(tmp_path / name)) for name in ("a.fbx", "b.fbx"))
    np.testing.assert_allclose(other.vertices, one.vertices, atol=1e-9)


def test_a_curve_is_read_once(tmp_path, monkeypatch):
    """However many stacks, layers and nodes of a malicious file name it."""
    write_fbx_character(tmp_path / "a.fbx", step=40, frames=5)

    def repeated(node: Node) -> Node:
        if node.name in ("Connections", "Objects"):
            return Node(node.name, node.values, [*node.nodes] * 20, node.scope)
        return node

    edited(tmp_path / "a.fbx", tmp_path / "b.fbx", repeated)
    calls = []
    monkeypatch.setattr(
        "habitus.io.motions.fbx_motion.curve_of", lambda *a: calls.append(a) or curve_of(*a)
    )
    one, other = (read_fbx_motion(tmp_path / name) for name in ("a.fbx", "b.fbx"))
    np.testing.assert_array_equal(one.turns, other.turns)
    assert len(calls) == 12  # two shoulders, three axes, two files


def _first(name: str, *values: Value) -> Callable[[Node], Node]:
    return lambda node: Node(name, values, node.nodes) if node.name == name else node


@pytest.mark.parametrize(
    ("message", "change"),
    [
        ("not three finite numbers each", _first("Vertices", np.zeros(301))),
        ("TransformLink has no inverse", _first("TransformLink", np.zeros(16))),
        ("UnitScaleFactor -1; expected a positive", _property("UnitScaleFactor", -1.0)),
        ("left-handed axes", _property("CoordAxisSign", -1)),
        ("rotation order 6", _property("RotationOrder", 6)),
    ],
)
def test_a_damaged_character_is_refused_with_its_name(walk, message, change, tmp_path):
    write_fbx_character(tmp_path / "a.fbx", step=4)
    edited(tmp_path / "a.fbx", tmp_path / "b.fbx", change)
    with pytest.raises(HabitusError, match=message) as error:
        retarget_to_character(walk, tmp_path / "b.fbx", out=tmp_path / "c.fbx")
    assert str(error.value).count(str(tmp_path / "b.fbx")) == 1
    assert not (tmp_path / "c.fbx").exists()
