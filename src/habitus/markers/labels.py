"""What labels of markers say: L_IAS, L.IAS, LIAS and LeftIAS are the same label, high up, left, in
front.

Where markers sit exactly is the marker layouts' business; here a label only has to tell up from
down and left from right.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import takewhile

_SIDE_WORD = re.compile(r"^(left|right)[ _.\-]*(?=\w)", re.IGNORECASE)
_SIDE_SUFFIX = re.compile(r"^(.+)[ _.\-](left|right|l|r)$", re.IGNORECASE)
_SEPARATORS = re.compile(r"[ _.\-]+")
_PROTOCOL = re.compile(r"^(IOR|CGM\d?|CAST|SPORTS|PIG)_", re.IGNORECASE)
_NEARLY_ALL = 0.8
_LONGEST = 64  # share of the labels; characters
_FRAGMENT = re.compile(r"^(.*\D)-\d{1,2}$")


@lru_cache(maxsize=1 << 16)
def normalised(label: str) -> str:
    """A label without case, separators and prefixes, its side as a leading L or R (``Left IAS`` ->
    ``LIAS``).
    """
    text = label.rsplit(":", 1)[-1].strip()
    text = re.sub(r"^Q_(?=\w)", "", text, flags=re.IGNORECASE)
    text = _SIDE_WORD.sub(lambda found: found[1][0], text)
    return _SEPARATORS.sub("", text).upper()


@lru_cache(maxsize=1 << 16)
def spellings(label: str) -> tuple[str, ...]:
    """The normalised forms to look a label up by, best first.

    A combined label (``A__IOR_B__CGM_C``) gives each of its parts; a trailing side (``IAS_L``) is
    also tried in front.
    """
    text = label.rsplit(":", 1)[-1].strip()
    forms: list[str] = []
    for part in [text, *text.split("__")] if "__" in text else [text]:
        bare = _PROTOCOL.sub("", part)
        forms += [normalised(part), normalised(bare)]
        suffixed = _SIDE_SUFFIX.match(bare)
        if suffixed:
            forms.append(suffixed[2][0].upper() + normalised(suffixed[1]))
    return tuple(dict.fromkeys(form for form in forms if form))


@lru_cache(maxsize=1 << 16)
def fragment_of(label: str) -> str | None:
    """The label whose second fragment this is (``RBAC-1`` -> ``RBAC``), or None."""
    fragment = _FRAGMENT.match(label.strip())
    return fragment[1] if fragment else None


def without_shared(labels: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Readings of labels that nearly all begin or end alike: what they share ("X…", "…_1") and the
    labels without it.

    The longest shared beginnings come first; a label that lacks what the others share stays as it
    is.
    """
    for end in (False, True):
        turned = [label[::-1] if end else label for label in labels]
        for part in _shared(turned):
            plain = tuple(text[len(part) :] if text.startswith(part) else text for text in turned)
            yield (
                (f"…{part[::-1]}", tuple(text[::-1] for text in plain))
                if end
                else (f"{part}…", plain)
            )


def _shared(labels: Sequence[str]) -> list[str]:
    """Beginnings that `_NEARLY_ALL` labels share, the longest first; none of them a whole label."""
    counts = [
        Counter(label[:length] for label in labels if len(label) > length)
        for length in range(1, _LONGEST)
    ]
    best = [count.most_common(1)[0] for count in counts if count]
    return [
        part for part, count in takewhile(lambda one: one[1] >= _NEARLY_ALL * len(labels), best)
    ][::-1]


