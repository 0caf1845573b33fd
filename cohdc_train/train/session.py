"""One run of `cohdc fit`: initial weights, training, last validation, closing lines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer

from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.presets import model_path
from cohdc_train.train.batch_size import find_batch_size
from cohdc_train.train.checkpoints import BEST, LAST, best_checkpoint
from cohdc_train.train.initial_weights import InitialWeights
from cohdc_train.train.messages import device_line, say
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.out_folder import claim_out
from cohdc_train.train.progress import ProgressReporter
from cohdc_train.train.resume import OptionsRecorder, resume_notes
from cohdc_train.train.sanity import find_learning_rate, overfit_verdict
from cohdc_train.train.step_timer import StepTimer
from cohdc_train.train.summary import summary_lines, training_facts


@dataclass(frozen=True)
class TrainingSession:
    """Runs a training that `FitCommand` has built.

    Attributes:
        trainer: the trainer.
        module: the network's module.
        data: the data.
        config: resolved options of `cohdc fit`.
        initial: where the first weights come from.
        notes: lines on options that follow from the checkpoint that is resumed.
        reporter: callback that counts and prints how the training goes.
        timer: callback that measures the time to the first step and between epochs.
    """

    trainer: Trainer
    module: MaskRCNNModule
    data: CocoDataModule
    config: Mapping[str, Any]
    initial: InitialWeights
    notes: Sequence[str]
    reporter: ProgressReporter
    timer: StepTimer

    @property
    def out(self) -> Path:
        """Folder for everything that is written."""
        return Path(self.config["out"])

    def run(self) -> None:
        """Train, from the initial weights or where `--ckpt_path` ended, and say how it went."""
        claim_out(self.config)
        self._load_initial_weights()
        if self.data.batch_size == "auto":
            self._choose_batch_size()
        self._compare_with_checkpoint()
        self._say_setup()
        if self.config["lr_find"]:
            find_learning_rate(self.trainer, self.module, self.data, self.out)
            return
        self.trainer.fit(self.module, datamodule=self.data, ckpt_path=self.config["ckpt_path"])
        if self.config["trainer"]["fast_dev_run"]:
            return
        if self.timer.first_step_s is None:
            say(
                "no step was made: the budget counts from the first session, and is used up; "
                "raise --minutes or --epochs"
            )
        self._score_last_step()
        self._keep_best()
        if self.trainer.is_global_zero:
            self._summarize()

    def _load_initial_weights(self) -> None:
        say(self.initial.describe(num_train_images(self.data)))
        if self.initial.kind == "network":
            skipped = self.module.load_pretrained(model_path(self.initial.source))
            if skipped:
                say(f"not loaded, for other classes or another shape: {', '.join(skipped)}")

    def _choose_batch_size(self) -> None:
        if self.trainer.world_size > 1:
            raise CohdcError(
                "batch_size auto: works on one device; give the number it finds there to several"
            )
        device = self.trainer.strategy.root_device
        self.data.batch_size = find_batch_size(self.module, self.data, device)
        say(f"batch size: {self.data.batch_size}")

    def _compare_with_checkpoint(self) -> None:
        """Record the options for later sessions, and say which differ from an earlier session's."""
        options = {
            "batch_size": self.data.batch_size,
            "ema": self.config["ema"],
            "precision": self.trainer.precision,
        }
        self.trainer.callbacks.append(OptionsRecorder(options))  # type: ignore[attr-defined]
        checkpoint: Path | None = self.config["ckpt_path"]
        if checkpoint is None:
            return
        notes = resume_notes(checkpoint, dict(self.module.hparams), options)
        for note in [*self.notes, *notes]:
            say(note)
        if checkpoint.resolve().parent != self.out.resolve():
            say(
                f"resume: --out {self.out} is not the checkpoint's folder; its {BEST} will be of "
                "this session"
            )

    def _say_setup(self) -> None:
        body = self.module.network.backbone.body
        say(f"HDC rates {body.rates()}, receptive field {body.receptive_field()} px")
        say(f"canvas {self.data.canvas[0]} x {self.data.canvas[1]} px")
        say(device_line(self.trainer))

    def _score_last_step(self) -> None:
        """Validate the last weights where no validation has, however the training ended."""
        trainer, module = self.trainer, self.module
        if trainer.limit_val_batches == 0 or module.validated_step == trainer.global_step:
            return
        trainer.validate(module, datamodule=self.data, verbose=False)
        best = best_checkpoint(trainer)
        score = trainer.callback_metrics.get(best.monitor or "")
        if score is None:
            return
        before = best.best_model_score
        is_better = before is None or (score > before if best.mode == "max" else score < before)
        if is_better:
            trainer.save_checkpoint(self.out / BEST)

    def _keep_best(self) -> None:
        """Save the last weights as best.ckpt where no validation has chosen one."""
        has_validated = self.trainer.limit_val_batches != 0
        if has_validated and (self.out / BEST).is_file():
            return
        self.trainer.save_checkpoint(self.out / BEST)
        say(f"no validation chose {BEST}: it has the weights of {LAST}")

    def _summarize(self) -> None:
        """Print scores, hints, times, files and the next command."""
        is_random = self.initial.kind == "random"
        facts = training_facts(self.module, self.data, self.reporter, is_random)
        if self.config["overfit"] and facts.scores:
            say(self.timer.line())
            say(overfit_verdict(facts.scores, self.config["overfit"]))
            return
        best = best_checkpoint(self.trainer).best_model_score
        best_ap = None if best is None else float(best)
        for line in summary_lines(facts, self.out, self.timer.line(), best_ap):
            say(line)


def num_train_images(data: CocoDataModule) -> int:
    """Return the number of training images, over all roots."""
    return sum(len(split.images) for split in data.folder.train)
