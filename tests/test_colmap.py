"""COLMAP models that COLMAP itself has written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dagmap.io.sources import Options, describe_source, open_source
from dagmap.model import RecordingError
from test_replay import dagmap

DATA = Path(__file__).parent / "data" / "colmap"
TRUTH = json.loads((DATA / "truth.json").read_text())
PLACES = {int(id_): place for id_, place in TRUTH["points"].items()}


@pytest.fixture(params=["bin", "txt"])
def model(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    return Path(shutil.copytree(DATA / request.param, tmp_path / request.param))


def test_pictures_show_their_points(model: Path) -> None:
    source = open_source(model)
    found = list(source)
    assert len(source) == len(found) == len(TRUTH["pictures"]) == 3
    for i, (name, truth) in enumerate(sorted(TRUTH["pictures"].items())):
        cycle = found[i]
        assert cycle.stamp == i, name
        assert np.allclose(cycle.pose[:3, 3], truth["centre"], atol=1e-6)
        assert np.asarray(cycle.ids).tolist() == truth["seen"]
        world = np.asarray(cycle.points) @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        assert np.allclose(world, [PLACES[id_] for id_ in truth["seen"]], atol=1e-6)
        assert (np.asarray(cycle.points)[:, 2] > 0).all()  # before the camera
        assert np.asarray(cycle.colors).shape == (len(truth["seen"]), 3)
    few = list(open_source(model, Options(max_features=5)))
    assert all(len(cycle.points) == 5 for cycle in few)


def test_a_project_has_its_model_in_sparse(tmp_path: Path) -> None:
    shutil.copytree(DATA / "bin", tmp_path / "office" / "sparse" / "0")
    assert open_source(tmp_path / "office").name == "office"


def test_a_model_becomes_a_map(model: Path, tmp_path: Path) -> None:
    found = describe_source(model)
    assert (found.kind, found.cycles) == ("COLMAP model", 3)
    run = dagmap("replay", model, "--out", tmp_path / "out", "--json")
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["map"]["nodes"] > 10


def test_half_of_a_model_is_named(model: Path) -> None:
    """And is not taken for the clouds of a LiDAR."""
    suffix = "." + model.name
    for lacking, there in (("images", "points3D"), ("points3D", "images")):
        (model / f"{lacking}{suffix}").rename(model / "other")
        with pytest.raises(RecordingError, match=f"no {lacking}{suffix} beside {there}{suffix}"):
            open_source(model)
        (model / "other").rename(model / f"{lacking}{suffix}")


def test_a_text_that_ends_early_is_noticed(tmp_path: Path) -> None:
    """At the end of a line too: COLMAP says how many there are."""
    model = Path(shutil.copytree(DATA / "txt", tmp_path / "txt"))
    for name, count in (("images", 2), ("points3D", 3)):
        file = model / f"{name}.txt"
        whole = file.read_text()
        file.write_text("".join(whole.splitlines(keepends=True)[:-count]))
        with pytest.raises(RecordingError, match=rf"{name}.txt: .* are promised, .* are there"):
            open_source(model)
        assert len(list(open_source(model, Options(keep_going=True)))) >= 2
        file.write_text(whole)


def test_models_that_were_cut_short(tmp_path: Path) -> None:
    for part in ("images.bin", "points3D.bin"):
        path = tmp_path / part / "bin"
        shutil.copytree(DATA / "bin", path)
        whole = (path / part).read_bytes()
        for share in (0.0, 0.3, 0.9):
            (path / part).write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(RecordingError, match=f"{part}: cut short: .*--keep-going"):
                open_source(path)
        assert len(list(open_source(path, Options(keep_going=True)))) >= 2  # at nine tenths
        (path / part).write_bytes(b"\xff" * 7 + b"\0" + whole[8:])  # a huge count
        with pytest.raises(RecordingError, match=f"{part}: (cut short|a name without an end)"):
            open_source(path)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("images.txt", "1 2 3\n\n", "images.txt, line 1: `id qw qx"),
        ("images.txt", "1 1 0 0 x 0 0 0 1 a.png\n\n", "images.txt, line 1: could not convert"),
        ("images.txt", "1 9 0 0 0 0 0 0 1 a.png\n\n", "line 1: the rotation is no unit quat"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n1 2 x\n", "images.txt, line 1: invalid literal"),
        ("images.txt", "", "0 pictures, 20 points; no map"),
        ("points3D.txt", "", "3 pictures, 0 points; no map"),
        ("points3D.txt", "1 2 3\n", "points3D.txt, line 1: `id x y z r g b error track`"),
    ],
)
def test_bad_texts_are_named(tmp_path: Path, file: str, text: str, said: str) -> None:
    path = Path(shutil.copytree(DATA / "txt", tmp_path / "txt"))
    (path / file).write_text(text)
    with pytest.raises(RecordingError, match=said):
        open_source(path)


def test_damaged_models_never_crash(model: Path) -> None:
    rng = np.random.default_rng(1)
    for file in sorted(model.glob("[ip]*")):
        whole = np.frombuffer(file.read_bytes(), np.uint8)
        for _ in range(100):
            damaged = whole.copy()
            damaged[rng.integers(0, len(whole), 5)] = rng.integers(0, 256, 5)
            file.write_bytes(damaged.tobytes())
            for keep_going in (False, True):
                try:
                    list(open_source(model, Options(keep_going=keep_going)))
                except RecordingError as error:
                    assert str(model) in str(error)
        file.write_bytes(whole.tobytes())
