"""A motion made in Python, as files for other programs: an arm that waves. Needs no capture.

python examples/export.py [FILE.fbx|.glb|.usdz|.bvh …]
"""

import sys
from pathlib import Path

import numpy as np

import habitus as hb
from habitus.body.motion import BodyMotion

body = hb.load_body("default")
rate = 30.0
seconds = np.arange(90) / rate
pose = np.zeros((len(seconds), body.num_joints, 3))
pose[:, body.joint_names.index("left_shoulder"), 2] = 0.9
pose[:, body.joint_names.index("right_shoulder"), 2] = 1.2
pose[:, body.joint_names.index("left_elbow"), 2] = 1.0 + 0.5 * np.sin(2 * np.pi * seconds)
trans = np.zeros((len(seconds), 3)) - body(betas=[1.0]).vertices.min(axis=0) * [0, 1, 0]
betas = np.pad([1.0], (0, body.num_betas - 1))
motion = BodyMotion(body, betas, pose, trans, rate, up_axis="+y", capture_name="wave")
folder = Path("demo_out")
for path in sys.argv[1:] or [folder / f"wave.{ending}" for ending in ("fbx", "glb", "bvh")]:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    hb.export_file(motion, path)
    print(f"wrote {path}")
