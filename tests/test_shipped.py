"""Shipped networks: named, small, described by their cards, and they find people."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from cohdc_train.cli import main
from cohdc_train.presets import model_path, shipped_models
from cohdc_train.segmenter import Segmenter

ROOT = Path(__file__).resolve().parents[1]
PHOTOS = ROOT.parent / "shared" / "data" / "samples" / "walking_xyz_rgb"
CANVASES = {"person": (480, 640), "person_s": (640, 864)}


def test_a_name_means_the_shipped_file_unless_there_is_a_file_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert shipped_models() == ["person", "person_s"]
    shipped = model_path("person")
    assert shipped.name == "person.onnx"
    assert shipped.is_file()
    assert model_path("folder/person") == Path("folder/person")
    assert model_path("nobody") == Path("nobody")
    (tmp_path / "person").write_bytes(b"mine")
    assert model_path("person") == Path("person")


@pytest.mark.parametrize(("name", "canvas"), CANVASES.items())
def test_it_keeps_the_contract_and_is_small(name: str, canvas: tuple[int, int]) -> None:
    segmenter = Segmenter(Path(name), num_threads=1)
    assert segmenter.class_names == ("person",)
    assert segmenter.canvas == canvas
    assert segmenter.cut_by_quality
    assert model_path(name).stat().st_size < 10e6
    assert len(segmenter(np.zeros((480, 640, 3), np.uint8))) == 0


@pytest.mark.parametrize(("name", "size"), [("person", "n"), ("person_s", "s")])
def test_the_card_tells_the_stored_figures(name: str, size: str) -> None:
    card = model_path(name).with_suffix(".md").read_text(encoding="utf-8")
    stored = json.loads(
        (ROOT / "docs" / "results" / "person" / f"{size}.json").read_text(encoding="utf-8")
    )
    rows = dict(re.findall(r"^\| (.+?) \| ([\d.]+) \|", card, flags=re.MULTILINE))
    names = {
        "mask AP50": "segm_AP50",
        "mask AP": "segm_AP",
        "Boundary AP": "boundary_AP",
        "box AP50": "box_AP50",
    }
    told = {key: float(rows[name]) for name, key in names.items()}
    assert told == {key: pytest.approx(stored["int8"][key], abs=5e-4) for key in names.values()}
    for word in ("License", "COCO", "ImageNet", f"tools/experiments/person_model.py {size}"):
        assert word in card


@pytest.mark.parametrize("name", CANVASES)
def test_it_finds_the_people_of_walking_xyz(name: str) -> None:
    """Two people are in each photograph; the sixteenth is cut by the image's edge."""
    if not PHOTOS.is_dir():
        pytest.skip("needs TUM's photographs beside the repository")
    segmenter = Segmenter(Path(name), num_threads=1)
    counts = []
    for file in sorted(PHOTOS.iterdir()):
        if (image := cv2.imread(str(file))) is not None:
            found = segmenter(np.ascontiguousarray(image[..., ::-1]))
            counts.append(int((found.scores >= 0.5).sum()))
    assert len(counts) == 8
    assert sum(min(count, 2) for count in counts) >= 14


def test_predict_takes_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("wall.png", np.full((120, 160, 3), 90, np.uint8))
    assert main(["predict", "wall.png", "--model", "person", "--out", "found"]) == 0
    assert json.loads(Path("found/predictions.json").read_text())["categories"] == [
        {"id": 1, "name": "person"}
    ]


def test_a_name_that_is_none_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "wall.png"), np.full((120, 160, 3), 90, np.uint8))
    assert (
        main(
            [
                "predict",
                str(tmp_path / "wall.png"),
                "--model",
                "dog",
                "--out",
                str(tmp_path / "found"),
            ]
        )
        == 1
    )
    assert (
        capsys.readouterr().err
        == "cohdc predict: dog: no such file; shipped networks: person, person_s\n"
    )
