"""`cohdc export`: a checkpoint becomes an ONNX file that equals it, or no file."""

import copy
import dataclasses
import json
import shutil
import subprocess
import sys

import coco_toys as toys
import cv2
import numpy as np
import pytest
import torch

from cohdc_train import signature
from cohdc_train.cli import main
from cohdc_train.errors import CohdcError, ContractError, ExportError
from cohdc_train.exporter import parity, steps
from cohdc_train.exporter.export import export
from cohdc_train.exporter.graph import count_flops
from cohdc_train.exporter.sample_images import draw_samples
from cohdc_train.models import Detector, MaskRCNN, detect
from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)


@pytest.fixture(scope="module")
def checkpoint(opinionated, tmp_path_factory):
    module = MaskRCNNModule(["person", "car"], opinionated.config)
    module.network.load_state_dict(opinionated.state_dict())
    path = tmp_path_factory.mktemp("run") / "best.ckpt"
    torch.save({"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()}, path)
    return path


@pytest.fixture(scope="module")
def exported(checkpoint):
    return export(checkpoint)


@pytest.fixture
def written(exported, monkeypatch):
    """Copy the file that was exported once where torch's exporter would write it again."""

    def write(network, class_names, path):
        shutil.copyfile(exported, path)
        return 0

    monkeypatch.setattr(steps, "write_graph", write)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make a COCO-format folder with the classes of the checkpoint."""
    root = tmp_path_factory.mktemp("data")
    toys.folder(root)
    return root


def _report(file):
    return json.loads(file.with_name(file.name + ".json").read_text())


def test_the_file_is_reported_equal_at_three_sizes_three_batches_without_detections_and_full(
    exported, opinionated
):
    report = _report(exported)
    assert len({tuple(case["size"]) for case in report["cases"]}) >= 3
    assert {case["batch"] for case in report["cases"]} == {1, 2, 4}
    assert report["most_detections"] == opinionated.config.detections
    assert report["detections_compared"] > 20
    for name, limit in {"boxes": 1e-2, "scores": 1e-4, "masks": 1e-3}.items():
        assert report["max_difference"][name] <= limit
    assert report["mask_iou_min"] >= 0.99
    assert report["bytes"] == exported.stat().st_size


def test_gflops_of_a_detection_by_hand(exported, opinionated, small_config):
    """Count four 3x3 convolutions, a deconvolution, and a 1x1 for background and two classes."""
    without_cqe = count_flops(MaskRCNN(2, dataclasses.replace(small_config, cqe="off")).eval())
    c, cells = small_config.fpn_channels, 14 * 14
    flops = 2 * (4 * 9 * c * c * cells + 4 * c * c * cells + c * 3 * 4 * cells)
    assert without_cqe.detection == pytest.approx(flops / 1e9)
    whole, report = count_flops(opinionated), _report(exported)
    assert whole.detection > without_cqe.detection
    assert whole.image == pytest.approx(without_cqe.image)
    assert report["gflops_image"] == pytest.approx(whole.image, abs=1e-3)


def test_metadata_and_shapes_keep_the_contract(exported):
    import onnx

    model = onnx.load(exported)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert set(signature.METADATA_KEYS) <= set(metadata)
    assert json.loads(metadata[signature.KEY_CLASSES]) == ["person", "car"]
    assert json.loads(metadata[signature.KEY_THRESHOLDS])["mask_cut"] == "half"
    assert not Segmenter(exported).cut_by_quality
    shape = [d.dim_param or d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim]
    assert shape == ["batch", "height", "width", 3]
    assert [output.name for output in model.graph.output] == list(signature.OUTPUTS)


def test_the_segmenter_sees_what_the_network_sees_at_a_third_size(exported, opinionated):
    rng = np.random.default_rng(3)
    image = cv2.resize(rng.integers(0, 255, (10, 14, 3)).astype(np.uint8), (222, 111))
    found = Segmenter(exported, num_threads=1)(image)
    expected = detect(opinionated, [torch.from_numpy(image).permute(2, 0, 1)])[0]
    assert len(found) == len(expected["scores"]) > 0
    np.testing.assert_allclose(found.boxes, expected["boxes"], atol=1e-2)
    np.testing.assert_allclose(found.quality, expected["quality"], atol=1e-3)
    assert found.size == (111, 222)
    assert found.class_names == ("person", "car")
    assert found.masks().shape == (len(found), 111, 222)


@pytest.mark.slow
def test_another_canvas_than_the_trainings(checkpoint, opinionated, tmp_path):
    rows, columns = opinionated.config.canvas
    larger = (rows + 64, columns + 32)
    file = export(checkpoint, tmp_path / "larger.onnx", canvas=larger)
    assert Segmenter(file).canvas == larger
    with pytest.raises(CohdcError, match="canvas 8 x 64 px"):
        export(checkpoint, tmp_path / "tiny.onnx", canvas=(8, 64))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["larger.onnx", "larger.onnx.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cqe", "side", "cut"),
    [
        *[
            ("multiply", 28, "half"),
            ("add", 28, "half"),
            ("off", 28, "half"),
            ("concat", 56, "half"),
        ],
        *[("add", 56, "half"), ("concat", 28, "quality")],
    ],
)
def test_every_form_of_mask_and_quality_head_exports(cqe, side, cut, opinionated, tmp_path):
    torch.manual_seed(0)
    config = dataclasses.replace(opinionated.config, cqe=cqe, mask_size=side, mask_cut=cut)
    module = MaskRCNNModule(["person", "car"], config)
    rest = {
        name: value
        for name, value in opinionated.state_dict().items()
        if not name.startswith("cqe.")
    }
    module.network.load_state_dict(rest, strict=False)
    torch.save(
        {"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()},
        tmp_path / f"{cqe}.ckpt",
    )
    report = json.loads(export(tmp_path / f"{cqe}.ckpt").with_name("model.onnx.json").read_text())
    assert report["detections_compared"] > 20
    assert report["max_difference"]["quality"] <= 1e-3
    assert report["max_difference"]["masks"] <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["mobilenet_v1", "mobilenet_v2"])
def test_a_pyramid_from_stride_8_on_a_light_backbone_exports(backbone, small_config, tmp_path):
    torch.manual_seed(0)
    changed = {
        "backbone": backbone,
        "finest_stride": 8,
        "anchor_scales": (32, 64, 128),
        "score_threshold": 0.1,
    }
    config = dataclasses.replace(small_config, rates=((1,),) * 4, **changed)
    module = MaskRCNNModule(["person", "car"], config)
    with torch.no_grad():
        images = [
            torch.from_numpy(cv2.resize(p, (128, 96))).permute(2, 0, 1) / 255
            for p in draw_samples(4)
        ]
        for _ in range(
            30
        ):  # without statistics of images, a deep random network is nearly constant
            module.network.train().features(torch.stack(images))
        module.network.eval().rpn.head.bbox_pred.weight.mul_(10)
        module.network.rpn.head.cls_logits.weight.mul_(3)
    torch.save(
        {"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()},
        tmp_path / "light.ckpt",
    )
    assert _report(export(tmp_path / "light.ckpt"))["detections_compared"] > 20


@pytest.mark.slow
def test_a_hundred_detections_in_one_image(opinionated, tmp_path):
    config = dataclasses.replace(
        opinionated.config, detections=100, proposals=(400, 300), nms_iou=0.8, score_threshold=0.3
    )
    module = MaskRCNNModule(["person", "car"], config)
    module.network.load_state_dict(opinionated.state_dict())
    torch.save(
        {"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()},
        tmp_path / "many.ckpt",
    )
    assert _report(export(tmp_path / "many.ckpt"))["most_detections"] == 100


@pytest.mark.parametrize("name", ["m.onnx", "m.onnx.json", "m.int8.onnx"])
def test_export_keeps_files_it_did_not_write(checkpoint, tmp_path, name):
    content = '{"file": "another.onnx"}'
    (tmp_path / name).write_text(content)
    with pytest.raises(CohdcError, match=r"is not of a former cohdc export; give another --out"):
        export(checkpoint, tmp_path / "m.onnx", int8=tmp_path, allow_drop=True)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: content}


def test_export_replaces_its_own_file(checkpoint, written, tmp_path):
    file = export(checkpoint, tmp_path / "m.onnx")
    first = _report(file)
    assert _report(export(checkpoint, file))["checkpoint_sha256"] == first["checkpoint_sha256"]


def test_a_file_that_differs_is_not_left_behind(checkpoint, written, tmp_path, monkeypatch):
    """The export fails with a tolerance below rounding, and leaves no file."""
    monkeypatch.setitem(parity.TOLERANCES, "masks", 0.0)
    with pytest.raises(ExportError, match=r"m\.onnx: masks differ from torch by"):
        export(checkpoint, tmp_path / "m.onnx")
    monkeypatch.setitem(parity.TOLERANCES, "masks", 1e-3)
    monkeypatch.setattr(parity, "MIN_MASK_IOU", 1.01)
    with pytest.raises(
        ExportError, match=r"m\.onnx: a mask's IoU with torch's is .* at least 1.01 wanted"
    ):
        export(checkpoint, tmp_path / "m.onnx")
    assert list(tmp_path.iterdir()) == []


def test_wrong_masks_and_other_detections_are_seen(opinionated, exported):
    """The comparison fails for another network than the one in the file."""
    images = draw_samples(2)
    parity.compare(opinionated, exported, images).require(exported)
    other = copy.deepcopy(opinionated)
    other.roi_heads.mask_predictor.mask_fcn_logits.weight.data.mul_(1.1)
    assert parity.compare(other, exported, images).max_difference["masks"] > 1e-3
    other.roi_heads.box_predictor.cls_score.weight.data.mul_(3)
    with pytest.raises(ExportError, match="finds other objects than torch"):
        parity.compare(other, exported, images).require(exported)


def test_ambiguous_images_are_skipped_and_few(opinionated):
    """A network whose threshold equals a detection's score is ambiguous; another is not."""
    (image,) = draw_samples(1)

    def found_by(detector):
        with torch.inference_mode():
            return [tensor.numpy()[0] for tensor in detector(torch.from_numpy(image)[None])]

    sure, edge = Detector(opinionated), Detector(copy.deepcopy(opinionated))
    found = found_by(sure)
    assert not parity._is_ambiguous(sure, image, found)
    at = float(found[2][int(found[-1]) - 1])
    edge.network.config = dataclasses.replace(opinionated.config, score_threshold=at)
    assert parity._is_ambiguous(edge, image, found_by(edge))
    few = parity.Parity(images=7) | parity.Parity(images=1, ambiguous=1)
    few.require("m.onnx")
    with pytest.raises(
        ExportError, match=r"m\.onnx: torch's detections depend on rounding in 3 of 10 images"
    ):
        (few | parity.Parity(images=2, ambiguous=2)).require("m.onnx")


def test_verify_only_finds_the_checkpoint_and_sees_that_it_changed(
    checkpoint, exported, tmp_path, capsys
):
    kept = tmp_path / "best.ckpt"
    shutil.copyfile(checkpoint, kept)
    file, report = tmp_path / "model.onnx", _report(exported)
    shutil.copyfile(exported, file)
    file.with_name("model.onnx.json").write_text(json.dumps(report | {"checkpoint": "best.ckpt"}))
    before = sorted(p.name for p in tmp_path.iterdir())
    assert main(["export", "--verify-only", str(file)]) == 0
    assert "equals torch on" in capsys.readouterr().out
    assert main(["export", str(kept), "--out", str(file), "--verify-only"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    content = torch.load(kept)
    content["state_dict"]["network.roi_heads.mask_predictor.mask_fcn_logits.weight"] *= 1.1
    torch.save(content, kept)
    assert main(["export", "--verify-only", str(file)]) == 1
    assert "has changed since the export" in capsys.readouterr().err
    assert main(["export", str(kept), "--out", str(file), "--verify-only"]) == 1
    assert "masks differ from torch by" in capsys.readouterr().err
    kept.unlink()
    assert main(["export", "--verify-only", str(file)]) == 1
    assert "is gone" in capsys.readouterr().err
    file.with_name("model.onnx.json").unlink()
    assert main(["export", "--verify-only", str(file)]) == 1
    assert "names no checkpoint" in capsys.readouterr().err


def test_int8_keeps_the_contract_and_says_what_it_scores(checkpoint, written, folder, tmp_path):
    import onnx

    out = tmp_path / "model.onnx"
    export(checkpoint, out, data=folder, int8=folder / "images")
    whole, small = _report(out), _report(tmp_path / "model.int8.onnx")
    assert whole["scores"]["torch"] == pytest.approx(whole["scores"]["onnx"], abs=1e-3, nan_ok=True)
    assert whole["scores"]["onnx"] == small["scores"]["float32"]
    assert small["bytes"] < 0.6 * whole["bytes"]
    graph = onnx.load(tmp_path / "model.int8.onnx").graph
    made = {output: node for node in graph.node for output in node.output}
    fed = {
        node.name: made[node.input[0]].op_type
        for node in graph.node
        if node.op_type in ("Conv", "ConvTranspose")
    }
    weights = {
        node.name: node.input[1] for node in graph.node if node.op_type in ("Conv", "ConvTranspose")
    }
    floats = [name for name, origin in fed.items() if origin != "DequantizeLinear"]
    assert floats
    assert all("mask_predictor" in weights[name] or "cqe" in weights[name] for name in floats)
    assert len(fed) > 5 * len(floats)
    numbers = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    heavy = [node.input[1] for node in graph.node if node.op_type in ("Conv", "Gemm")]
    dense = [numbers[made[name].input[0]] for name in heavy if name in made]
    assert len(dense) > 20
    assert {array.dtype for array in dense} == {np.dtype(np.int8)}
    assert {int(np.abs(array.astype(int)).max()) for array in dense} == {
        64
    }  # 255 * 64 * 2 fits into 16 bits
    assert Segmenter(tmp_path / "model.int8.onnx")(draw_samples(1)[0]).class_names == (
        "person",
        "car",
    )
    assert main(["export", "--verify-only", str(tmp_path / "model.int8.onnx")]) == 1


def test_int8_that_loses_too_much_is_refused(checkpoint, written, folder, tmp_path, monkeypatch):
    scores = {"model.onnx": 0.5, "model.int8.onnx": 0.48}

    class FakeScorer:
        def __init__(self, *_):
            pass

        def score_network(self):
            return dict.fromkeys(steps.SCORES, scores["model.onnx"])

        def score_file(self, path):
            name = path.name.lstrip(".").rsplit(".", 2)[0].removesuffix(".tmp")
            return dict.fromkeys(steps.SCORES, scores[name])

    monkeypatch.setattr(steps, "ValidationScorer", FakeScorer)
    calibration = folder / "images"
    with pytest.raises(CohdcError, match=r"int8 needs --data"):
        export(checkpoint, tmp_path / "model.onnx", int8=calibration)
    with pytest.raises(
        ExportError, match=r"model\.int8\.onnx: mask AP falls by 0\.020 in int8, allowed 0\.01"
    ):
        export(checkpoint, tmp_path / "model.onnx", data=folder, int8=calibration)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.onnx", "model.onnx.json"]
    export(checkpoint, tmp_path / "model.onnx", data=folder, int8=calibration, allow_drop=True)
    assert (tmp_path / "model.int8.onnx").is_file()


def test_a_file_that_scores_otherwise_is_refused(
    checkpoint, written, folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        steps.ValidationScorer, "score_file", lambda self, path: dict.fromkeys(steps.SCORES, 0.5)
    )
    with pytest.raises(ExportError, match=r"m\.onnx: mask AP differs from torch's by"):
        export(checkpoint, tmp_path / "m.onnx", data=folder)
    assert list(tmp_path.iterdir()) == []


def test_validate_takes_the_file(exported, folder, tmp_path, capsys):
    assert (
        main(["validate", str(exported), str(folder), "--out", str(tmp_path / "scores.json")]) == 0
    )
    assert "boundary_AP" in capsys.readouterr().out
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert 0 <= scores["segm_AP50"] <= 1
    assert main(["validate", str(exported), str(folder), "--canvas", "[64,64]"]) == 1
    assert "its canvas was fixed by cohdc export" in capsys.readouterr().err


def test_bad_checkpoints_and_folders_are_one_line(tmp_path, checkpoint, capsys):
    (tmp_path / "no.ckpt").write_bytes(b"nothing")
    assert main(["export", str(tmp_path / "no.ckpt")]) == 1
    assert "no.ckpt" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    with pytest.raises(CohdcError, match=r"empty: 0 images"):
        export(checkpoint, tmp_path / "m.onnx", images=tmp_path / "empty")


def test_a_foreign_file_is_no_segmenter(tmp_path):
    (tmp_path / "x.onnx").write_bytes(b"nothing")
    with pytest.raises(ContractError, match=r"x\.onnx: onnxruntime cannot load it"):
        Segmenter(tmp_path / "x.onnx")
    with pytest.raises(ContractError, match="no such file"):
        Segmenter(tmp_path / "y.onnx")


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda m: m.metadata_props.pop(0), "metadata cohdc"),
        (
            lambda m: setattr(m.metadata_props[0], "value", "99"),
            "contract 99, this version reads 1",
        ),
        (lambda m: setattr(m.graph.output[0], "name", "boxez"), "output boxes is missing"),
    ],
)
def test_a_broken_contract_is_named(exported, tmp_path, break_it, message):
    import onnx

    model = onnx.load(exported)
    if "output" in message:
        for node in model.graph.node:
            node.output[:] = ["boxez" if name == "boxes" else name for name in node.output]
    break_it(model)
    onnx.save(model, tmp_path / "broken.onnx")
    with pytest.raises(ContractError, match=message):
        Segmenter(tmp_path / "broken.onnx")


def test_the_segmenter_never_imports_torch(exported):
    code = (
        "import sys, numpy as np; from cohdc_train.segmenter import Segmenter;"
        f"found = Segmenter({str(exported)!r})(np.zeros((60, 80, 3), np.uint8));"
        "print(len(found) >= 0);"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
