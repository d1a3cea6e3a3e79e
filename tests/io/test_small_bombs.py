"""Small files that once hung a reader or filled the memory: each ends in one line, soon and without
much memory.
"""

import base64
import contextlib
import json
import struct
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from habitus.errors import HabitusError
from habitus.io.layouts.files import load_layout
from habitus.io.limits import read_json, read_toml, read_xml
from habitus.io.meshes import read_mesh
from habitus.io.registrations.templates import load_template
from habitus.io.rgbd.files import read_description, read_image
from habitus.io.rgbd.keypoints import read_keypoints
from habitus.io.rgbd.read import read_views
from habitus.io.scans import read_scan

MAX_BYTES = 300 << 20
MAX_SECONDS = 2.0


def peak_kilobytes() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def measured(read, path: Path):
    """What a reader gives or raises, checked to have been cheap (memory where Linux tells it)."""
    started = time.process_time()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts from what is there now
        before = peak_kilobytes()
    except OSError:
        before = None
    try:
        return read(path)
    except HabitusError as error:
        assert not isinstance(error.__cause__, MemoryError)
        return error
    finally:
        assert time.process_time() - started < MAX_SECONDS
        assert before is None or (peak_kilobytes() - before) * 1024 < MAX_BYTES


def refused(read, path: Path) -> str:
    error = measured(read, path)
    assert isinstance(error, HabitusError), error
    return str(error)


# -- descriptions of cameras -----------------------------------------------------------------------


def levels(count: int, form: str) -> str:
    lines = ["a0: &a0 {k: 1}" if "<<" in form else "a0: &a0 [1]"]
    for k in range(1, count):
        lines.append(form.format(k=k, refs=",".join([f"*a{k - 1}"] * 10)))
    return "\n".join(lines)


YAML_BOMBS = {
    "merges": levels(12, "a{k}: &a{k} {{<<: [{refs}], k{k}: 1}}"),
    "lists": levels(12, "a{k}: &a{k} [{refs}]"),
    "camera": levels(8, "a{k}: &a{k} [{refs}]") + "\ncamera_matrix: *a7\nfx: *a7",
    "plain": "data:\n" + "- 1.5\n" * 500_000,
    "short": "data: [" + "1," * 150_000 + "]",
    "deep": "[" * 200_000,
    "nested": "".join(" " * k + "a:\n" for k in range(1200)),
    "remarks": "#\n" * 400_000,
    "itself": "a: &a [*a]",
    "unknown": "a: *nobody",
    "keys": "? [1, 2]\n: 3",
}


@pytest.mark.parametrize("name", YAML_BOMBS)
def test_yaml_that_grows_is_refused(tmp_path, name):
    (tmp_path / "cameras.yaml").write_text(YAML_BOMBS[name])
    if name == "remarks":  # nothing grows in these: they are read
        assert not isinstance(measured(read_description, tmp_path / "cameras.yaml"), HabitusError)
    else:
        assert "cameras.yaml" in refused(read_description, tmp_path / "cameras.yaml")


def test_yaml_says_what_it_did():
    from habitus.io.rgbd.files import _yaml

    assert _yaml("") is None
    found = _yaml(
        "%YAML:1.0\n---\na: &a {x: 1, y: -2.5e-3}\nb: {<<: *a, x: 2}\nc: [*a, .inf, ~, true, '7', 010]\n"
        "d: !!opencv-matrix {rows: 1, dt: d, data: [1., .5]}\n<<: {e: text, a: 9}\n"
    )
    assert found["a"] == {"x": 1, "y": -0.0025} and found["b"] == {"x": 2, "y": -0.0025}
    assert found["c"] == [found["a"], float("inf"), None, True, "7", 10]
    assert found["d"] == {"rows": 1, "dt": "d", "data": [1.0, 0.5]} and found["e"] == "text"


def test_json_of_many_small_values_is_refused():
    with pytest.raises(HabitusError, match="values"):
        read_json("[" + "[]," * 3_000_000 + "1]")
    with pytest.raises(HabitusError):
        read_toml("a = [" + "1," * 2_000_000 + "]")


# -- layouts ---------------------------------------------------------------------------------------

