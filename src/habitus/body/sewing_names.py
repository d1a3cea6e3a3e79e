"""What tailors' measurements are: a sentence, and the name in ISO 8559-1 where it is the same one.

Those of `habitus.body.sewing` and the tapes of `habitus.body.tapes` that only tailors take.
"""

from types import MappingProxyType

SEWING = MappingProxyType(
    {
        "upper_chest_circumference_m": ("level, at the armpits", "upper chest girth"),
        "underbust_circumference_m": ("level, at the fold under the breasts", "underbust girth"),
        "high_hip_circumference_m": ("level, half way from waist to fullest buttocks", ""),
        "neck_base_circumference_m": (
            "seventh neck vertebra, side neck points, hollow of the throat",
            "neck base girth",
        ),
        "armscye_circumference_m": ("tip of the shoulder, armpit", "armscye girth"),
        "elbow_circumference_m": ("across the straight elbow", "elbow girth"),
        "mid_thigh_circumference_m": (
            "level, half way from crotch to kneecap: 60 % of the way from hip to knee",
            "mid-thigh girth",
        ),
        "heel_ankle_circumference_m": ("under the heel and over the front of the ankle", ""),
        "back_neck_to_waist_m": (
            "seventh neck vertebra to the waist, over the back",
            "back neck point to waist",
        ),
        "front_neck_to_waist_m": (
            "hollow of the throat to the waist, over the front",
            "front neck point to waist",
        ),
        "side_neck_to_bust_m": ("side neck point to nipple", "side neck point to bust point"),
        "side_neck_to_waist_front_m": (
            "side neck point over the nipple to the waist",
            "side neck point to waist over bust",
        ),
        "side_neck_to_waist_back_m": ("side neck point straight down the back to the waist", ""),
        "shoulder_length_m": ("side neck point to the tip of the shoulder", "shoulder length"),
        "across_shoulder_m": (
            "between the tips of the shoulders, over the back",
            "back shoulder width",
        ),
        "across_back_m": (
            "between the armscyes over the back, half way from shoulder to armpit",
            "back width",
        ),
        "across_front_m": (
            "between the armscyes over the chest, half way from shoulder to armpit",
            "front width",
        ),
        "neck_back_arc_m": ("between the side neck points behind the neck", ""),
        "bust_point_distance_m": ("between the nipples, straight", "bust point width"),
        "buttock_point_distance_m": ("between the fullest points of the buttocks, straight", ""),
        "bust_to_underbust_m": ("nipple to the fold under the breast", ""),
        "bust_front_arc_m": ("front of the chest's tape, between its widest points", ""),
        "bust_back_arc_m": ("back of the chest's tape, between its widest points", ""),
        "waist_back_arc_m": ("back of the natural waist's tape, between its widest points", ""),
        "hip_back_arc_m": ("back of the hip's tape, between its widest points", ""),
        "arm_length_m": (
            "tip of the shoulder over the outer elbow to the wrist's little finger side",
            "arm length",
        ),
        "back_neck_to_wrist_m": (
            "seventh neck vertebra over shoulder and elbow to the wrist",
            "back neck point to wrist",
        ),
        "waist_to_hip_m": ("waist to fullest buttocks, over the side", "waist to hip"),
        "outside_leg_m": ("waist over the hip to the floor", "outside leg length"),
        "front_crotch_length_m": ("front waist to crotch, 1.17 times the tape on the skin", ""),
        "back_crotch_length_m": ("crotch to back waist, 1.17 times the tape on the skin", ""),
        "total_crotch_length_m": (
            "front waist through the crotch to back waist, 1.17 times the tape on the skin",
            "total crotch length",
        ),
        "natural_waist_height_m": ("sole to the natural waist", "waist height"),
        "armpit_height_m": ("sole to the armpit", "armpit height"),
        "armscye_depth_m": ("tip of the shoulder to armpit, upright", ""),
        "back_neck_to_crown_m": ("seventh neck vertebra to crown, upright", ""),
        "back_neck_to_bust_height_m": ("seventh neck vertebra to nipples, upright", ""),
        "armpit_to_waist_height_m": ("armpit to waist, upright", ""),
        "underbust_to_waist_height_m": ("fold under the breast to waist, upright", ""),
        "waist_to_high_hip_height_m": ("waist to high hip, upright", ""),
        "waist_to_hip_height_m": ("waist to fullest buttocks, upright", ""),
        "waist_to_knee_height_m": ("waist to the middle of the kneecap, upright", ""),
        "body_rise_m": ("waist to crotch, upright; ISO's is taken seated", ""),
        "hip_to_crotch_height_m": ("fullest buttocks to crotch, upright", ""),
        "shoulder_slope_deg": (
            "side neck point to the tip of the shoulder, below the level",
            "shoulder slope",
        ),
        "hip_inclination_deg": ("waist to hip at the side, against the plumb line", ""),
    }
)
AT_REST = frozenset(
    f"{name}_circumference_m" for name in ("high_hip", "elbow", "mid_thigh", "heel_ankle")
)
"""Those of them with level arms; the others are taken with hanging arms and heels together."""
