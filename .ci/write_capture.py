"""Writes a synthetic capture for CI's run without torch: python .ci/write_capture.py FILE.c3d."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from demo import RATE_HZ, make_capture  # noqa: E402

from habitus.io.captures.c3d_write import write_c3d  # noqa: E402
from habitus.io.captures.read import Capture  # noqa: E402
from habitus.io.models.bodies import load_body  # noqa: E402

truth, labels = make_capture(load_body("default"), 200, 1)
write_c3d(Capture("demo", labels, truth.observed, RATE_HZ, "+y"), Path(sys.argv[1]))
