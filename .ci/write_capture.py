"""Writes a synthetic capture for CI's run without torch: python .ci/write_capture.py FILE.c3d."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from demo import RATE_HZ, make_capture

from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.models.bodies import load_body

truth, labels = make_capture(load_body("default"), 200, 1)
write_c3d(Capture("demo", labels, truth.observed, RATE_HZ, "+y"), Path(sys.argv[1]))
