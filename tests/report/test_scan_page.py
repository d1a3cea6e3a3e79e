"""The page of a registered scan: its strings are safe, and a real browser draws each look at it."""

import json
import re
from html import unescape

import numpy as np
import pytest
from browser import visit
from page_samples import registered

from habitus.report.registration import scan_page
from habitus.results.save import scan_metrics

NASTY = "</script><script>alert(1)</script><b>&'"
LOOKS = ("Surface", "Scan", "Distances", "Model", "Offset", "Weights")
PROBE = """
<script>
const told = [], canvas = document.getElementById('body'), gl = canvas.getContext('webgl2');
const seen = () => {
  const all = new Uint8Array(4 * canvas.width * canvas.height), sums = [0, 0, 0, 0];
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, all);
  for (let i = 0; i < all.length; i++) sums[i % 4] += all[i] / 255;
  return sums.map(one => one / sums[3]).slice(0, 3).concat(sums[3] / canvas.width / canvas.height);
};
document.getElementById('spin').click();
for (const b of document.querySelectorAll('[data-look]')) {
  b.click();
  const shown = [...document.querySelectorAll('[data-caption]')].filter(p => !p.hidden);
  told.push([b.textContent, ...seen(), shown.length, shown[0].textContent]);
}
document.querySelector('[data-look]').click();
document.getElementById('over').click();
told.push(['over', ...seen()]);
document.body.insertAdjacentHTML('beforeend', `<pre id="told">${JSON.stringify(told).replaceAll('<', '&lt;')}</pre>`);
</script>
"""


@pytest.fixture(scope="module")
def fit():
    return registered(NASTY)


def test_it_is_one_whole_file_and_strings_stay_strings(fit):
    page = scan_page(fit, scan_metrics(fit))
    assert page.count("<script") == 3 and "<b>&" not in page and page.count(NASTY) == 0
    assert NASTY in unescape(page) and "http" not in page.replace("http-equiv", "")
    links = re.findall(r"<a href='(.*?)' download>", page)
    assert links == [
        "surface.ply",
        "surface.glb",
        "model.ply",
        "rest.ply",
        "body.npz",
        "metrics.json",
    ]


def test_every_look_is_drawn(fit, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(
        scan_page(fit, scan_metrics(fit)).replace("</body>", f"{PROBE}</body>"), "utf-8"
    )
    dom = visit(path, tmp_path)
    assert 'data-ready="yes"' in dom and 'data-webgl="yes"' in dom and "data-errors=" not in dom
    told = json.loads(unescape(re.findall(r'<pre id="told">(.*?)</pre>', dom)[-1]))
    found = {name: np.array(rest[:4]) for name, *rest in told}
    assert tuple(found) == (*LOOKS, "over") and all(rest[4] == 1 for _, *rest in told[:-1])
    assert all(0.05 < one[3] < 0.6 for one in found.values())  # the body covers a part of the stage
    red, grey = (found[name][0] - found[name][2] for name in ("Distances", "Surface"))
    assert red > 0.1 > abs(grey) and found["over"][0] > found["Surface"][0]
    assert (
        np.abs(found["Surface"][:3] - found["Model"][:3]).max()
        < 0.02
        < np.abs(found["Weights"] - found["Model"]).max()
    )
