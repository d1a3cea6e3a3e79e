"""The words of the report of a marker fit, as data: names of stages, files, terms and body parts,
and every sentence, as formats that `page` fills in.
"""

STAGES = {"pose": "Pose stage", "soft_tissue": "Soft-tissue stage"}
SECONDS = {
    "read": "Reading the file",
    "shape": "Shape and marker placement",
    "pose": "Pose",
    "soft_tissue": "Soft tissue",
    "export": "Writing results",
    "total": "Total",
    "startup": "Start-up (imports, compilation; not in the total)",
}
FILES = {
    "body.npz": "shape, pose and markers in every frame, for Python (AMASS names)",
    "body.glb": "the moving body, for Blender, game engines and web viewers",
    "metrics.json": "the numbers of this page, for programs",
    "obj": "a folder with one mesh per frame",
}
TERMS = {
    "data": "Markers, observed and predicted",
    "surface": "Distance of markers from the skin",
    "start": "Distance of markers from their places in the layout",
    "betas": "Shape prior",
    "pose": "Pose prior",
    "soft_tissue": "Soft-tissue prior",
    "acceleration": "Change of soft tissue from frame to frame",
    "frames": "All terms, frame by frame",
}
TERM_STAGES = {"shape_": "Shape stage"}
SEGMENTS = {
    "pelvis": "pelvis",
    "hip": "thigh",
    "knee": "lower leg",
    "ankle": "foot",
    "foot": "toes",
    "spine1": "belly",
    "spine2": "waist",
    "spine3": "chest",
    "collar": "shoulder",
    "shoulder": "upper arm",
    "elbow": "forearm",
    "wrist": "hand",
    "hand": "fingers",
}
"""The body segment that each joint moves."""


def segment(joint: str) -> str:
    """The segment that a joint moves, in words."""
    side, _, rest = joint.partition("_")
    if side in ("left", "right") and rest:
        return f"{side} {SEGMENTS.get(rest, rest)}".replace("_", " ")
    return SEGMENTS.get(joint, joint).replace("_", " ")


NO_MARKERS = "No marker is visible in any frame, so the fit cannot be judged."
ERROR = "The mean distance between observed and predicted markers is {mean:.1f} mm"
ERROR_BOTH = " with soft tissue and {pose:.1f} mm without"
SUSPECTS = {0: "No marker is suspect for long", 1: "{count:,} marker is suspect for long"}
SUSPECTS_MANY = "{count:,} markers are suspect for long"
BRIEF = " {count} {were} down-weighted briefly."
FLAGGED = " {count} {are} flagged."

TILES = {
    "mean": "Mean error",
    "p95": "95 % are below",
    "height": "Height",
    "mass": "Mass",
    "missing": "Missing",
    "speed": "Speed",
}
TILE_NOTES = {
    "height": "of the fitted body",
    "mass": "volume times density",
    "missing": "of all marker samples",
}

WRONG_TITLE = "What looked wrong"
WRONG_NOTHING = "Nothing: no suspect marker, no warning, no flagged frame."
FRAMES_FLAGGED = "{share} frames are flagged: too few markers are visible to trust them."
BRIEF_TITLE = "{count} brief suspicions: samples far from the body, down-weighted in those frames"
UNOBSERVED = (
    "No markers on: {names}. Their position comes from the pose prior{accuracy}; they are hatched "
    "in the player."
)
UNOBSERVED_ACCURACY = " (standard deviation {low} to {high} cm)"
SUSPICION = "{label}: {reason} ({frames}{corrected})"
CORRECTED = "; corrected by the fit"

ASSUMED_TITLE = "What was assumed"
LAYOUT = "Markers are placed as in the layout “{layout}”, within its tolerances."
UP = "{up} is up in the capture; lengths are in metres."
RATE = "Frames are evenly spaced, {rate:g} per second."
FLOOR_ZERO = "The floor in the player is at the capture's height zero."
FLOOR = (
    "The capture's height zero is not the floor; in the player the floor is at {height:.2f} m, "
    "where the body usually stands."
)
RECORDED = "The file states of the subject: {values}."
GENDER_NEUTRAL = "The body model is gender-neutral"
GENDER_MODEL = "The body is the {model} model"
GENDER_SAYS = {
    "female": "{shape} was classified as female ({female:.0%})",
    "male": "{shape} was classified as male ({male:.0%})",
    "": "{shape} does not determine the sex (female {female:.0%})",
}
GENDER_SHAPE = {"neutral": "this shape", "": "the neutral shape"}

BODY_TITLE = "Body"
BODY_LEAD = "Measured on the fitted body at rest."
BODY_TAPES = " Click a girth to see its tape."
BODY_HEADS = ("", "Fitted", "Stated in the file")
TIMING_TITLE = "Timing"

HELD_OUT_TITLE = "Held-out markers"
HELD_OUT_LEAD = (
    "These markers were left out of the fit and then predicted at their places in the layout. The "
    "error combines that of the body where no marker constrains it with the distance of the real "
    "markers from these places."
)
HELD_OUT_KNOWN = (
    " Known placement: the same, with the markers' placement estimated from another capture of "
    "this person."
)
HELD_OUT_KNOWN_HEAD = "{stage}, known placement"
HELD_OUT_ROWS = {"mean": "Mean", "median": "Median", "p95": "95 % are below", "max": "Largest"}
HELD_OUT_EACH = "Each marker"

DETAILS_TITLE = "Settings and versions"

PLAYER = "The fitted body with observed and predicted markers."
PLACEMENT_HINT = "Latent markers on the body at rest; hover for the distance from the skin."
STRIDE = (
    "The player shows every {stride} frame ({shown:.3g} of {rate:g} Hz); plots and numbers use all."
)
MORPHS = (
    "The player draws pose-dependent and soft-tissue shape to {missed:.1f} mm RMS; the exports are "
    "more accurate."
)
SKINNING = (
    "The player uses linear blending where the body uses dual quaternions: strongly twisted joints "
    "look thinner."
)
ANGLES = " About one frame in {stride:.1f} is drawn."
POSE_STAGE_BAR = "; the pale bar is the pose stage"
