"""Work of each step of the demo; heavy modules are imported where they are used."""

import multiprocessing
import os
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from cohdc_train.demo.plan import SCENE_SEED, DemoPlan
from cohdc_train.errors import CohdcError

SHIPPED = "person"
IMAGE_SIZE = (288, 384)  # px, of the rendered photographs
CANVAS = (384, 512)  # px, of the fine-tuned network
PERSON_DISTANCE = (0.5, 2.5)  # m, of the people in them
_LEARNING_RATE = 3e-4
PLAIN = {
    "free_space.enabled": False,
    "motion_segmentation.enabled": False,
}

# name in slam/ -> what the images and tables call it
RUNS = {
    "plain": "plain RGB-D SLAM",
    "geometry": "depth geometry, no masks",
    "masks": "masks and geometry",
}


def render(out: Path, plan: DemoPlan, seed: int) -> dict[str, Any]:
    """Render photographs into data/ and a sequence into sequence/, on one core each."""
    from cohdc_train.synth.coco import coco
    from cohdc_train.synth.scenario import SceneConfig
    from cohdc_train.synth.sequence import sequence

    for name in ("data", "sequence"):
        shutil.rmtree(out / name, ignore_errors=True)
    scene = SceneConfig(action="fill_view", walls="plain")
    with _processes() as pool:
        photographs = pool.submit(
            coco,
            out / "data",
            train=plan.train_images,
            val=plan.val_images,
            size=IMAGE_SIZE,
            seed=seed,
            distance=PERSON_DISTANCE,
        )
        recording = pool.submit(
            sequence,
            out / "sequence",
            frames=plan.frames,
            seed=SCENE_SEED,
            people=2,
            scene=scene,
        )
        photographs.result()
        recording.result()
    return {}


def score_shipped(out: Path) -> dict[str, float]:
    """Return the validation scores of the shipped network."""
    from cohdc_train.validation import validate

    return validate(Path(SHIPPED), out / "data")


def train(out: Path, plan: DemoPlan, seed: int) -> dict[str, float]:
    """Fine-tune the shipped network by `cohdc fit`; return the scores of the best checkpoint."""
    from cohdc_train.validation import validate

    shutil.rmtree(out / "train", ignore_errors=True)
    # A low rate: the network knows people already, and the training is short.
    arguments = [
        f"--minutes={plan.minutes:g}",
        f"--model.optimizer.lr={_LEARNING_RATE:g}",
        f"--data.canvas=[{CANVAS[0]},{CANVAS[1]}]",
        f"--pretrained={SHIPPED}",
        f"--seed_everything={seed}",
        f"--out={out / 'train'}",
    ]
    command = [sys.executable, "-m", "cohdc_train", "fit", str(out / "data"), *arguments]
    if subprocess.run(command, check=False).returncode != 0:
        raise CohdcError("the training failed; its own message stands above")
    return validate(out / "train" / "best.ckpt", out / "data")


def export_model(out: Path) -> dict[str, Any]:
    """Export the best checkpoint to model.onnx, and check the file against torch."""
    from cohdc_train.exporter.export import export

    for name in ("model.onnx", "model.onnx.json"):
        (out / name).unlink(missing_ok=True)
    export(out / "train" / "best.ckpt", out / "model.onnx", images=out / "data" / "images")
    return {}


def run_slam_three_times(out: Path, seed: int) -> dict[str, Any]:
    """Track the sequence in three ways; return the metrics of each.

    The two runs without a network share the cores; the run with the network has both.
    """
    shutil.rmtree(out / "slam", ignore_errors=True)
    (out / "slam").mkdir()
    with _processes() as pool:
        jobs = {name: pool.submit(track, out, name, seed) for name in ("plain", "geometry")}
        metrics = {name: job.result() for name, job in jobs.items()}
    metrics["masks"] = track(out, "masks", seed)
    return metrics


def track(out: Path, name: str, seed: int) -> dict[str, Any]:
    """Run SLAM on the sequence.

    Args:
        out: folder of the demo.
        name: "plain" uses neither masks nor geometry, "geometry" no masks, "masks" both.
        seed: of the SLAM system.
    """
    from cohdc_train.slam.config import SlamConfig
    from cohdc_train.slam.features.orb import OrbExtractor
    from cohdc_train.slam.geometry.calibration import load_camera
    from cohdc_train.slam.run import run_slam
    from cohdc_train.slam.visualization.animation import RunAnimation
    from cohdc_train.trajectory.trajectory import Trajectory

    settings = SlamConfig(seed=seed).override(PLAIN if name == "plain" else {})
    model = out / "model.onnx" if name == "masks" else None
    sequence, folder = out / "sequence", out / "slam" / name
    if model is None:
        return run_slam(sequence, folder, settings=settings)

    camera = load_camera(sequence / "camera.yaml")
    animation = RunAnimation(out / "demo.webp", OrbExtractor(camera, settings.features))
    metrics = run_slam(sequence, folder, model=model, settings=settings, observers=[animation])
    animation.write(
        Trajectory.load_tum(folder / "trajectory.txt"),
        Trajectory.load_tum(sequence / "groundtruth.txt"),
        baseline=Trajectory.load_tum(out / "slam" / "plain" / "trajectory.txt"),
    )
    return metrics


def _processes() -> ProcessPoolExecutor:
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(2, spawn, initializer=_use_one_thread)


def _use_one_thread() -> None:
    """Limit a new process before numpy is loaded: threads of two processes block each other."""
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    import cv2

    cv2.setNumThreads(1)
