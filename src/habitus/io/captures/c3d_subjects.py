"""What a C3D file records about the people in it: names, height, mass, marker diameter, sex."""

from habitus.io.captures.c3d_parameters import Parameters

_HEIGHT = ("HEIGHT", "BODYHEIGHT", "BODY HEIGHT")
_MASS = ("BODYMASS", "BODY MASS", "MASS", "WEIGHT", "BODYWEIGHT")
_DIAMETER = ("MARKER_DIAMETER", "MARKER DIAMETER", "MARKERDIAMETER", "MARKER_DIA")
_SEX = ("SEX", "GENDER")
_AGE = ("AGE", "AGE_YEARS")
_GROUPS = ("PROCESSING", "SUBJECT", "SUBJECTS", "SEG", "ANALYSIS")


def subject_names(parameters: Parameters) -> tuple[str, ...]:
    """The names the file gives its subjects, in its order."""
    names = parameters.texts("SUBJECTS", "NAMES") or parameters.texts("SUBJECT", "NAME")
    return tuple(name for name in names if name.isprintable() and name)


def recorded_values(parameters: Parameters) -> dict[str, float | str]:
    """height_m, mass_kg, marker_diameter_m, age_years and sex, as far as the file records them and
    they make sense of a person.
    """
    found: dict[str, float | str] = {}
    height = _first(parameters, _HEIGHT)
    mass = _first(parameters, _MASS)
    diameter = _first(parameters, _DIAMETER)
    if height is not None and (metres := _metres(height, 0.4, 2.6)) is not None:
        found["height_m"] = metres
    if mass is not None and 5.0 <= mass <= 350.0:
        found["mass_kg"] = round(mass, 3)
    if diameter is not None and (metres := _metres(diameter, 0.0015, 0.06)) is not None:
        found["marker_diameter_m"] = metres
    elif (radius := _first(parameters, ("TARGET_RADIUS",))) and 0.001 <= radius <= 0.03:
        found["marker_diameter_m"] = round(2 * radius, 6)
    age = _first(parameters, _AGE)
    if age is not None and 1.0 <= age <= 120.0:
        found["age_years"] = round(age, 3)
    sex = _sex(parameters)
    if sex:
        found["sex"] = sex
    return found


def _first(parameters: Parameters, names: tuple[str, ...]) -> float | None:
    for group in _GROUPS:
        for name in names:
            value = parameters.number(group, name)
            if value is not None and value > 0:
                return value
    return None


def _metres(value: float, least: float, most: float) -> float | None:
    """The value in metres, whichever of m, cm, mm makes it lie between ``least`` and ``most``."""
    for factor in (1.0, 0.01, 0.001):
        if least <= value * factor <= most:
            return round(value * factor, 6)
    return None


def _sex(parameters: Parameters) -> str | None:
    for group in _GROUPS:
        for name in _SEX:
            for text in parameters.texts(group, name):
                word = text.lower()
                if word in ("f", "female", "woman", "w"):
                    return "female"
                if word in ("m", "male", "man"):
                    return "male"
    return None
