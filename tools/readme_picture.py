"""Draws the README's picture: moments of a fitted capture, out of its report, by headless Chromium.

habitus mosh 85_12.c3d --out results
python tools/readme_picture.py results/85_12/report.html 14 18 20 23 --out docs/images/85_12.jpg
"""

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

FLAGS = (
    "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader"
)
LAYERS = "body,observed,predicted"
WINDOW = (1280, 1160)
BOX = (400, 500, 900, 1080)  # of a moment, within the player, in pixels of the page


def moment(report: Path, seconds: float, folder: Path) -> Image.Image:
    """The player at a time."""
    picture = folder / f"{seconds:g}.png"
    url = f"{report.resolve().as_uri()}#t={seconds:g}&theme=light&layers={LAYERS}"
    size = f"--window-size={WINDOW[0]},{WINDOW[1]}"
    command = [
        shutil.which("chromium") or "google-chrome",
        *FLAGS.split(),
        "--hide-scrollbars",
        size,
    ]
    command += [
        f"--user-data-dir={folder / 'profile'}",
        "--virtual-time-budget=1500",
        f"--screenshot={picture}",
        url,
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return Image.open(picture).convert("RGB").crop(BOX)


def main() -> None:
    """Draw each moment, put them side by side, write a small file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("report", type=Path)
    parser.add_argument("seconds", type=float, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        moments = [np.asarray(moment(options.report, t, Path(folder))) for t in options.seconds]
    Image.fromarray(np.concatenate(moments, axis=1)).save(options.out, quality=88, optimize=True)
    print(f"wrote {options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
