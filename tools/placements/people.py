"""Whose captures the prior over placements is learned from: a person's name and their files (no two
are one person).
"""

PEOPLE: dict[str, tuple[str, ...]] = {
    "CMU 85": ("85_02.c3d", "85_12.c3d"),
    "HDM mm": ("HDM_mm_01-02_03_120.c3d",),
    "DJ2": ("DJ2.trc",),
    "HC030A": ("HC030A01.c3d", "HC030A05.c3d", "HC030A22.c3d"),
    "HC042A": ("HC042A13.c3d", "HC042A40.c3d"),
    "RoboStatic": ("RoboStatic.c3d",),
    "Running": ("Running_0002.c3d",),
    "ECH": ("anat_pose_ECH.c3d", "right_hip.c3d", "right_knee.c3d"),
    "static_rotated": ("static_rotated.c3d",),
    "tennis": ("kinematics_tennis_serve.c3d",),
    "nick": ("nick_freeform_001.c3d",),
    "testsample": ("testsample.c3d", "testsample2.c3d"),
}
