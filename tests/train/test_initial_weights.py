"""`--pretrained`: where the first weights come from, and what follows from it."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from cohdc_train.errors import CohdcError
from cohdc_train.models import NetworkConfig
from cohdc_train.presets import config_path
from cohdc_train.train.initial_weights import (
    InitialWeights,
    choose_initial_weights,
    resolve_backbone_lr,
    resolve_network,
)


def fields(config: str | None = None, **changes: Any) -> dict[str, Any]:
    """Return the fields of a shipped network's config, or of the default one, with changes."""
    given: dict[str, Any] = {}
    if config is not None:
        shipped = config_path(f"networks/{config}.yaml").read_text(encoding="utf-8")
        given = yaml.safe_load(shipped)["model"]["network"]
    return dataclasses.asdict(NetworkConfig(**{**given, **changes}))


@pytest.mark.parametrize("name", ["hdc_net_n", "hdc_net_s"])
def test_nano_and_small_start_from_the_shipped_network(name: str) -> None:
    network = fields(name)
    initial = choose_initial_weights("auto", network)
    assert (initial.kind, initial.source) == ("network", "person")
    assert resolve_network(initial, network) == {
        "weights": None,
        "norm": "frozen",
        "frozen_stages": 2,
    }


@pytest.mark.parametrize(
    "name", ["hdc_net_m", "resnet18_hdc", "resnet50", "resnet50_hdc", "resnet101"]
)
def test_resnets_start_from_published_weights(name: str) -> None:
    network = fields(name)
    initial = choose_initial_weights("auto", network)
    assert (initial.kind, initial.source) == ("backbone", "IMAGENET1K_V1")
    assert resolve_network(initial, network) == {
        "weights": "IMAGENET1K_V1",
        "norm": "frozen",
        "frozen_stages": 2,
    }


@pytest.mark.parametrize(
    "changes", [{"fpn_channels": 32}, {"mask_size": 56}, {"cqe": "off"}, {"norm": "batch"}]
)
def test_other_layers_than_the_shipped_ones_start_from_published_weights(
    changes: dict[str, Any],
) -> None:
    assert choose_initial_weights("auto", fields("hdc_net_n", **changes)).source == "IMAGENET1K_V1"


@pytest.mark.parametrize(
    ("network", "reason"),
    [
        (fields("mobilenet_v1"), "mobilenet_v1"),
        (fields(width=0.5), "width"),
        (fields("hdc_net_n", width=0.5), "width"),
    ],
)
def test_without_published_weights_training_starts_at_random(
    network: dict[str, Any], reason: str
) -> None:
    initial = choose_initial_weights("auto", network)
    assert initial.kind == "random"
    assert reason in initial.describe(100)
    assert "100 images are few" in initial.describe(100)
    assert "few" not in initial.describe(100_000)
    assert resolve_network(initial, network) == {
        "weights": None,
        "norm": "batch",
        "frozen_stages": 0,
    }


def test_given_norms_and_stages_stay() -> None:
    network = fields("resnet50", norm="batch", frozen_stages=0)
    resolved = resolve_network(choose_initial_weights("auto", network), network)
    assert (resolved["norm"], resolved["frozen_stages"]) == ("batch", 0)


def test_given_backbone_weights_come_before_the_shipped_network() -> None:
    initial = choose_initial_weights("auto", fields("hdc_net_n", weights="mine.pth"))
    assert (initial.kind, initial.source) == ("backbone", "mine.pth")


def test_files_are_distinguished_by_content(tmp_path: Path) -> None:
    state, checkpoint, other = (
        tmp_path / name for name in ("state.pth", "best.ckpt", "other.ckpt")
    )
    torch.save({"conv1.weight": torch.zeros(1)}, state)
    torch.save({"hyper_parameters": {"network": {"norm": "batch"}}, "state_dict": {}}, checkpoint)
    other.write_bytes(b"no weights")
    network = fields("hdc_net_n")
    assert choose_initial_weights(str(state), network) == InitialWeights("backbone", str(state))
    assert choose_initial_weights(str(checkpoint), network) == InitialWeights(
        "network", str(checkpoint), "batch"
    )
    with pytest.raises(CohdcError, match=r"other\.ckpt: neither a checkpoint nor a state dict"):
        choose_initial_weights(str(other), network)
    with pytest.raises(CohdcError, match=r"persn: no such file; .*person, person_s"):
        choose_initial_weights("persn", network)


def test_resume_keeps_norm_and_stages_of_the_checkpoint(tmp_path: Path) -> None:
    last = tmp_path / "last.ckpt"
    hyper = {"network": {"norm": "frozen", "frozen_stages": 3}, "optimizer": {"backbone_lr": 0.2}}
    torch.save({"hyper_parameters": hyper, "state_dict": {}, "loops": {}}, last)
    network = fields("resnet50")
    initial = choose_initial_weights("auto", network, last)
    assert initial.kind == "resumed"
    assert resolve_network(initial, network) == {
        "weights": None,
        "norm": "frozen",
        "frozen_stages": 3,
    }
    assert "norm" not in resolve_network(initial, fields("resnet50", norm="batch"))
    assert resolve_backbone_lr(initial, None) == 0.2
    assert resolve_backbone_lr(initial, 0.7) == 0.7


def test_state_dict_is_refused_as_a_checkpoint_to_resume(tmp_path: Path) -> None:
    state = tmp_path / "state.pth"
    torch.save({"conv1.weight": torch.zeros(1)}, state)
    with pytest.raises(
        CohdcError, match=r"state\.pth: not a checkpoint of cohdc fit; --pretrained takes"
    ):
        choose_initial_weights("auto", fields("resnet50"), state)


def test_backbone_learns_slower_from_trained_weights() -> None:
    assert resolve_backbone_lr(InitialWeights("network", "person"), None) == 0.2
    assert resolve_backbone_lr(InitialWeights("random", norm="batch"), None) == 1.0


def test_norms_that_an_exported_file_cannot_hold_are_refused() -> None:
    network = fields("hdc_net_n", norm="batch")
    with pytest.raises(CohdcError, match=r"--model\.network\.norm frozen"):
        resolve_network(choose_initial_weights("person", network), network)


def test_published_weights_of_mobilenet_v1_are_refused_with_the_flag() -> None:
    with pytest.raises(CohdcError, match=r"mobilenet_v1.*--pretrained FILE\.pth"):
        choose_initial_weights("imagenet", fields("mobilenet_v1"))
