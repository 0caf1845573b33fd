"""Learning-rate schedule and parameter groups."""

import copy
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer

from cohdc_train.errors import CohdcError
from cohdc_train.models import MaskRCNN, NetworkConfig
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.optimizer import OptimizerConfig, build_optimizer, elapsed_fraction

TINY = NetworkConfig(depth=18, width=0.125, fpn_channels=8, fc=16, canvas=(32, 32))


class Steps:
    """As much of a trainer as the optimizer asks for."""

    precision = "32-true"
    callbacks: tuple[Any, ...] = ()

    def __init__(self, total: float) -> None:
        self.estimated_stepping_batches = total


def module(total: float = 1000, **options: Any) -> MaskRCNNModule:
    built = MaskRCNNModule(["person"], TINY, OptimizerConfig(**options))
    built._trainer = Steps(total)  # type: ignore[assignment]
    return built


def test_rate_warms_up_and_ends_at_its_fraction() -> None:
    config = OptimizerConfig(warmup_ratio=0.1, final_fraction=0.1)
    assert config.factor(0, 0.05) == pytest.approx(
        0.5 * (0.1 + 0.9 * 0.5 * (1 + math.cos(0.05 * math.pi)))
    )
    assert config.factor(0, 0.5) == pytest.approx(0.55)
    assert config.factor(0, 1.0) == pytest.approx(0.1)
    assert OptimizerConfig(final_fraction=1.0).factor(0, 0.9) == 1.0


def test_warmup_in_steps_replaces_the_share_of_the_budget() -> None:
    config = OptimizerConfig(warmup_steps=9, final_fraction=1.0)
    assert [config.factor(step, 0.5) for step in (0, 4, 9, 50)] == pytest.approx(
        [0.1, 0.5, 1.0, 1.0]
    )


@given(
    warmup=st.just(0.0) | st.floats(1e-3, 0.5),
    first=st.floats(0.0, 1.0),
    second=st.floats(0.0, 1.0),
)
def test_rate_is_continuous_in_the_budget_used(warmup: float, first: float, second: float) -> None:
    """No jump at the end of the warm-up, wherever steps or a clock put the training."""
    config = OptimizerConfig(warmup_ratio=warmup)
    steepest = (1 / warmup if warmup else 0.0) + math.pi / 2
    change = abs(config.factor(5, first) - config.factor(5, second))
    assert (
        change <= steepest * abs(first - second) + 1.1e-3
    )  # the first step has 1e-3 of the rate, never 0


@given(warmup=st.floats(0.0, 0.5))
def test_rate_rises_then_falls(warmup: float) -> None:
    config = OptimizerConfig(warmup_ratio=warmup)
    factors = [config.factor(0, i / 100) for i in range(101)]
    peak = factors.index(max(factors))
    assert factors[: peak + 1] == sorted(factors[: peak + 1])
    assert factors[peak:] == sorted(factors[peak:], reverse=True)
    assert 0 < min(factors) <= max(factors) <= 1


@pytest.mark.parametrize(("name", "kind"), [("sgd", torch.optim.SGD), ("adamw", torch.optim.AdamW)])
def test_biases_and_norms_do_not_decay(name: Any, kind: type) -> None:
    built = module(name=name, weight_decay=0.1)
    optimizer = built.configure_optimizers()["optimizer"]
    assert type(optimizer) is kind
    for group in optimizer.param_groups:
        kinds = {p.ndim > 1 for p in group["params"]}
        assert kinds == {group["weight_decay"] == 0.1}
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(
        list(built.network.parameters())
    )


def test_frozen_stages_are_not_optimized() -> None:
    built = MaskRCNNModule(
        ["person"], NetworkConfig(**{**TINY.__dict__, "frozen_stages": 2, "norm": "frozen"})
    )
    built._trainer = Steps(10)  # type: ignore[assignment]
    optimized = {
        id(p)
        for group in built.configure_optimizers()["optimizer"].param_groups
        for p in group["params"]
    }
    assert id(built.network.backbone.body.conv1.weight) not in optimized


def test_schedule_without_an_end_is_refused() -> None:
    with pytest.raises(CohdcError, match="--minutes"):
        module(total=float("inf")).configure_optimizers()


