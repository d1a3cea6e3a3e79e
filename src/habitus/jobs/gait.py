"""Gait analysis of captures: files of a laboratory in, angles, strides, forces and a page out."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from habitus.body.motion import Moving
from habitus.body.segments import SegmentMasses, segment_masses
from habitus.errors import HabitusError, check_extra
from habitus.export.opensim_setup import write_opensim
from habitus.fit.markers.result import MarkerFit
from habitus.gait.analysis import GaitAnalysis, analyse
from habitus.gait.contacts import ForcePlate
from habitus.io.bands import read_bands
from habitus.io.captures.events import read_events
from habitus.io.captures.force_plates import read_force_plates
from habitus.io.limits import read_file
from habitus.io.names import plain_name
from habitus.jobs.anatomy import anatomy_of, angles
from habitus.jobs.exporting import read_moving
from habitus.jobs.mosh import mosh
from habitus.jobs.opensim import ScaledModel, scaled_model, solve
from habitus.jobs.options import GaitOptions, takes
from habitus.jobs.results import with_methods
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
        opensim_model: ScaledModel | None = None,
    ) -> None:
        """Write angles.csv, cycles.csv, dynamics.csv, gait.json and gait.html.

        band: a laboratory's reference curves (.csv). capture: a copy of it with angles, moments and
        powers as model outputs is written as gait.c3d. opensim: of a marker fit, a folder that
        OpenSim runs (`habitus.export.opensim_setup`); opensim_model: with a model scaled to the
        person (`habitus.jobs.opensim.scaled_model`), solved and checked. Raises HabitusError where
        the folder cannot be written.
        """
        bands = {} if band is None else read_bands(band)
        setup = None
        if opensim or opensim_model is not None:
            given = _marker_fit(self.motion), self.plates, self.contacts
            setup = partial(write_opensim, *given)
            if opensim_model is not None:
                setup = partial(solve, opensim_model, *given, self.residual)
        save_gait(self, folder, partial(gait_page, bands=bands), capture, setup)


@takes(GaitOptions)
def gait(
    motion: Moving | PathLike, capture: PathLike | None = None, *, options: GaitOptions
) -> GaitResult:
    """The gait analysis of a body in motion: a fit, a motion, or the file or result folder of one.

    capture: the .c3d that was fitted, for its force plates and events. Fits of any sensor have
    angles, captures with force plates have forces. Raises HabitusError for a body without SMPL's
    joints or without landmarks, and for a capture that cannot be read.
    """
    moving = read_moving(motion)
    plates: tuple[ForcePlate, ...] = ()
    events = None
    if capture is not None and Path(capture).suffix.lower() == C3D:
        content, name = read_file(Path(capture)), Path(capture).name
        if options.plates == "auto":
            plates = read_force_plates(content, name)
        if options.events == "auto":
            events = read_events(content, name)
    analysis = analyse(
        moving,
        anatomy_of(moving),
        angles(moving, options.convention),
        _masses(moving, options.mass),
        plates,
        events,
        [note for plate in plates for note in plate.notes],
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
        pairs += [(fit, _capture_of(fit, raw)) for fit in mosh(raw)]
    beside = sorted(Path(captures).iterdir()) if captures is not None else []
    for path in fitted:
        moving = read_moving(path)
        pairs.append((moving, _capture_of(moving, beside)))
    _refuse_unwritable(pairs, options)
    results = []
    with result_lock(out, GAIT_FILES):
        model = _scaled(pairs, options, progress)
        for moving, capture in pairs:
            progress(f"analysing {moving.capture_name}")
            result = gait(moving, capture, options=options)
            copied = capture if options.c3d else None
            where = out if len(pairs) == 1 else Path(out) / plain_name(moving.capture_name)
            result.save(where, options.band, copied, options.opensim, model)
            results.append(result)
    return results


def _marker_fit(moving: Moving) -> MarkerFit:
    if not isinstance(moving, MarkerFit):
        raise HabitusError(
            f"{moving.capture_name}: opensim is asked for a motion without markers; expected a fit"
        )
    return moving


def _scaled(
    pairs: Sequence[tuple[Moving, Path | None]],
    options: GaitOptions,
    progress: Callable[[str], Any],
) -> ScaledModel | None:
    """The user's generic model scaled to the person, its markers placed on the first capture with
    strides, else on the first.
    """
    if options.opensim_model is None:
        return None
    check_extra("opensim", "scaled OpenSim models", "opensim")
    fits = [_marker_fit(moving) for moving, _ in pairs]
    progress(f"scaling {options.opensim_model.name}")
    placing, analysis = 0, None
    for k, (moving, capture) in enumerate(pairs):
        own = gait(moving, capture, options=options)
        if analysis is None or own.strides:
            placing, analysis = k, own
        if own.strides:
            break
    assert analysis is not None
    mass = analysis.masses.total
    return scaled_model(fits, options.opensim_model, mass, options.opensim_markers, placing)


def _capture_of(moving: Moving, captures: Sequence[Path]) -> Path | None:
    """The .c3d that was fitted: of those whose name the motion's begins with, the longest; several
    people of one file are named by it and by themselves.
    """
    own = [path for path in captures if path.suffix.lower() == C3D]
    named = [path for path in own if moving.capture_name.startswith(plain_name(path.stem))]
    return max(named, key=lambda path: len(path.stem), default=None)


def _refuse_unwritable(pairs: Sequence[tuple[Moving, Path | None]], options: GaitOptions) -> None:
    """Before anything is written: names that differ, and a capture where a copy of it is wanted."""
    names = [moving.capture_name for moving, _ in pairs]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise HabitusError(
            f"several results are of {twice[0]}; expected captures whose names differ: analyse "
            "them in separate runs"
        )
    if options.opensim_markers is not None and options.opensim_model is None:
        raise HabitusError(
            f"--opensim-markers {options.opensim_markers} without a model; give --opensim-model"
        )
    without = [moving.capture_name for moving, capture in pairs if capture is None]
    if options.c3d and without:
        raise HabitusError(
            f"{without[0]}: no .c3d of this name to copy; give the folder that holds it "
            "(--captures), or leave --c3d out"
        )


def _masses(moving: Moving, mass: float | None) -> SegmentMasses:
    """Masses by what is given, else recorded, else from the volume."""
    source = "given"
    if mass is None and isinstance(moving, MarkerFit):
        recorded = moving.recorded.get("mass_kg")
        mass = float(recorded) if isinstance(recorded, float | int) else None
        source = "recorded in the capture"
    return segment_masses(moving.body, moving.betas, mass, source)
