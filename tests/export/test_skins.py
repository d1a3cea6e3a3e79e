"""A default body's skin in files, read back by other programs' readers."""

import io
import json
import shutil
import subprocess

import numpy as np
import pytest
import trimesh
from PIL import Image
from read_fbx import read_records
from read_glb import Glb
from scipy.spatial import KDTree
from synthetic_fit import synthetic_fit, tube_body

from habitus import load_body
from habitus.body.skin import TONES, paint_skin, skin_mesh, skin_of
from habitus.errors import HabitusError
from habitus.export import write_glb
from habitus.export.motion import export_motion
from habitus.export.skins import write_painted_surface
from habitus.io.people import BodyShape
from habitus.jobs.exporting import export_file

VALIDATE = """
const validator = require("gltf-validator"), data = require("fs").readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(data)).then((report) => console.log(JSON.stringify(report.issues)));
"""


@pytest.fixture(scope="module")
def person():
    body = load_body("female")
    return BodyShape("her", body, np.zeros(body.num_betas), "her").standing()


@pytest.fixture(scope="module")
def picture():
    return paint_skin(TONES["medium"])


@pytest.fixture(scope="module")
def full():
    return load_body("female", detail="full")


def pixels(content):
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def seen_at(uv, picture):
    """Colours at coordinates that count from below left."""
    size = len(picture)
    column, row = (np.asarray(uv) * [size, -size] + [0, size]).astype(int).clip(0, size - 1).T
    return picture[row, column]


def check_coordinates(uv, source, picture, full):
    """The file's coordinates show each vertex the colour that the body's own places have."""
    known = skin_of(full.mesh, "medium").colours
    apart = np.abs(seen_at(uv, picture).astype(int) - known[source]).max(axis=1)
    assert np.median(apart) <= 2 and (apart < 40).mean() > 0.98


def test_glb_carries_texture_and_coordinates(tmp_path, person, picture, full):
    told = export_motion(person, tmp_path / "a.glb", skin="medium")
    assert told.skinned
    glb = Glb(tmp_path / "a.glb")
    material = glb.json["materials"][0]["pbrMetallicRoughness"]
    assert material["baseColorFactor"] == [1, 1, 1, 1]
    texture = glb.json["textures"][material["baseColorTexture"]["index"]]
    assert glb.json["images"][texture["source"]]["mimeType"] == "image/png"
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (mesh,) = scene.geometry.values()
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(image, picture)
    places = np.asarray(mesh.vertices)
    source = nearest(full, places)
    check_coordinates(mesh.visual.uv, source, picture, full)


def nearest(full, places):
    """The body's vertex at each place; the file may stand elsewhere."""
    at = places - places.min(axis=0) + full.v_template.min(axis=0)
    away, source = KDTree(full.v_template).query(at)
    assert away.max() < 1e-5
    return source


def test_khronos_validator_finds_nothing(tmp_path, person):
    node = shutil.which("node")
    if (
        not node
        or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode
    ):
        pytest.skip("no validator here: npm install gltf-validator, NODE_PATH")
    for name in ("moving.glb", "still.glb"):
        if name == "moving.glb":
            export_motion(person, tmp_path / name, skin=0.3)
        else:
            write_still_glb(tmp_path / name)
        run = subprocess.run(
            [node, "-e", VALIDATE, tmp_path / name], capture_output=True, text=True
        )
        assert json.loads(run.stdout)["messages"] == []


def write_still_glb(path):
    surface = load_body("male", detail="full")()
    write_painted_surface(surface, path, skin_of(surface.mesh, "dark"))


