"""Where markers go: anatomical landmarks as vertices of the base mesh, picked on the left side and
mirrored.

Definitions follow palpation guides for marker placement; heights were checked against the means of
the ANSUR II survey (cervicale, suprasternale, iliocristale, trochanterion, epicondyle, malleolus,
... as shares of stature). Shoulders' landmarks are the skin that lies over the bone when the arms
hang, where technicians feel for it: in the T-pose, where arms are raised, the acromion's lies 20 mm
from it.
"""

from __future__ import annotations

import numpy as np

MIDLINE = {
    "head_top": 881,
    "forehead": 251,
    "nose_tip": 297,
    "glabella": 234,
    "sellion": 136,
    "chin": 732,
    "head_back": 962,
    "neck_front": 803,
    "c7": 858,
    "t2": 1467,
    "t6": 3780,
    "t10": 3960,
    "t12": 3988,
    "l1": 4002,
    "l3": 4045,
    "l5": 4195,
    "sacrum": 4205,
    "jugular_notch": 1526,
    "sternum_mid": 1402,
    "xiphoid": 4088,
    "navel": 4121,
    "waist_front": 4367,
    "waist_back": 4188,
}
LEFT = {
    "front_head": 7672,
    "back_head": 7664,
    "temple": 11997,
    "head_side": 7675,
    "mastoid": 12158,
    "cheek": 7604,
    "ear": 12186,
    "neck_side": 7536,
    "acromion": 8276,
    "clavicle_medial": 8161,
    "shoulder_front": 8050,
    "shoulder_back": 8292,
    "trapezius": 8224,
    "scapula_upper": 8220,
    "scapula_mid": 8245,
    "scapula_lower": 10592,
    "back_lower": 10620,
    "breast": 8449,
    "rib_side": 10625,
    "waist_side": 10690,
    "belly_side": 10778,
    "iliac_crest": 10805,
    "asis": 10947,
    "psis": 10830,
    "buttock": 10861,
    "trochanter": 10932,
    "upper_arm_high": 8300,
    "upper_arm": 8376,
    "biceps": 8385,
    "triceps": 8395,
    "elbow_lateral": 10039,
    "elbow_medial": 10062,
    "olecranon": 10059,
    "forearm": 10108,
    "forearm_low": 10159,
    "wrist_radial": 10438,
    "wrist_ulnar": 10228,
    "wrist_dorsal": 10561,
    "hand_back": 9914,
    "hand_radial": 9844,
    "hand_ulnar": 10249,
    "thumb_base": 10346,
    "thigh_front": 13350,
    "thigh_front_low": 11185,
    "thigh_lateral": 11115,
    "thigh_lateral_low": 11172,
    "thigh_back": 11111,
    "thigh_medial": 13333,
    "knee_lateral": 11248,
    "knee_medial": 13002,
    "patella": 11242,
    "tibial_tuberosity": 11306,
    "fibula_head": 11305,
    "shin_front": 11382,
    "shank_lateral": 11400,
    "shank_lateral_high": 11342,
    "calf": 11335,
    "ankle_lateral": 11444,
    "ankle_medial": 12939,
    "heel": 12442,
    "heel_high": 12950,
    "heel_lateral": 12899,
    "heel_medial": 12901,
    "midfoot_top": 12818,
    "navicular": 12858,
    "mt1_head": 13299,
    "mt2_head": 13310,
    "mt5_head": 13301,
    "mt1_base": 12816,
    "mt5_base": 12869,
    "hallux": 12380,
    "big_toe": 12768,
    "toe_tip": 13115,
    "little_toe": 13248,
    "thumb_tip": 9428,
    "index_tip": 8595,
    "middle_tip": 8936,
    "ring_tip": 8982,
    "pinky_tip": 9313,
    "thumb_cmc": 9899,
    "thumb_mcp": 10307,
    "thumb_ip": 9355,
    "index_mcp": 9772,
    "index_pip": 8638,
    "index_dip": 8652,
    "middle_mcp": 9778,
    "middle_pip": 8763,
    "middle_dip": 8881,
    "ring_mcp": 9784,
    "ring_pip": 9022,
    "ring_dip": 9073,
    "pinky_mcp": 9183,
    "pinky_pip": 9214,
    "pinky_dip": 9228,
}
OF_WOMEN = {  # in the women's body: one vertex cannot stand where the survey has it on both sexes
    "acromion": 8275,  # the others' lies 12 mm low on women or 13 mm high on men
    "trochanter": 10926,  # 19 mm low on women
    "iliac_crest": 11014,  # 17 mm high on women
}


def landmark_vertices(mirror: np.ndarray, space: str = "neutral") -> dict[str, int]:
    """Name -> base vertex: midline ones as they are, the others as left_ and right_."""
    found = dict(MIDLINE)
    for name, vertex in (LEFT | (OF_WOMEN if space == "female" else {})).items():
        found["left_" + name] = vertex
        found["right_" + name] = int(mirror[vertex])
    return found
