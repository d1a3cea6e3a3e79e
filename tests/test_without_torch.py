"""From a body to its surface, and from a capture to its files, torch is not imported: here it
cannot be.
"""

import subprocess
import sys
import textwrap

BLOCKED = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ImportError("torch is not to be imported here")

sys.meta_path.insert(0, NoTorch())
"""


def run(code: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED + textwrap.dedent(code), *arguments],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_body_moves_is_measured_and_differentiated_without_torch():
    said = run(
        """
        import habitus
        from habitus.body.jacobians import surface_jacobian
        body = habitus.load_body("default")
        surface = body([1.5], pose={"left_elbow": (0, -1.2, 0)})
        jacobian = surface_jacobian(body, [1.5], {"left_elbow": (0, -1.2, 0)}, vertices=[5, 100])
        print(surface.vertices.dtype, jacobian.vertices_pose.shape, round(body.measure(surface)["height_m"], 1))
        """
    )
    dtype, *shape, height = said.split()
    assert dtype == "float64" and " ".join(shape) == "(2, 3, 24, 3)" and 1.4 < float(height) < 2.1


def test_a_capture_becomes_files_without_torch(tmp_path):
    run(
        """
        import numpy as np
        import habitus
        from habitus.io.captures.c3d_write import write_c3d
        from habitus.io.captures.read import Capture
        from habitus.body.prior import shipped_prior
        from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

        body, layout = habitus.load_body("default"), habitus.load_layout("cmu-41")
        prior, rng = shipped_prior().for_joints(body.joint_names), np.random.default_rng(0)
        pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 24, 60.0, rng)
        betas, places = np.zeros(body.num_betas), layout.vertices(body)
        made = simulate_capture(body, betas, pose, trans, places, layout.distances(), Faults(), rng)
        write_c3d(Capture("walk", layout.labels, made.observed, 60.0, "+y"), sys.argv[1] + "/walk.c3d")
        (fit,) = habitus.mosh(sys.argv[1] + "/walk.c3d", sys.argv[1] + "/out", layout="cmu-41", obj=True)
        assert np.nanmean(fit.errors()) < 0.01
        """,
        str(tmp_path),
    )
    written = {path.suffix for path in (tmp_path / "out" / "walk").rglob("*")}
    assert {".npz", ".glb", ".json", ".html", ".obj"} <= written


def test_markers_are_fitted_beside_a_scan_and_terms_without_torch():
    said = run(
        """
        from dataclasses import replace
        import numpy as np
        import habitus as hb
        from habitus.body.prior import shipped_prior
        from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

        body, layout = hb.load_body("default").with_betas(4), hb.load_layout("cmu-41")
        prior, rng = shipped_prior().for_joints(body.joint_names), np.random.default_rng(0)
        pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 24, 60.0, rng)
        betas, places = np.ones(4), layout.vertices(body)
        made = simulate_capture(body, betas, pose, trans, places, layout.distances(), Faults(), rng)
        markers = hb.Markers(made.observed, layout, fps=60.0)
        standard = hb.FitSettings()
        few = replace(standard.scans.search, candidates=1, drawn_poses=0, kept=4, refined=1)
        settings = replace(
            standard, frames=4, motion=False, scans=replace(standard.scans, search=few)
        )
        alone = hb.Fit(body, markers, settings).solve()
        scan = hb.Scan(np.asarray(body(betas, pose[5], trans[5]).vertices), frame=5)
        prior = {"mine": hb.Term(lambda betas: (betas, {"betas": np.eye(4)}))}
        both = hb.Fit(body, [markers, scan], settings, prior).solve()
        print(*(np.linalg.norm(fit.betas - betas) for fit in (alone, both)))
        """
    )
    alone, both = map(float, said.split())
    assert both < alone < 1.5