NAMES = [f"label_number_{k}" for k in range(60_000)]
MARKER = '<Marker name="{}"><body>pelvis</body><location>0 0 0</location></Marker>'
LAYOUTS = {
    "labels.txt": "\n".join(NAMES),
    "labels.xml": f"<a>{''.join(f'<Marker name={name!r}/>' for name in NAMES)}</a>",
    "markers.osim": f"<a>{''.join(map(MARKER.format, NAMES[:20_000]))}</a>",
    "elements.xml": f"<a>{'<b/>' * 4_000_000}</a>",
    "long.xml": f"<a>{'<b/>' * 15_000_000}</a>",
    "attributes.xml": f"<a {' '.join(f'{name}={name!r}' for name in NAMES * 6)}/>",
    "labels.json": json.dumps({"markersets": [{"indices": dict.fromkeys(NAMES, 1)}]}),
    "labels.toml": 'name = "x"\n[markers]\n'
    + "".join(f'{n} = "sternum"\n' for n in NAMES[:20_000]),
    "long.txt": "x" * 60_000_000,
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_of_very_many_labels_are_refused(tmp_path, name):
    (tmp_path / name).write_text(LAYOUTS[name])
    assert name in refused(load_layout, tmp_path / name)


@pytest.mark.parametrize("name", ["labels.txt", "labels.xml"])
def test_layouts_of_as_many_labels_as_allowed_are_read_or_refused_soon(tmp_path, name):
    few = ["LFHD", "RFHD", "C7", "STRN", "LASI", "RASI", "LKNE", "RKNE", *NAMES[:300]]
    form = {"labels.txt": "{}\n", "labels.xml": "<Marker name='{}'/>"}[name]
    text = "".join(map(form.format, few))
    (tmp_path / name).write_text(text if name.endswith("txt") else f"<a>{text}</a>")
    load_layout("cmu-41")  # shipped layouts are read once a process
    measured(load_layout, tmp_path / name)


def test_a_file_is_not_read_before_its_size_is_known(tmp_path):
    for name in ("a.txt", "a.toml", "a.json", "a.osim", "a.yaml"):
        path = tmp_path / name
        with path.open("wb") as file:
            file.truncate(3 << 30)
        read = read_description if name == "a.yaml" else load_layout
        assert "expected at most" in refused(read, path)
    with (tmp_path / "t.toml").open("wb") as file:
        file.truncate(3 << 30)
    assert "expected at most" in refused(load_template, tmp_path / "t.toml")


@pytest.mark.parametrize("extends", ["../base.toml", "/etc/base.toml", "a/../../base.toml"])
def test_a_layout_does_not_lead_out_of_its_folder(tmp_path, extends):
    (tmp_path / "base.toml").write_text('name = "base"\n[markers]\nA = "sternum"\n')
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "x.toml").write_text(f'name = "x"\nextends = "{extends}"\n')
    assert "leads out" in refused(load_layout, tmp_path / "in" / "x.toml")
    (tmp_path / "in" / "y.toml").write_text('name = "y"\nextends = "deep/base.toml"\n')
    (tmp_path / "in" / "deep").mkdir()
    (tmp_path / "base.toml").rename(tmp_path / "in" / "deep" / "base.toml")
    assert load_layout(tmp_path / "in" / "y.toml").markers[0].label == "A"


def test_xml_is_counted_as_it_is_read():
    with pytest.raises(HabitusError, match="elements"):
        read_xml("<a>" + "<b/>" * 300_000 + "</a>")


# -- meshes and scans ------------------------------------------------------------------------------


@pytest.mark.parametrize("read", [read_mesh, read_scan])
@pytest.mark.parametrize(
    "text",
    [
        "\n" * 300_000,
        "\r\n" * 150_000,
        " " * 300_000,
        " \n" * 150_000,
        "f" * 300_000,
        "f 1\n" * 75_000,
        "f 1" * 100_000,
        "\\\n" * 150_000,
        "usemtl a\n" * 30_000,
        "v 0 0 0\nf 1 1 99999999\\\n99999999\n",
        "v 0 0 0\n" + "o a\nf 1 1 1\n" * 20_000,
    ],
)
def test_an_obj_takes_time_in_proportion(tmp_path, read, text):
    (tmp_path / "a.obj").write_text(text)
    measured(read, tmp_path / "a.obj")


