"""Headless Chromium for tests: a page's DOM and its picture."""

import shutil
import subprocess
from pathlib import Path

import pytest

FLAGS = (
    "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader",
    "--disable-background-networking --no-first-run --disable-component-update --disable-sync "
    "--hide-scrollbars",
)


def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("no Chromium here: apt-get install chromium")


def visit(
    page: Path,
    folder: Path,
    *,
    fragment: str = "",
    size: tuple[int, int] = (1280, 1000),
    picture: Path | None = None,
    extra: tuple[str, ...] = (),
) -> str:
    """The DOM after the script ran, or with ``picture`` a screenshot there."""
    profile = folder / f"profile-{len(list(folder.glob('profile-*')))}"
    what = f"--screenshot={picture}" if picture else "--dump-dom"
    command = [
        chromium(),
        *" ".join(FLAGS).split(),
        *extra,
        f"--user-data-dir={profile}",
        f"--window-size={size[0]},{size[1]}",
    ]
    url = f"{page.resolve().as_uri()}#{fragment}"
    done = subprocess.run(
        [*command, "--virtual-time-budget=1500", what, url],
        capture_output=True,
        timeout=120,
        check=True,
        text=True,
    )
    return done.stdout
