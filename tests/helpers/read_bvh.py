"""A second, small reader of BVH files: joints in space, position channels in the place of
offsets.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


class Bvh:
    def __init__(self, path: Path):
        words = path.read_text().split()
        motion = words.index("MOTION")
        self.names = []
        self.parents = []
        self.offsets = []
        self.channels = []
        self.ends = []
        stack = []
        at = 1
        while at < motion:
            word = words[at]
            if word in ("ROOT", "JOINT"):
                self.parents.append(stack[-1] if stack else -1)
                self.names.append(words[at + 1])
                self.channels.append([])
                stack.append(len(self.names) - 1)
                at += 3
            elif word == "End":
                stack.append(-2)
                at += 3
            elif word == "OFFSET":
                offset = [float(value) for value in words[at + 1 : at + 4]]
                (self.ends if stack[-1] == -2 else self.offsets).append(offset)
                at += 4
            elif word == "CHANNELS":
                count = int(words[at + 1])
                self.channels[stack[-1]] = words[at + 2 : at + 2 + count]
                at += 2 + count
            else:
                assert word == "}"
                stack.pop()
                at += 1
        frames = int(words[motion + 2])
        self.frame_time = float(words[motion + 5])
        self.values = np.array(words[motion + 6 :], float).reshape(frames, -1)

    def joints(self, frame: int) -> dict[str, np.ndarray]:
        """Places in the file's own unit."""
        values = list(self.values[frame])
        turns = []
        places = []
        for joint, channels in enumerate(self.channels):
            given = [values.pop(0) for _ in channels]
            moved = given[:3] if channels[0] == "Xposition" else self.offsets[joint]
            order = "".join(name[0] for name in channels if name.endswith("rotation"))
            turn = Rotation.from_euler(order, given[-3:], degrees=True)
            parent = self.parents[joint]
            turns.append(turn if parent < 0 else turns[parent] * turn)
            places.append(
                np.array(moved) if parent < 0 else places[parent] + turns[parent].apply(moved)
            )
        assert not values
        return dict(zip(self.names, places, strict=True))
