"""Sphinx reads this when `tools/build_site.py` builds the documentation as a site."""

project, author = "habitus", "the authors of habitus"
extensions = ["myst_parser"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "habitus"
html_show_sphinx = html_show_copyright = False
html_copy_source = False
html_static_path, html_css_files = ["site.css"], ["site.css"]
nitpicky = True
