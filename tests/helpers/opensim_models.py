"""A small OpenSim model made in code: a pelvis, two legs and a trunk of a usual size, with markers
on landmarks under the labels of OpenSim's Rajagopal set.
"""

from pathlib import Path

import numpy as np

HIP, KNEE, ANKLE, HEEL = 0.085, 0.41, 0.40, 0.045
SIDED = {
    "ASI": ("pelvis", (0.02, 0.03, 0.125)),
    "PSI": ("pelvis", (-0.16, 0.05, 0.045)),
    "ACR": ("torso", (-0.02, 0.42, 0.17)),
    "LFC": ("femur", (0.0, -KNEE, 0.055)),
    "MFC": ("femur", (0.0, -KNEE, -0.055)),
    "LMAL": ("tibia", (-0.005, -ANKLE, 0.05)),
    "MMAL": ("tibia", (0.005, -ANKLE + 0.01, -0.04)),
    "CAL": ("calcn", (-0.02, 0.01, 0.0)),
    "TOE": ("calcn", (0.22, 0.02, -0.02)),
    "MT5": ("calcn", (0.15, 0.01, 0.05)),
}
"""Markers of the right side by the ends of their labels; left ones are mirrored."""
MIDDLE = {"C7": ("torso", (-0.06, 0.45, 0.0)), "CLAV": ("torso", (0.06, 0.36, 0.0))}


def small_model(opensim, markers: bool = True):
    """The model, its joints as in OpenSim's gait models."""
    model = opensim.Model()
    model.setName("small")
    weights = {
        "pelvis": 11.0,
        "femur": 9.0,
        "tibia": 3.7,
        "talus": 0.1,
        "calcn": 1.2,
        "torso": 34.0,
    }

    def body(name: str):
        mass = weights[name.split("_")[0]]
        own = opensim.Body(name, mass, opensim.Vec3(0), opensim.Inertia(*[0.05 * mass] * 3))
        model.addBody(own)
        return own

    def vec(*numbers):
        return opensim.Vec3(*map(float, numbers))

    def join(name, parent, place, child, coordinates):
        """Turns about z, x, y in this order, then shifts, of those that have a coordinate."""
        motion = opensim.SpatialTransform()
        turned = ("z", "x", "y")
        for k, axis in enumerate((*turned, "x", "y", "z")):
            own = motion.updTransformAxis(k)
            own.setAxis(vec(*(one == axis for one in "xyz")))
            if k < len(coordinates):
                own.setCoordinateNames(opensim.ArrayStr(coordinates[k], 1))
                own.set_function(opensim.LinearFunction(1.0, 0.0))
            else:
                own.set_function(opensim.Constant(0.0))
        zero = vec(0, 0, 0)
        frames = name, parent, vec(*place), zero, child, zero, zero
        kind = (opensim.CustomJoint, motion) if coordinates else (opensim.WeldJoint,)
        model.addJoint(kind[0](*frames, *kind[1:]))

    pelvis = body("pelvis")
    free = [f"pelvis_{k}" for k in ("tilt", "list", "rotation", "tx", "ty", "tz")]
    join("ground_pelvis", model.getGround(), (0, 0, 0), pelvis, free)
    torso = body("torso")
    back = [f"lumbar_{k}" for k in ("extension", "bending", "rotation")]
    join("back", pelvis, (-0.09, 0.08, 0), torso, back)
    for end, s in (("r", 1.0), ("l", -1.0)):
        femur, tibia, talus, calcn = (
            body(f"{part}_{end}") for part in ("femur", "tibia", "talus", "calcn")
        )
        hip = [f"hip_{k}_{end}" for k in ("flexion", "adduction", "rotation")]
        join(f"hip_{end}", pelvis, (-0.06, -0.07, s * HIP), femur, hip)
        knee = [f"knee_angle_{end}"]
        join(f"knee_{end}", femur, (0, -KNEE, 0), tibia, knee)
        ankle = [f"ankle_angle_{end}"]
        join(f"ankle_{end}", tibia, (0, -ANKLE, 0), talus, ankle)
        join(f"subtalar_{end}", talus, (-0.04, -HEEL, 0), calcn, [])
    if markers:
        for label, (name, place) in MIDDLE.items():
            model.addMarker(opensim.Marker(label, model.getBodySet().get(name), vec(*place)))
        for label, (name, (x, y, z)) in SIDED.items():
            for side, s in (("r", 1.0), ("l", -1.0)):
                whole = name if name in ("pelvis", "torso") else f"{name}_{side}"
                carrier = model.getBodySet().get(whole)
                model.addMarker(opensim.Marker(f"{side.upper()}{label}", carrier, vec(x, y, s * z)))
    model.finalizeConnections()
    model.initSystem()
    return model


def write_small_model(opensim, path: Path, markers: bool = True) -> Path:
    small_model(opensim, markers).printToXML(str(path))
    return path


def posed_markers(model, coordinates: dict[str, np.ndarray]) -> tuple[list[str], np.ndarray]:
    """Labels, and where the model's markers are (T, M, 3) with these coordinates (T,)."""
    state = model.initSystem()
    markers = list(model.getMarkerSet())
    frames = []
    for k in range(len(next(iter(coordinates.values())))):
        for name, values in coordinates.items():
            model.getCoordinateSet().get(name).setValue(state, float(values[k]), False)
        model.realizePosition(state)
        frames.append([one.getLocationInGround(state).to_numpy() for one in markers])
    return [one.getName() for one in markers], np.array(frames)
