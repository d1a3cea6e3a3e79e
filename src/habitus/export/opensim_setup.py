"""A folder that OpenSim 4 runs: markers, ground forces and set-ups of its inverse kinematics and
inverse dynamics, for a scaled model of the user's whose markers have the capture's labels.

| file | what |
|---|---|
| markers.trc | the capture's markers, y up, mm |
| ground_forces.mot | force (N), centre of pressure (m) and free moment (Nm) of each foot |
| external_loads.xml | which of them acts on which foot |
| inverse_kinematics.xml, inverse_dynamics.xml | set-ups: `opensim-cmd run-tool FILE` |

Generic models do not come along: their terms are their authors'. `habitus.jobs.opensim` scales the
user's and solves it in this folder.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from habitus.export.opensim_engine import ACCURACY
from habitus.export.trc import write_trc
from habitus.files import write_text
from habitus.gait.contacts import Contact, ForcePlate
from habitus.io.captures.read import Capture
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

FILES = (
    "markers.trc",
    "ground_forces.mot",
    "external_loads.xml",
    "inverse_kinematics.xml",
    "inverse_dynamics.xml",
)
MODEL = "scaled_model.osim"
"""Name of the model in the set-ups, where the user gives none."""
FEET = {"right": "calcn_r", "left": "calcn_l"}
"""Bodies of OpenSim's models that stand on the floor."""
LOWPASS_HZ = 6.0
"""Of the coordinates in inverse dynamics."""


def write_opensim(
    fit: "MarkerFit",
    plates: Sequence[ForcePlate],
    contacts: Sequence[Contact],
    folder: Path,
    model: str = MODEL,
    without: Collection[str] = (),
) -> tuple[str, ...]:
    """Write the files into a folder that is there; of a capture without force plates those of
    inverse kinematics alone. Their names come back. without: labels that inverse kinematics leaves
    out, beside suspect ones. Raises HabitusError where they cannot be written.
    """
    capture = Capture(fit.capture_name, fit.labels, fit.observed_markers, fit.rate_hz, fit.up_axis)
    write_trc(capture, folder / "markers.trc")
    last = (fit.num_frames - 1) / fit.rate_hz
    write_text(folder / "inverse_kinematics.xml", _kinematics(fit, model, last, without))
    if not any(not contact.refused for contact in contacts):
        return FILES[0], FILES[3]
    times, table = ground_table(plates, contacts, up_rotation(fit.up_axis))
    write_text(folder / "ground_forces.mot", mot_text("ground_forces", times, table))
    write_text(folder / "external_loads.xml", _loads())
    write_text(folder / "inverse_dynamics.xml", _dynamics(model, min(last, float(times[-1]))))
    return FILES


def ground_table(
    plates: Sequence[ForcePlate],
    contacts: Sequence[Contact],
    upright: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, " S"], dict[str, Float[np.ndarray, " S"]]]:
    """Times (s) of the plates' samples, and the columns of both feet, y up: zero where no contact
    of the foot is used. A foot on two plates at once has the sum, at their common centre.
    """
    rate = max(plate.rate_hz for plate in plates)
    count = max(len(plate.force) for plate in plates if plate.rate_hz == rate)
    times = np.arange(count) / rate
    by_number = {plate.number: plate for plate in plates}
    table: dict[str, Float[np.ndarray, " S"]] = {}
    for side in FEET:
        force, about, free = (np.zeros((count, 3)) for _ in range(3))
        size = np.zeros(count)
        for contact in contacts:
            if contact.side != side or contact.refused:
                continue
            plate = by_number[contact.plate]
            start, end = contact.span
            rows = np.round(times * plate.rate_hz).astype(int)
            inside = (times >= start) & (times <= end) & (rows < len(plate.force))
            inside[inside] &= np.isfinite(plate.pressure[rows[inside], 0])
            own = rows[inside]
            weight = np.linalg.norm(plate.force[own], axis=1)
            force[inside] += plate.force[own]
            about[inside] += weight[:, None] * plate.pressure[own]
            free[inside] += plate.free_moment[own]
            size[inside] += weight
        place = about / np.maximum(size, 1e-9)[:, None]
        end_name = side[0]
        for kind, values in (("v", force), ("p", place)):
            for axis, column in zip("xyz", (values @ upright.T).T, strict=True):
                table[f"ground_force_{end_name}_{kind}{axis}"] = column
        for axis, column in zip("xyz", (free @ upright.T).T, strict=True):
            table[f"ground_torque_{end_name}_{axis}"] = column
    return times, table


def mot_text(
    name: str, times: Float[np.ndarray, " S"], table: Mapping[str, Float[np.ndarray, " S"]]
) -> str:
    """A .mot file of columns over time (s), angles in degrees."""
    rows = np.column_stack([times, *table.values()])
    head = [
        name,
        "version=1",
        f"nRows={len(rows)}",
        f"nColumns={rows.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(["time", *table]),
    ]
    return "\n".join([*head, *("\t".join(f"{x:.6f}" for x in row) for row in rows)]) + "\n"


def _document(tool: ElementTree.Element) -> str:
    root = ElementTree.Element("OpenSimDocument", Version="40000")
    root.append(tool)
    ElementTree.indent(root, "\t")
    return ElementTree.tostring(root, "unicode", xml_declaration=True) + "\n"


def _tool(kind: str, name: str, **texts: str) -> ElementTree.Element:
    """An element of OpenSim's with a text in each child."""
    out = ElementTree.Element(kind, name=name)
    for key, text in texts.items():
        ElementTree.SubElement(out, key).text = text
    return out


def _kinematics(fit: "MarkerFit", model: str, last: float, without: Collection[str]) -> str:
    tool = _tool(
        "InverseKinematicsTool",
        "inverse_kinematics",
        model_file=model,
        marker_file="markers.trc",
        time_range=f"0 {last:.6f}",
        output_motion_file="inverse_kinematics.mot",
        report_errors="true",
        constraint_weight="Inf",
        accuracy=f"{ACCURACY:g}",
    )
    tasks = ElementTree.SubElement(tool, "IKTaskSet", name="tasks")
    objects = ElementTree.SubElement(tasks, "objects")
    doubted = {suspect.label for suspect in fit.suspects if not suspect.corrected} | {*without}
    for label in fit.labels:
        used = "false" if label in doubted else "true"
        objects.append(_tool("IKMarkerTask", label, apply=used, weight="1"))
    return _document(tool)


def _dynamics(model: str, last: float) -> str:
    return _document(
        _tool(
            "InverseDynamicsTool",
            "inverse_dynamics",
            model_file=model,
            time_range=f"0 {last:.6f}",
            forces_to_exclude="Muscles",
            external_loads_file="external_loads.xml",
            coordinates_file="inverse_kinematics.mot",
            lowpass_cutoff_frequency_for_coordinates=f"{LOWPASS_HZ:g}",
            output_gen_force_file="inverse_dynamics.sto",
        )
    )


def _loads() -> str:
    loads = ElementTree.Element("ExternalLoads", name="external_loads")
    objects = ElementTree.SubElement(loads, "objects")
    for side, body in FEET.items():
        end = side[0]
        objects.append(
            _tool(
                "ExternalForce",
                f"{side}_foot",
                applied_to_body=body,
                force_expressed_in_body="ground",
                point_expressed_in_body="ground",
                force_identifier=f"ground_force_{end}_v",
                point_identifier=f"ground_force_{end}_p",
                torque_identifier=f"ground_torque_{end}_",
            )
        )
    ElementTree.SubElement(loads, "datafile").text = "ground_forces.mot"
    return _document(loads)