def png(width: int, height: int, bits: int = 8) -> bytes:
    """A flat grey image."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    row = b"\0" + bytes(width * bits // 8)
    machine = zlib.compressobj(1)
    data = b"".join(machine.compress(row * 100) for _ in range(height // 100)) + machine.flush()
    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def gltf(picture: bytes | None = None, **changed) -> tuple[dict, bytes]:
    points = np.eye(3, dtype="<f4")
    data = points.tobytes() + np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ],
    }
    if picture is not None:
        document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(data), "byteLength": len(picture)}
        )
        data += picture
        document["images"] = [{"bufferView": 2, "mimeType": "image/png"}]
        document["textures"] = [{"source": 0}]
        document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        document["meshes"][0]["primitives"][0]["material"] = 0
    data += bytes(-len(data) % 4)
    return document | {"buffers": [{"byteLength": len(data)}]} | changed, data


def glb(path: Path, document: dict, data: bytes) -> Path:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    total = 28 + len(text) + len(data)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, total)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(data), b"BIN\0")
        + data
    )
    return path


def test_a_scene_shows_a_mesh_in_few_places(tmp_path):
    assert len(read_scan(glb(tmp_path / "a.glb", *gltf())).points) == 3
    nodes = {"nodes": [{"mesh": 0}] * 20_000, "scenes": [{"nodes": list(range(20_000))}]}
    assert "nodes" in refused(read_scan, glb(tmp_path / "a.glb", *gltf(**nodes)))
    whole = np.zeros((200_000, 3), "<f4").tobytes()
    document, _ = gltf(
        bufferViews=[{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteLength": len(whole)}],
        nodes=[{"mesh": 0}] * 1000,
        scenes=[{"nodes": list(range(1000))}],
    )
    document["accessors"][0] |= {"bufferView": 1, "count": 200_000}
    assert "may fill" in refused(read_scan, glb(tmp_path / "a.glb", document, whole))


def test_an_accessor_without_bytes_is_held_against_the_file(tmp_path):
    document, data = gltf()
    document["accessors"][0] = {"componentType": 5126, "count": 10**9, "type": "VEC3"}
    assert "may fill" in refused(read_scan, glb(tmp_path / "a.glb", document, data))


@pytest.mark.parametrize("material", ["plain", "glossy"])
@pytest.mark.parametrize("where", ["inside", "base64", "beside"])
def test_pictures_of_a_scan_are_bounded_before_they_are_unpacked(tmp_path, material, where):
    picture = png(13_000, 13_000)
    document, data = gltf(picture)
    if where != "inside":
        (tmp_path / "p.png").write_bytes(picture)
        uri = (
            "p.png"
            if where == "beside"
            else "data:image/png;base64," + base64.b64encode(picture).decode()
        )
        document["images"] = [{"uri": uri}]
    if material == "glossy":
        document["materials"] = [
            {
                "extensions": {
                    "KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}
                }
            }
        ]
    assert "pictures" in refused(read_scan, glb(tmp_path / "a.glb", document, data))


def test_pictures_of_an_obj_are_bounded_before_they_are_unpacked(tmp_path):
    (tmp_path / "a.png").write_bytes(png(13_000, 13_000))
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    assert "pictures" in refused(read_scan, tmp_path / "a.obj")


def test_a_picture_of_a_fair_size_is_used(tmp_path):
    scan = read_scan(glb(tmp_path / "a.glb", *gltf(png(400, 400))))
    assert scan.colours is not None and len(scan.colours) == len(scan.colour_places) == 400_000


# -- folders of depth images -----------------------------------------------------------------------


def test_images_of_a_depth_folder_are_bounded_in_all(tmp_path):
    (tmp_path / "depth").mkdir()
    (tmp_path / "cameras.json").write_text('{"fx": 500, "fy": 500, "cx": 320, "cy": 240}')
    flat = png(7000, 7000, bits=16)
    for k in range(12):
        (tmp_path / "depth" / f"{k}.png").write_bytes(flat)
    assert "may fill" in refused(read_views, tmp_path)


def test_keypoints_in_a_long_file_are_refused(tmp_path):
    (tmp_path / "a.json").write_text('{"people": [' + "{}," * 2_000_000 + "{}]}")
    refused(read_keypoints, tmp_path / "a.json")


def test_a_png_chunk_that_is_longer_than_its_file_takes_no_memory(tmp_path):
    """PIL asks for as many bytes as the chunk claims."""
    path = tmp_path / "depth.png"
    Image.fromarray(np.ones((18, 24), np.uint16)).save(path)
    raw = path.read_bytes()
    at = raw.index(b"IDAT") - 4
    path.write_bytes(raw[:at] + struct.pack(">I", 0x7FFFFFF0) + raw[at + 4 :])
    tracemalloc.start()
    try:
        with contextlib.suppress(HabitusError):
            read_image(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 10 << 20
