"""What MediaPipe's pose detector (BlazePose, 33 keypoints) finds in pictures.

    pip install mediapipe==0.10.14
    python tools/keypoints/detect.py FOLDER

Writes FOLDER/detections.npz: keypoints (N, 33, 3), pixels (their centres at halves) and visibility,
NaN where nobody was found. It runs in an environment of its own; its weights come with it.
"""

import sys
from pathlib import Path

import mediapipe
import numpy as np
from PIL import Image


def main(folder: Path) -> None:
    """Detect in all pictures of a folder."""
    rows = []
    with mediapipe.solutions.pose.Pose(static_image_mode=True, model_complexity=1) as pose:
        for path in sorted(folder.glob("*.png")):
            image = np.asarray(Image.open(path).convert("RGB"))
            seen = pose.process(image).pose_landmarks
            row = np.full((33, 3), np.nan)
            if seen is not None:
                height, width = image.shape[:2]
                row = np.array([[p.x * width, p.y * height, p.visibility] for p in seen.landmark])
            rows.append(row)
    np.savez_compressed(folder / "detections.npz", keypoints=np.array(rows))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
