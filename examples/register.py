"""A scan of somebody made up, in millimetres and z up, registered from nothing: how far from the
truth is it?
"""

import numpy as np

import habitus as hb
from habitus.fit.points.scan import Scan
from habitus_lab.population.scans import Scanner, person, scanned, stance

CAMERAS = [
    np.array((np.sin(angle), up, np.cos(angle))) / np.hypot(1.0, up)
    for angle in np.arange(8) * np.pi / 4
    for up in (-0.2, 0.2)
]
"""Around the person, as in a booth: they see no point inside the mouth, which nothing registers."""


def main() -> None:
    """Make a scan, register it, compare."""
    body = hb.load_body("default")
    rng = np.random.default_rng(1)
    truth = person(body, stance("A", body.joint_names, rng), rng)  # vertices in metres, y up
    dense = scanned(truth, body.faces, Scanner(points=400_000, sides=CAMERAS), rng)
    points = 1000 * dense.points[:50_000, [2, 0, 1]]
    (fit,) = hb.register_scans([Scan("anna", points)], body, up="+z")
    there = 1000 * truth[:, [2, 0, 1]] @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    print(
        "distance",
        *(f"{1e3 * value:.2f}" for value in np.percentile(fit.to_surface, (50, 95))),
        "mm of the scan",
    )
    print(
        "truth",
        f"{1e3 * np.linalg.norm(fit.vertices - there, axis=1)[fit.weights > 0.5].mean():.2f}",
        "mm",
    )
    print("height", f"{fit.measurements['height_m']:.3f}", "m;", fit.verdict)


if __name__ == "__main__":
    main()
