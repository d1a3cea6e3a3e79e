"""What each measurement is called, here and elsewhere, and what it is.

Names of tapes end in ``_circumference_m`` (ISO 7250-1; ISO 8559-1 says girth), all lengths in
``_m``, mass in ``_kg``.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType

from habitus.body.sewing_names import AT_REST, SEWING
from habitus.errors import HabitusError

LEVEL_ARMS = "arms level, feet a little apart"
HANGING_ARMS = "arms hanging, heels together"
_STANDING = ("shoulder_height_m", "shoulder_breadth_m", "biacromial_breadth_m", "chest_breadth_m",
             "chest_depth_m", "chest_circumference_m", "hip_breadth_m", "hip_depth_m",
             "hip_circumference_m")  # fmt: skip
_UNITS = {"_m2": ("m²", 1.0), "_m3": ("l", 1e3), "_m": ("cm", 1e2), "_kg": ("kg", 1.0),
          "_deg": ("°", 1.0)}  # fmt: skip
"""How a measurement is shown, by what its name ends in, and how many of it are one of m, m², m³, kg
or degree."""


@dataclass(frozen=True)
class Definition:
    """A measurement: what is measured, its names in ISO 8559-1 or ISO 7250-1, and ANSUR II's
    column.

    ``column`` is "" where the survey measured something else or nothing.
    """

    says: str
    iso: str = ""
    column: str = ""


DEFINITIONS = MappingProxyType(
    {
        "height_m": Definition("sole to crown", "stature", "stature"),
        "mass_kg": Definition(
            "volume times 1,090 - 141 waist / height, kg/m³", "body mass", "weightkg"
        ),
        "surface_area_m2": Definition("of the skin"),
        "volume_m3": Definition("within the skin, lungs half full"),
        "inseam_m": Definition(
            "sole to crotch", "inside leg height, crotch height", "crotchheight"
        ),
        "sitting_height_m": Definition(
            "1.0105 times height less inseam, as in people on average",
            "sitting height",
            "sittingheight",
        ),
        "cervical_height_m": Definition(
            "sole to the seventh neck vertebra", "back neck height", "cervicaleheight"
        ),
        "shoulder_height_m": Definition(
            "sole to the acromion, arms hanging", "shoulder height", "acromialheight"
        ),
        "chest_height_m": Definition("sole to the nipples", "bust height", "chestheight"),
        "waist_height_m": Definition("sole to the navel", "", "waistheightomphalion"),
        "hip_height_m": Definition("sole to the fullest buttocks", "hip height", "buttockheight"),
        "trochanter_height_m": Definition(
            "sole to the greater trochanter", "", "trochanterionheight"
        ),
        "knee_height_m": Definition(
            "sole to the middle of the kneecap", "", "kneeheightmidpatella"
        ),
        "ankle_height_m": Definition(
            "sole to the outer ankle bone", "ankle height", "lateralmalleolusheight"
        ),
        "shoulder_breadth_m": Definition(
            "across the deltoids, arms hanging", "shoulder breadth (bideltoid)", "bideltoidbreadth"
        ),
        "biacromial_breadth_m": Definition(
            "between the acromia, arms hanging",
            "shoulder breadth (biacromial)",
            "biacromialbreadth",
        ),
        "chest_breadth_m": Definition("of the chest's tape, without the arms, which hang"),
        "chest_depth_m": Definition(
            "of the chest's tape, arms hanging", "chest depth", "chestdepth"
        ),
        "waist_breadth_m": Definition("of the waist's tape", "", "waistbreadth"),
        "waist_depth_m": Definition("navel to the furrow of the back", "", "waistdepth"),
        "hip_breadth_m": Definition(
            "at the broadest, heels together", "hip breadth, standing", "hipbreadth"
        ),
        "hip_depth_m": Definition(
            "of the hip's tape, heels together", "buttock depth", "buttockdepth"
        ),
        "arm_span_m": Definition("between fingertips, arms level", "arm span", "span"),
        "upper_arm_length_m": Definition(
            "acromion to elbow: 1.22 times the way between the joints' centres",
            "upper arm length",
            "acromionradialelength",
        ),
        "forearm_length_m": Definition(
            "outer elbow to the thumb's side of the wrist",
            "lower arm length",
            "radialestylionlength",
        ),
        "hand_length_m": Definition(
            "wrist to the middle finger's tip", "hand length", "handlength"
        ),
        "hand_breadth_m": Definition(
            "across the knuckles, without the thumb", "hand breadth at metacarpals", "handbreadth"
        ),
        "foot_length_m": Definition(
            "heel to the longest toe, along the foot", "foot length", "footlength"
        ),
        "foot_breadth_m": Definition(
            "across the ball of the foot", "foot breadth", "footbreadthhorizontal"
        ),
        "head_length_m": Definition(
            "between the brows to the back of the head", "head length", "headlength"
        ),
        "head_breadth_m": Definition("above the ears", "head breadth", "headbreadth"),
        "chest_circumference_m": Definition(
            "at the nipples, arms hanging", "bust girth, chest circumference", "chestcircumference"
        ),
        "natural_waist_circumference_m": Definition(
            "level, half way from the tenth rib to the hip bone", "waist girth"
        ),
        "waist_circumference_m": Definition("level, at the navel", "", "waistcircumference"),
        "hip_circumference_m": Definition(
            "at the fullest buttocks, heels together", "hip girth", "buttockcircumference"
        ),
        "neck_circumference_m": Definition(
            "across the neck, under the larynx", "neck girth", "neckcircumference"
        ),
        "head_circumference_m": Definition(
            "over the brows and the back of the head", "head girth", "headcircumference"
        ),
        "thigh_circumference_m": Definition(
            "25 % of the way from hip to knee", "thigh girth", "thighcircumference"
        ),
        "knee_circumference_m": Definition("level, at the kneecap", "knee girth"),
        "calf_circumference_m": Definition(
            "level, 30 % of the way from knee to ankle", "calf girth", "calfcircumference"
        ),
        "ankle_circumference_m": Definition(
            "level, 78 % of the way from knee to ankle", "minimum leg girth", "anklecircumference"
        ),
        "upper_arm_circumference_m": Definition(
            "60 % of the way from shoulder to elbow, relaxed",
            "upper-arm girth",
            "bicepscircumferenceflexed",
        ),
        "forearm_circumference_m": Definition(
            "22 % of the way from elbow to wrist, relaxed",
            "forearm girth",
            "forearmcircumferenceflexed",
        ),
        "wrist_circumference_m": Definition(
            "97 % of the way from elbow to wrist", "wrist girth", "wristcircumference"
        ),
        "hand_circumference_m": Definition(
            "across the knuckles, without the thumb", "hand girth", "handcircumference"
        ),
    }
    | {name: Definition(says, iso) for name, (says, iso) in SEWING.items()}
)
ALIASES = MappingProxyType(
    {
        "stature": "height_m",
        "weight": "mass_kg",
        "crotch_height": "inseam_m",
        "inside_leg_height": "inseam_m",
        "chest": "chest_circumference_m",
        "bust": "chest_circumference_m",
        "waist": "waist_circumference_m",
        "hip": "hip_circumference_m",
        "hips": "hip_circumference_m",
        "neck": "neck_circumference_m",
        "thigh": "thigh_circumference_m",
        "calf": "calf_circumference_m",
        "wrist": "wrist_circumference_m",
        "waist_girth": "natural_waist_circumference_m",
        "underbust": "underbust_circumference_m",
        "high_bust": "upper_chest_circumference_m",
        "high_hip": "high_hip_circumference_m",
        "neck_base": "neck_base_circumference_m",
        "armscye": "armscye_circumference_m",
        "elbow": "elbow_circumference_m",
        "crotch_length": "total_crotch_length_m",
        "bust_span": "bust_point_distance_m",
        "navel_waist": "waist_circumference_m",
        "volume": "volume_m3",
        "upper_arm": "upper_arm_circumference_m",
        "forearm": "forearm_circumference_m",
        "ankle": "ankle_circumference_m",
        "knee": "knee_circumference_m",
        "bideltoid_breadth": "shoulder_breadth_m",
        "span": "arm_span_m",
        "hand": "hand_circumference_m",
        "head": "head_circumference_m",
        "buttock_depth": "hip_depth_m",
    }
)


def find_measurement(name: str, known: Iterable[str] = DEFINITIONS) -> str:
    """The full name of a measurement given with or without its unit, as a girth, or by a common
    short word.

    Raises HabitusError with what is near where there is none.
    """
    known = tuple(known)
    plain = name.strip().lower().replace("-", "_").replace(" ", "_")
    words = (plain, ALIASES.get(plain, plain), plain.replace("_girth", "_circumference"))
    for word in words:
        for full in (word, *(f"{word}{ending}" for ending in _UNITS)):
            if full in known:
                return full
    short = [plain_measurement(each) for each in known]
    near = get_close_matches(plain, short, n=3, cutoff=0.5) or short
    raise HabitusError(f"there is no measurement {name!r}; expected one such as {', '.join(near)}")


def plain_measurement(name: str) -> str:
    """A measurement's name without its unit."""
    ending = next((ending for ending in _UNITS if name.endswith(ending)), "")
    return name.removesuffix(ending)


def shown_unit(name: str) -> tuple[float, str]:
    """The factor that brings a measurement to the unit in which it is shown, and that unit."""
    unit, factor = next(
        (each for ending, each in _UNITS.items() if name.endswith(ending)), ("", 1.0)
    )
    return factor, unit


def shown_measurement(name: str, value: float) -> str:
    """A measurement with its unit: lengths in cm, volumes in litres."""
    factor, unit = shown_unit(name)
    digits = 2 if name.endswith("_m2") else 1
    return f"{factor * value:.{digits}f} {unit}".replace(" °", "°")


def si_unit(name: str) -> str:
    """The unit of a measurement's value: m, m², m³, kg or degrees."""
    ending = next(ending for ending in _UNITS if name.endswith(ending))
    return {"_m2": "m²", "_m3": "m³", "_deg": "degrees"}.get(ending, ending[1:])


def posture_of(name: str) -> str:
    """How the person stands for a measurement."""
    standing = name in _STANDING or (name in SEWING and name not in AT_REST)
    return HANGING_ARMS if standing else LEVEL_ARMS
