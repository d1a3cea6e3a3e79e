"""Readers of what a laboratory's files hold beside markers: force plates, events, reference curves."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from plate_files import write
from target import Target, alone


def gait_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _plates, _bands


def _read_plates(path: Path) -> None:
    from habitus.io.captures.events import read_events
    from habitus.io.captures.force_plates import read_force_plates

    content = path.read_bytes()
    for plate in read_force_plates(content, path.name):
        shape = plate.force.shape
        assert shape == plate.pressure.shape and shape[0] == len(plate.free_moment)
        assert np.isfinite(plate.force).all() and np.abs(plate.force).max(initial=0.0) < 1e9
        assert np.isfinite(plate.free_moment).all() and np.isfinite(plate.corners).all()
        assert not np.isinf(plate.pressure).any() and plate.rate_hz > 0.0
        assert all(note.isprintable() for note in plate.notes)
    for events in read_events(content, path.name).values():
        for times in (events.strikes, events.offs):
            assert np.isfinite(times).all() and (np.diff(times) >= 0.0).all()


def _plates(folder: Path) -> list[Target]:
    contents = []
    for kind in (2, 3, 4):
        path = folder / f"{kind}.c3d"
        write(path, kind, events=True)
        contents.append(path.read_bytes())
    return [alone("plates.c3d", _read_plates, *contents)]


def _read_bands(path: Path) -> None:
    from habitus.io.bands import read_bands

    found = read_bands(path)
    assert found and all(band.shape == (101, 2) for band in found.values())
    assert all(np.isfinite(band).all() for band in found.values())


def _bands(folder: Path) -> list[Target]:
    rows = [f"{k},{10 + k * 0.2:.1f},3.5,{k - 50},2" for k in range(0, 101, 5)]
    head = "percent,knee_flexion_mean,knee_flexion_sd,hip_flexion_mean,hip_flexion_sd"
    return [
        alone("band.csv", _read_bands, "\n".join([head, *rows]).encode()),
        alone("cycles.csv", _read_cycles, cycles().encode()),
    ]


def cycles(shift: float = 0.0) -> str:
    """A result's cycles.csv of two strides a side."""
    rows = ["side,stride,percent,knee_flexion_deg,hip_internal_rotation_deg_not_validated"]
    for side in ("left", "right"):
        for stride in (1, 2):
            rows += [f"{side},{stride},{k},{k + shift + stride:.1f},-3" for k in range(101)]
    return "\n".join(rows) + "\n"


def _read_cycles(path: Path) -> None:
    from habitus.io.bands import read_bands

    folder = path.with_suffix(".results")
    for name in ("a", "b", "c"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / name / "cycles.csv").write_bytes(path.read_bytes())
    found = read_bands(folder)
    assert all(np.isfinite(band).all() and band.shape == (101, 2) for band in found.values())
