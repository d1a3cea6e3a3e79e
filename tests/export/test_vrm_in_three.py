"""A .vrm in three-vrm, in Chromium: its humanoid, its expressions and its gaze work.

Skips where three-vrm is missing: ``npm install three @pixiv/three-vrm``, and NODE_PATH to its
``node_modules``. Tried with three 0.187 and three-vrm 3.5.5.
"""

import json
import os
import re
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from browser import live_dom

from habitus.jobs.exporting import export_file

PAGE = """<!doctype html><body><pre id="told">nothing yet</pre>
<script type="importmap">{"imports": {
  "three": "./node_modules/three/build/three.module.js",
  "three/addons/": "./node_modules/three/examples/jsm/",
  "@pixiv/three-vrm": "./node_modules/@pixiv/three-vrm/lib/three-vrm.module.js"}}</script>
<script type="module">
const tell = (found) => {
  document.getElementById("told").textContent = "answer" + ": " + JSON.stringify(found);
};
try {
  const THREE = await import("three");
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  const { VRMLoaderPlugin } = await import("@pixiv/three-vrm");
  const loader = new GLTFLoader();
  loader.register((parser) => new VRMLoaderPlugin(parser));
  const { vrm } = (await loader.loadAsync("a.vrm")).userData;
  const place = (bone) =>
    vrm.humanoid.getRawBoneNode(bone).getWorldPosition(new THREE.Vector3()).toArray();
  const turn = (bone, axis, angle) => {
    vrm.humanoid.getNormalizedBoneNode(bone).rotation[axis] = angle;
  };
  vrm.scene.updateMatrixWorld(true);
  const rest = place("leftHand");
  turn("leftUpperArm", "z", -Math.PI / 2);
  turn("leftLowerArm", "y", -Math.PI / 2);
  turn("rightUpperLeg", "x", -Math.PI / 2);
  turn("rightLowerLeg", "x", Math.PI / 2);
  vrm.expressionManager.setValue("aa", 1);
  vrm.expressionManager.setValue("blinkLeft", 1);
  vrm.update(1 / 60);
  vrm.scene.updateMatrixWorld(true);
  let weights = [];
  vrm.scene.traverse((node) => {
    if (node.morphTargetInfluences) weights = Array.from(node.morphTargetInfluences);
  });
  const names = ["leftUpperArm", "leftLowerArm", "leftHand"];
  const legs = ["rightUpperLeg", "rightLowerLeg", "rightFoot"];
  tell({
    bones: Object.keys(vrm.humanoid.humanBones).length,
    expressions: vrm.expressionManager.expressions.length,
    version: vrm.meta.metaVersion,
    rest: rest,
    weights: weights,
    arm: names.map(place),
    leg: legs.map(place),
  });
} catch (error) { tell({ error: String(error.stack) }); }
</script>"""


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.fixture
def served(tmp_path):
    modules = [Path(part) for part in os.environ.get("NODE_PATH", "").split(os.pathsep) if part]
    found = [part for part in modules if (part / "@pixiv" / "three-vrm").is_dir()]
    if not found:
        pytest.skip("no three-vrm here: npm install three @pixiv/three-vrm, NODE_PATH")
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "node_modules").symlink_to(found[0], target_is_directory=True)
    (folder / "index.html").write_text(PAGE, encoding="utf-8")
    handler = partial(_Quiet, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{server.server_address[1]}/index.html"
        server.shutdown()


def test_three_vrm_moves_the_avatar(served, tmp_path):
    folder, url = served
    export_file("female", folder / "a.vrm", skin="medium")
    dom = live_dom(url, tmp_path, "answer: ")
    answer = re.search(r"answer: (\{.*?\})</pre>", dom, re.DOTALL)
    assert answer, dom[:500]
    told = json.loads(answer[1])
    assert "error" not in told, told
    assert (told["bones"], told["version"]) == (55, "1") and told["expressions"] == 17 + 52
    shoulder, elbow, hand = np.array(told["arm"])
    assert told["rest"][0] > 0.5  # to its left
    upper, fore = elbow - shoulder, hand - elbow
    assert -upper[1] > 0.99 * np.linalg.norm(upper)  # down
    assert fore[2] > 0.99 * np.linalg.norm(fore)  # and forward, about axes of the T-pose
    hip, knee, foot = np.array(told["leg"])
    thigh, shin = knee - hip, foot - knee
    assert thigh[2] > 0.98 * np.linalg.norm(thigh) and -shin[1] > 0.98 * np.linalg.norm(shin)
    assert sum(weight > 0.1 for weight in told["weights"]) == 2  # jaw and one lid
