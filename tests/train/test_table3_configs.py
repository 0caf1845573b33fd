"""Table 3's configs against the paper's table, and all configs through the command line."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from cohdc_train.presets import config_path
from cohdc_train.train.cli import fit

# Paper, Table 3 and the text of section 3.1.1: train images, validation images, epochs, (width,
# height) of the image, side of the mini-mask, smallest anchor scale of four that double, learning
# rate, pre-trained model.
TABLE = {
    1: (680, 120, 100, (1024, 800), 56, 32, 0.001, False),
    2: (680, 120, 200, (1024, 800), 56, 32, 0.001, False),
    3: (820, 140, 200, (1024, 800), 56, 32, 0.001, False),
    4: (1014, 180, 400, (1024, 800), 56, 32, 0.001, False),
    5: (1014, 180, 400, (1920, 1080), 56, 32, 0.02, False),
    6: (1014, 180, 100, (1024, 800), 28, 32, 0.001, False),
    7: (1014, 180, 100, (1920, 1080), 28, 16, 0.001, False),
    8: (1014, 180, 100, (1920, 1080), 28, 8, 0.001, False),
    9: (480, 120, 100, (1920, 1080), 28, 8, 0.001, False),
    10: (480, 120, 100, (1920, 1080), 28, 8, 0.001, True),
}


@pytest.mark.parametrize("test", TABLE)
def test_config_has_the_values_of_its_column_only(test: int) -> None:
    train, val, epochs, (width, height), mini, scale, lr, pretrained = TABLE[test]
    network: dict[str, Any] = {
        "backbone": "resnet",
        "anchor_scales": [scale, 2 * scale, 4 * scale, 8 * scale],
    }
    if pretrained:
        network["weights"] = "IMAGENET1K_V1"
    expected: dict[str, Any] = {
        "data": {
            "canvas": [height, width],
            "mini_mask": [mini, mini],
            "subset": {"train": train, "val": val},
        },
        "model": {"network": network, "optimizer": {"name": "sgd", "lr": lr}},
        "trainer": {"max_epochs": epochs},
    }
    if not pretrained:
        expected["pretrained"] = "none"
    shipped = config_path(f"configs/table3/test{test:02d}.yaml")
    assert yaml.safe_load(shipped.read_text(encoding="utf-8")) == expected


NETWORKS = [
    f"networks/{path.name}"
    for path in sorted(config_path("networks/resnet50.yaml").parent.iterdir())
]


def holds(resolved: Any, given: Any) -> bool:
    """Whether every value that a file gives stands in the resolved configuration."""
    if not isinstance(given, dict):
        return bool(resolved == given)
    return all(name in resolved and holds(resolved[name], value) for name, value in given.items())


@pytest.mark.parametrize(
    "name", ["person.yaml", "table4.yaml", *NETWORKS, *(f"table3/test{i:02d}.yaml" for i in TABLE)]
)
def test_config_parses_and_resolves(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as stop:
        fit(["--config", name, f"--data.root={tmp_path}", "--print_config"])
    assert stop.value.code == 0
    given = yaml.safe_load(config_path(name).read_text(encoding="utf-8"))
    assert holds(yaml.safe_load(capsys.readouterr().out), given)


def test_network_and_recipe_combine(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    both = ["--config=networks/hdc_net_n.yaml", "--config", "person.yaml"]
    with pytest.raises(SystemExit):
        fit([*both, f"--data.root={tmp_path}", "--print_config"])
    network = yaml.safe_load(capsys.readouterr().out)["model"]["network"]
    assert (network["backbone"], network["fpn_channels"], network["mask_cut"]) == (
        "mobilenet_v2",
        64,
        "quality",
    )
