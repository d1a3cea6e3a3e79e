# SPDX-License-Identifier: Apache-2.0
"""How bones drive a body's pose blend shapes: plain Python, for Maya, Unreal and any program that
runs Python 3.7.

`habitus export walk/body.npz --out walk.fbx --bake-correctives all` writes walk.correctives.json
beside the mesh. The weight of a channel is ``clip(row . vec(R - I) - bias, 0, 1) ** power``: R is
how its joint is turned against its parent, both counted from rest, in the body's axes (x to its
left, y up, z forward). Files of edition 1 have no bias and no power: 0 and 1.
"""

import json

FORMAT, EDITIONS = "habitus-correctives", (1, 2)
ORDERS = ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2), (2, 1, 0))


class Correctives:
    """What a .correctives.json says. Raises ValueError for text that is none.

    ``joints`` are all names, root first; ``needed`` those whose turns the weights need;
    ``channels`` the names of the blend shapes, in the order of `weights`.
    """

    def __init__(self, text):
        try:
            self._read(json.loads(text))
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(
                f"is damaged ({type(error).__name__}: {error}); export it again"
            ) from error

    def _read(self, told):
        if not isinstance(told, dict) or told.get("format") != FORMAT:
            raise ValueError("is no .correctives.json of habitus export")
        if told["version"] not in EDITIONS:
            raise ValueError(f"is of edition {told['version']}; this reads editions 1 and 2")
        self.joints = [joint["name"] for joint in told["joints"]]
        self.rests = {joint["name"]: joint["rest"] for joint in told["joints"]}
        self._parents = {joint["name"]: joint["parent"] for joint in told["joints"]}
        self.channels = [channel["name"] for channel in told["channels"]]
        self._driven = {}
        for place, channel in enumerate(told["channels"]):
            bias, power = (
                (0.0, 1.0) if told["version"] == 1 else (channel["bias"], channel["power"])
            )
            if len(channel["row"]) != 9 or not _finite(channel["row"]):
                raise ValueError("has channels without nine numbers")
            if not _finite([bias, power]) or power <= 0:
                raise ValueError("has channels without a bias and a positive power")
            driven = place, channel["row"], bias, power
            self._driven.setdefault(channel["joint"], []).append(driven)
        known = set(self.joints)
        if not all(len(rest) == 3 and _finite(rest) for rest in self.rests.values()):
            raise ValueError("has joints without three numbers")
        if not all(name in known and self._parents[name] in known for name in self._driven):
            raise ValueError("has channels of joints that it does not name")
        self.needed = [
            name
            for name in self.joints
            if name in self._driven or name in map(self._parents.get, self._driven)
        ]

    def axes(self, places):
        """Which axes of a mesh are the body's, from where joints rest in it: {name: (x, y, z)}, in
        any unit.

        Importers turn and mirror meshes, each in its own way; this tells how: for each axis of the
        body an axis of the mesh, and a sign. Raises ValueError where fewer than four joints are
        known.
        """
        known = [name for name in self.joints if name in places]
        if len(known) < 4:
            raise ValueError("names joints of another skeleton")
        here, there = [_less_mean([p[name] for name in known]) for p in (self.rests, places)]
        together = [
            [sum(t[a] * h[b] for t, h in zip(there, here)) for b in range(3)] for a in range(3)
        ]
        order = max(ORDERS, key=lambda order: sum(abs(together[order[b]][b]) for b in range(3)))
        return tuple((order[b], 1.0 if together[order[b]][b] >= 0 else -1.0) for b in range(3))

    def weights(self, turns, axes):
        """A weight for each of ``channels``. turns: of joints from rest, in the mesh's axes ({name:
        3 rows of 3}).

        Raises ValueError where a joint of ``needed`` is missing.
        """
        found = [0.0] * len(self.channels)
        for name, channels in self._driven.items():
            for missing in (name, self._parents[name]):
                if missing not in turns:
                    raise ValueError(f"needs the joint {missing}")
            local = _times_transposed(turns[self._parents[name]], turns[name])
            entries = [
                sign * other * local[row][column] - (row == column)
                for row, sign in axes
                for column, other in axes
            ]
            for place, row, bias, power in channels:
                driven = sum(r * e for r, e in zip(row, entries)) - bias
                found[place] = min(1.0, max(0.0, driven)) ** power
        return found


def from_matrices(before, now):
    """A joint's turn from rest (3 rows of 3) from matrices of 16 numbers, row after row, that
    points stand in front of.

    before: from the mesh's space to the joint's at rest (a bind-pre matrix); now: from the joint's
    to the world's.
    """
    columns = [
        [sum(before[4 * r + k] * now[4 * k + c] for k in range(3)) for c in range(3)]
        for r in range(3)
    ]
    sizes = [sum(x * x for x in column) ** 0.5 or 1.0 for column in columns]
    return [[columns[c][r] / sizes[c] for c in range(3)] for r in range(3)]


def from_quaternions(rest, now):
    """A joint's turn from rest (3 rows of 3) from how it rests and how it is now, both (x, y, z,
    w).
    """
    (a, b, c, d), (x, y, z, w) = now, (-rest[0], -rest[1], -rest[2], rest[3])
    x, y, z, w = (
        d * x + a * w + b * z - c * y,
        d * y + b * w + c * x - a * z,
        d * z + c * w + a * y - b * x,
        d * w - a * x - b * y - c * z,
    )
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _finite(numbers):
    return all(type(x) in (int, float) and abs(x) < 1e6 for x in numbers)


def _less_mean(points):
    mean = [sum(p[c] for p in points) / len(points) for c in range(3)]
    return [[p[c] - mean[c] for c in range(3)] for p in points]


def _times_transposed(first, second):
    """first^T second."""
    return [[sum(first[k][r] * second[k][c] for k in range(3)) for c in range(3)] for r in range(3)]


def plain(name):
    """A node's name without its path, its name space and what stands before a point."""
    for mark in "|:.":
        name = name.rpartition(mark)[2]
    return name
