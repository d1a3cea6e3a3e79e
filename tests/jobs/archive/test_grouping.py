"""Whose captures are one subject's: folders and names, and what was worn."""

from pathlib import PurePosixPath

import numpy as np

from habitus.jobs.archive.grouping import SubjectsTable, grouped_by_subject
from habitus.jobs.finding import MarkerSet

LABELS = tuple(f"M{k}" for k in range(12))


def marker_set(subject=None, larger: float = 1.0, rigid: bool = True) -> MarkerSet:
    points = np.random.default_rng(0).uniform(0, larger, (12, 3))
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    return MarkerSet(
        subject,
        LABELS,
        np.where(distances > 0.1, distances, np.nan) if rigid else np.full((12, 12), np.nan),
    )


def groups(captures, table=None):
    found = grouped_by_subject([(path, "", seen) for path, seen in captures], table, "top")
    return {path: subject for (path, _), subject in found.items()}


def test_folders_names_and_what_was_worn_part_subjects():
    captures = [
        ("a/1.c3d", marker_set()),
        ("a/2.c3d", marker_set(larger=1.1)),
        ("a/3.c3d", marker_set()),
        ("a/4.c3d", marker_set("ann")),
    ]
    captures += [
        ("b/1.c3d", marker_set()),
        ("b/2.c3d", marker_set(rigid=False)),
        ("c.c3d", marker_set()),
        ("d.c3d", marker_set("ann")),
    ]
    assert groups(captures) == {
        "a/1.c3d": "a",
        "a/2.c3d": "a (2)",
        "a/3.c3d": "a",
        "a/4.c3d": "a/ann",
        "b/1.c3d": "b",
        "b/2.c3d": "b (2)",
        "c.c3d": "top",
        "d.c3d": "ann",
    }


def test_a_table_joins_folders_and_is_believed_unless_markers_sit_elsewhere():
    table = SubjectsTable({PurePosixPath("a"): "eva", PurePosixPath("b"): "eva"})
    captures = [
        ("a/1.c3d", marker_set("x")),
        ("a/2.c3d", marker_set(rigid=False)),
        ("b/1.c3d", marker_set("y")),
    ]
    captures += [("b/2.c3d", marker_set(larger=1.1)), ("c/1.c3d", marker_set())]
    assert list(groups(captures, table).values()) == ["eva", "eva", "eva", "eva (2)", "c"]


def test_people_of_one_file_are_told_apart_by_the_file():
    table = SubjectsTable({PurePosixPath("a"): "eva"})
    found = grouped_by_subject(
        [("a/1.c3d", "x", marker_set("x")), ("a/1.c3d", "y", marker_set("y"))], table, "top"
    )
    assert set(found.values()) == {"a/x", "a/y"}
