"""OpenSim's own scaling, inverse kinematics and inverse dynamics behind arrays (extra `opensim`).

Everything is in OpenSim's units and frame: metres, radians, y up. Nothing is printed, and no log is
written into the working folder.
"""

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, require_extra, shown

Points = Float[np.ndarray, "M 3"]
ROUGH, ACCURACY = 1e-5, 1e-6
"""Of inverse kinematics: as in OpenSim's examples, where angles are some degrees rough from frame
to frame, and a quarter of that at two and a half times the seconds."""
ROTATIONAL = 1
"""OpenSim's number of coordinates that are angles."""


class Tracked(NamedTuple):
    """Inverse kinematics of T frames. coordinates (T, C): radians and metres; markers (T, M, 3): of
    the model; turns (T, B, 3, 3), origins (T, B, 3): of bodies in the ground.
    """

    coordinates: Float[np.ndarray, "T C"]
    markers: Float[np.ndarray, "T M 3"]
    turns: Float[np.ndarray, "T B 3 3"]
    origins: Float[np.ndarray, "T B 3"]


def engine() -> Any:
    """The module opensim, silent. Raises HabitusError where it is not installed."""
    opensim = require_extra("opensim", "scaled OpenSim models", "opensim")
    opensim.Logger.removeFileSink()
    opensim.Logger.setLevelString("Off")
    return opensim


@contextlib.contextmanager
def _explained(what: str) -> Iterator[None]:
    """OpenSim's exceptions as one line."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        said = shown(lines[0] if lines else str(error), 160)
        raise HabitusError(f"OpenSim cannot {what}: {said}") from error


@contextlib.contextmanager
def _unprinted() -> Iterator[None]:
    """What OpenSim writes to the standard output past its log goes nowhere."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def load_model(path: Path, marker_set: Path | None = None) -> Any:
    """A model of a file, with the markers of another where given. Raises HabitusError."""
    opensim = engine()
    with _explained(f"read {path.name}"):
        model = opensim.Model(str(path))
        if marker_set is not None:
            model.updateMarkerSet(opensim.MarkerSet(str(marker_set)))
        model.finalizeConnections()
        model.initSystem()
    return model


def save_model(
    model: Any, factors: Mapping[str, Iterable[float]], path: Path, markers: Path, scales: Path
) -> None:
    """Write a model, its markers, and the factors by which it was scaled, as OpenSim's files."""
    with _explained(f"write {path.name}"):
        model.printToXML(str(path))
        model.getMarkerSet().printToXML(str(markers))
        _scale_set(factors).printToXML(str(scales))


def body_names(model: Any) -> tuple[str, ...]:
    """Names of a model's bodies."""
    return tuple(body.getName() for body in model.getBodySet())


def coordinate_names(model: Any) -> tuple[str, ...]:
    """Names of a model's coordinates, in the order of `Tracked.coordinates`."""
    return tuple(one.getName() for one in model.getCoordinateSet())


def rotational(model: Any) -> np.ndarray:
    """(C,) which coordinates are angles."""
    return np.array([one.getMotionType() == ROTATIONAL for one in model.getCoordinateSet()])


def marker_bodies(model: Any) -> dict[str, str]:
    """The body that carries each of a model's markers."""
    return {
        marker.getName(): marker.getParentFrame().findBaseFrame().getName()
        for marker in model.getMarkerSet()
    }


def joint_centres(model: Any) -> dict[str, Float[np.ndarray, "3"]]:
    """Where the joint above each body lies (m, ground) with all coordinates at their defaults, by
    the body's name.
    """
    state = model.initSystem()
    model.realizePosition(state)
    out = {}
    for joint in model.getJointSet():
        frame = joint.getChildFrame()
        out[frame.findBaseFrame().getName()] = frame.getPositionInGround(state).to_numpy()
    return out


def scaled(model: Any, factors: Mapping[str, Iterable[float]], mass: float) -> Any:
    """A copy of a model with bodies scaled about their own axes x, y, z, and of this mass (kg),
    distributed as the model's is. Joints, muscles, contacts and markers follow.
    """
    out = model.clone()
    with _explained("scale the model"):
        state = out.initSystem()
        out.scale(state, _scale_set(factors), True, float(mass))
        out.initSystem()
    return out


def _scale_set(factors: Mapping[str, Iterable[float]]) -> Any:
    opensim = engine()
    scales = opensim.ScaleSet()
    for body, factor in factors.items():
        scale = opensim.Scale()
        scale.setSegmentName(body)
        scale.setScaleFactors(opensim.Vec3(*map(float, factor)))
        scale.setApply(True)
        scales.cloneAndAppend(scale)
    return scales


