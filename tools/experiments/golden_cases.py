"""What golden.py runs in both checkouts."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from golden_inputs import Inputs, fit_command

Command = list[str]
_STEPS = 20
_FORMATS = ("coco", "labelme", "yolo")
_SCORED = ("data/coco_small", "data/tum/trajectories", "data/tum/groundtruth")
_NETWORKS = ("person", "person_s")


@dataclass(frozen=True)
class Case:
    """Commands whose results must not change.

    Attributes:
        name: for --cases.
        prepare: makes the input, once for both checkouts.
        commands: returns the commands for an input; they run in an empty folder, which is compared.
        needs: files and folders below the shared one without which the case is skipped.
    """

    name: str
    prepare: Callable[[Inputs], Path]
    commands: Callable[[Path], list[Command]]
    needs: tuple[str, ...] = ()


def _slam(sequence: Path, out: str, *options: str) -> Command:
    return ["cohdc", "slam", "--sequence", str(sequence), "--out", out, "--seed", "0", *options]


def _slam_xyz(sequence: Path) -> list[Command]:
    return [_slam(sequence, "out")]


def _slam_loop(sequence: Path) -> list[Command]:
    return [_slam(sequence, "out", "--cloud", "true")]


def _slam_masks(sequence: Path) -> list[Command]:
    masks = ["--masks", str(sequence / "masks")]
    small = ["--features", "800", "--culling.dilate", "5"]
    masked = _slam(sequence, "masked", *masks, *small, "--cloud", "true")
    return [masked, _slam(sequence, "unmasked", "--features", "800")]


def _slam_flow(sequence: Path) -> list[Command]:
    return [["golden_flow", str(sequence), "out"]]


def _slam_late_masks(sequence: Path) -> list[Command]:
    words = ["--sequences", str(sequence), "--out", "out", "--late", "3", "--features", "800"]
    return [["late_masks", *words]]


def _slam_stereo(sequence: Path) -> list[Command]:
    options = ["--features", "600", "--cloud", "true"]
    coarse = ["--features", "600", "--method.refinement", "false"]
    return [_slam(sequence, "out", *options), _slam(sequence, "unrefined", *coarse)]


def _predict(photos: Path) -> list[Command]:
    commands = []
    for model in _NETWORKS:
        for kind in _FORMATS:
            out = ["--out", f"{model}_{kind}", "--format", kind, "--threads", "1"]
            commands.append(["cohdc", "predict", str(photos), "--model", model, *out])
    return commands


def _train(people: Path) -> list[Command]:
    return [fit_command(people, "out", _STEPS)]


def _export(checkpoint: Path) -> list[Command]:
    images = checkpoint.parent / "people" / "images"
    return [["cohdc", "export", str(checkpoint), "--out", "model.onnx", "--images", str(images)]]


def _scores(folder: Path) -> list[Command]:
    """Score a shipped network, and every trajectory, such as walking_xyz_c, by its ground truth."""
    words = ["--out", "person.json", "--threads", "1"]
    commands = [["cohdc", "validate", "person", str(folder / "coco"), *words]]
    for estimate in sorted((folder / "trajectories").glob("*.txt")):
        scene = estimate.stem.rpartition("_")[0]
        (truth,) = (folder / "groundtruth").glob(f"fr?_{scene}.txt")
        out = ["--out", f"{estimate.stem}.json"]
        commands.append(["cohdc", "evaluate", str(truth), str(estimate), *out])
    return commands


def _synth(_: Path) -> list[Command]:
    small = ["--size", "[96,128]", "--seed", "3"]
    scene = ["--frames", "4", "--people", "2", "--scene.cart", "pushed"]
    images = ["--train", "3", "--val", "1"]
    return [
        ["cohdc", "synth", "sequence", "sequence", *small, *scene],
        ["cohdc", "synth", "coco", "coco", *small, *images],
    ]


CASES = (
    Case("slam_xyz", Inputs.xyz, _slam_xyz, ("data/tum/rgbd_dataset_freiburg1_xyz",)),
    Case("slam_loop", Inputs.loop, _slam_loop),
    Case("slam_masks", Inputs.walk, _slam_masks),
    Case("slam_flow", Inputs.loop, _slam_flow),
    Case("slam_late_masks", Inputs.walk, _slam_late_masks),
    Case("slam_stereo", Inputs.stereo, _slam_stereo),
    Case("predict", Inputs.photos, _predict, ("data/samples",)),
    Case("train", Inputs.people, _train),
    Case("export", Inputs.checkpoint, _export),
    Case("scores", Inputs.scored, _scores, _SCORED),
    Case("synth", Inputs.nothing, _synth),
)
