"""The report of an evaluation: it holds what was measured, alone and whole."""

import io
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from browser import chromium, visit
from PIL import Image
from tube_people import tube_people, tube_scape, written_tubes

from habitus.export.png import png
from habitus.jobs.evaluate import evaluate
from habitus.jobs.evaluation_files import evaluation_numbers, write_evaluation
from habitus.parallel.workers import Threads
from habitus.report import drawing
from habitus.report.evaluation.figures import SERIES, figures, inline, model_looks
from habitus.report.evaluation.page import Picture, training_page

VOID = {"meta", "link", "br", "img", "input", "hr"}
NASTY = "</script><script>alert(1)</script><b>&\"'$x_1$"


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """An evaluation of two models and a twin, and the folder that it was written to."""
    folder = tmp_path_factory.mktemp("evaluation")
    paths = written_tubes(folder)
    models = [paths["tubes"], tube_scape(tube_people().body)]
    found = evaluate(
        models,
        paths["noisy"],
        folder / "out",
        clean=paths["clean"],
        plain=True,
        counts=(1, 2, 3, 4),
        repeats=2,
        workers=Threads(1),
    )
    return found, folder / "out"


@pytest.fixture(scope="module")
def numbers(done):
    return json.loads((done[1] / "evaluation.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def page(done):
    return (done[1] / "report.html").read_text("utf-8")


class Parsed(HTMLParser):
    """Tags that are opened and closed in order, their attributes, and the cells of tables."""

    def __init__(self, text):
        super().__init__()
        self.open = []
        self.tags = []
        self.rows = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th", "small"):
            self.rows[-1][-1] += data


def test_page_is_alone_and_whole(page):
    assert page.startswith("<!doctype html>") and page.rstrip().endswith("</html>")
    assert "://" not in page and "@import" not in page and "url(" not in re.sub(r"url\(#", "", page)
    parsed = Parsed(page)
    ids = [attributes["id"] for _, attributes in parsed.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    sources = [attributes["src"] for tag, attributes in parsed.tags if tag == "img"]
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    aims = {
        found
        for _, attributes in parsed.tags
        for found in re.findall(r"#([\w-]+)", attributes.get("href") or "")
    }
    assert aims and aims <= set(ids)


def test_every_figure_is_there(done, page, numbers):
    plots = {
        "model_generalisation",
        "pose_generalisation",
        "cumulative_variance",
        "run_time",
        "neck_twist",
    }
    parsed = Parsed(page)
    ids = {attributes.get("id") for _, attributes in parsed.tags}
    assert {f"figure-{name}" for name in plots} <= ids
    assert {f"figures/{name}.svg" for name in plots} <= set(numbers["figures"])
    words = [attributes["alt"] for tag, attributes in parsed.tags if tag == "img"]
    for model in numbers["models"]:
        mine = [text for text in words if f", {model['name']}: " in text]
        kinds = [text.split(",")[0] for text in mine]
        necks = ["neck"] * (model["kind"] != "BlendSCAPE")
        # two people were seen a second time: two fits of each model in pose generalisation
        assert kinds == ["model error map", "pose error map", *necks, "worst fits", "worst fits"]
    assert len(words) == sum(name.endswith(".png") for name in numbers["figures"])
    for name in numbers["figures"]:
        content = (done[1] / name).read_bytes()
        if name.endswith(".svg"):
            assert ElementTree.fromstring(content).tag.endswith("svg")
        else:
            assert np.asarray(Image.open(io.BytesIO(content)))[..., 3].mean() > 5


def test_the_table_says_what_the_json_says(page, numbers):
    rows = iter(Parsed(page).rows)
    assert next(rows) == ["Shape coefficients", "1", "2", "3", "4"]
    groups = [
        ("Model generalisation, mm", "model_generalisation", "mean_mm"),
        ("Model generalisation, mm", "model_generalisation", "clean_mean_mm"),
        ("Pose generalisation, mm", "pose_generalisation", "mean_mm"),
        ("Pose generalisation, mm", "pose_generalisation", "clean_mean_mm"),
        ("Removed by pose blend shapes, %", "removed_by_pose_shapes", "percent"),
        ("Run time, ms", "run_time", "median_ms"),
    ]
    for title, key, what in groups:
        assert next(rows)[0].startswith(title)
        digits = 0 if what == "percent" else 2
        for model in (model for model in numbers["models"] if model[key]):
            values = dict(zip(model[key]["counts"], model[key][what], strict=True))
            told = [f"{values[k]:.{digits}f}" if k in values else "–" for k in (1, 2, 3, 4)]
            assert next(rows) == [model["name"], *told]


def test_json_has_every_number_of_the_evaluation(done, numbers):
    found, folder = done
    assert [model["name"] for model in numbers["models"]] == ["tubes", "tubes, plain", "scape"]
    assert numbers["shown"] == 2 and numbers["dataset"]["subjects"] == [
        "ann",
        "bob",
        "ann",
        "bob",
        "eve",
    ]
    with np.load(folder / "per_vertex.npz") as maps:
        for entry, model in zip(found.models, numbers["models"], strict=True):
            np.testing.assert_allclose(
                model["model_generalisation"]["errors_mm"], 1e3 * entry.shape.errors
            )
            np.testing.assert_allclose(
                model["pose_generalisation"]["clean_mean_mm"], 1e3 * entry.pose.clean_means
            )
            np.testing.assert_allclose(model["run_time"]["median_ms"], 1e3 * entry.times.medians)
            assert model["run_time"]["counts"][0] == 0
            key = re.sub(r"[^A-Za-z0-9.-]+", "_", entry.name) + "/pose/clean"
            np.testing.assert_allclose(maps[key].mean(1), entry.pose.clean_means, rtol=1e-5)
    shares = {model["name"]: model["cumulative_variance"] for model in numbers["models"]}
    np.testing.assert_allclose(shares["scape"]["share"], [0.6, 0.8, 0.9, 1.0])
    assert shares["scape"]["of"] == "all shapes trained on"
    scales = (tube_people().body.shapedirs ** 2).sum((0, 1))
    np.testing.assert_allclose(shares["tubes"]["share"], np.cumsum(scales) / scales.sum())


def test_what_pose_shapes_remove_is_against_the_same_model_without(numbers):
    full, plain = numbers["models"][:2]
    errors = [np.array(model["pose_generalisation"]["clean_mean_mm"]) for model in (full, plain)]
    np.testing.assert_allclose(
        full["removed_by_pose_shapes"]["percent"], 100 * (1 - errors[0] / errors[1])
    )
    assert (
        plain["removed_by_pose_shapes"] is None
        and full["removed_by_pose_shapes"]["percent"][-1] > 50
    )


def test_words_say_who_is_best(page):
    text = re.search(r"<p class='verdict'>(.*?)</p>", page)[1]
    assert text.startswith("tubes ") and "with 2 shape coefficients" in text


def test_without_second_poses_and_clean_meshes_less_is_shown(done):
    found, _ = done
    models = tuple(replace(entry, pose=None, twist=None) for entry in found.models)
    bare = [
        replace(e, shape=replace(e.shape, clean_errors=None, clean_per_vertex=None)) for e in models
    ]
    numbers = evaluation_numbers(replace(found, clean=None, models=tuple(bare)))
    plots = figures(numbers)
    page = training_page(numbers, plots, [])
    assert set(plots) == {"model_generalisation", "cumulative_variance", "run_time"}
    assert "Pose generalisation" not in page and "noise-free" not in page and "neck" not in page
    Parsed(page)


def test_strings_cannot_break_out(done):
    found, _ = done
    first = found.models[0]
    shape = replace(first.shape, registrations=tuple(NASTY for _ in first.shape.registrations))
    label = replace(first.model, label=NASTY)
    numbers = evaluation_numbers(
        replace(found, dataset=NASTY, models=(replace(first, model=label, shape=shape),))
    )
    picture = Picture("neck", NASTY, "x.png", NASTY, b"", (0.0, 1.0))
    page = training_page(numbers, figures(numbers), [picture, replace(picture, kind="worst fits")])
    assert "<p class='facts'>1 model · " in page
    assert "<script>alert" not in page and page.count("<script") == page.count("</script>") == 1
    assert '<b>&"' not in page
    Parsed(page)


def test_written_again_old_figures_go(done, tmp_path):
    found, folder = done
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / "figures" / "mine.png").write_bytes(b"")
    before = {path.name for path in (tmp_path / "figures").iterdir()}
    write_evaluation(replace(found, models=found.models[:1]), tmp_path)
    after = {path.name for path in (tmp_path / "figures").iterdir()}
    assert after < before and "mine.png" in after and not any("scape" in name for name in after)


# -- figures ---------------------------------------------------------------------------------------


def test_figures_follow_the_page(numbers):
    plots = figures(numbers)
    assert plots == figures(numbers)
    for name, svg in plots.items():
        text = inline(svg, name)
        assert (
            not re.search("|".join(SERIES), text)
            and "var(--series-0)" in text
            and "var(--ink)" in text
        )
        assert "<style" not in text and "<metadata" not in text


def test_models_keep_their_colours_and_twins_share_them(numbers):
    looks = model_looks(numbers["models"])
    assert looks["tubes"]["color"] == looks["tubes, plain"]["color"] != looks["scape"]["color"]
    assert looks["tubes, plain"]["linestyle"] == "--" and looks["tubes"]["linestyle"] == "-"


# -- pictures --------------------------------------------------------------------------------------


def test_png_is_read_back():
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 4), dtype=np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png(image)))), image)


