"""`cohdc predict` with a fake segmenter: files, filters, drawing, readers."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cohdc_train.contour import Polygon, rasterize
from cohdc_train.errors import ContractError, DataError
from cohdc_train.files import MANIFEST
from cohdc_train.prediction.drawing import draw_detections
from cohdc_train.prediction.image_sources import SourceImage, read_images
from cohdc_train.prediction.options import PredictOptions
from cohdc_train.prediction.predict import predict, predict_images
from cohdc_train.segmenter import Detections

BOXES = np.array(
    [[20.0, 10.0, 60.0, 90.0], [70.5, 40.0, 110.5, 60.0], [5.0, 95.0, 9.0, 99.0]], np.float32
)


class Fake:
    """Segmenter that finds an oval with a hole, an oval, and an object with an empty mask."""

    class_names = ("person", "car")

    def __call__(self, rgb: NDArray[np.uint8], /) -> Detections:
        y, x = np.mgrid[:28, :28] - 13.5
        oval = np.clip(1 - np.hypot(x, y) / 27, 0, 1).astype(np.float32)
        ring = np.where(np.hypot(x, y) < 5, 0, oval).astype(np.float32)
        masks = np.stack([ring, oval, np.zeros_like(oval)])
        height, width = rgb.shape[:2]
        labels, scores = np.array([0, 1, 0]), np.array([0.9, 0.6, 0.55], np.float32)
        quality = np.array([0.8, 0.3, 0.9], np.float32)
        return Detections(BOXES, labels, scores, quality, masks, (height, width), self.class_names)


def make_image(name: str = "room") -> SourceImage:
    rgb = np.random.default_rng(1).integers(0, 80, (100, 120, 3), np.uint8)
    return SourceImage(f"{name}.png", name, rgb)


def test_coco_file_holds_what_was_found(tmp_path: Path) -> None:
    images = [make_image("a"), make_image("b")]
    result = predict_images(images, Fake(), tmp_path / "new" / "out")
    assert json.loads((tmp_path / "new" / "out" / "predictions.json").read_text()) == result
    assert [image["file_name"] for image in result["images"]] == ["a.png", "b.png"]
    assert result["categories"] == [{"id": 1, "name": "person"}, {"id": 2, "name": "car"}]
    first, second, *_ = result["annotations"]
    assert len(result["annotations"]) == 4, "the object without pixels is skipped"
    assert (first["category_id"], first["category"], second["category_id"]) == (1, "person", 2)
    assert first["bbox"] == [20, 10, 40, 80]
    assert second["score"] == pytest.approx(0.6)
    assert second["quality"] == pytest.approx(0.3)
    assert sorted(file.name for file in (tmp_path / "new" / "out").iterdir()) == [
        MANIFEST,
        "a_overlay.jpg",
        "b_overlay.jpg",
        "predictions.json",
    ]


def test_polygons_keep_the_floor(tmp_path: Path) -> None:
    one = make_image()
    result = predict_images([one], Fake(), tmp_path, PredictOptions(iou_floor=0.9))
    for annotation, mask in zip(result["annotations"], Fake()(one.rgb).masks()[:2], strict=True):
        rings = [Polygon(np.reshape(ring, (-1, 2))) for ring in annotation["segmentation"]]
        filled = rasterize(rings, (100, 120))
        assert (filled & mask).sum() / (filled | mask).sum() >= 0.9
        assert annotation["area"] == pytest.approx(mask.sum(), rel=0.1)


@pytest.mark.filterwarnings(
    "ignore:__array__ implementation:DeprecationWarning"
)  # pycocotools under numpy 2
def test_pycocotools_loads_the_file(tmp_path: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco", reason="pycocotools comes with the train extra")
    one = make_image()
    predict_images([one], Fake(), tmp_path, PredictOptions(iou_floor=1.0, contour="bisection"))
    loaded = coco.COCO(str(tmp_path / "predictions.json"))
    masks = [
        loaded.annToMask(annotation).astype(bool)
        for annotation in loaded.loadAnns(loaded.getAnnIds())
    ]
    assert np.array_equal(masks, Fake()(one.rgb).masks()[:2])


@pytest.mark.parametrize(
    ("least", "left"),
    [((0.5, None), [0.9, 0.6]), ((0.7, None), [0.9]), ((0.5, 0.5), [0.9]), ((0.95, None), [])],
)
def test_score_and_quality_filter(
    tmp_path: Path, least: tuple[float, float | None], left: list[float]
) -> None:
    result = predict_images([make_image()], Fake(), tmp_path, PredictOptions(*least))
    assert [annotation["score"] for annotation in result["annotations"]] == pytest.approx(left)
    assert (tmp_path / "room_overlay.jpg").is_file()


def test_drawing_colors_the_masks_only(tmp_path: Path) -> None:
    one = make_image()
    found = Fake()(one.rgb).select(np.array([False, True, False]))
    drawn = draw_detections(one.rgb, found, [[]])
    mask = found.masks()[0]
    untouched = ~mask
    untouched[: int(BOXES[1, 1]) + 2, 60:] = False  # the text
    assert np.array_equal(drawn[untouched], one.rgb[untouched])
    assert (drawn[mask][:, 0] > one.rgb[mask][:, 0] + 30).mean() > 0.9, "the first color is red"


def test_folder_is_read_in_order_and_overlays_do_not_collide(tmp_path: Path) -> None:
    for name, gray in [("b.png", 1), ("a.jpg", 2), ("a.png", 3)]:
        cv2.imwrite(str(tmp_path / name), np.full((8, 8, 3), gray, np.uint8))
    (tmp_path / "notes.txt").write_text("no image")
    images = list(read_images(tmp_path))
    assert [one.name for one in images] == ["a.jpg", "a.png", "b.png"]
    assert [one.stem for one in images] == ["a.jpg", "a.png", "b"]
    cv2.imwrite(str(tmp_path / "a.jpg.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "folder.jpg").mkdir()
    assert len({one.stem for one in read_images(tmp_path)}) == 4


def test_images_come_as_rgb(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "red.png"), np.full((4, 4, 3), (0, 0, 255), np.uint8))
    (red,) = read_images(tmp_path / "red.png")
    assert red.rgb[0, 0].tolist() == [255, 0, 0]


def test_video_frames_are_read(tmp_path: Path) -> None:
    file = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV cannot write videos")
    for gray in (10, 120, 230):
        writer.write(np.full((48, 64, 3), gray, np.uint8))
    writer.release()
    frames = list(read_images(file))
    assert [frame.name for frame in frames] == [
        "walk_000000.jpg",
        "walk_000001.jpg",
        "walk_000002.jpg",
    ]
    assert [round(float(frame.rgb.mean()), -1) for frame in frames] == [10, 120, 230]


class _Webcam:
    """Fake of OpenCV's: number 0 gives gray images without end, others none."""

    released = 0

    def __init__(self, origin: object) -> None:
        self.works = origin == 0

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, np.full((48, 64, 3), 90, np.uint8)) if self.works else (False, None)

    def release(self) -> None:
        _Webcam.released += 1


