"""Segmenter: ONNX files of other exporters, built here, are read like our own."""

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torchvision.models.detection import MaskRCNN as TorchvisionMaskRCNN

from cohdc_train.cli import main
from cohdc_train.errors import ContractError
from cohdc_train.segmenter import Segmenter
from cohdc_train.segmenter.adapters import MAX_DETECTIONS

CANVAS = (64, 96)
CLASSES = ("person", "dog", "car")
PROTOTYPES = 4


def prototypes():
    """Make [P, 16, 24] logits of +-8: everywhere, the left half, the upper half, nowhere."""
    maps = np.full((PROTOTYPES, CANVAS[0] // 4, CANVAS[1] // 4), -8.0, np.float32)
    maps[0], maps[1, :, :12], maps[2, :8] = 8, 8, 8
    return maps


def candidate(box, label, score, prototype):
    """Make a column [4 + C + P]; box: cx, cy, w, h in canvas px."""
    scores, coefficients = np.zeros(len(CLASSES)), np.zeros(PROTOTYPES)
    scores[label], coefficients[prototype] = score, 1
    return np.concatenate([box, scores, coefficients])


def yolo(path, table, names=CLASSES, free=False):
    """Write a file whose candidates are `table` times the mean of the image's red channel."""
    table = np.asarray(table, np.float32)
    factor = np.ones_like(table)  # 1 where the table stands as it is
    if table.shape[0] == 4 + len(CLASSES) + PROTOTYPES:
        factor[4] = 0  # scores of the first class follow the red channel
    constants = {"fixed": table * factor, "red_part": table * (1 - factor), "protos": prototypes()}
    tensors = [numpy_helper.from_array(value[None], name) for name, value in constants.items()]
    tensors += [
        numpy_helper.from_array(np.array(v, np.int64), n)
        for n, v in {"red": 0, "axes": [1, 2]}.items()
    ]
    nodes = [
        helper.make_node("Gather", ["images", "red"], ["plane"], axis=1),
        helper.make_node("ReduceMean", ["plane", "axes"], ["mean"], keepdims=1),
        helper.make_node("Mul", ["red_part", "mean"], ["moved"]),
        helper.make_node("Add", ["fixed", "moved"], ["output0"]),
        helper.make_node("Identity", ["protos"], ["output1"]),
    ]
    sides = ["height", "width"] if free else CANVAS
    graph = helper.make_graph(
        nodes,
        "yolo",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, *sides])],
        [
            helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, *table.shape]),
            helper.make_tensor_value_info("output1", TensorProto.FLOAT, [1, *prototypes().shape]),
        ],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    if names is not None:
        helper.set_model_props(model, {"names": repr(dict(enumerate(names))), "task": "segment"})
    onnx.save(model, path)
    return path


def columns(*candidates, count=8400):
    table = np.zeros((4 + len(CLASSES) + PROTOTYPES, count))
    for i, one in enumerate(candidates):
        table[:, 7 * i] = one
    return table


def red(height, width):
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = 255
    return image


def test_yolo_boxes_masks_labels_and_suppression(tmp_path):
    table = columns(
        candidate([30, 20, 40, 24], 2, 0.6, 0),
        candidate([31, 20, 40, 24], 2, 0.5, 0),  # the same car once more
        candidate([48, 32, 40, 40], 0, 0.9, 1),  # the left half of a box in the middle
        candidate([30, 20, 40, 24], 1, 0.4, 2),  # a dog where the car is
        candidate([60, 40, 10, 10], 1, 0.04, 0),  # below the threshold
    )
    file = Segmenter(yolo(tmp_path / "y.onnx", table), num_threads=1)
    assert file.class_names == CLASSES
    assert file.canvas == CANVAS
    found = file(red(128, 192))  # twice the canvas: no border
    assert [found.class_names[label] for label in found.labels] == ["person", "car", "dog"]
    np.testing.assert_allclose(found.scores, [0.9, 0.6, 0.4], atol=1e-6)
    np.testing.assert_allclose(
        found.boxes, [[56, 24, 136, 104], [20, 16, 100, 64], [20, 16, 100, 64]], atol=1e-4
    )
    person, car, dog = found.masks()
    expected = np.zeros((128, 192), bool)
    expected[24:104, 56:96] = True  # the prototype ends at column 12 of 24, the middle of the image
    assert (person & expected).sum() / (person | expected).sum() > 0.95
    assert car[17:63, 21:99].all()
    assert dog[:64].any()
    assert not dog[66:].any()
    assert (found.quality == 1).all()


def test_yolo_takes_red_first_and_halves_of_255(tmp_path):
    file = Segmenter(yolo(tmp_path / "y.onnx", columns(candidate([48, 32, 20, 20], 0, 0.8, 0))))
    half = red(64, 96) // 2
    assert file(half).scores[0] == pytest.approx(0.8 * 127 / 255, abs=1e-4)
    assert len(file(np.ascontiguousarray(half[..., ::-1]))) == 0  # blue


@pytest.mark.parametrize("size", [(200, 200), (50, 300), (64, 64)])
def test_yolo_letterbox_is_undone(tmp_path, size):
    """A candidate that covers the content is the whole image, clipped to it."""
    height, width = size
    scale = min(CANVAS[0] / height, CANVAS[1] / width)
    table = columns(
        candidate([48, 32, width * scale, height * scale], 1, 0.8, 0),
        candidate([48, 32, 96, 64], 2, 0.7, 0),
    )
    found = Segmenter(yolo(tmp_path / "y.onnx", table))(red(*size))
    np.testing.assert_allclose(found.boxes, [[0, 0, width, height]] * 2, atol=0.6 / scale)
    assert found.masks().mean() > 0.97


