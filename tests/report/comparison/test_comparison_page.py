"""The page of a comparison, as text and in a real browser."""

import json
import re
from dataclasses import replace
from html import unescape
from urllib.parse import unquote

import numpy as np
from browser import chromium, visit
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.report.comparison.differences import differences
from habitus.report.comparison.numbers import numbers
from habitus.report.comparison.page import comparison_page

NASTY = "</script><b>&\"'"


def page_of(a, b, names=("first", "second")):
    found = differences(a, b)
    return comparison_page(found, numbers(found, names), names, ("../a/report.html", None))


def test_strings_from_outside_stay_strings():
    labels = tuple(f"{NASTY}{k}" for k in range(12))
    fit = synthetic_fit(
        frames=8, labels=labels, capture_name=NASTY, layout_name=NASTY, body_name=NASTY
    )
    page = page_of(fit, fit, (NASTY, "second"))
    assert "</script><b>" not in page and page.count("<script") == 4
    assert (
        NASTY in unescape(page) and "href='../a/report.html'" in page and "Report of B" not in page
    )


def test_links_lead_to_folders_of_any_name():
    fit = synthetic_fit(frames=8)
    found = differences(fit, fit)
    names, link = ("a", "b"), "javascript:1 #?/report.html"
    page = comparison_page(found, numbers(found, names), names, (link, None))
    (written,) = re.findall(r"<a href='([^']*)'>Report of A", page)
    assert unquote(unescape(written)) == link and not set(":#?") & set(written)


PROBE = """
<script>(async () => {
const { player, distances, angles } = habitusReport, found = {}, rest = ms => new Promise(r => setTimeout(r, ms));
const bones = (pose, j) => [...pose.bones.slice(16 * j + 12, 16 * j + 15)];
player.seekTime(0.5); player.draw();
found.knees = [bones(player.pose, 4), bones(player.other.pose, 4)];
const count = set => set.list.length / set.size;
player.toggle('skeleton'); player.draw(); found.beside = count(player.scene.bones);
player.otherView(); player.draw(); found.mode = player.state.mode; found.over = count(player.scene.bones);
player.toggle('difference'); player.draw();
found.marked = [4, 5].map(j => player.pose.bones[16 * j + 15]);
document.querySelector('.moments .go').click(); await rest(50); found.time = player.time;
found.curves = distances.series.length; found.angles = angles.series.length;
found.wide = document.documentElement.scrollWidth - innerWidth;
document.body.dataset.probe = JSON.stringify(found);
})().catch(e => { document.body.dataset.errors = e.message; })</script></body>
"""


def test_both_bodies_move_on_one_clock(tmp_path):
    chromium()
    fit = synthetic_fit(frames=60, rate_hz=60.0, soft=False)
    pose = fit.pose.copy()
    joint = fit.body.joint_names.index("left_hip")
    pose[20:40, joint, 0] += 0.3
    slow = replace(
        BodyMotion.of(replace(fit, pose=pose)), pose=pose[::2], trans=fit.trans[::2], rate_hz=30.0
    )
    page = tmp_path / "compare.html"
    page.write_text(page_of(fit, slow).replace("</body>", PROBE), "utf-8")
    tag = re.search(r"<body[^>]*>", visit(page, tmp_path, size=(420, 900)))[0]
    assert 'data-ready="yes"' in tag and "data-errors" not in tag, tag
    found = json.loads(unescape(re.search(r'data-probe="([^"]*)"', tag)[1]))
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    np.testing.assert_allclose(
        found["knees"], [turn @ m.joints(k)[4] for m, k in ((fit, 30), (slow, 15))], atol=2e-3
    )
    joints = len(fit.body.joint_names)
    assert (
        found["mode"] == "over"
        and found["beside"] == joints - 1
        and found["over"] == 2 * (joints - 1)
    )
    assert found["marked"] == [1, 0]  # 12 cm at the knee under the hip that was turned
    assert (
        0.33 < found["time"] < 0.67
        and found["curves"] == 4
        and found["angles"] == 4
        and found["wide"] <= 0
    )
