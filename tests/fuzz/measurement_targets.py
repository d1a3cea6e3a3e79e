"""Readers of what pattern programs write of a person, and small sound files for them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from target import Target, alone

from habitus.body.measurement_names import DEFINITIONS

_SMIS = """\
<?xml version="1.0" encoding="UTF-8"?>
<smis><version>0.3.4</version><read-only>false</read-only><notes/><unit>cm</unit>
<pm_system>998</pm_system><personal><gender>female</gender></personal><body-measurements>
<m name="bust_circ" value="94.5"/><m name="waist_circ" value="78.1" full_name="Waist"/>
<m name="neck_arc_b" value="(neck_circ - 20)"/></body-measurements></smis>
"""
_YAML = "body:\n  bust: 94.5  # cm\n  waist: 78.1\n  arm_pose_angle: 45.0\n  shoulder_incl: 21.7\n"
_JSON = '{"units": "metric", "measurements": {"chest": 945.0, "waist": 781, "shoulderSlope": 21.7}}'
_CSV = "name,value,unit\nchest_circumference_m,0.945,m\nmass_kg,67,kg\n"


def measurement_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return (_tapes,)


def _read(path: Path) -> None:
    from habitus.io.measurement_files import read_measurements

    found = read_measurements(path)
    assert found.values and set(found.values) <= DEFINITIONS.keys()
    values = np.array(list(found.values.values()))
    assert np.isfinite(values).all() and (values > 0.0).all() and values.max() < 1e6
    assert all(name.isprintable() and len(name) <= 100 for name in found.unused)
    assert found.sex in ("", "female", "male")


def _tapes(folder: Path) -> list[Target]:
    files = {".smis": _SMIS, ".yaml": _YAML, ".json": _JSON, ".csv": _CSV}
    return [alone(f"tapes{ending}", _read, text.encode()) for ending, text in files.items()]
