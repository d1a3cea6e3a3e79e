"""A layout that was found by fitting, as a file for a person to read and correct."""

from habitus.errors import shown
from habitus.fit.discover.result import Discovery
from habitus.io.layouts.toml import key_text, marker_line, quoted
from habitus.io.names import plain_name

_HEADER = """\
# A marker layout that was found by fitting a body to {capture}. Places are usually right to 5 cm, and to 10 cm on
# hands and along limbs; a confidence is the chance that the marker sits within 5 cm of its place. Look at report.html,
# correct what is wrong (`habitus layout show --landmarks` lists the landmarks), and fit again with --layout FILE.
"""  # noqa: E501


def found_layout_text(found: Discovery, capture_name: str) -> str:
    """The text of a layout file: the least sure markers first, each with the labels that keep their
    distance to it.
    """
    name = plain_name(capture_name)
    layout = found.layout
    lines = [
        _HEADER.format(capture=name),
        *(f"# NOT SURE: {shown(doubt, 300)}" for doubt in found.doubts),
        f"name = {quoted(f'discovered in {name}')}",
        f"title = {quoted(f'Found by fitting a body to {name}')}",
        *([] if layout.num_vertices is None else [f"num_vertices = {layout.num_vertices}"]),
        "",
        "[markers]",
    ]
    for marker in sorted(
        layout.markers, key=lambda one: 1.0 if one.confidence is None else one.confidence
    ):
        mates = found.companions.get(marker.label, ())
        note = (
            f"  # keeps its distance to {', '.join(plain_name(mate) for mate in mates)}"
            if mates
            else ""
        )
        lines.append(marker_line(marker) + note)
    if found.left_out:
        lines += [
            "",
            "[left_out]",
            *(f"{key_text(label)} = {quoted(why)}" for label, why in found.left_out.items()),
        ]
    return "\n".join(lines) + "\n"