def test_fbx_carries_texture_and_coordinates(tmp_path, person, picture, full):
    export_motion(person, tmp_path / "a.fbx", skin="medium")
    records = {record.name: record for record in read_records((tmp_path / "a.fbx").read_bytes())}
    objects = records["Objects"]
    (video,), (texture,) = objects.all("Video"), objects.all("Texture")
    assert np.array_equal(pixels(video["Content"].values[0]), picture)
    links = [record.values for record in records["Connections"].records]
    (material,) = objects.all("Material")
    assert ["OP", texture.values[0], material.values[0], "DiffuseColor"] in links
    assert ["OO", video.values[0], texture.values[0]] in links
    layer = objects.all("Geometry")[0]["LayerElementUV"]
    uv = np.asarray(layer["UV"].values[0]).reshape(-1, 2)
    assert np.allclose(uv, skin_mesh(full.mesh).uv, atol=1e-6)


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz"])
def test_usd_carries_texture_and_coordinates(tmp_path, person, picture, full, ending):
    pytest.importorskip("pxr", reason="no usd-core here: pip install 'habitus[usd]'")
    from pxr import Ar, Usd, UsdGeom, UsdShade, UsdValidation

    export_motion(person, tmp_path / f"a.{ending}", skin="medium")
    beside = [] if ending == "usdz" else ["a_skin.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([f"a.{ending}", *beside])
    stage = Usd.Stage.Open(str(tmp_path / f"a.{ending}"))
    mesh = UsdGeom.Mesh.Get(stage, "/person/body")
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    texture = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSource()[0].GetPrim())
    assert texture.GetIdAttr().Get() == "UsdUVTexture"
    path = texture.GetInput("file").Get()
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path.resolvedPath))
    assert np.array_equal(pixels(bytes(opened.GetBuffer())), picture)
    uv = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    own = skin_mesh(full.mesh)
    assert np.allclose(np.array(uv).reshape(-1, 4, 2), own.uv[own.quad_uv], atol=1e-6)
    if ending == "usdz":
        found = UsdValidation.ValidationContext(
            UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        ).Validate(stage)
        assert not [f"{error.GetName()}: {error.GetMessage()}" for error in found]


def test_obj_has_material_and_texture_beside_it(tmp_path, person, picture):
    export_motion(person, tmp_path / "a.obj", skin="medium", frame=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mtl", "a.obj", "a_skin.png"]
    mesh = trimesh.load(tmp_path / "a.obj", process=False)
    assert np.array_equal(np.asarray(mesh.visual.material.image.convert("RGB")), picture)
    export_motion(person, tmp_path / "frames", skin="medium")
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names[-2:] == ["skin.mtl", "skin_skin.png"] and names[0].endswith(".obj")
    mesh = trimesh.load(tmp_path / "frames" / names[0], process=False)
    assert np.array_equal(np.asarray(mesh.visual.material.image.convert("RGB")), picture)


def test_ply_has_colours_of_vertices(tmp_path, person, full):
    export_motion(person, tmp_path / "a.ply", skin="medium")
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    known = skin_of(full.mesh, "medium").colours
    assert np.array_equal(np.asarray(mesh.visual.vertex_colors)[:, :3], known)
    export_motion(person, tmp_path / "b.ply")
    assert trimesh.load(tmp_path / "b.ply", process=False).visual.kind is None


def test_without_a_skin_files_stay_as_they_were(tmp_path, person):
    export_motion(person, tmp_path / "a.glb")
    export_motion(person, tmp_path / "b.glb", skin="none")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    assert "images" not in Glb(tmp_path / "a.glb").json


def test_other_bodies_stay_plain(tmp_path):
    fit = synthetic_fit(3, body=tube_body())
    told = export_motion(fit, tmp_path / "a.glb", skin="dark")
    write_glb(fit, tmp_path / "b.glb")
    assert not told.skinned
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_skins_that_cannot_be(tmp_path, person):
    with pytest.raises(HabitusError, match=r"a\.bvh: skin is for files that hold a mesh"):
        export_motion(person, tmp_path / "a.bvh", skin="dark")
    with pytest.raises(HabitusError, match="skin is 'blue'; expected light, medium, dark"):
        export_file(person, tmp_path / "a.glb", skin="blue")
    assert not list(tmp_path.iterdir())
