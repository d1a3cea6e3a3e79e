"""Writers of text captures for the tests, made after files that OpenSim, Motive and QTM write."""

import numpy as np


def _cell(value: float) -> str:
    return f"{value:.6f}" if np.isfinite(value) else ""


def trc_text(
    labels: tuple[str, ...],
    points: np.ndarray,
    rate: float = 100.0,
    unit: str = "mm",
    numbers: np.ndarray | None = None,
) -> str:
    """A TRC file; ``numbers`` are its frame numbers, 1, 2, 3, … where not given."""
    numbers = np.arange(1, len(points) + 1) if numbers is None else numbers
    head = [
        "PathFileType\t4\t(X/Y/Z)\tmade.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{len(points)}\t{len(labels)}\t{unit}\t{rate:g}\t1\t{len(points)}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{i + 1}" for i in range(len(labels)) for axis in "XYZ"),
        "",
    ]
    rows = [
        "\t".join([str(number), f"{(number - 1) / rate:.8f}", *map(_cell, frame.reshape(-1))])
        for number, frame in zip(numbers, points, strict=True)
    ]
    return "\r\n".join([*head, *rows]) + "\r\n"


def motive_text(
    labels: tuple[str, ...],
    points: np.ndarray,
    rate: float = 120.0,
    unit: str = "Meters",
    version: str = "1.23",
) -> str:
    """A Motive export with a rigid body, a bone and their solved markers before the tracked
    markers.
    """
    head = (
        f"Format Version,{version},Take Name,made,Capture Frame Rate,{rate:.6f},Export Frame "
        f"Rate,{rate:.6f}"
    )
    head += f",Rotation Type,Quaternion,Length Units,{unit},Coordinate Space,Global"
    columns = [("Rigid Body", "Prop", "Rotation", axis) for axis in "XYZW"]
    columns += [("Rigid Body", "Prop", "Position", axis) for axis in "XYZ"]
    columns += [("Rigid Body Marker", "Prop:Marker1", "Position", axis) for axis in "XYZ"]
    columns += [("Bone", "Ann:Hip", "Rotation", axis) for axis in "XYZW"]
    columns += [("Bone", "Ann:Hip", "Position", axis) for axis in "XYZ"]
    columns += [("Bone Marker", f"Ann:{labels[0]}", "Position", axis) for axis in "XYZ"]
    extra = len(columns)
    columns += [("Marker", f"Ann:{label}", "Position", axis) for label in labels for axis in "XYZ"]
    columns += [("Marker", "Unlabeled 1042", "Position", axis) for axis in "XYZ"]
    lines = [head, ""]
    lines += [
        f",{title}," + ",".join(column[i] for column in columns)
        for i, title in enumerate(("Type", "Name"))
    ]
    lines += [",ID," + ",".join(f'"{i:032X}"' for i in range(len(columns)))]
    lines += [",," + ",".join(column[2] for column in columns)]
    lines += ["Frame,Time (Seconds)," + ",".join(column[3] for column in columns)]
    for i, frame in enumerate(points):
        cells = ["0.5"] * extra + [_cell(value) for value in frame.reshape(-1)] + ["9", "9", "9"]
        lines.append(f"{i},{i / rate:.6f}," + ",".join(cells))
    return "\n".join(lines) + "\n"


def qtm_text(
    labels: tuple[str, ...],
    points: np.ndarray,
    rate: float = 100.0,
    times: bool = False,
    more: bool = False,
) -> str:
    """A QTM export in millimetres, zeros for missing; with a frame and a time column, with the
    newer header lines.
    """
    lines = [
        f"NO_OF_FRAMES\t{len(points)}",
        "NO_OF_CAMERAS\t8",
        f"NO_OF_MARKERS\t{len(labels)}",
        f"FREQUENCY\t{rate:g}",
    ]
    lines += [
        "NO_OF_ANALOG\t0",
        "ANALOG_FREQUENCY\t0",
        "DESCRIPTION\t--",
        "TIME_STAMP\t2020-01-02, 10:11:12.123\t4242.1",
    ]
    lines += ["DATA_INCLUDED\t3D", "MARKER_NAMES\t" + "\t".join(labels)]
    if more:
        lines += ["TRAJECTORY_TYPES\t" + "\t".join(["Measured"] * len(labels))]
        lines += (
            ["Frame\tTime\t" + "\t".join(f"{label} {axis}" for label in labels for axis in "XYZ")]
            if times
            else []
        )
    for i, frame in enumerate(np.nan_to_num(points)):
        front = [str(i + 1), f"{i / rate:.5f}"] if times else []
        lines.append("\t".join([*front, *(f"{value:.3f}" for value in frame.reshape(-1))]))
    return "\r\n".join(lines) + "\r\n"
