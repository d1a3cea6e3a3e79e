"""Just enough of what labels mean to tell up from down and left from right: a height, a side and a depth for the common ones.

Where markers sit exactly is the marker layouts' business; here a name only has to say "high on the body", "left", "in front".
"""

import re
from dataclasses import dataclass
from functools import cache

# (height from the sole 0 to the crown 6, depth +1 in front / -1 behind / 0 neither) -> names without their side
_PLACES = {
    (6.0, 1): "FHD FRONTHEAD HDF SEL SGL GLAB HEADFRONT FHEAD FHEA AH CHEECK NOSE FOREHEAD HEADF",
    (
        6.0,
        0,
    ): "ARIEL HV HEADTOP TOPHEAD THEAD THEA HEAD TEMP HEADTAMP TET HEADL HEADR HEADSIDE HEADLEFT HEADRIGHT HEADTEMP EAR",
    (6.0, -1): "BHD BACKHEAD HDB OCC HEADBACK BHEAD PH MAS REARHEAD HEADB",
    (4.7, 1): "CLAV SUP SJN SNJ IJ JUG CHEST CHESTTOP UPTHRX MAN STER CLAVICLE",
    (4.1, 1): "STRN SXS PX XYPH XPRO STR XYP CHESTLOW STERNUM LOTHRX",
    (5.0, -1): "C7 CV7 TV2 T2 TOPBACK BACKTOP SPINETOP SPINETHORACIC2 CERV7",
    (
        4.0,
        -1,
    ): "T10 T8 T12 TV10 TV7 TV8 MAI SPINETHORACIC12 LOBACK T6 MIDBACK SCAP BACKLEFT BACKRIGHT BACKL BACKR BAK BAC",
    (5.0, 0): "SHO ACR AC SAE SAJ CAJ SHOULDER SHOULDERTOP ACROMIUM ACROMION SH A",
    (3.0, 1): "ASI ASIS IAS FWT WAISTFRONT EAS",
    (3.0, -1): "PSI PSIS IPS BWT WAISTBACK BACKASIS EPS SACR VSAC SACRUM WAISTCBACK SACRAL VSACRAL",
    (2.6, 0): "GT GTRO FTC TROCHANTER TRO",
    (1.6, 0): "KNE KNEE FLE FME LFE MFE KNEEOUT KNEEIN KNI KNEELAT KNEEMED MKNEE LEK MEK LFC MFC LFEO KNEEEXT KNEEINT",
    (0.4, 0): "ANK ANKLE FAL TAM LM SPH LMAL MMAL ANKLEOUT ANKLEIN ANKLELAT ANKLEMED MANKLE MED",
    (0.2, -1): "HEE HEL HEEL FCC CAL CALC CA HEELBACK",
    (
        0.1,
        1,
    ): "TOE MT1 MT5 MT2 FM1 FM2 FM5 TOEIN TOEOUT TOETIP FOREFOOT2 FOREFOOT5 FOREFOOTOUT FOREFOOTIN 5META D1M D5M MFH1 MFH5 "
    "TT2 P1MT P5MT HLX FMH SMH VMH TOE1 TOE5",
}
_TABLE = {name: place for place, names in _PLACES.items() for name in names.split()}
_INFIX = re.compile(r"(WAIST)([LR])(FRONT|BACK)|(HEAD|BACK)(L|R|LEFT|RIGHT)")


@dataclass(frozen=True)
class Place:
    """Height on the body (0 sole to 6 crown), side (+1 left, -1 right, 0 middle or unknown), depth (+1 front, -1 back)."""

    height: float
    side: int
    depth: int


@cache
def place_of(label: str) -> Place | None:
    """Where a label is on the body, roughly; None for labels that say too little. Combined labels use their first known part."""
    for part in label.split("__"):
        found = _place(re.sub(r"[^A-Z0-9]", "", part.upper().removeprefix("CGM_").removeprefix("IOR_")))
        if found:
            return found
    return None


def _place(key: str) -> Place | None:
    infix = _INFIX.fullmatch(key)
    if infix:
        if infix[1]:
            return Place(3.0, 1 if infix[2] == "L" else -1, 1 if infix[3] == "FRONT" else -1)
        side = 1 if infix[5].startswith("L") else -1
        return Place(6.0, side, 0) if infix[4] == "HEAD" else Place(4.0, side, -1)
    if key in _TABLE:
        height, depth = _TABLE[key]
        return Place(height, 0, depth)
    for word, side in (("LEFT", 1), ("RIGHT", -1), ("L", 1), ("R", -1)):
        stem = key.removeprefix(word)
        if stem != key and stem in _TABLE:
            height, depth = _TABLE[stem]
            return Place(height, side, depth)
    return None
