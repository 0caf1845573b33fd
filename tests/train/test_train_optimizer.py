"""Schedule, parameter groups, and what the backbone gets of them."""

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
from cohdc_train.train.optimizer import OptimizerConfig, build_optimizer, time_spent

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


def test_the_rate_warms_up_linearly_and_ends_at_its_fraction() -> None:
    config = OptimizerConfig(warmup_steps=50, final_fraction=0.1)
    assert config.factor(0, 1000) == pytest.approx(1 / 51)
    assert config.factor(24, 1000) == pytest.approx(25 / 51)
    assert config.factor(50, 1000) == pytest.approx(1.0)
    assert config.factor(525, 1000) == pytest.approx(0.55)
    assert config.factor(1000, 1000) == pytest.approx(0.1)
    assert OptimizerConfig(final_fraction=1.0).factor(900, 1000) == 1.0


@given(total=st.integers(1, 5000), warmup=st.integers(0, 500))
def test_the_rate_rises_then_falls(total: int, warmup: int) -> None:
    config = OptimizerConfig(warmup_steps=warmup)
    factors = [config.factor(step, total) for step in range(0, total + 1, max(1, total // 50))]
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
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(list(built.network.parameters()))


def test_frozen_stages_are_not_optimized() -> None:
    built = MaskRCNNModule(["person"], NetworkConfig(**{**TINY.__dict__, "frozen_stages": 2, "norm": "frozen"}))
    built._trainer = Steps(10)  # type: ignore[assignment]
    optimized = {id(p) for group in built.configure_optimizers()["optimizer"].param_groups for p in group["params"]}
    assert id(built.network.backbone.body.conv1.weight) not in optimized


def test_a_schedule_without_an_end_is_refused() -> None:
    with pytest.raises(CohdcError, match="max_epochs"):
        module(total=float("inf")).configure_optimizers()


def test_the_rate_falls_with_the_time_where_that_ends_first(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": 0.0}
    monkeypatch.setattr(Timer, "time_elapsed", lambda self, stage="train": clock["now"])
    options = {"accelerator": "cpu", "logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = Trainer(max_epochs=-1, max_time={"seconds": 100}, **options)
    spent = time_spent(trainer)
    assert spent is not None
    config = OptimizerConfig(warmup_steps=10, lr=1.0, final_fraction=0.0, backbone_lr=0.5, frozen_steps=3)
    optimizer, schedule = build_optimizer(config, MaskRCNN(1, TINY), 2**31, False, spent)
    rates = []
    for seconds in (5.0, *range(10, 101, 10)):  # of ten steps of warm-up, the clock's beginning is not seen
        for _ in range(11):
            clock["now"] = float(seconds)
            optimizer.step()
            schedule.step()
        rates.append(schedule.get_last_lr())
    assert [head for head, *_ in rates] == pytest.approx(
        [config.factor(11, 2**31, s / 100) for s in (5, *range(10, 101, 10))]
    )
    assert rates[5][0] == pytest.approx(0.5)
    assert rates[-1][0] == pytest.approx(0.0, abs=1e-12)
    assert all(body == pytest.approx(0.5 * head) for head, _, body, *_ in rates)
    assert time_spent(Trainer(max_epochs=3, **options)) is None


@pytest.mark.parametrize("options", [{"lr": 0.0}, {"final_fraction": 1.5}, {"backbone_lr": -1.0}])
def test_senseless_rates_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="lr"):
        OptimizerConfig(**options)  # type: ignore[arg-type]


def rates(built: MaskRCNNModule, steps: int) -> list[tuple[float, float]]:
    """Learning rates of the backbone and of what stands around it, step by step."""
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


def test_the_backbone_rests_then_follows_at_its_share() -> None:
    found = rates(module(total=20, lr=1e-3, warmup_steps=0, frozen_steps=5, backbone_lr=0.1, final_fraction=1.0), 20)
    assert [backbone for backbone, _ in found] == pytest.approx([0.0] * 5 + [1e-4] * 15)
    assert [rest for _, rest in found] == pytest.approx([1e-3] * 20)


@pytest.mark.parametrize("name", ["sgd", "adamw"])
def test_a_resting_backbone_stays_as_it_is(name: Any) -> None:
    torch.manual_seed(0)
    built = module(total=10, name=name, lr=0.1, frozen_steps=2, warmup_steps=0)
    configured = built.configure_optimizers()
    body, other = built.network.backbone.body.layer1[0].conv1.weight, built.network.rpn.head.bbox_pred.weight
    before = body.detach().clone(), other.detach().clone()
    for parameter in built.network.parameters():
        parameter.grad = torch.ones_like(parameter)
    moved = []
    for _ in range(3):
        configured["optimizer"].step()
        configured["lr_scheduler"]["scheduler"].step()
        moved.append((not torch.equal(body, before[0]), not torch.equal(other, before[1])))
    assert moved == [(False, True), (False, True), (True, True)]
