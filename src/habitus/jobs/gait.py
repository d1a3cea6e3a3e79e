"""Gait analysis of captures: files of a laboratory in, angles, strides, forces and a page out."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from habitus.body.motion import Moving
from habitus.body.segments import SegmentMasses, segment_masses
from habitus.errors import HabitusError
from habitus.export.opensim_setup import write_opensim
from habitus.fit.markers.result import MarkerFit
from habitus.gait.analysis import GaitAnalysis, analyse
from habitus.gait.contacts import PlateForces
from habitus.io.bands import read_bands
from habitus.io.captures.events import read_events
from habitus.io.captures.force_plates import ForcePlate, read_force_plates
from habitus.io.limits import read_file
from habitus.io.names import plain_name
from habitus.jobs.anatomy import anatomy_of, angles
from habitus.jobs.mosh import mosh
from habitus.jobs.options import GaitOptions, takes
from habitus.jobs.results import load_fit, load_motion, with_methods
from habitus.report.gait import gait_page
from habitus.results.gait import GAIT_FILES, save_gait
from habitus.results.save import result_lock
from habitus.types import PathLike

C3D = ".c3d"
"""Captures with force plates and events."""


class GaitResult(GaitAnalysis):
    """A gait analysis that can write itself."""

    def save(
        self,
        folder: PathLike,
        band: PathLike | None = None,
        capture: PathLike | None = None,
        opensim: bool = False,
    ) -> None:
        """Write angles.csv, cycles.csv, dynamics.csv, gait.json and gait.html.

        band: a laboratory's reference curves (.csv). capture: a copy of it with angles, moments and
        powers as model outputs is written as gait.c3d. opensim: of a marker fit, a folder that
        OpenSim runs (`habitus.export.opensim_setup`). Raises HabitusError where the folder cannot
        be written.
        """
        bands = {} if band is None else read_bands(band)
        setup = None
        if opensim:
            if not isinstance(self.motion, MarkerFit):
                raise HabitusError("opensim is asked for a motion without markers; expected a fit")
            setup = partial(write_opensim, self.motion, self.plates, self.contacts)
        save_gait(self, folder, partial(gait_page, bands=bands), capture, setup)


@takes(GaitOptions)
def gait(
    motion: Moving | PathLike, capture: PathLike | None = None, *, options: GaitOptions
) -> GaitResult:
    """The gait analysis of a body in motion: a fit, a motion, or the file or result folder of one.

    capture: the .c3d that was fitted, for its force plates and events. Angles come of any sensor's
    fit, forces of captures with plates. Raises HabitusError for a body without SMPL's
    joints or without landmarks, and for a capture that cannot be read.
    """
    moving = motion if isinstance(motion, Moving) else load_any(motion)
    plates: tuple[ForcePlate, ...] = ()
    filed = None
    notes: list[str] = []
    if capture is not None and Path(capture).suffix.lower() == C3D:
        content, name = read_file(Path(capture)), Path(capture).name
        if options.plates == "auto":
            plates = read_force_plates(content, name)
        if options.events == "auto":
            filed = read_events(content, name)
        notes += [note for plate in plates for note in plate.notes]
    analysis = analyse(
        moving,
        anatomy_of(moving),
        angles(moving, options.convention),
        _masses(moving, options.mass),
        [_forces(plate) for plate in plates if plate.loaded.any()],
        filed,
        notes,
    )
    return with_methods(GaitResult, analysis)


@takes(GaitOptions)
def gaits(
    sources: Sequence[PathLike],
    out: PathLike,
    *,
    captures: PathLike | None = None,
    options: GaitOptions,
    progress: Callable[[str], Any] = lambda text: None,
) -> list[GaitResult]:
    """Analyse captures of one person (fitted first, with one shape) or result folders, and write
    each into the folder ``out``, of several into ``out``/NAME, as ``habitus gait`` does.

    captures: a folder with the .c3d files of result folders. Raises HabitusError.
    """
    paths = [Path(source) for source in sources]
    if not paths:
        raise HabitusError("no capture is given; expected .c3d files or result folders")
    raw = [path for path in paths if path.is_file() and path.suffix.lower() != ".npz"]
    fitted = [path for path in paths if path not in raw]
    pairs: list[tuple[Moving, Path | None]] = []
    if raw:
        progress(f"fitting {len(raw)} capture{'s' if len(raw) > 1 else ''}")
        by_name = {path.stem: path for path in raw}
        pairs += [(fit, by_name.get(fit.capture_name, raw[0])) for fit in mosh(raw)]
    for path in fitted:
        moving = load_any(path)
        pairs.append((moving, _capture_of(moving, captures)))
    results = []
    names = _distinct([moving.capture_name for moving, _ in pairs])
    with result_lock(out, GAIT_FILES):
        for name, (moving, capture) in zip(names, pairs, strict=True):
            progress(f"analysing {name}")
            result = gait(moving, capture, options=options)
            copied = capture if options.c3d else None
            where = out if len(pairs) == 1 else Path(out) / name
            result.save(where, options.band, copied, options.opensim)
            results.append(result)
    return results


def load_any(path: PathLike) -> Moving:
    """A fit or a motion in a file or a result folder. Raises HabitusError."""
    where = Path(path)
    try:
        return load_fit(where)
    except HabitusError:
        return load_motion(where / "body.npz" if where.is_dir() else where)


def _capture_of(moving: Moving, folder: PathLike | None) -> Path | None:
    """The capture in a folder whose name a result has."""
    if folder is None:
        return None
    found = [path for path in Path(folder).iterdir() if path.stem == moving.capture_name]
    return next((path for path in found if path.suffix.lower() == C3D), None)


def _distinct(names: Sequence[str]) -> list[str]:
    """Names of folders: those that come again are numbered."""
    out: list[str] = []
    for name in map(plain_name, names):
        again = sum(other == name or other.startswith(f"{name}_") for other in out)
        out.append(f"{name}_{again + 1}" if name in out else name)
    return out


def _masses(moving: Moving, mass: float | None) -> SegmentMasses:
    """Masses by what is given, else recorded, else from the volume."""
    source = "given"
    if mass is None and isinstance(moving, MarkerFit):
        recorded = moving.recorded.get("mass_kg")
        mass = float(recorded) if isinstance(recorded, float | int) else None
        source = "recorded in the capture"
    return segment_masses(moving.body, moving.betas, mass, source)


def _forces(plate: ForcePlate) -> PlateForces:
    return PlateForces(
        plate.number,
        plate.corners,
        plate.force,
        plate.pressure,
        plate.free_moment[:, None] * plate.up,
        plate.rate_hz,
    )