def test_colours_run_from_the_first_to_the_last_and_are_cut_off():
    found = drawing.ramp_colours(np.array([-1.0, 0.0, 0.5, 1.0, 9.0]), 1.0)
    ramp = [drawing.rgb(colour) for colour in drawing.ERROR_RAMP]
    np.testing.assert_allclose(found, [ramp[0], ramp[0], ramp[2], ramp[4], ramp[4]])


def test_what_is_in_front_is_seen_where_it_is():
    body = tube_people().body
    vertices = body.v_template
    faces = body.faces
    colours = np.where(
        vertices[:, :1] > 0.2, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]
    )  # the left arm is red
    front, back = (
        drawing.picture(vertices, faces, colours, axes, height=200)
        for axes in (drawing.FRONT, drawing.BACK)
    )
    for image, side in ((front, 1), (back, -1)):
        red = (image[..., 0] > 60) & (image[..., 2] < 20) & (image[..., 3] > 200)
        columns = np.flatnonzero(red.any(0)) - image.shape[1] / 2
        assert len(columns) > 20 and (side * columns > 0).all()
    rows = np.flatnonzero(front[..., 3].any(1))
    assert rows[0] < 12 and rows[-1] > 187  # it fills the height
    assert abs(front.shape[1] / 200 - np.ptp(vertices[:, 0]) / np.ptp(vertices[:, 1])) < 0.1


def test_page_opens_in_a_browser(done, tmp_path):
    chromium()
    shot = tmp_path / "dark.png"
    visit(done[1] / "report.html", tmp_path, fragment="theme=dark", size=(1200, 1400), picture=shot)
    pixels = np.asarray(Image.open(shot).convert("RGB"), dtype=int)
    assert np.median(pixels) < 60 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100
