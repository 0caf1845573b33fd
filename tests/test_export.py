"""A checkpoint becomes an ONNX file that equals it, or no file."""

import dataclasses
import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

import cohdc_train.export as export_module
from cohdc_train import signature
from cohdc_train.cli import main
from cohdc_train.errors import CohdcError, ContractError, ExportError
from cohdc_train.export import export
from cohdc_train.models import detect
from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")


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


def test_the_file_is_reported_equal_at_two_sizes_two_batches_and_without_detections(exported):
    report = json.loads(exported.with_name("model.onnx.json").read_text())
    assert len({tuple(case["size"]) for case in report["cases"]}) >= 2
    assert {case["batch"] for case in report["cases"]} == {1, 2}
    assert report["detections_compared"] > 20
    for name, limit in {"boxes": 1e-2, "scores": 1e-4, "masks": 1e-3}.items():
        assert report["max_difference"][name] <= limit


def test_metadata_and_shapes_keep_the_contract(exported):
    import onnx

    model = onnx.load(exported)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert set(signature.METADATA_KEYS) <= set(metadata)
    assert json.loads(metadata[signature.KEY_CLASSES]) == ["person", "car"]
    shape = [d.dim_param or d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim]
    assert shape == ["batch", "height", "width", 3]
    assert [output.name for output in model.graph.output] == list(signature.OUTPUTS)


def test_the_segmenter_sees_what_the_network_sees_at_a_third_size(exported, opinionated):
    rng = np.random.default_rng(3)
    image = cv2.resize(rng.integers(0, 255, (10, 14, 3)).astype(np.uint8), (222, 111))
    found = Segmenter(exported, threads=1)(image)
    expected = detect(opinionated, [torch.from_numpy(image).permute(2, 0, 1)])[0]
    assert len(found) == len(expected["scores"]) > 0
    np.testing.assert_allclose(found.boxes, expected["boxes"], atol=1e-2)
    np.testing.assert_allclose(found.quality, expected["quality"], atol=1e-3)
    assert found.size == (111, 222)
    assert found.class_names == ("person", "car")
    assert found.masks().shape == (len(found), 111, 222)


def test_another_canvas_than_the_trainings(checkpoint, opinionated, tmp_path):
    rows, columns = opinionated.config.canvas
    larger = (rows + 64, columns + 32)
    file = export(checkpoint, tmp_path / "larger.onnx", canvas=larger)
    assert Segmenter(file).canvas == larger
    with pytest.raises(CohdcError, match="canvas 8 x 64 px"):
        export(checkpoint, tmp_path / "tiny.onnx", canvas=(8, 64))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["larger.onnx", "larger.onnx.json"]


@pytest.mark.slow
@pytest.mark.parametrize(("cqe", "side"), [("multiply", 28), ("add", 28), ("off", 28), ("concat", 56), ("add", 56)])
def test_every_form_of_mask_and_quality_head_exports(cqe, side, opinionated, tmp_path):
    torch.manual_seed(0)
    config = dataclasses.replace(opinionated.config, cqe=cqe, mask_size=side)
    module = MaskRCNNModule(["person", "car"], config)
    rest = {name: value for name, value in opinionated.state_dict().items() if not name.startswith("cqe.")}
    module.network.load_state_dict(rest, strict=False)
    torch.save({"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()}, tmp_path / f"{cqe}.ckpt")
    report = json.loads(export(tmp_path / f"{cqe}.ckpt").with_name("model.onnx.json").read_text())
    assert report["detections_compared"] > 20
    assert report["max_difference"]["quality"] <= 1e-3


def test_a_file_that_differs_is_not_left_behind(checkpoint, exported, tmp_path, monkeypatch):
    """Parity is real: with a tolerance below rounding the export fails, and nothing lies in the folder."""

    def write_the_exported_file(network, class_names, path):
        shutil.copyfile(exported, path)
        return 0

    monkeypatch.setattr(export_module, "_write_onnx", write_the_exported_file)
    monkeypatch.setattr(export_module, "TOLERANCES", {**export_module.TOLERANCES, "masks": 0.0})
    with pytest.raises(ExportError, match=r"m\.onnx: masks differ from torch by"):
        export(checkpoint, tmp_path / "m.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_output_is_seen(opinionated, exported):
    """The comparison fails when the network that is compared is not the one in the file."""
    changed = torch.nn.Module.requires_grad_(opinionated, True)
    pictures = export_module._drawn_images()
    with torch.inference_mode():
        same = export_module._compare(opinionated, exported, pictures)["max_difference"]
        weight = changed.roi_heads.mask_predictor.mask_fcn_logits.weight
        weight.data.mul_(1.1)
        other = export_module._compare(changed, exported, pictures)["max_difference"]
        weight.data.div_(1.1)
    assert same["masks"] <= 1e-3 < other["masks"]


def test_bad_checkpoints_and_folders_are_one_line(tmp_path, checkpoint, capsys):
    (tmp_path / "no.ckpt").write_bytes(b"nothing")
    assert main(["export", str(tmp_path / "no.ckpt")]) == 1
    assert "no.ckpt" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    with pytest.raises(CohdcError, match=r"empty: 0 images"):
        export(checkpoint, tmp_path / "m.onnx", tmp_path / "empty")


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
        (lambda m: setattr(m.metadata_props[0], "value", "99"), "contract 99, this version reads 1"),
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
        "import sys, numpy as np; from pathlib import Path; from cohdc_train.segmenter import Segmenter;"
        f"print(len(Segmenter(Path({str(exported)!r}))(np.zeros((60, 80, 3), np.uint8)).boxes) >= 0);"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