def test_rate_follows_the_clock_where_time_ends_the_training(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = {"now": 0.0}
    monkeypatch.setattr(Timer, "time_elapsed", lambda self, stage="train": clock["now"])
    options = {
        "accelerator": "cpu",
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
    }
    trainer = Trainer(max_epochs=-1, max_time={"seconds": 100}, **options)
    progress = elapsed_fraction(trainer, math.inf)
    assert progress is not None
    config = OptimizerConfig(
        warmup_ratio=0.1, lr=1.0, final_fraction=0.0, backbone_lr=0.5, backbone_freeze_steps=3
    )
    optimizer, schedule = build_optimizer(config, MaskRCNN(1, TINY), progress, False)
    rates = []
    for seconds in range(5, 101, 5):
        for _ in range(4):
            clock["now"] = float(seconds)
            optimizer.step()
            schedule.step()
        rates.append(schedule.get_last_lr())
    assert [heads for heads, *_ in rates] == pytest.approx(
        [config.factor(0, s / 100) for s in range(5, 101, 5)]
    )
    assert rates[9][0] == pytest.approx(0.5)
    assert rates[-1][0] == pytest.approx(0.0, abs=1e-12)
    assert all(body == pytest.approx(0.5 * heads) for heads, _, body, *_ in rates)


def test_elapsed_fraction_is_the_larger_of_steps_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Timer, "time_elapsed", lambda self, stage="train": 30.0)
    options = {
        "accelerator": "cpu",
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
    }
    timed = elapsed_fraction(Trainer(max_epochs=3, max_time={"seconds": 100}, **options), 50)
    counted = elapsed_fraction(Trainer(max_epochs=3, **options), 50)
    assert timed is not None
    assert counted is not None
    assert [timed(step) for step in (0, 10, 25)] == pytest.approx([0.3, 0.3, 0.5])
    assert [counted(step) for step in (0, 10, 25)] == pytest.approx([0.0, 0.2, 0.5])
    assert elapsed_fraction(Trainer(max_epochs=-1, **options), math.inf) is None


@pytest.mark.parametrize(
    "options",
    [
        {"lr": 0.0},
        {"final_fraction": 1.5},
        {"backbone_lr": -1.0},
        {"warmup_ratio": 1.0},
        {"warmup_steps": -1},
    ],
)
def test_senseless_rates_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"lr|warmup"):
        OptimizerConfig(**options)  # type: ignore[arg-type]


def rates(built: MaskRCNNModule, steps: int) -> list[tuple[float, float]]:
    """Return the learning rates of the backbone and of the rest, step by step."""
    configured = built.configure_optimizers()
    optimizer, schedule = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    body = {id(p) for p in built.network.backbone.body.parameters()}
    found = []
    for _ in range(steps):
        lr = {id(group["params"][0]) in body: group["lr"] for group in optimizer.param_groups}
        found.append((lr[True], lr[False]))
        optimizer.step()
        schedule.step()
    return found


def test_backbone_is_frozen_then_follows_at_its_share() -> None:
    found = rates(
        module(
            total=20,
            lr=1e-3,
            warmup_steps=0,
            backbone_freeze_steps=5,
            backbone_lr=0.1,
            final_fraction=1.0,
        ),
        20,
    )
    assert [backbone for backbone, _ in found] == pytest.approx([0.0] * 5 + [1e-4] * 15)
    assert [rest for _, rest in found] == pytest.approx([1e-3] * 20)


@pytest.mark.parametrize("name", ["sgd", "adamw"])
def test_frozen_backbone_keeps_its_weights(name: Any) -> None:
    torch.manual_seed(0)
    built = module(total=10, name=name, lr=0.1, backbone_freeze_steps=2, warmup_steps=0)
    configured = built.configure_optimizers()
    body, other = (
        built.network.backbone.body.layer1[0].conv1.weight,
        built.network.rpn.head.bbox_pred.weight,
    )
    before = body.detach().clone(), other.detach().clone()
    for parameter in built.network.parameters():
        parameter.grad = torch.ones_like(parameter)
    moved = []
    for _ in range(3):
        configured["optimizer"].step()
        configured["lr_scheduler"]["scheduler"].step()
        moved.append((not torch.equal(body, before[0]), not torch.equal(other, before[1])))
    assert moved == [(False, True), (False, True), (True, True)]


def test_resumed_schedule_has_the_same_rates() -> None:
    def built() -> tuple[Any, Any]:
        configured = module(total=20, lr=1e-3).configure_optimizers()
        return configured["optimizer"], configured["lr_scheduler"]["scheduler"]

    optimizer, schedule = built()
    uninterrupted = []
    for step in range(20):
        uninterrupted.append(optimizer.param_groups[0]["lr"])
        if step == 7:
            stored = copy.deepcopy((optimizer.state_dict(), schedule.state_dict()))
        optimizer.step()
        schedule.step()

    optimizer, schedule = built()
    optimizer.load_state_dict(stored[0])
    schedule.load_state_dict(stored[1])
    resumed = []
    for _ in range(7, 20):
        resumed.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert resumed == uninterrupted[7:]
