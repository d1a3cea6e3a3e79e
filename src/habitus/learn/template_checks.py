"""Checks of a template before training: joints without vertices, scattered parts, left taken for
right.
"""

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from habitus.learn.finding import Finding, named
from habitus.learn.posing.rig import kinship
from habitus.mesh.template import Template

# pieces beyond one a part, as a share of the vertices: no segmentation of a body has as many
_SCATTERED = 0.1
_STRAY = 3  # vertices of a part among parts far from it that are worth a note
_KIN = 2  # bones between joints whose parts may touch


def check_template(template: Template) -> list[Finding]:
    """What is odd about a template. Errors: parts that are scattered over the mesh. Warnings:
    joints without vertices; pieces of parts that lie among parts far from theirs; joints called
    left on the right side.
    """
    findings = []
    if template.empty_joints:
        message = (
            "no vertex belongs to this joint; expected a part of the mesh, or a tree without it"
        )
        findings.append(Finding("warning", named(template.empty_joints, 5), message))
    return [*findings, *_scattered(template), *_sides(template)]


def _scattered(template: Template) -> list[Finding]:
    pieces, stray = scattered(template)
    if pieces - len(np.unique(template.part)) > _SCATTERED * template.num_vertices:
        message = (
            f"its {template.num_joints} parts lie in {pieces} pieces; expected parts of connected "
            "vertices, one around "
            "each bone: check the order of the array 'part'"
        )
        return [Finding("error", "the template", message)]
    lost = [k for k in range(template.num_joints) if stray[k] >= _STRAY]
    if not lost:
        return []
    message = (
        f"{stray[lost].sum()} vertices lie among parts of joints that are far from theirs in the "
        "tree; expected "
        "parts of connected vertices, one around each bone"
    )
    return [
        Finding("warning", f"parts of {named([template.joint_names[k] for k in lost])}", message)
    ]


def scattered(template: Template) -> tuple[int, Int[np.ndarray, " J"]]:
    """How many connected pieces all parts are of, and how many vertices of each part lie in pieces
    that touch only parts more than two bones away.

    Pieces that touch nothing do not count: eyes and teeth are pieces of the mesh of their own.
    """
    pairs = template.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    parts = template.part[pairs]
    within = parts[:, 0] == parts[:, 1]
    ends = pairs[within]
    joined = coo_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=2 * (template.num_vertices,)
    )
    count, piece = connected_components(joined, directed=False)
    across = np.concatenate([pairs[~within], pairs[~within][:, ::-1]])
    near = (
        kinship(template.parents)[template.part[across[:, 0]], template.part[across[:, 1]]] <= _KIN
    )
    touches = np.zeros(count, bool)
    related = np.zeros(count, bool)
    touches[piece[across[:, 0]]] = True
    related[piece[across[near, 0]]] = True
    lost = (touches & ~related)[piece]
    return int(touches.sum()), np.bincount(template.part[lost], minlength=template.num_joints)


def _sides(template: Template) -> list[Finding]:
    words = [name.lower() for name in template.joint_names]
    across = {"left": [], "right": []}
    for joint, word in enumerate(words):
        for side, places in across.items():
            if side in word and len(rows := template.part_vertices(joint)):
                places.append(template.vertices[rows, 0].mean())
    if not (across["left"] and across["right"]) or np.mean(across["left"]) >= np.mean(
        across["right"]
    ):
        return []
    message = (
        "parts of joints called left have smaller x than those called right; expected x to the "
        "body's left: turn the "
        "template so that it faces +z, or exchange the names"
    )
    return [Finding("warning", "the template", message)]
