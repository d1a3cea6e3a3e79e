"""Sphinx reads this when `tools/build_site.py` builds the documentation as a site."""

import re

project = "habitus"
author = "the authors of habitus"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
html_theme = "furo"
html_title = "habitus"
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types in signatures link to nothing
suppress_warnings = ["ref.python"]


def setup(app):
    """Docstrings are Markdown; autodoc reads reStructuredText."""
    app.connect("autodoc-process-docstring", lambda *event: _to_rest(event[-1]))


def _to_rest(lines):
    """Code becomes literal blocks, single backticks double ones, the rest plain text; in place."""
    text = re.sub(r"```(?:\w+)?\n(.*?)\n```", _literal_block, "\n".join(lines), flags=re.DOTALL)
    parts = text.split("\n\n")
    lines[:] = "\n\n".join(_paragraph(part) for part in parts).split("\n")


def _literal_block(match):
    code = "\n".join("    " + line for line in match[1].split("\n"))
    return f"\n\n{code}\n\n"


def _paragraph(text):
    """Indented paragraphs are code or equations; elsewhere all markup but backticks is escaped."""
    rows = text.strip("\n").split("\n")
    if text.strip() and all(row.startswith("    ") for row in rows):
        return "::\n\n" + "\n".join(rows)
    pieces = re.split(r"(`+[^`]+`+)", text)
    for k, piece in enumerate(pieces):
        if k % 2:
            pieces[k] = "``" + " ".join(piece.strip("`").split()) + "``"
        else:
            pieces[k] = re.sub(r"([*|_\\])", r"\\\1", piece)
    return "".join(pieces)
