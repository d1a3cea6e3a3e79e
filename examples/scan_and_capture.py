"""A scan gives the shape, a capture of 12 markers the motion, in one call: a made person.

python examples/scan_and_capture.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
from two_sensors import person

import habitus as hb
from habitus_lab.population.scans import Scanner, scanned


def main(folder: str = "scan-and-capture", seed: int = 3) -> dict[str, float]:
    """Fit, save the motion, and print how far shape and joints are from the truth (mm)."""
    body = hb.load_body("default")
    (betas, pose, trans), markers, _ = person(body, seed)
    standing = body(betas, pose[15], np.zeros(3)).vertices
    rng = np.random.default_rng(seed)
    scan = scanned(standing, body.faces, Scanner(points=20_000, noise=0.001), rng, "scan")

    fit = hb.Fit(body, [hb.Scan(scan), markers]).solve()
    fit.motion.save(Path(folder) / "results")

    alone = hb.Fit(body, markers).solve()
    joints = body(betas, pose, trans).joints
    errors = {}
    for name, each in (("12 markers", alone), ("with a scan", fit)):
        off = body.rest_vertices(each.betas) - body.rest_vertices(betas)
        errors[f"{name}: shape"] = 1e3 * np.linalg.norm(off, axis=-1).mean()
        far = np.linalg.norm(each.motion.joints() - joints, axis=-1)
        errors[f"{name}: joints"] = 1e3 * far.mean()
    for name, error in errors.items():
        print(f"{name:20} {error:6.1f} mm")
    print("scan:", fit.verdicts["scan"])
    print("capture:", fit.motion.verdict)
    return errors


if __name__ == "__main__":
    main(*sys.argv[1:2])