def with_markers(model: Any, places: Mapping[str, tuple[str, Float[np.ndarray, "3"]]]) -> Any:
    """A copy of a model with these markers and no others: by label the body and the place (m) in
    the body's axes.
    """
    opensim = engine()
    out = model.clone()
    out.updMarkerSet().clearAndDestroy()
    with _explained("place the markers"):
        for label, (body, place) in places.items():
            frame = out.getBodySet().get(body)
            out.addMarker(opensim.Marker(label, frame, opensim.Vec3(*map(float, place))))
        out.finalizeConnections()
        out.initSystem()
    return out


def track(
    model: Any,
    labels: Sequence[str],
    observed: Float[np.ndarray, "T M 3"],
    rate_hz: float,
    bodies: Sequence[str] = (),
    accuracy: float = ACCURACY,
) -> Tracked:
    """Inverse kinematics: the model's coordinates that bring its markers of these labels nearest to
    the observed ones (m, y up; NaN where missing), all with equal weight.

    bodies: whose places are reported. Raises HabitusError where OpenSim does not solve it.
    """
    opensim = engine()
    own = model.clone()
    own.updForceSet().clearAndDestroy()  # muscles take no part, but time
    table = opensim.TimeSeriesTableVec3()
    table.setColumnLabels(list(labels))
    weights = opensim.SetMarkerWeights()
    for label in labels:
        weights.cloneAndAppend(opensim.MarkerWeight(label, 1.0))
    for k, points in enumerate(np.asarray(observed, np.float64)):
        row = opensim.RowVectorVec3(len(labels))
        for column, point in enumerate(points):
            row[column] = opensim.Vec3(*point.tolist())
        table.appendRow(k / rate_hz, row)
    frames = []
    with _explained("follow the markers"):
        own.finalizeConnections()
        state = own.initSystem()
        reference = opensim.MarkersReference(table, weights)
        none = opensim.SimTKArrayCoordinateReference()
        solver = opensim.InverseKinematicsSolver(own, reference, none, float("inf"))
        solver.setAccuracy(accuracy)
        markers = [own.getMarkerSet().get(label) for label in labels]
        carriers = [own.getBodySet().get(name) for name in bodies]
        coordinates = list(own.getCoordinateSet())
        for k in range(len(observed)):
            state.setTime(k / rate_hz)
            if k:
                solver.track(state)
            else:
                solver.assemble(state)
            own.realizePosition(state)
            frames.append(
                (
                    [one.getValue(state) for one in coordinates],
                    [one.getLocationInGround(state).to_numpy() for one in markers],
                    *_placed(carriers, state),
                )
            )
    values, places, turns, origins = zip(*frames, strict=True)
    shape = len(observed), len(bodies), 3
    return Tracked(
        np.array(values, np.float64),
        np.array(places, np.float64),
        np.array(turns, np.float64).reshape(*shape, 3),
        np.array(origins, np.float64).reshape(shape),
    )


def _placed(bodies: Sequence[Any], state: Any) -> tuple[list, list]:
    """Turns (rows) and origins of bodies in the ground."""
    turns, origins = [], []
    for body in bodies:
        transform = body.getTransformInGround(state)
        turn = transform.R()
        turns.append([[turn.get(i, j) for j in range(3)] for i in range(3)])
        origins.append(transform.p().to_numpy())
    return turns, origins


def inverse_dynamics(setup: Path) -> None:
    """Run an inverse dynamics set-up in its folder: generalised forces (N, Nm) of all coordinates
    over time. Raises HabitusError where OpenSim cannot.
    """
    opensim = engine()
    what = "compute the inverse dynamics"
    with _explained(what), _unprinted(), contextlib.chdir(setup.parent):
        if not opensim.InverseDynamicsTool(setup.name).run():  # names in it are of this folder
            raise RuntimeError(f"{setup.name} was not run")


def read_table(path: Path) -> tuple[Float[np.ndarray, " T"], dict[str, Float[np.ndarray, " T"]]]:
    """Times (s) and columns of a .sto or .mot file that OpenSim wrote."""
    opensim = engine()
    with _explained(f"read {path.name}"):
        table = opensim.TimeSeriesTable(str(path))
        labels = table.getColumnLabels()
        values = table.getMatrix().to_numpy()
        times = np.array(table.getIndependentColumn(), np.float64)
    return times, dict(zip(labels, np.asarray(values, np.float64).T, strict=True))