def test_yolo_that_suppresses_by_itself(tmp_path):
    rows = np.zeros((300, 6 + PROTOTYPES))
    rows[5] = [10, 8, 50, 32, 0.6, 2, 1, 0, 0, 0]
    rows[9] = [28, 12, 68, 52, 0.9, 0, 0, 1, 0, 0]
    found = Segmenter(yolo(tmp_path / "y.onnx", rows))(red(128, 192))
    assert found.labels.tolist() == [0, 2]
    np.testing.assert_allclose(found.boxes, [[56, 24, 136, 104], [20, 16, 100, 64]], atol=1e-4)


def test_yolo_finds_at_most_as_many_as_a_contract_file_and_may_find_none(tmp_path):
    many = columns(
        *(
            candidate([8 + 2 * (i % 40), 8 + 6 * (i // 40), 1.5, 5], 1, 0.3 + i / 1000, 0)
            for i in range(300)
        )
    )
    found = Segmenter(yolo(tmp_path / "y.onnx", many))(red(64, 96))
    assert len(found) == MAX_DETECTIONS
    assert np.all(np.diff(found.scores) <= 0)
    nothing = Segmenter(yolo(tmp_path / "n.onnx", columns()))(red(64, 96))
    assert len(nothing) == 0
    assert nothing.masks().shape == (0, 64, 96)


def test_yolo_of_a_free_size_runs_at_640(tmp_path):
    assert Segmenter(yolo(tmp_path / "y.onnx", columns(), free=True)).canvas == (640, 640)


def test_class_names_from_a_text_beside_the_file_or_numbers(tmp_path):
    file = yolo(tmp_path / "y.onnx", columns(), names=None)
    assert Segmenter(file).class_names == ("1", "2", "3")
    (tmp_path / "y.onnx.txt").write_text("a\nb\nc\n")
    assert Segmenter(file).class_names == ("a", "b", "c")
    (tmp_path / "y.onnx.txt").write_text("a\nb\n")
    with pytest.raises(ContractError, match=r"y\.onnx: 2 class names for 3 classes"):
        Segmenter(file)
    with pytest.raises(ContractError, match=r"n\.onnx: its class names cannot be read: \{0: oops"):
        Segmenter(_named(yolo(tmp_path / "n.onnx", columns()), "{0: oops("))


def _named(path, text):
    model = onnx.load(path)
    helper.set_model_props(model, {"names": text})
    onnx.save(model, path)
    return path


def test_predict_runs_a_foreign_file(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), red(128, 192)[..., ::-1])
    file = yolo(tmp_path / "y.onnx", columns(candidate([48, 32, 40, 40], 0, 0.9, 0)))
    assert (
        main(
            [
                "predict",
                str(tmp_path / "a.png"),
                "--model",
                str(file),
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
    assert (tmp_path / "out" / "a_overlay.jpg").is_file()


@pytest.mark.parametrize("shape", [[1, 3, 64, 96], [1, 4, 64, 96]])
def test_an_image_to_image_graph_is_no_segmenter(tmp_path, shape):
    graph = helper.make_graph(
        [helper.make_node("Identity", ["x"], ["y"])],
        "same",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, shape)],
    )
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9),
        tmp_path / "i.onnx",
    )
    with pytest.raises(
        ContractError, match="neither cohdc export nor another known exporter wrote it"
    ):
        Segmenter(tmp_path / "i.onnx")


@pytest.fixture(scope="module")
def torchvisions(opinionated):
    """Make torchvision's own detector from the small network's parts."""
    backbone, heads = opinionated.backbone, opinionated.roi_heads
    backbone.out_channels = opinionated.config.fpn_channels
    return TorchvisionMaskRCNN(
        backbone,
        min_size=96,
        max_size=128,
        rpn_anchor_generator=opinionated.rpn.anchor_generator,
        rpn_head=opinionated.rpn.head,
        rpn_pre_nms_top_n_test=100,
        rpn_post_nms_top_n_test=50,
        box_head=heads.box_head,
        box_predictor=heads.box_predictor,
        box_score_thresh=0.45,
        box_detections_per_img=10,
        mask_head=heads.mask_head,
        mask_predictor=heads.mask_predictor,
    ).eval()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("size", [(96, 128), (192, 256)])
def test_torchvisions_own_export_gives_what_torchvision_finds(torchvisions, tmp_path, size):
    rng = np.random.default_rng(3)
    image = cv2.resize(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8), size[::-1])
    small = cv2.resize(image, (128, 96))
    x = torch.from_numpy(small).permute(2, 0, 1) / 255
    path = tmp_path / "torchvision.onnx"
    torch.onnx.export(torchvisions, ([x],), str(path), dynamo=False, opset_version=18)
    (tmp_path / "torchvision.onnx.txt").write_text("person\ncar\n")
    with torch.inference_mode():
        expected = torchvisions([x])[0]
    file = Segmenter(path, num_threads=1)
    assert file.canvas == (96, 128)
    found = file(image)
    scale = size[0] / 96
    assert len(found) == len(expected["scores"]) > 2
    assert found.class_names == ("person", "car")
    assert found.labels.tolist() == (expected["labels"] - 1).tolist()
    np.testing.assert_allclose(found.boxes, expected["boxes"].numpy() * scale, atol=1e-2 * scale)
    for mask, truth in zip(found.masks(), expected["masks"][:, 0].numpy(), strict=True):
        whole = cv2.resize(truth, size[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
        if whole.sum() > 200 * scale**2:
            assert (mask & whole).sum() / (mask | whole).sum() > 0.9
