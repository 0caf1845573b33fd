"""`cohdc fit` and `cohdc validate` on six drawn images with a tiny network."""

import json
import re
import warnings
from pathlib import Path
from typing import Any
from urllib.error import URLError

import coco_toys
import pytest
import torch
import yaml
from lightning.pytorch.utilities import rank_zero_info

from cohdc_train.cli import main
from cohdc_train.errors import CohdcError
from cohdc_train.models import NetworkConfig
from cohdc_train.train import progress
from cohdc_train.train.cli import fit
from cohdc_train.train.messages import user_errors
from cohdc_train.train.module import MaskRCNNModule

TINY = """
data: {canvas: [48, 64], workers: 0}
model:
  network: {depth: 18, width: 0.125, fpn_channels: 8, fc: 16, anchor_scales: [8, 16, 32, 64],
            rois: 16, proposals: [50, 20]}
trainer: {accelerator: cpu, max_epochs: 1, precision: 32-true}
figures: false
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = coco_toys.folder(tmp_path_factory.mktemp("toy"))
    (root / "tiny.yaml").write_text(TINY, encoding="utf-8")
    return root


def arguments(toy: Path, out: Path, *more: str) -> list[str]:
    return ["--config", str(toy / "tiny.yaml"), f"--data.root={toy}", f"--out={out}", *more]


@pytest.fixture(scope="module")
def run(toy: Path) -> Path:
    out = toy / "run"
    fit(arguments(toy, out, "--trainer.log_every_n_steps=1"))
    return out


def test_fit_writes_checkpoints_logs_and_configuration(run: Path) -> None:
    assert {"best.ckpt", "last.ckpt", "config.yaml", "logs"} <= {
        path.name for path in run.iterdir()
    }
    (log,) = (run / "logs").glob("*/metrics.csv")
    header = log.read_text().splitlines()[0].split(",")
    wanted = {
        "val/segm_AP",
        "val/segm_AP50",
        "val/segm_AP70",
        "val/boundary_AP",
        "val/quality_error",
        "val/box_AP",
        "val/mIoU",
        "val/S90_matched",
        "val/S90_all",
    }
    assert wanted <= set(header)
    assert list((run / "logs").glob("*/events.out.tfevents*"))


def test_saved_configuration_repeats_the_training(toy: Path, run: Path) -> None:
    saved = yaml.safe_load((run / "config.yaml").read_text())
    assert saved["data"]["root"] == str(toy)
    assert saved["model"]["optimizer"]["name"] == "adamw"
    again = toy / "again"
    fit(["--config", str(run / "config.yaml"), f"--out={again}"])
    weights = [torch.load(r / "last.ckpt", weights_only=True)["state_dict"] for r in (run, again)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_checkpoint_loads_without_its_initial_weights(run: Path) -> None:
    checkpoint = torch.load(run / "best.ckpt", weights_only=True)
    checkpoint["hyper_parameters"]["network"]["weights"] = "/not/there.pt"
    torch.save(checkpoint, run / "moved.ckpt")
    module = MaskRCNNModule.load(run / "moved.ckpt")
    assert module.class_names == ["person", "car"]
    assert module.network_config.canvas == (48, 64)
    assert not module.training
    theirs = MaskRCNNModule.load_from_checkpoint(run / "best.ckpt", weights_only=True)
    assert theirs.network_config.depth == module.network_config.depth


@pytest.mark.parametrize("content", [b"", b"no checkpoint", None])
def test_load_refuses_other_files_in_one_line(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "some.ckpt"
    if content is None:
        torch.save({"weights": torch.zeros(1)}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(CohdcError, match=r"some\.ckpt: not a checkpoint of cohdc fit") as error:
        MaskRCNNModule.load(path)
    assert "\n" not in str(error.value)


def test_last_checkpoint_is_of_the_last_epoch(
    toy: Path,
) -> None:
    out = toy / "standstill"  # at this rate no epoch scores better than the first
    fit(arguments(toy, out, "--trainer.max_epochs=3", "--model.optimizer.lr=1e-12"))
    epochs = {
        name: torch.load(out / f"{name}.ckpt", weights_only=True)["epoch"]
        for name in ("best", "last")
    }
    assert epochs == {"best": 0, "last": 2}


def test_training_logs_rates_speed_and_time_left(run: Path) -> None:
    (log,) = (run / "logs").glob("*/metrics.csv")
    header = set(log.read_text().splitlines()[0].split(","))
    assert {
        "lr/heads",
        "lr/backbone",
        "speed/images_per_s",
        "speed/minutes_left",
        "train/loss",
    } <= header
    assert {"val/segm_AP/person", "val/segm_AP/car"} <= header


def test_training_ends_with_scores_files_and_the_next_command(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(arguments(toy, tmp_path))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.strip()]
    end = "\n".join(lines[-7:])
    assert re.search(
        r"^best\.ckpt: mask AP \d\.\d{3}, AP50 \d\.\d{3} on the validation split$", end, re.M
    )
    assert re.search(r"^mask AP per class: person \d\.\d{3}, car \d\.\d{3}$", end, re.M)
    assert re.search(
        r"^hint: AP50 is 0\.\d+ after 3 steps from random weights on 6 images", end, re.M
    )
    assert f"files in {tmp_path}: best.ckpt, last.ckpt, config.yaml, logs" in end
    assert lines[-1] == f"next: cohdc export {tmp_path / 'best.ckpt'} --images {toy / 'images'}"
    assert any(re.match(r"step 3; 6 images, .*loss .*lr .*mask AP .*AP50", line) for line in lines)


def test_best_checkpoint_exists_when_no_validation_was_due(toy: Path, tmp_path: Path) -> None:
    fit(arguments(toy, tmp_path, "--trainer.max_epochs=2", "--trainer.check_val_every_n_epoch=50"))
    best = torch.load(tmp_path / "best.ckpt", weights_only=True)
    last = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert best["global_step"] == last["global_step"] == 6
    assert MaskRCNNModule.load(tmp_path / "best.ckpt").class_names == ["person", "car"]


def test_training_stops_after_its_minutes(toy: Path, tmp_path: Path) -> None:
    trainer = fit(arguments(toy, tmp_path, "--minutes=0.05", "--trainer.max_epochs=-1"))
    assert 0 < trainer.global_step < 2000
    assert {"best.ckpt", "last.ckpt"} <= {path.name for path in tmp_path.iterdir()}


def test_canvas_is_chosen_from_the_images_and_saved(toy: Path, tmp_path: Path) -> None:
    (toy / "auto.yaml").write_text(
        TINY.replace("canvas: [48, 64]", "canvas: auto"), encoding="utf-8"
    )
    fit(["--config", str(toy / "auto.yaml"), f"--data.root={toy}", f"--out={tmp_path}"])
    canvas = tuple(yaml.safe_load((tmp_path / "config.yaml").read_text())["data"]["canvas"])
    module = MaskRCNNModule.load(tmp_path / "best.ckpt")
    assert module.network_config.canvas == canvas
    assert all(side % 32 == 0 for side in canvas)


def test_overfit_trains_and_validates_on_the_same_images(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = fit(arguments(toy, tmp_path, "--overfit=2", "--trainer.max_steps=2"))
    data = trainer.datamodule  # type: ignore[attr-defined]
    assert data.folder.train[0].images == data.folder.val.images
    assert len(data.folder.val.images) == 2
    assert data.augment.flip == 0
    assert "overfit: AP50" in capsys.readouterr().out.splitlines()[-1]


def test_lr_find_suggests_a_rate_and_trains_nothing(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(arguments(toy, tmp_path, "--lr_find=true", "--trainer.max_epochs=100"))
    assert "lr find: " in capsys.readouterr().out
    assert not (tmp_path / "best.ckpt").exists()


def test_failed_download_names_the_flag_for_a_local_file(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def offline(*_: Any, **__: Any) -> None:
        raise URLError("no route to host")

    monkeypatch.setattr("torch.hub.load_state_dict_from_url", offline)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", offline)
    wide = ("--model.network.width=1.0", "--model.network.depth=18")
    assert main(["fit", *arguments(toy, tmp_path, *wide)]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert "IMAGENET1K_V1 of resnet18" in last
    assert "no route to host" in last
    assert "--pretrained FILE.pth" in last


def test_training_resumes_with_more_epochs(toy: Path, run: Path) -> None:
    trainer = fit(
        arguments(
            toy, toy / "resumed", "--trainer.max_epochs=2", f"--ckpt_path={run / 'last.ckpt'}"
        )
    )
    assert (trainer.current_epoch, trainer.global_step) == (2, 6)


def test_training_starts_from_weights_of_another(toy: Path, run: Path) -> None:
    still = ("--model.optimizer.lr=1e-12", f"--pretrained={run / 'last.ckpt'}")
    fit(arguments(toy, toy / "same", *still))
    before, after = (MaskRCNNModule.load(out / "last.ckpt").network for out in (run, toy / "same"))
    for (name, old), new in zip(before.named_parameters(), after.parameters(), strict=True):
        torch.testing.assert_close(new, old, atol=1e-6, rtol=0, msg=name)


def test_other_classes_load_all_but_class_layers(run: Path) -> None:
    before = MaskRCNNModule.load(run / "last.ckpt")
    for names in (["person"], ["dog", "cat"]):  # the second has as many classes
        module = MaskRCNNModule(names, before.network_config)
        own = {name: weights.clone() for name, weights in module.network.state_dict().items()}
        left = module.load_pretrained(run / "last.ckpt")
        assert {name.rsplit(".", 2)[-2] for name in left} == {
            "cls_score",
            "bbox_pred",
            "mask_fcn_logits",
            "quality",
        }
        old, new = before.network.state_dict(), module.network.state_dict()
        assert all(torch.equal(new[name], own[name] if name in left else old[name]) for name in new)


def test_checkpoint_without_a_fitting_weight_is_refused(run: Path) -> None:
    other = NetworkConfig(
        depth=50, width=0.25, fpn_channels=16, fc=32, anchor_scales=(8, 16, 32, 64)
    )
    module = MaskRCNNModule(["dog"], other)
    module.network = torch.nn.ModuleDict({"another": torch.nn.Linear(1, 1)})  # type: ignore[assignment]
    with pytest.raises(CohdcError, match=r"last\.ckpt: none of the weights of its backbone fits"):
        module.load_pretrained(run / "last.ckpt")


def test_resume_refuses_other_classes(
    toy: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(
        [
            "fit",
            *arguments(toy, toy / "no", "--data.classes=[car]", f"--ckpt_path={run / 'last.ckpt'}"),
        ]
    )
    assert code == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"cohdc fit: {run / 'last.ckpt'}: its classes are person, car;")
    assert "the data's are car; --pretrained" in last


def test_validate_prints_and_writes_the_scores(
    toy: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = toy / "scores.json"
    assert main(["validate", str(run / "last.ckpt"), str(toy), "--workers=0", f"--out={out}"]) == 0
    assert {"segm_AP50", "box_AP", "S90_all"} <= set(json.loads(out.read_text()))
    assert "segm_AP50" in capsys.readouterr().out


def test_half_precision_trains(toy: Path) -> None:
    trainer = fit(
        arguments(toy, toy / "bf16", "--trainer.precision=bf16-mixed", "--data.batch_size=3")
    )
    assert trainer.global_step == 2


def test_diverged_loss_names_step_and_images(toy: Path) -> None:
    with pytest.raises(
        CohdcError, match=r"^step \d+: the loss is not finite on images \d+, \d+:.*lower the lr$"
    ):
        fit(arguments(toy, toy / "nan", "--model.optimizer.lr=1e30", "--trainer.max_epochs=5"))


def test_unreadable_image_in_a_worker_is_one_line(tmp_path: Path) -> None:
    root = coco_toys.folder(tmp_path)
    (root / "tiny.yaml").write_text(TINY, encoding="utf-8")
    for path in (root / "images").glob("train_*"):
        path.write_bytes(b"not an image")
    with pytest.raises(
        CohdcError, match=r"^\S+train_\d\.png: image \d cannot be read as an image$"
    ):
        fit(arguments(root, tmp_path / "out", "--data.workers=1", "--trainer.limit_val_batches=0"))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--model.network.rates=[[2],[1],[1],[1]]"], "holes"),
        (["--model.network.weights=nowhere.pt"], "nowhere.pt"),
        (["--model.network.anchor_scales=[8]"], "anchor_scales"),
        (["--data.classes=[dog]"], "'dog'"),
        (["--ckpt_path=nowhere.ckpt"], "nowhere.ckpt"),
        (["--pretrained=nowhere.ckpt"], "nowhere.ckpt"),
        (["--pretrained=person"], "layers"),
        (["--config=table3/test99.yaml"], "test99.yaml"),
    ],
)
def test_bad_values_are_one_line(
    toy: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", *arguments(toy, toy / "bad", *more)]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("cohdc fit: ")
    assert message in last


def test_renamed_option_names_the_new_one(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = "model.optimizer.frozen_steps", "model.optimizer.backbone_freeze_steps"
    config = tmp_path / "old.yaml"
    config.write_text("model: {optimizer: {frozen_steps: 3}}")
    for option in ("--pictures=false", f"--{old}=3", f"--config={config}"):
        with pytest.raises(SystemExit) as stop:
            fit(arguments(toy, toy / "bad", option))
        assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines()[-3:] == [
        "cohdc fit: no option --pictures; it is --figures now",
        f"cohdc fit: no option --{old}; it is --{new} now",
        f"cohdc fit: {config}: no option {old}; it is {new} now",
    ]


@pytest.mark.parametrize(
    "wrong", ["--data.rot=x", "--model.network.canvas=[1,2]", "--data.batch_size=two"]
)
def test_wrong_key_or_type_is_a_usage_error(toy: Path, wrong: str) -> None:
    with pytest.raises(SystemExit) as stop:
        fit(arguments(toy, toy / "bad", wrong))
    assert stop.value.code == 2


def test_several_folders_become_a_list_of_roots(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        fit([f"--data.root=[{toy},{toy}]", "--print_config"])
    assert yaml.safe_load(capsys.readouterr().out)["data"]["root"] == [str(toy), str(toy)]


def test_print_config_shows_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        fit(["DATA", "--print_config"])
    assert stop.value.code == 0
    shown: dict[str, Any] = yaml.safe_load(capsys.readouterr().out)
    assert shown["data"]["root"] == "DATA"
    assert shown["data"]["canvas"] == "auto"
    assert shown["model"]["network"]["backbone"] == "mobilenet_v2"  # networks/hdc_net_n.yaml
    assert shown["pretrained"] == "auto"
    assert shown["checkpoint"]["monitor"] == "val/segm_AP"
    assert shown["figures"] is True


def test_weight_average_is_validated_and_kept(toy: Path, run: Path, tmp_path: Path) -> None:
    """Check that best.ckpt has the average, and keeps the plain weights for a resume."""
    fit(arguments(toy, tmp_path, "--ema=0.99"))
    checkpoint = torch.load(tmp_path / "best.ckpt", weights_only=True)
    plain = torch.load(run / "best.ckpt", weights_only=True)
    name = "network.rpn.head.bbox_pred.weight"
    assert not torch.equal(checkpoint["state_dict"][name], plain["state_dict"][name])
    assert torch.equal(checkpoint["current_model_state"][name], plain["state_dict"][name])
    assert MaskRCNNModule.load(tmp_path / "best.ckpt").class_names == ["person", "car"]
    fit(
        arguments(
            toy,
            tmp_path,
            "--ema=0.99",
            f"--ckpt_path={tmp_path / 'last.ckpt'}",
            "--trainer.max_epochs=2",
        )
    )
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["epoch"] == 1


def test_decay_of_one_is_refused(toy: Path, tmp_path: Path) -> None:
    with pytest.raises(CohdcError, match="ema 1"):
        fit(arguments(toy, tmp_path, "--ema=1.0"))


@pytest.mark.parametrize("name", ["best.ckpt", "last.ckpt", "config.yaml"])
def test_fit_keeps_files_it_did_not_write(
    toy: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert main(["fit", *arguments(toy, tmp_path)]) == 1
    lines = capsys.readouterr().err.splitlines()
    (line,) = [line for line in lines if line.startswith("cohdc fit: ")]
    assert f"{tmp_path}: holds {name}, not written by a former cohdc fit" in line
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_validate_keeps_figures_it_did_not_write(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "best.jpg").write_text("mine")
    assert main(["validate", "person", str(toy), f"--figures={tmp_path}"]) == 1
    assert "holds best.jpg, not written by a former cohdc validate" in capsys.readouterr().err
    assert (tmp_path / "best.jpg").read_text() == "mine"


def test_batch_size_is_found(toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit(arguments(toy, tmp_path, "--data.batch_size=auto", "--data.mini_mask=[28,28]"))
    assert "batch size: 32" in capsys.readouterr().out
    with pytest.raises(CohdcError, match="works on one device"):
        fit(arguments(toy, tmp_path, "--data.batch_size=auto", "--trainer.devices=2"))


@pytest.mark.slow
def test_two_images_are_learned(tmp_path: Path) -> None:
    """Train and score on two images: all objects are found, so the way from JSON to AP is sound."""
    root = coco_toys.folder(tmp_path, train=2)
    (tmp_path / "tiny.yaml").write_text(TINY, encoding="utf-8")
    same = [
        f"--data.paths.{split}_{kind}" for split in ("train", "val") for kind in ("json", "images")
    ]
    places = [root / "instances_train.json", root / "images"] * 2
    trainer = fit(
        [
            "--config",
            str(tmp_path / "tiny.yaml"),
            *(f"{name}={place}" for name, place in zip(same, places, strict=True)),
            f"--out={tmp_path / 'run'}",
            "--model.network.width=0.25",
            "--model.network.fpn_channels=16",
            "--model.network.fc=32",
            "--model.optimizer.lr=0.004",
            "--data.canvas=[96,128]",
            "--trainer.enable_progress_bar=false",
            "--data.augment.flip=0",
            "--data.augment.scale_jitter=[1,1]",
            "--data.augment.photometric=false",
            "--trainer.max_epochs=150",
            "--trainer.check_val_every_n_epoch=150",
        ]
    )
    assert trainer.callback_metrics["val/segm_AP50"] == 1.0
    assert trainer.callback_metrics["val/box_AP50"] == 1.0
    assert trainer.callback_metrics["val/mIoU"] > 0.8


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("one line", "one line"),
        ("Traceback\n  here\nDataError: a.png: is broken", "a.png: is broken"),
        ("two lines\nwithout a name", "without a name"),
    ],
)
def test_error_of_several_lines_becomes_its_last(text: str, told: str) -> None:
    with pytest.raises(CohdcError) as error, user_errors():
        raise CohdcError(text)
    assert str(error.value) == told


def test_interrupted_training_keeps_its_last_step(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = MaskRCNNModule.training_step

    def interrupted(self: MaskRCNNModule, batch: Any, batch_idx: int) -> torch.Tensor:
        if self.global_step == 2:
            raise KeyboardInterrupt
        return step(self, batch, batch_idx)

    monkeypatch.setattr(MaskRCNNModule, "training_step", interrupted)
    with pytest.raises((SystemExit, KeyboardInterrupt)):
        fit(arguments(toy, tmp_path))
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == 2
    last = capsys.readouterr().out.splitlines()[-1]
    assert (
        last == f"interrupted at step 2; --ckpt_path {tmp_path / 'last.ckpt'} continues from there"
    )


def test_resume_refuses_another_network(
    toy: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(
        [
            "fit",
            *arguments(
                toy, toy / "no", "--model.network.fc=32", f"--ckpt_path={run / 'last.ckpt'}"
            ),
        ]
    )
    assert code == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert "last.ckpt: its network has fc 16, this one 32; give --config of its training" in last


@pytest.mark.parametrize(
    ("options", "backbone"),
    [
        (["--model.network.detections=7"], "mobilenet_v2"),
        (["--config=person.yaml"], "mobilenet_v2"),
        (["--model.network.depth=18"], "resnet"),
        (["--config=networks/resnet50.yaml"], "resnet"),
        (["--config", "table3/test01.yaml"], "resnet"),
    ],
)
def test_named_network_replaces_the_default(
    options: list[str], backbone: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        fit(["DATA", *options, "--print_config"])
    assert yaml.safe_load(capsys.readouterr().out)["model"]["network"]["backbone"] == backbone


def test_repeated_configuration_does_not_resume(toy: Path, run: Path, tmp_path: Path) -> None:
    fit(arguments(toy, tmp_path, "--trainer.max_epochs=2", f"--ckpt_path={run / 'last.ckpt'}"))
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["ckpt_path"] is None


def test_resume_names_options_that_differ(
    toy: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = (
        "--trainer.max_epochs=2",
        "--data.canvas=[64,64]",
        "--data.batch_size=3",
        "--model.optimizer.lr=0.5",
        "--model.optimizer.warmup_ratio=0.1",
        "--model.network.rates=[[1],[1],[1],[1]]",
        "--trainer.precision=bf16-mixed",
        "--ema=0.9",
    )
    trainer = fit(arguments(toy, tmp_path, *changed, f"--ckpt_path={run / 'last.ckpt'}"))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("resume: ")]
    assert lines == [
        "resume: --model.optimizer.lr: 0.0012 in the checkpoint, 0.5 was asked for; 0.0012 is used;"
        " --pretrained CHECKPOINT starts with another one",
        "resume: --model.network.rates: ((1, 2, 3), (1, 2, 3), (1, 2, 3), (1, 2, 3)) in the "
        "checkpoint, ((1,), (1,), (1,), (1,)) was asked for; ((1,), (1,), (1,), (1,)) is used",
        "resume: --data.canvas: (48, 64) in the checkpoint, (64, 64) was asked for; "
        "(64, 64) is used",
        "resume: --model.optimizer.warmup_ratio: 0.05 in the checkpoint, 0.1 was asked for; "
        "0.1 is used",
        "resume: --data.batch_size: 2 in the checkpoint, 3 was asked for; 3 is used",
        "resume: --trainer.precision: 32-true in the checkpoint, bf16-mixed was asked for; "
        "bf16-mixed is used",
        "resume: --ema: 0.0 in the checkpoint, 0.9 was asked for; "
        "the average starts at the checkpoint",
        f"resume: --out {tmp_path} is not the checkpoint's folder; its best.ckpt will be of this "
        "session",
    ]
    resumed = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert resumed["hyper_parameters"]["optimizer"]["lr"] == 0.0012
    assert trainer.optimizers[0].param_groups[0]["initial_lr"] == 0.0012
    assert resumed["fit_options"] == {"batch_size": 3, "ema": 0.9, "precision": "bf16-mixed"}


def test_resume_with_equal_options_prints_no_note(
    toy: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(arguments(toy, run, f"--ckpt_path={run / 'last.ckpt'}"))
    out = capsys.readouterr().out
    assert "resume: " not in out
    assert "no step was made: the budget counts from the first session" in out


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--model.network.norm=frozen", "its network has norm batch, this one frozen"),
        ("--model.network.frozen_stages=3", "its network has frozen_stages 0, this one 3"),
        ("--model.optimizer.name=sgd", "its optimizer has name adamw, this one sgd"),
    ],
)
def test_resume_refuses_what_its_optimizer_cannot_load(
    toy: Path, run: Path, option: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["fit", *arguments(toy, toy / "no", option, f"--ckpt_path={run / 'last.ckpt'}")])
    assert code == 1
    assert f"last.ckpt: {words}; give --config" in capsys.readouterr().err.splitlines()[-1]


def test_fit_prints_its_own_lines_only(
    toy: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fit(arguments(toy, tmp_path))
    out, err = capfd.readouterr()
    assert err == ""
    words = [line.partition(" ")[0] for line in out.splitlines()]
    assert words == [
        *("initial", "HDC", "canvas", "device:", "step"),
        *("best.ckpt:", "mask", "hint:", "hint:", "time:", "files", "next:"),
    ]
    (device,) = [line for line in out.splitlines() if line.startswith("device: ")]
    assert re.fullmatch(r"device: CPU, precision 32-true, \d+ threads?", device)


def test_user_messages_and_warnings_are_shown(
    toy: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO")
    step = MaskRCNNModule.training_step

    def talkative(self: MaskRCNNModule, batch: Any, batch_idx: int) -> torch.Tensor:
        rank_zero_info("information of the user's own")
        warnings.warn("a warning of the user's own", UserWarning, stacklevel=1)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(MaskRCNNModule, "training_step", talkative)
    with pytest.warns(UserWarning, match="a warning of the user's own"):
        fit(arguments(toy, tmp_path, "--trainer.max_steps=1"))
    assert caplog.messages == ["information of the user's own"]


def test_training_without_validation_says_where_its_files_are(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(arguments(toy, tmp_path, "--trainer.limit_val_batches=0"))
    lines = capsys.readouterr().out.splitlines()
    assert "no validation chose best.ckpt: it has the weights of last.ckpt" in lines
    assert lines[-2] == f"files in {tmp_path}: best.ckpt, last.ckpt, config.yaml, logs"
    assert lines[-1] == f"next: cohdc export {tmp_path / 'best.ckpt'} --images {toy / 'images'}"
    best, last = (
        torch.load(tmp_path / name, weights_only=True)["state_dict"]
        for name in ("best.ckpt", "last.ckpt")
    )
    assert all(torch.equal(best[name], last[name]) for name in last)


@pytest.mark.parametrize(
    "option",
    [
        "--checkpoint.filename=mine",
        "--checkpoint.save_top_k=3",
        "--checkpoint.save_top_k=0",
        "--checkpoint.save_weights_only=true",
        "--checkpoint.save_last=true",
        "--checkpoint.enable_version_counter=true",
    ],
)
def test_options_that_rename_checkpoints_are_refused(
    toy: Path, tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", *arguments(toy, tmp_path, option)]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"cohdc fit: {option.partition('=')[0]} ")
    assert "keeps best.ckpt and last.ckpt" in last


@pytest.mark.parametrize("monitor", ["val/box_AP", "null"])
def test_best_checkpoint_exists_whatever_it_watches(
    toy: Path, tmp_path: Path, monitor: str
) -> None:
    fit(arguments(toy, tmp_path, f"--checkpoint.monitor={monitor}"))
    assert {"best.ckpt", "last.ckpt"} <= {path.name for path in tmp_path.iterdir()}


def test_overfit_on_more_images_than_there_are_is_refused(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", *arguments(toy, tmp_path, "--overfit=1000")]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == (
        f"cohdc fit: --overfit 1000: {toy / 'instances_train.json'} has 6 training images with "
        "objects; give at most 6"
    )


def test_closing_lines_state_the_time_to_the_first_step_and_between_epochs(
    toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(arguments(toy, tmp_path, "--trainer.max_epochs=3"))
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if line.startswith("time: ")]
    assert re.fullmatch(
        r"time: \d+\.\d s to the first step, \d+\.\d s between epochs \(without validation\)", line
    )


def test_training_without_a_bar_prints_its_steps(
    toy: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(progress, "_LINE_INTERVAL_S", 0.0)
    fit(arguments(toy, tmp_path, "--trainer.limit_val_batches=0"))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("step ")]
    assert [line.partition(";")[0] for line in lines] == ["step 1", "step 2", "step 3"]
    assert all(re.search(r"\d images, .*; loss .*; lr .* min", line) for line in lines)
