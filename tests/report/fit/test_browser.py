"""The report in a real browser (headless Chromium, software WebGL): it runs, and it draws the right
body.
"""

import json
import re
from dataclasses import replace
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import chromium, visit
from PIL import Image
from synthetic_fit import synthetic_fit, tube_body

from habitus.body.skin import skin_of
from habitus.io.models.bodies import load_body
from habitus.observe.markers import MarkerAttachment
from habitus.report.fit.page import report_page
from habitus.rotations import up_rotation

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


def silhouette(
    vertices: np.ndarray, faces: np.ndarray, camera: np.ndarray, width: int, height: int
) -> np.ndarray:
    """Pixels (row 0 at the bottom) that triangles cover."""
    clip = np.c_[vertices, np.ones(len(vertices))] @ camera.reshape(4, 4)
    screen = (clip[:, :2] / clip[:, 3:] + 1) * [width / 2, height / 2]
    covered = np.zeros((height, width), bool)
    for a, b, c in screen[faces]:
        low = np.maximum(np.floor(np.minimum(np.minimum(a, b), c)), 0).astype(int)
        high = np.minimum(np.ceil(np.maximum(np.maximum(a, b), c)), [width, height]).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        edges = [
            (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        inside = np.all([e >= 0 for e in edges], axis=0) | np.all([e <= 0 for e in edges], axis=0)
        covered[low[1] : high[1], low[0] : high[0]] |= inside
    return covered


@pytest.mark.parametrize("stage", ["pose", "soft_tissue"])
def test_the_player_draws_the_body_of_the_fit(folder, stage):
    frame = 37
    fit = synthetic_fit(rate_hz=60.0, body=tube_body(posedirs=True))
    page = folder / f"{stage}.html"
    page.write_text(
        report_page(fit).replace("</body>", PROBE % (frame, stage) + "</body>"), "utf-8"
    )
    tag = body_tag(visit(page, folder, size=(700, 700)))
    assert tag["webgl"] == tag["ready"] == "yes" and "errors" not in tag
    probe = json.loads(tag["probe"])
    soft = fit.soft_tissue[frame] if stage == "soft_tissue" else 0
    inputs = (torch.as_tensor(a) for a in (fit.betas + soft, fit.pose[frame], fit.trans[frame]))
    surface = fit.body(*inputs)
    turn = up_rotation("+z").T
    joints = np.array(probe["bones"]).reshape(-1, 16)[:, 12:15]
    assert (
        np.abs(joints - surface.joints.numpy() @ turn).max() < 0.02
    )  # soft tissue shifts nodes by (I - R) d
    seen = np.array(list(probe["bits"])).reshape(probe["height"], probe["width"]) == "1"
    camera = np.array(probe["camera"])
    faces = fit.body.faces
    expected = silhouette(
        surface.vertices.numpy() @ turn, faces, camera, probe["width"], probe["height"]
    )
    assert expected.sum() > 3000
    assert (seen & expected).sum() / (seen | expected).sum() > 0.975


# Goes through links to moments, as whoever clicks them would, and waits for what each of them
# draws.
STATES = """
<script>(async () => {
const drawn = () => new Promise(rest => setTimeout(rest, 60)), { player } = habitusReport, told = [];
for (const hash of %s) {
  location.hash = hash;
  await drawn();
  const { view, stage, selected } = player.state;
  told.push([view, stage, selected, document.documentElement.dataset.theme ?? '']);
}
document.body.dataset.probe = JSON.stringify(told);
})().catch(e => { document.body.dataset.errors = e.message; })</script></body>
"""


def test_page_is_alive_in_every_state(folder):
    page = folder / "states.html"
    everything = "body,glass,observed,predicted,errors,skeleton,names"
    links = (
        "view=placement&theme=dark",
        f"t=0.3&stage=pose&follow=no&marker=M03&layers={everything}&theme=light",
    )
    page.write_text(
        report_page(synthetic_fit()).replace("</body>", STATES % json.dumps(links)), "utf-8"
    )
    dom = visit(page, folder)
    tag = body_tag(dom)
    assert tag.get("ready") == "yes" and "errors" not in tag, tag
    placed, seen = json.loads(tag["probe"])
    assert placed == ["placement", "soft_tissue", -1, "dark"] and seen == [
        "motion",
        "pose",
        3,
        "light",
    ]
    assert (
        len(re.findall('class="bar( suspect)?"', dom)) == 12
        and dom.count('class="line ') == 2 + 2  # errors, angles
        and 'class="flag"' in dom
    )


def test_strings_from_outside_stay_strings(folder):
    nasty = "</script><img src=x onerror=\"document.body.dataset.errors='hacked'\"><b>&"
    labels = tuple(f"{nasty}{k}" for k in range(12))
    page = folder / "nasty.html"
    page.write_text(
        report_page(synthetic_fit(labels=labels, capture_name=nasty, warnings=(nasty,))), "utf-8"
    )
    dom = visit(page, folder)
    assert body_tag(dom).get("ready") == "yes" and "errors" not in body_tag(dom)
    assert "<img" not in dom and "&lt;img src=x" in dom


@pytest.mark.parametrize("size", [(1280, 1000), (420, 1500)])
def test_picture_is_not_blank(folder, size):
    page = folder / "picture.html"
    picture = folder / f"picture-{size[0]}.png"
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


def probed(folder, fit, script: str, **how) -> dict:
    """What a script, run in the page of a fit, writes into ``found``."""
    page = folder / "probed.html"
    tail = (
        f"<script>(async () => {{ const found = {{}}; {script};"
        "document.body.dataset.probe = JSON.stringify(found); })()"
        ".catch(e => { document.body.dataset.errors = e.message; })</script></body>"
    )
    page.write_text(report_page(fit).replace("</body>", tail), "utf-8")
    tag = body_tag(visit(page, folder, **how))
    assert tag.get("ready") == "yes" and "errors" not in tag, tag
    return json.loads(tag["probe"])


@pytest.mark.parametrize("size", [(1280, 800), (420, 800)])
def test_a_click_on_a_bar_leaves_the_player_in_sight(folder, size):
    script = """
        const rest = ms => new Promise(r => setTimeout(r, ms)), player = document.querySelector('#player');
        const bar = document.querySelector('.bar'), stage = document.querySelector('.stage');
        const seen = () => {
          const { width, height, top, left, bottom, right } = stage.getBoundingClientRect();
          return width > 150 && height > 120 && top >= 0 && left >= 0 && bottom <= innerHeight && right <= innerWidth;
        };
        const tall = () => document.documentElement.scrollHeight, before = tall();
        bar.scrollIntoView({ block: 'center' }); await rest(100); found.lost = !seen();
        bar.click(); await rest(100); found.kept = seen(); found.jump = Math.abs(tall() - before);
        found.bar = bar.getBoundingClientRect().top > 0; found.chosen = bar.getAttribute('aria-pressed');
        document.querySelector('#undock').click(); await rest(100); found.closed = !seen();
        bar.click(); await rest(100); scrollTo(0, player.offsetTop - 10);
        dispatchEvent(new Event('scroll'));
        found.home = !player.classList.contains('docked')
    """
    found = probed(folder, synthetic_fit(markers=40), script, size=size, fragment="t=0")
    assert found["lost"] and found["kept"] and found["bar"] and found["closed"] and found["home"], (
        found
    )
    assert found["chosen"] == "true" and found["jump"] <= 2


def test_the_parts_of_the_page_do_what_they_say(folder):
    script = """
        const { player, angles, gaps } = habitusReport, { lines } = player.scene;
        const count = () => { player.draw(); return lines.list.length / lines.size; };
        player.set({ frame: 60, layers: { body: true, errors: false } }); found.without = count();
        player.toggle('trails'); found.all = count();
        player.set({ selected: 5 }); found.one = count();
        player.set({ view: 'placement' }); found.rest = count(); found.placed = lines.list.every(isFinite);
        const waist = document.querySelector('[data-tape=waist_circumference_m]'), all = player.layers.tapes;
        waist.click(); found.taped = count() - found.rest; found.said = waist.getAttribute('aria-pressed');
        found.waist = all.filter(t => t.name.startsWith('waist')).reduce((n, t) => n + t.points.length / 3, 0);
        player.toggle('tapes'); found.allTaped = count() - found.rest;
        found.points = all.reduce((n, t) => n + t.points.length / 3, 0);
        const isMark = (v, k) => k % 16 === 15 && v > 0;
        const marked = () => { player.draw(); return player.pose.bones.filter(isMark).length; };
        player.set({ view: 'motion' }); found.unmarked = marked();
        player.toggle('guessed'); found.guessed = marked(); player.set({ view: 'placement' }); found.atRest = marked();
        player.set({ view: 'motion' });

        const section = document.querySelector('#angle-plot');
        const knee = section.querySelector('[data-angle="knee flexion"]');
        found.names = [...section.querySelectorAll('.angles button')].map(b => b.textContent);
        knee.click();
        found.curves = section.querySelectorAll('path.line').length; found.pressed = knee.getAttribute('aria-pressed');
        found.low = Math.min(...angles.series[0].values); found.high = Math.max(...angles.series[0].values);

        const box = gaps.canvas.getBoundingClientRect(), x = box.left + (box.width + gaps.left) / 2, y = box.top + 5;
        gaps.canvas.dispatchEvent(new MouseEvent('click', { bubbles: true, clientX: x, clientY: y }));
        found.time = player.time; found.selected = player.state.selected; found.first = gaps.order[0];
        const told = (m, u) => gaps.describe(m, Math.floor(u * gaps.bins));
        found.states = [told(1, 0.1), told(1, 0.42), told(2, 0.55)];

        const queue = [], tick = now => queue.splice(0).forEach(f => f(now));
        window.requestAnimationFrame = f => queue.push(f);
        player.pending = false; player.seek(0); tick(0); player.play(true);
        for (const now of [1000, 1400, 1800, 2250]) tick(now);  // a machine that draws twice a second
        found.late = player.time;
        player.set({ speed: 0.5 }); tick(2750); found.half = player.time
    """
    found = probed(folder, synthetic_fit(frames=240, rate_hz=60.0, soft=False), script)
    assert (
        found["without"] == 0
        and 12 * 20 < found["all"] < 12 * 35
        and 20 < found["one"] < 70
        and found["placed"]
    )
    assert (
        found["taped"] == found["waist"] > 2
        and found["said"] == "true"
        and found["allTaped"] == found["points"]
    )
    assert (
        found["guessed"] > 3 and found["atRest"] == found["unmarked"] == 0
    )  # twelve markers tell little
    assert "Knee flexion" in found["names"] and found["curves"] == 2 and found["pressed"] == "true"
    assert (
        5 < found["low"] < 15 and 35 < found["high"] < 45
    )  # the walk's knees bend by .15 to .7 rad
    assert (
        found["time"] == pytest.approx(239 / 60 / 2, abs=0.05)
        and found["selected"] == found["first"] == 1
    )
    assert found["states"] == ["seen", "missing", "far from the body, so down-weighted"]
    assert found["late"] == pytest.approx(1.25, abs=0.01) and found["half"] == pytest.approx(
        1.5, abs=0.01
    )


def first_marker(fit):
    """The same fit with one marker."""
    arrays = {name: getattr(fit, name)[:1] for name in ("labels", "latent_markers", "marker_noise")}
    seen = ("observed_markers", "predicted_pose_stage", "predicted_soft_tissue", "marker_weights")
    arrays |= {name: getattr(fit, name)[:, :1] for name in seen if getattr(fit, name) is not None}
    attachment = MarkerAttachment(fit.attachment.triangles[:1], fit.attachment.coefficients[:1])
    return replace(fit, attachment=attachment, suspects=(), **arrays)


STRANGE = {
    "capture_name": "\u202egnp.exe\x1b[31m\ud800",
    "labels": tuple(f"\u0631\u0643\u0628\u0629\u200e\x00<b>{k}" for k in range(12)),
}


@pytest.mark.parametrize(
    ("fit", "size"),
    [
        (first_marker(synthetic_fit(frames=1)), (400, 900)),
        (first_marker(synthetic_fit(frames=2, soft=False)), (1280, 900)),
        (synthetic_fit(frames=40, suspects=(), capture_name="lang" * 400), (400, 900)),
        (synthetic_fit(frames=40, **STRANGE), (400, 900)),
    ],
    ids=["one sample", "one marker", "long name", "strange names"],
)
def test_pages_at_the_edge_stay_whole(folder, fit, size):
    script = """
        habitusReport.player.play(true);
        found.wide = document.documentElement.scrollWidth - innerWidth;
        found.title = document.title; found.text = document.body.innerText.slice(0, 3000)
    """
    found = probed(folder, fit, script, size=size)
    assert found["wide"] <= 0 and len(found["title"]) < 200
    assert not re.search("[\x00-\x08\x1b\u202a-\u202e]", found["text"] + found["title"])


def test_what_was_put_right_is_painted_apart(folder):
    right = SimpleNamespace(label="M03", reason="swapped with M02", frames=9, corrected=True)
    wrong = SimpleNamespace(label="M05", reason="fell", frames=80, corrected=False)
    page = folder / "right.html"
    page.write_text(report_page(replace(synthetic_fit(), suspects=(right, wrong))), "utf-8")
    dom = visit(page, folder)
    assert "errors" not in body_tag(dom)
    bars = re.findall(r'<button class="bar (\w+)"[^>]*><span class="label">(M\d\d)<', dom)
    assert dict(bars) == {"corrected": "M03", "suspect": "M05"}
    assert "(9 frames; corrected" in dom and '<li class="bad">\u2068M05' in dom


# Composes a picture with names, then films a turn by a clock of its own, and writes down what came
# of both.
FILMING = """
<script>
const { player } = habitusReport, { recorder, camera } = player, began = camera.yaw, sheet = recorder.compose();
const pixels = sheet.getContext('2d').getImageData(0, 0, sheet.width, sheet.height).data;
const colours = new Set();
for (let i = 0; i < pixels.length; i += 4) colours.add(pixels[i] * 65536 + pixels[i + 1] * 256 + pixels[i + 2]);
const size = canvas => [canvas.width, canvas.height];
const told = { size: size(sheet), canvas: size(player.canvas), colours: colours.size };
class Film extends EventTarget {
  constructor() { super(); this.mimeType = 'video/webm'; this.yaws = []; }
  start() { told.started = true; }
  stop() { Object.assign(told, { widest: Math.max(...this.yaws) }); this.dispatchEvent(new Event('stop')); tell(); }
}
const tell = () => {
  Object.assign(told, { back: camera.yaw === began, idle: recorder.recording === null });
  document.body.dataset.filmed = JSON.stringify(told);
};
window.MediaRecorder = Film;
const draw = player.draw.bind(player), waiting = [];
window.requestAnimationFrame = act => waiting.push(act);
player.draw = () => { recorder.recording?.yaws.push(camera.yaw - began); draw(); };
recorder.turntable(() => {});
for (let ms = 1000; ms < 8000; ms += 250) for (const act of waiting.splice(0)) act(ms);
</script>
"""


def test_a_picture_and_a_turn_of_the_body_can_be_saved(folder):
    page = folder / "filmed.html"
    page.write_text(
        report_page(synthetic_fit(rate_hz=60.0)).replace("</body>", FILMING + "</body>"), "utf-8"
    )
    tag = body_tag(visit(page, folder, size=(700, 700)))
    assert "errors" not in tag
    told = json.loads(tag["filmed"])
    assert told["size"] == told["canvas"] and told["colours"] > 50
    assert told["started"] and told["back"] and told["idle"] and 5.9 < told["widest"] < 2 * np.pi


def test_skin_of_a_default_body_is_shown_on_demand(folder):
    """The page holds three bytes a vertex; the button paints the body, and others have none."""
    script = """
const { player, arrays } = habitusReport, { canvas, scene } = player, { gl } = scene;
const mean = () => {
  player.draw();
  const { width, height } = canvas, pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const sums = [0, 0, 0];
  for (let i = 0; i < pixels.length; i++) if (i % 4 < 3) sums[i % 4] += pixels[i];
  return sums;
};
player.set({ layers: { body: true }, follow: true });
const plain = mean();
player.toggle('skin');
found.warmer = (v => v[0] - v[2])(mean()) - (plain[0] - plain[2]);
found.colours = arrays.has('colours') ? arrays.shape('colours') : null;
found.first = arrays.has('colours') ? [...arrays.get('colours').slice(0, 3)] : null;
found.button = Boolean(document.querySelector('[data-layer=skin]'));
"""
    body = load_body("female")
    found = probed(folder, synthetic_fit(4, body=body), script)
    known = skin_of(body.full.mesh, "medium").colours[body.full_vertices]
    assert found["colours"] == list(known.shape) and found["first"] == known[0].tolist()
    assert found["button"] and found["warmer"] > 1e5
    found = probed(folder, synthetic_fit(4), script)
    assert found["colours"] is None and not found["button"] and found["warmer"] == 0