def test_a_webcam_is_a_number_and_has_an_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", _Webcam)
    monkeypatch.chdir(tmp_path)
    assert [image.name for image in read_images(Path("0"), 2)] == [
        "webcam0_000000.jpg",
        "webcam0_000001.jpg",
    ]
    assert len(list(read_images(Path("0")))) == 100
    with pytest.raises(DataError, match=r"webcam7: no image can be read from it"):
        list(read_images(Path("7")))
    with pytest.raises(DataError, match="no such file"):
        read_images(tmp_path / "12")
    with pytest.raises(DataError, match="frames is 0"):
        read_images(Path("0"), 0)
    assert _Webcam.released == 3
    Path("0").mkdir()
    with pytest.raises(DataError, match="holds no image"):  # a folder of that name is that folder
        read_images(Path("0"))


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"absent: no such file"):
        read_images(tmp_path / "absent")
    with pytest.raises(DataError, match=r"holds no image"):
        read_images(tmp_path)
    for name, content in [("broken.jpg", b"not a jpeg"), ("empty.png", b"")]:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: cannot be decoded"):
            list(read_images(tmp_path / name))


def test_verb_names_a_missing_model(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(ContractError, match=r"absent\.onnx"):
        predict(tmp_path / "a.png", model=tmp_path / "absent.onnx", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
