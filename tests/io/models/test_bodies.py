import contextlib
import io
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import smplx
import torch
from soft_tubes import planted_regressor
from synthetic import official_arrays, synthetic_body, with_features, write_official

from habitus.body.dynamics import Dynamics
from habitus.body.model import BodyModel
from habitus.body.pose_features import POSE_FEATURES
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body, save_body

FILES = {
    "smpl": "SMPL_NEUTRAL.pkl",
    "smplh": "SMPLH_MALE.npz",
    "smplx": "SMPLX_NEUTRAL.npz",
    "mano": "MANO_RIGHT.pkl",
}
families = pytest.mark.parametrize("family", FILES)


@pytest.fixture(scope="module", params=FILES)
def official(request, tmp_path_factory) -> tuple[str, Path]:
    family = request.param
    size = (
        None if family in ("smplx", "smplh", "smpl") else 778
    )  # smplx picks its landmarks by number
    betas = {"smplx": 20}.get(family, 10)
    path = tmp_path_factory.mktemp(family) / FILES[family]
    return family, write_official(
        path, official_arrays(family, size, num_betas=betas, influences=6, seed=3)
    )


def smplx_surface(family: str, path: Path, betas, pose, trans, expression=None):
    """What ``smplx`` itself makes of a file, hands given as joint rotations."""
    kind = {"smpl": smplx.SMPL, "smplh": smplx.SMPLH, "smplx": smplx.SMPLX, "mano": smplx.MANO}[
        family
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        model = kind(
            str(path),
            ext=path.suffix[1:],
            dtype=torch.float64,
            use_pca=False,
            flat_hand_mean=True,
            num_betas=10,
        )
    flat = pose.flatten(1)
    parts = {"global_orient": flat[:, :3]}
    if family == "mano":
        parts |= {"hand_pose": flat[:, 3:]}
    elif family == "smpl":
        parts |= {"body_pose": flat[:, 3:]}
    else:
        face = 9 if family == "smplx" else 0
        cuts = [3, 63, *([3, 3, 3] if face else []), 45, 45]
        names = [
            "body_pose",
            *(["jaw_pose", "leye_pose", "reye_pose"] if face else []),
            "left_hand_pose",
            "right_hand_pose",
        ]
        parts |= dict(zip(names, flat.split(cuts, 1)[1:], strict=True))
    if expression is not None:
        parts["expression"] = expression
    with torch.no_grad():
        return model(betas=betas, transl=trans, **parts)


def random_state(body: BodyModel, count: int = 3):
    torch.manual_seed(5)
    betas = torch.zeros(count, body.num_betas, dtype=torch.float64)
    betas[:, :10] = torch.randn(count, 10)
    pose = 0.5 * torch.randn(count, body.num_joints, 3, dtype=torch.float64)
    return betas, pose, torch.randn(count, 3, dtype=torch.float64)


def assert_like_smplx(body: BodyModel, family: str, path: Path):
    betas, pose, trans = random_state(body)
    extra = {"expression": torch.randn(3, 10, dtype=torch.float64)} if family == "smplx" else {}
    theirs = smplx_surface(family, path, betas[:, :10], pose, trans, **extra)
    ours = body(betas, pose, trans, **extra)
    assert (ours.vertices - theirs.vertices).abs().max() < 1e-6
    assert (ours.joints - theirs.joints[:, : body.num_joints]).abs().max() < 1e-6


def test_official_files_make_the_surface_that_smplx_makes(official):
    family, path = official
    assert_like_smplx(load_body(path), family, path)


def test_smplx_reads_what_we_save_and_so_do_we(official, tmp_path):
    family, path = official
    body = load_body(path)
    for ending in (".pkl",) if family == "smpl" else (".npz", ".pkl"):
        if family == "smplx" and ending == ".pkl":
            continue
        copy = tmp_path / f"{path.stem}{ending}"
        save_body(body, copy)
        assert_like_smplx(body, family, copy)
        assert_same(load_body(copy), body)


def assert_same(a: BodyModel, b: BodyModel):
    for name in (
        "v_template",
        "shapedirs",
        "posedirs",
        "expressiondirs",
        "joint_regressor",
        "skinning_weights",
        "faces",
        "part",
        "mirror",
    ):
        ours = getattr(a, name)
        theirs = getattr(b, name)
        assert (ours is None and theirs is None) or np.array_equal(ours, theirs), name
    for name in (
        "parents",
        "joint_names",
        "skinning",
        "pose_features",
        "shape_features",
        "pose_joints",
    ):
        assert getattr(a, name) == getattr(b, name), name
    assert dict(a.landmarks) == dict(b.landmarks) and set(b.extras) <= set(a.extras)
    assert all(np.array_equal(a.extras[key], b.extras[key]) for key in b.extras)
    assert (a.pose_prior is None) == (b.pose_prior is None)
    if a.pose_prior is not None:
        assert a.pose_prior.joint_names == b.pose_prior.joint_names
        assert np.array_equal(a.pose_prior.mean, b.pose_prior.mean)
        assert np.allclose(a.pose_prior.covariance, b.pose_prior.covariance, atol=1e-12)
    assert (a.dynamics is None) == (b.dynamics is None)
    if a.dynamics is not None:
        assert np.array_equal(a.dynamics.directions, b.dynamics.directions)
        for name in ("history", "drive", "limits", "reach"):
            assert np.array_equal(
                getattr(a.dynamics.regressor, name), getattr(b.dynamics.regressor, name)
            ), name
        for name in ("joints", "rate_hz", "controls"):
            assert getattr(a.dynamics.regressor, name) == getattr(b.dynamics.regressor, name), name
    assert (a.female_direction is None) == (b.female_direction is None)
    if a.female_direction is not None:
        assert np.array_equal(a.female_direction[0], b.female_direction[0])


def full_body(skinning: str = "dqbs") -> BodyModel:
    """A body with everything that only our files hold."""
    body = synthetic_body("smpl", 90)
    rng = np.random.default_rng(3)
    spread = rng.normal(size=(69, 69))
    prior = PosePrior(
        body.joint_names[1:], rng.normal(size=69), np.eye(69) + spread @ spread.T / 69
    )
    return replace(
        body,
        skinning=skinning,
        landmarks={"head_top": 4, "left_heel": 60},
        part=body.skinning_index[:, 0],
        mirror=np.arange(90)[::-1],
        pose_prior=prior,
        female_direction=(rng.normal(size=10), 0.25),
        dynamics=Dynamics(
            rng.normal(size=(90, 3, 2)), planted_regressor(controls="smpl", shapes=2)
        ),
    )


@pytest.mark.parametrize("ending", [".npz", ".pkl"])
def test_everything_we_know_of_a_body_survives_a_file(ending, tmp_path):
    twisted = with_features(full_body(), "rotations", 0, (18, 4, 20))
    unmoved = Dynamics(np.ones((90, 3, 2)), planted_regressor(shapes=0))
    stiff = replace(full_body("lbs"), posedirs=None, dynamics=unmoved)
    for body in (
        full_body(),
        full_body().with_betas(4),
        stiff,
        replace(full_body(), dynamics=None),
        twisted,
    ):
        save_body(body, tmp_path / f"body{ending}")
        back = load_body(tmp_path / f"body{ending}")
        assert_same(back, body)
        assert back.pose_prior is not None and back.female_direction[1] == 0.25
    assert [path.name for path in tmp_path.iterdir()] == [f"body{ending}"]


def test_expressions_of_smplx_are_no_shape(tmp_path):
    arrays = official_arrays("smplx", 80, num_betas=400)
    body = load_body(write_official(tmp_path / "SMPLX_NEUTRAL.npz", arrays))
    assert body.num_betas == 300 and np.array_equal(
        body.expressiondirs, arrays["shapedirs"][..., 300:]
    )
    few = load_body(tmp_path / "SMPLX_NEUTRAL.npz", num_betas=16)
    save_body(few, tmp_path / "few.npz")
    with np.load(tmp_path / "few.npz") as saved:  # smplx looks for expressions behind 300 shapes
        assert np.array_equal(saved["shapedirs"][..., 300:], arrays["shapedirs"][..., 300:])
        assert np.array_equal(saved["shapedirs"][..., :16], arrays["shapedirs"][..., :16])
        assert not saved["shapedirs"][..., 16:300].any()
    assert_same(load_body(tmp_path / "few.npz"), few)


def test_weights_are_never_cut(tmp_path):
    arrays = official_arrays("smal", 100, influences=9)
    body = load_body(write_official(tmp_path / "smal.pkl", arrays))
    assert body.skinning_index.shape[1] == int((arrays["weights"] != 0).sum(1).max()) > 4
    assert np.array_equal(body.skinning_weights, arrays["weights"])
    assert (body.skinning_value[:, 0] >= body.skinning_value[:, -1]).all()
    assert body.joint_names[-1] == "mouth"


def own_arrays() -> dict:
    """The project's own file of a small body."""
    body = full_body("lbs")
    rows, columns = np.nonzero(body.joint_regressor)
    arrays = {
        key: getattr(body, key)
        for key in (
            "v_template",
            "shapedirs",
            "skinning_index",
            "skinning_value",
            "faces",
            "mirror",
        )
    }
    return arrays | {
        "joint_regressor_rows": rows,
        "joint_regressor_cols": columns,
        "joint_regressor_values": body.joint_regressor[rows, columns],
        "parents": np.array(body.parents),
        "joint_names": np.array(body.joint_names),
        "part": np.array(body.joint_names)[body.part],
        "landmark_names": np.array(list(body.landmarks)),
        "landmark_vertices": np.array(list(body.landmarks.values())),
        "pose_mean": body.pose_prior.mean,
        "pose_precision": body.pose_prior.precision,
        "female_weights": body.female_direction[0],
        "female_bias": np.array(0.25),
        "license": np.array("CC0-1.0"),
    }


def test_our_own_files_hold_the_same_body(tmp_path):
    np.savez_compressed(tmp_path / "own.npz", **own_arrays())
    body = load_body(tmp_path / "own.npz")
    known = replace(full_body("lbs"), posedirs=None, dynamics=None)
    assert_same(body, known)
    assert body.name == "own" and str(body.extras["license"]) == "CC0-1.0"


def test_the_default_body_is_there_at_once():
    seconds = []
    for _ in range(4):
        begin = time.perf_counter()
        body = load_body("default")
        seconds.append(time.perf_counter() - begin)
    assert min(seconds) < 0.3
    assert body.name == "default" and body.num_joints == 24 and body.num_vertices != 6890
    assert body.skinning_index.shape[1] == 4 and {
        "head_top",
        "c7",
        "left_asis",
        "right_heel",
    } <= set(body.landmarks)
    assert np.allclose(body.skinning_weights.sum(1), 1)
    height = body.v_template[:, 1].max() - body.v_template[:, 1].min()
    assert 1.4 < height < 2.0


@pytest.mark.parametrize("shapes", [0, 2])
@pytest.mark.parametrize("name", POSE_FEATURES)
def test_what_drives_pose_blend_shapes_survives_our_own_files_only(name, shapes, tmp_path):
    more = {"expressiondirs": np.ones((90, 3, 5)), "extras": {"version": np.array("2")}}
    for body, joints in (
        (full_body(), None),
        (replace(full_body("lbs"), **more), None),
        (full_body(), (7, 2)),
    ):
        weights = np.random.default_rng(2).uniform(
            size=body.skinning_value.shape
        )  # sums are one but for rounding
        body = replace(body, skinning_value=weights / weights.sum(1, keepdims=True))
        body = with_features(body, name, shapes, joints)
        save_body(body, tmp_path / "body.npz")
        back = load_body(tmp_path / "body.npz")
        assert_same(back, body)
        assert_same(body, back)
        pose = torch.randn(24, 3, dtype=torch.float64)
        betas = torch.randn(10, dtype=torch.float64)
        assert (back(betas, pose).vertices - body(betas, pose).vertices).abs().max() < 1e-12
    if (name, shapes) != ("rotations", 0):
        save_body(replace(body, posedirs=None), tmp_path / "none.npz")
        assert load_body(tmp_path / "none.npz").pose_features == name
        with np.load(tmp_path / "body.npz") as file:  # nobody takes it for one of SMPL's
            assert not {"J_regressor", "weights", "kintree_table", "f"} & set(file)
        with pytest.raises(
            HabitusError, match=rf"'{name}' with {shapes} shape_features; official files .* \.npz"
        ):
            save_body(body, tmp_path / "body.pkl")
        assert not (tmp_path / "body.pkl").exists()


@pytest.mark.parametrize(
    ("change", "say"),
    [
        (
            {"dynamicsdirs": np.zeros((89, 3, 2))},
            r"'dynamicsdirs' is float64 of shape \(89, 3, 2\)",
        ),
        (
            {"dynamics_drive": np.zeros((3, 2, 23))},
            r"'dynamics_limits' is float64 of shape \(24,\); expected .*\(23\)",
        ),
        (
            {"dynamics_joints": np.array(["joint_0"])},
            r"dynamics' drive has shape \(3, 2, 24\); expected \(3, 2, 12\)",
        ),
        (
            {"dynamics_controls": np.array("feelings")},
            "controls are 'feelings'; expected one of joints, smpl",
        ),
        ({"dynamics_rate": np.array(0.0)}, "learned at 0 Hz"),
    ],
)
def test_dynamics_that_do_not_fit_together_are_refused(change, say, tmp_path):
    save_body(full_body(), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        np.savez(tmp_path / "bad.npz", allow_pickle=False, **{**file, **change})
    with pytest.raises(HabitusError, match=say):
        load_body(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("change", "say"),
    [
        (
            {"pose_features": np.array("magic")},
            "pose features are 'magic'; expected one of rotations, angles",
        ),
        ({"pose_features": np.array("quaternions")}, r"expected numbers of shape \(90, 3, 184\)"),
        ({"shape_features": np.array(2)}, r"expected numbers of shape \(90, 3, 207\)"),
        ({"shape_features": np.array(-1)}, "'shape_features' runs from -1 to -1; expected 0 to 10"),
        ({"shape_features": np.array("two")}, "'shape_features' is"),
    ],
)
def test_our_own_files_that_contradict_themselves_are_refused(change, say, tmp_path):
    body = with_features(full_body(), "angles", 1)
    save_body(body, tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        np.savez(tmp_path / "bad.npz", allow_pickle=False, **{**file, **change})
    with pytest.raises(HabitusError, match=say) as caught:
        load_body(tmp_path / "bad.npz")
    assert "bad.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_official_files_keep_smpls_features(tmp_path):
    arrays = official_arrays("smpl", 60) | {
        "pose_features": np.array("angles")
    }  # no word of theirs
    assert load_body(write_official(tmp_path / "smpl.npz", arrays)).pose_features == "rotations"


def broken(change) -> dict:
    arrays = official_arrays("smpl", 60)
    change(arrays)
    return arrays


@pytest.mark.parametrize(
    ("change", "say"),
    [
        (lambda a: a.pop("posedirs") is None or a.pop("weights"), "no array 'weights'"),
        (
            lambda a: a.update(weights=a["weights"][:, :23]),
            r"'weights' is float64 of shape \(60, 23\); expected .*\(60, 24\)",
        ),
        (lambda a: a.update(shapedirs=a["shapedirs"][..., 0]), "'shapedirs'"),
        (lambda a: a.update(shapedirs=a["shapedirs"][..., :0]), "'shapedirs'"),
        (lambda a: a.update(posedirs=a["posedirs"][..., :200]), r"\(60, 3, 207\)"),
        (lambda a: a.update(J_regressor=a["J_regressor"].T), "'J_regressor'"),
        (
            lambda a: a["v_template"].__setitem__((3, 1), np.nan),
            "'v_template' holds numbers that are not finite",
        ),
        (lambda a: a.update(f=a["f"] + 60), "'f' runs from 60"),
        (lambda a: a.update(weights=2 * a["weights"]), "vertex 0 sum to 2"),
        (lambda a: a["kintree_table"].__setitem__((0, 4), 9), "parent of joint 4 is 9"),
        (lambda a: a.update(v_template=np.array(["a", "b"])), "'v_template' is"),
        (lambda a: a.update(bs_type=np.array("quaternion")), "lrotmin"),
    ],
)
@pytest.mark.parametrize("ending", [".npz", ".pkl"])
def test_wrong_arrays_are_named(change, say, ending, tmp_path):
    arrays = {
        key: value.tolist() if value.dtype.kind == "U" else value
        for key, value in broken(change).items()
    }
    path = write_official(tmp_path / f"wrong{ending}", arrays)
    with pytest.raises(HabitusError, match=say) as caught:
        load_body(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("ending", [".npz", ".pkl"])
@pytest.mark.parametrize("keep", [0, 1, 2, 10, 1000, 0.5, 0.999])
def test_cut_files_give_one_clear_error(keep, ending, tmp_path):
    path = write_official(tmp_path / f"cut{ending}", official_arrays("smpl", 60))
    whole = path.read_bytes()
    path.write_bytes(whole[: keep if isinstance(keep, int) else int(keep * len(whole))])
    with pytest.raises(HabitusError, match=path.name):
        load_body(path)


def test_flipped_bytes_never_do_worse_than_an_error(tmp_path):
    path = write_official(tmp_path / "flip.pkl", official_arrays("mano", 40))
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    for _ in range(150):
        damaged = bytearray(whole)
        for place in (
            generator.integers(0, len(whole), 1)
            if generator.random() < 0.3
            else generator.integers(0, 400, 2)
        ):
            damaged[place] = generator.integers(0, 256)
        path.write_bytes(bytes(damaged))
        with contextlib.suppress(HabitusError):
            load_body(path)


def test_other_places_and_endings_are_refused(tmp_path):
    with pytest.raises(HabitusError, match=r"no_such\.npz: No such file"):
        load_body(tmp_path / "no_such.npz")
    with pytest.raises(HabitusError, match="directory"):
        load_body(tmp_path)
    with pytest.raises(HabitusError, match=r"expected \.npz or \.pkl"):
        save_body(full_body(), tmp_path / "body.obj")
    (tmp_path / "text.npz").write_text("not a model")
    with pytest.raises(HabitusError, match=r"text\.npz"):
        load_body(tmp_path / "text.npz")
    with pytest.raises(HabitusError, match="expected 1 to 10"):
        save_body(full_body(), tmp_path / "body.npz")
        load_body(tmp_path / "body.npz", num_betas=11)


def test_the_example_in_the_docs_makes_a_body(tmp_path, monkeypatch):
    page = (Path(__file__).resolve().parents[3] / "docs" / "adding-a-body-model.md").read_text()
    blocks = [block.split("```")[0] for block in page.split("```python\n")[1:]]
    monkeypatch.chdir(tmp_path)
    exec(next(block for block in blocks if "save_body" in block), {})
    assert load_body("mine.npz").landmarks == {"head_top": 3, "left_heel": 7}
