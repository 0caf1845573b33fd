"""A training that starts from an exported file, where no checkpoint is left."""

import dataclasses
from pathlib import Path

import pytest
import torch
from toy_networks import MOBILENET, SMALL, with_statistics

from cohdc_train.errors import CohdcError
from cohdc_train.exporter.graph import write_graph
from cohdc_train.exporter.quantization import quantize
from cohdc_train.exporter.sample_images import draw_samples
from cohdc_train.models import MaskRCNN, NetworkConfig, detect
from cohdc_train.train.module import MaskRCNNModule

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
IMAGE = torch.from_numpy(draw_samples(1)[0]).permute(2, 0, 1)


def module_of(config: NetworkConfig, names: list[str]) -> MaskRCNNModule:
    torch.manual_seed(1)
    return MaskRCNNModule(names, config).eval()


Exported = tuple[MaskRCNN, Path]
RESNET = dataclasses.replace(SMALL, norm="frozen", score_threshold=0.05)
UNTRAINED = {"resnet": RESNET, "mobilenet_v2": MOBILENET}


@pytest.fixture(
    scope="module",
    params=[*(pytest.param(name, marks=pytest.mark.slow) for name in UNTRAINED), "fine_tuned"],
)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Return a network and the file that was exported from it."""
    if request.param == "fine_tuned":
        folder: Path = request.getfixturevalue("fine_tuned")
        module = MaskRCNNModule.load(folder / "training" / "best.ckpt")
        return module.network.eval(), folder / "model.onnx"
    network = with_statistics(UNTRAINED[request.param])
    path = tmp_path_factory.mktemp("exported") / "model.onnx"
    write_graph(network, ["person", "car"], path)
    return network, path


@pytest.fixture(scope="module")
def network(exported: Exported) -> MaskRCNN:
    return exported[0]


@pytest.fixture(scope="module")
def file(exported: Exported) -> Path:
    return exported[1]


def test_loaded_network_detects_what_the_file_detects(network: MaskRCNN, file: Path) -> None:
    module = module_of(network.config, ["person", "car"])
    assert module.load_pretrained(file) == []
    (expected,), (found,) = detect(network, [IMAGE]), detect(module.network, [IMAGE])
    assert len(expected["scores"]) >= 3
    for name, values in expected.items():
        torch.testing.assert_close(found[name], values, atol=2e-3, rtol=1e-3, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("exported", UNTRAINED, indirect=True)  # whose biases are 0
def test_quantized_weights_load_within_their_step(
    network: MaskRCNN, file: Path, tmp_path: Path
) -> None:
    small = tmp_path / "model.int8.onnx"
    quantize(file, small, draw_samples(2))
    exact, rounded = (module_of(network.config, ["person", "car"]) for _ in range(2))
    exact.load_pretrained(file)
    assert rounded.load_pretrained(small) == []
    for (name, one), other in zip(
        exact.network.named_parameters(), rounded.network.parameters(), strict=True
    ):
        step = one.abs().max() / 63  # 7 bits with a sign
        assert (one - other).abs().max() <= 0.51 * step + 1e-6, name


def test_other_classes_keep_their_class_layers(network: MaskRCNN, file: Path) -> None:
    module = module_of(network.config, ["robot"])
    left = module.load_pretrained(file)
    assert {name.rsplit(".", 2)[-2] for name in left} == {
        "cls_score",
        "bbox_pred",
        "mask_fcn_logits",
        "quality",
    }


def test_file_that_does_not_fit_is_one_line(network: MaskRCNN, file: Path, tmp_path: Path) -> None:
    config = network.config
    (garbage := tmp_path / "garbage.onnx").write_bytes(b"no graph")
    for path, changed, message in (
        (file, {"norm": "batch"}, "is trained, and the file holds none; freeze it"),
        (file, {"cqe": "off"}, r"has \d+ layers, the network \d+"),
        (
            file,
            {"fc": 16},
            r"layer roi_heads.box_head.fc6 is \[32, \d+\] in the file, \[16, \d+\] here",
        ),
        (garbage, {}, r"garbage\.onnx: not "),
        (tmp_path / "nowhere.onnx", {}, r"nowhere\.onnx: no such file"),
    ):
        with pytest.raises(CohdcError, match=message) as error:
            module_of(dataclasses.replace(config, **changed), ["person"]).load_pretrained(path)
        assert "\n" not in str(error.value)
