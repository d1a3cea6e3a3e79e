"""Texts that try to run as a script or as HTML where a page shows them, and whether one did."""

from pathlib import Path

from browser import visit

RUN = "document.documentElement.dataset.ran=1"
TEXTS = (
    f"<script>{RUN}</script>",
    f"</script><script>{RUN}</script>",
    f"</td></style></title><img src=x onerror={RUN}>",
    f"\"><svg onload='{RUN}'>",
    f"' autofocus onfocus='{RUN}' onmouseover='{RUN}",
    f"javascript:{RUN}//",
    "<b id=injected>bold</b>",
    "${" + RUN + "}{{constructor}}",
    "\u202e\x1b]0;title\x07&lt;",
)
HOSTILE = "".join(TEXTS)
FILE_NAME = f"<img src=x onerror={RUN}>\"'><b id=injected>"
"""One that file systems take."""
_PROBE = """
<script>
addEventListener('error', event => { document.documentElement.dataset.failed = event.message; });
for (const one of document.querySelectorAll('button, summary, label, select, input, td, th, canvas, [data-look]')) {
  for (const kind of ['mouseover', 'focus', 'click', 'input', 'change', 'mousemove'])
    one.dispatchEvent(new MouseEvent(kind, { bubbles: true }));
}
document.documentElement.dataset.probed = 1;
</script></body>
"""


def ran(page: Path, folder: Path, texts: tuple[str, ...] = TEXTS) -> list[str]:
    """What of the texts became more than text in Chromium, after every control was used."""
    source = page.read_text("utf-8")
    probe = page.with_name("probed.html")
    probe.write_text(source.replace("</body>", _PROBE), "utf-8")
    seen = visit(probe, folder)
    root = seen[seen.index("<html") :].partition(">")[0]
    assert "data-probed" in root, "the page's controls were not used"
    faults = [name for name in ("data-ran", "data-failed") if name in root]
    faults += [mark for mark in ('<b id="injected"', 'href="javascript:') if mark in seen]
    title = source.partition("<title>")[2].partition("</title>")[0]
    if f"<title>{title}" not in seen and "<" in title:
        faults.append("title")
    return faults
