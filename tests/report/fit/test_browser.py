"""The report in a real browser (headless Chromium, software WebGL): it runs, and it draws the right body."""

import json
import re
from html import unescape

import numpy as np
import pytest
import torch
from browser import chromium, visit
from PIL import Image
from synthetic_fit import synthetic_fit, tube_body

from habitus.export.arrays import up_rotation
from habitus.report.fit.page import report_page

# Draws the body alone, white on black, and writes down its silhouette, camera, and joints.
PROBE = """
<script>
const { player } = habitusReport, { canvas, scene } = player, { gl } = scene;
player.set({ frame: %s, stage: '%s', layers: { body: true } });
const black = [0, 0, 0], lit = [1, 1, 1];
player.colors = { ...player.colors, background: black, albedo: [40, 40, 40], sky: lit, ground: lit, key: 1 };
const draw = scene.draw.bind(scene), enable = gl.enable.bind(gl);
scene.draw = view => draw({ ...view, show: { ...view.show, floor: false } });
gl.enable = what => what === gl.CULL_FACE || enable(what);  // the test's tubes have no lids
player.draw();
const width = canvas.width, height = canvas.height, pixels = new Uint8Array(4 * width * height);
gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
let bits = '';
for (let i = 0; i < width * height; i++) bits += pixels[4 * i] > 127 ? '1' : '0';
const camera = [...player.viewProjection], bones = [...player.pose.bones];
document.body.dataset.probe = JSON.stringify({ width, height, camera, bits, bones });
</script>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    chromium()
    return tmp_path_factory.mktemp("browser")


def body_tag(dom: str) -> dict[str, str]:
    tag = re.search(r"<body[^>]*>", dom)[0]
    return {key: unescape(value) for key, value in re.findall(r'data-([a-z]+)="([^"]*)"', tag)}


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixels (row 0 at the bottom) that triangles cover."""
    clip = np.c_[vertices, np.ones(len(vertices))] @ camera.reshape(4, 4)
    screen = (clip[:, :2] / clip[:, 3:] + 1) * [width / 2, height / 2]
    covered = np.zeros((height, width), bool)
    for a, b, c in screen[faces]:
        low = np.maximum(np.floor(np.minimum(np.minimum(a, b), c)), 0).astype(int)
        high = np.minimum(np.ceil(np.maximum(np.maximum(a, b), c)), [width, height]).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        edges = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        inside = np.all([e >= 0 for e in edges], axis=0) | np.all([e <= 0 for e in edges], axis=0)
        covered[low[1] : high[1], low[0] : high[0]] |= inside
    return covered


@pytest.mark.parametrize("stage", ["pose", "soft_tissue"])
def test_the_player_draws_the_body_of_the_fit(folder, stage):
    frame = 37
    fit = synthetic_fit(rate_hz=60.0, body=tube_body(posedirs=True))
    page = folder / f"{stage}.html"
    page.write_text(report_page(fit).replace("</body>", PROBE % (frame, stage) + "</body>"), "utf-8")
    tag = body_tag(visit(page, folder, size=(700, 700)))
    assert tag["webgl"] == tag["ready"] == "yes" and "errors" not in tag
    probe = json.loads(tag["probe"])
    soft = fit.soft_tissue[frame] if stage == "soft_tissue" else 0
    inputs = (torch.as_tensor(a) for a in (fit.betas + soft, fit.pose[frame], fit.trans[frame]))
    surface, turn = fit.body(*inputs), up_rotation("+z").T
    joints = np.array(probe["bones"]).reshape(-1, 16)[:, 12:15]
    assert np.abs(joints - surface.joints.numpy() @ turn).max() < 0.02  # soft tissue shifts nodes by (I - R) d
    seen = np.array(list(probe["bits"])).reshape(probe["height"], probe["width"]) == "1"
    camera, faces = np.array(probe["camera"]), fit.body.faces
    expected = silhouette(surface.vertices.numpy() @ turn, faces, camera, probe["width"], probe["height"])
    assert expected.sum() > 3000
    assert (seen & expected).sum() / (seen | expected).sum() > 0.975


def test_page_is_alive_in_every_state(folder):
    page = folder / "states.html"
    page.write_text(report_page(synthetic_fit()), "utf-8")
    everything = "body,glass,observed,predicted,errors,skeleton,names"
    for fragment in ("", "view=placement&theme=dark", f"t=0.3&stage=pose&follow=no&marker=M03&layers={everything}"):
        dom = visit(page, folder, fragment=fragment)
        tag = body_tag(dom)
        assert tag.get("ready") == "yes" and "errors" not in tag, (fragment, tag)
    assert (
        len(re.findall('class="bar( suspect)?"', dom)) == 12
        and dom.count('class="line ') == 2
        and 'class="flag"' in dom
    )


def test_strings_from_outside_stay_strings(folder):
    nasty = "</script><img src=x onerror=\"document.body.dataset.errors='hacked'\"><b>&"
    labels = tuple(f"{nasty}{k}" for k in range(12))
    page = folder / "nasty.html"
    page.write_text(report_page(synthetic_fit(labels=labels, capture_name=nasty, warnings=(nasty,))), "utf-8")
    dom = visit(page, folder)
    assert body_tag(dom).get("ready") == "yes" and "errors" not in body_tag(dom)
    assert "<img" not in dom and "&lt;img src=x" in dom


@pytest.mark.parametrize("size", [(1280, 1000), (420, 1500)])
def test_picture_is_not_blank(folder, size):
    page, picture = folder / "picture.html", folder / f"picture-{size[0]}.png"
    page.write_text(report_page(synthetic_fit()), "utf-8")
    visit(page, folder, fragment="t=0.2&theme=light&layers=body", size=size, picture=picture)
    pixels = np.asarray(Image.open(picture).convert("RGB"), dtype=int)
    assert pixels.shape[:2] == size[::-1]
    stage = pixels[-450:-20, size[0] // 3 : -size[0] // 3]
    assert len(np.unique(stage.reshape(-1, 3), axis=0)) > 300


def test_without_webgl_the_rest_still_works(folder):
    page = folder / "plain.html"
    page.write_text(report_page(synthetic_fit(frames=30)), "utf-8")
    dom = visit(page, folder, extra=("--disable-3d-apis",))
    assert body_tag(dom).get("webgl") == "no" and body_tag(dom).get("ready") == "yes"
    assert "could not start" in dom and 'class="line final"' in dom


def test_one_frame_and_no_soft_tissue(folder):
    page = folder / "one.html"
    page.write_text(report_page(synthetic_fit(frames=1, soft=False)), "utf-8")
    tag = body_tag(visit(page, folder))
    assert tag.get("ready") == "yes" and "errors" not in tag