# Height from the sole 0 to the crown 6; depth 1 in front, -1 behind, 0 neither; the names without
# their side.
_PLACES: tuple[tuple[float, int, str], ...] = (
    (6.0, 1, "FHD FRONTHEAD HDF SEL SGL GLAB HEADFRONT FHEAD FHEA AH CHEECK NOSE FOREHEAD HEADF"),
    (6.0, 0, "ARIEL HV HEADTOP TOPHEAD THEAD THEA HEAD TEMP HEADTAMP TET HEADSIDE HEADTEMP EAR"),
    (6.0, -1, "BHD BACKHEAD HDB OCC HEADBACK BHEAD PH MAS REARHEAD HEADB"),
    (5.0, 0, "SHO ACR AC SAE SAJ CAJ SHOULDER SHOULDERTOP ACROMIUM ACROMION SH A"),
    (5.0, -1, "C7 CV7 TV2 T2 TOPBACK BACKTOP SPINETOP SPINETHORACIC2 CERV7"),
    (4.7, 1, "CLAV SUP SJN SNJ IJ JUG CHEST CHESTTOP UPTHRX MAN STER CLAVICLE"),
    (4.1, 1, "STRN SXS PX XYPH XPRO STR XYP CHESTLOW STERNUM LOTHRX"),
    (4.0, -1, "T10 T8 T12 TV10 TV7 TV8 MAI SPINETHORACIC12 LOBACK T6 MIDBACK SCAP BAK BAC"),
    (3.0, 1, "ASI ASIS IAS FWT EAS"),
    (3.0, -1, "PSI PSIS IPS BWT WAISTBACK BACKASIS EPS SACR VSAC SACRUM WAISTCBACK SACRAL VSACRAL"),
    (2.6, 0, "GT GTRO FTC TROCHANTER TRO"),
    (
        1.6,
        0,
        "KNE KNEE FLE FME LFE MFE KNEEOUT KNEEIN KNI KNEELAT KNEEMED MKNEE LEK MEK LFC MFC "
        "KNEEEXT KNEEINT",
    ),
    (0.4, 0, "ANK ANKLE FAL TAM LM SPH LMAL MMAL ANKLEOUT ANKLEIN ANKLELAT ANKLEMED MANKLE MED"),
    (0.2, -1, "HEE HEL HEEL FCC CAL CALC CA HEELBACK"),
    (
        0.1,
        1,
        "TOE MT1 MT5 MT2 FM1 FM2 FM5 TOEIN TOEOUT TOETIP TOE1 TOE5 5META D1M D5M MFH1 MFH5 TT2 "
        "P1MT P5MT HLX",
    ),
    (0.1, 1, "FMH SMH VMH FOREFOOT2 FOREFOOT5 FOREFOOTOUT FOREFOOTIN"),
)
_TABLE = {name: (height, depth) for height, depth, names in _PLACES for name in names.split()}
_INNER_SIDE = re.compile(
    r"(?P<part>WAIST)(?P<side>[LR])(?P<end>FRONT|BACK)|(?P<part2>HEAD|BACK)(?P<side2>L|R|LEFT|RIGHT)"
)


@dataclass(frozen=True)
class Place:
    """Height (0 sole to 6 crown), side (1 left, -1 right, 0 middle or unknown), depth (1 front, -1
    back).
    """

    height: float
    side: int
    depth: int


@cache
def place_of(label: str) -> Place | None:
    """Roughly where a label is; None where it says too little. Of ``C_7__IOR_CV7`` the first known
    part counts.
    """
    for part in label.removesuffix("_study").split("__"):
        place = _place(re.sub(r"[^A-Z0-9]", "", re.sub("^(CGM|IOR|CAST)_", "", part.upper())))
        if place:
            return place
    return None


def _place(key: str) -> Place | None:
    inner = _INNER_SIDE.fullmatch(key)
    if inner and inner["part"]:
        return Place(3.0, 1 if inner["side"] == "L" else -1, 1 if inner["end"] == "FRONT" else -1)
    if inner:
        side = 1 if inner["side2"].startswith("L") else -1
        return Place(6.0, side, 0) if inner["part2"] == "HEAD" else Place(4.0, side, -1)
    for word, side in (("", 0), ("LEFT", 1), ("RIGHT", -1), ("L", 1), ("R", -1)):
        if key.startswith(word) and key[len(word) :] in _TABLE:
            height, depth = _TABLE[key[len(word) :]]
            return Place(height, side, depth)
    return None
