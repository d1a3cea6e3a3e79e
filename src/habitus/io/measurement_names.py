"""What pattern programs call our measurements, and the unit of their files.

GarmentCode: its document "GarmentCode Body Measurements". Seamly2D and Valentina: the names of
SeamlyMe. FreeSewing: `config/measurements.mjs`. A name that is not here has no measurement of ours;
`docs/for-tailors.md` says where definitions differ.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class PatternProgram:
    """``names``: the program's own to ours. ``unit``: metres a unit of its lengths."""

    title: str
    names: Mapping[str, str]
    unit: float
    endings: tuple[str, ...]


GARMENTCODE = PatternProgram(
    "GarmentCode",
    MappingProxyType(
        {
            "height": "height_m",
            "head_l": "back_neck_to_crown_m",
            "bust": "chest_circumference_m",
            "underbust": "underbust_circumference_m",
            "waist": "natural_waist_circumference_m",
            "hips": "hip_circumference_m",
            "leg_circ": "thigh_circumference_m",
            "wrist": "wrist_circumference_m",
            "back_width": "bust_back_arc_m",
            "waist_back_width": "waist_back_arc_m",
            "hip_back_width": "hip_back_arc_m",
            "neck_w": "neck_back_arc_m",
            "waist_line": "back_neck_to_waist_m",
            "waist_over_bust_line": "side_neck_to_waist_front_m",
            "bust_line": "side_neck_to_bust_m",
            "vert_bust_line": "back_neck_to_bust_height_m",
            "bust_points": "bust_point_distance_m",
            "bum_points": "buttock_point_distance_m",
            "arm_length": "arm_length_m",
            "armscye_depth": "armscye_depth_m",
            "shoulder_w": "biacromial_breadth_m",
            "shoulder_incl": "shoulder_slope_deg",
            "hips_line": "waist_to_hip_height_m",
            "hip_inclination": "hip_inclination_deg",
            "crotch_hip_diff": "hip_to_crotch_height_m",
        }
    ),
    0.01,
    (".yaml", ".yml"),
)
FREESEWING = PatternProgram(
    "FreeSewing",
    MappingProxyType(
        {
            "ankle": "ankle_circumference_m",
            "biceps": "upper_arm_circumference_m",
            "bustFront": "bust_front_arc_m",
            "bustPointToUnderbust": "bust_to_underbust_m",
            "bustSpan": "bust_point_distance_m",
            "chest": "chest_circumference_m",
            "crossSeam": "total_crotch_length_m",
            "crossSeamFront": "front_crotch_length_m",
            "crotchDepth": "body_rise_m",
            "head": "head_circumference_m",
            "heel": "heel_ankle_circumference_m",
            "highBust": "upper_chest_circumference_m",
            "hips": "high_hip_circumference_m",
            "hpsToBust": "side_neck_to_bust_m",
            "hpsToWaistBack": "side_neck_to_waist_back_m",
            "hpsToWaistFront": "side_neck_to_waist_front_m",
            "inseam": "inseam_m",
            "knee": "knee_circumference_m",
            "neck": "neck_circumference_m",
            "seat": "hip_circumference_m",
            "seatBack": "hip_back_arc_m",
            "shoulderSlope": "shoulder_slope_deg",
            "shoulderToElbow": "upper_arm_length_m",
            "shoulderToShoulder": "across_shoulder_m",
            "shoulderToWrist": "arm_length_m",
            "underbust": "underbust_circumference_m",
            "upperLeg": "thigh_circumference_m",
            "waist": "natural_waist_circumference_m",
            "waistBack": "waist_back_arc_m",
            "waistToArmpit": "armpit_to_waist_height_m",
            "waistToFloor": "outside_leg_m",
            "waistToHips": "waist_to_high_hip_height_m",
            "waistToKnee": "waist_to_knee_height_m",
            "waistToSeat": "waist_to_hip_m",
            "waistToUnderbust": "underbust_to_waist_height_m",
            "waistToUpperLeg": "body_rise_m",
            "wrist": "wrist_circumference_m",
        }
    ),
    0.001,
    (".json",),
)
SEAMLY = PatternProgram(
    "Seamly2D and Valentina",
    MappingProxyType(
        {
            "height": "height_m",
            "height_neck_back": "cervical_height_m",
            "height_armpit": "armpit_height_m",
            "height_waist_side": "natural_waist_height_m",
            "height_hip": "hip_height_m",
            "height_bustpoint": "chest_height_m",
            "height_shoulder_tip": "shoulder_height_m",
            "height_waist_side_to_knee": "waist_to_knee_height_m",
            "height_waist_side_to_hip": "waist_to_hip_height_m",
            "width_shoulder": "biacromial_breadth_m",
            "hand_length": "hand_length_m",
            "hand_palm_width": "hand_breadth_m",
            "hand_palm_circ": "hand_circumference_m",
            "foot_length": "foot_length_m",
            "foot_width": "foot_breadth_m",
            "head_circ": "head_circumference_m",
            "head_depth": "head_length_m",
            "head_width": "head_breadth_m",
            "head_crown_to_neck_back": "back_neck_to_crown_m",
            "neck_mid_circ": "neck_circumference_m",
            "neck_circ": "neck_base_circumference_m",
            "neck_arc_b": "neck_back_arc_m",
            "highbust_circ": "upper_chest_circumference_m",
            "bust_circ": "chest_circumference_m",
            "lowbust_circ": "underbust_circumference_m",
            "waist_circ": "natural_waist_circumference_m",
            "highhip_circ": "high_hip_circumference_m",
            "hip_circ": "hip_circumference_m",
            "bust_arc_f": "bust_front_arc_m",
            "bust_arc_b": "bust_back_arc_m",
            "waist_arc_b": "waist_back_arc_m",
            "hip_arc_b": "hip_back_arc_m",
            "neck_front_to_waist_f": "front_neck_to_waist_m",
            "neck_side_to_waist_bustpoint_f": "side_neck_to_waist_front_m",
            "neck_side_to_waist_b": "side_neck_to_waist_back_m",
            "neck_back_to_waist_b": "back_neck_to_waist_m",
            "waist_to_hip_side": "waist_to_hip_m",
            "shoulder_slope_neck_side_angle": "shoulder_slope_deg",
            "shoulder_length": "shoulder_length_m",
            "shoulder_tip_to_shoulder_tip_b": "across_shoulder_m",
            "across_chest_f": "across_front_m",
            "across_back_b": "across_back_m",
            "bustpoint_to_bustpoint": "bust_point_distance_m",
            "bustpoint_to_neck_side": "side_neck_to_bust_m",
            "bustpoint_to_lowbust": "bust_to_underbust_m",
            "arm_shoulder_tip_to_wrist": "arm_length_m",
            "arm_shoulder_tip_to_elbow": "upper_arm_length_m",
            "arm_upper_circ": "upper_arm_circumference_m",
            "arm_elbow_circ": "elbow_circumference_m",
            "arm_lower_circ": "forearm_circumference_m",
            "arm_wrist_circ": "wrist_circumference_m",
            "armscye_circ": "armscye_circumference_m",
            "leg_crotch_to_floor": "inseam_m",
            "leg_waist_side_to_floor": "outside_leg_m",
            "leg_thigh_upper_circ": "thigh_circumference_m",
            "leg_thigh_mid_circ": "mid_thigh_circumference_m",
            "leg_knee_circ": "knee_circumference_m",
            "leg_calf_circ": "calf_circumference_m",
            "leg_ankle_circ": "ankle_circumference_m",
            "leg_ankle_diag_circ": "heel_ankle_circumference_m",
            "crotch_length": "total_crotch_length_m",
            "crotch_length_b": "back_crotch_length_m",
            "crotch_length_f": "front_crotch_length_m",
            "rise_length_side": "body_rise_m",
        }
    ),
    0.01,
    (".smis", ".vit"),
)
PROGRAMS: Mapping[str, PatternProgram] = MappingProxyType(
    {"garmentcode": GARMENTCODE, "seamly": SEAMLY, "freesewing": FREESEWING}
)
