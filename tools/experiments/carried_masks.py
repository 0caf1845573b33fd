#!/usr/bin/env python3
"""Score masks propagated by flow and depth against the true masks of later frames.

    tools/experiments/carried_masks.py --sequences SEQUENCE ... --out OUT [--steps 1 3 6 10]

Every --every-th frame's mask, of the TUM-format sequence's folder `masks`, is propagated to those
that follow, where it shows a person.
OUT/carried_masks.md has the means, OUT/carried_masks.json the same: IoU, share of the people's
pixels that are covered, share of all others that are.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from cohdc_train.errors import CohdcError, DataError
from cohdc_train.files import write_json, write_text
from cohdc_train.slam.config import MaskConfig
from cohdc_train.slam.dynamics.mask_propagation import (
    HalfResFrame,
    MaskPropagator,
    downsample,
    downsample_mask,
)
from cohdc_train.slam.dynamics.mask_sources import MaskFolder
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.io.sources import RecordedSequence
from cohdc_train.types import Mask


def halves(folder: Path) -> list[tuple[HalfResFrame, Mask]]:
    """Return all frames of a sequence at half size, with their true masks.

    Raises:
        DataError: a file cannot be used.
    """
    camera = choose_camera(folder, None)[0]
    masks = MaskFolder(folder / "masks", camera, MaskConfig())
    return [
        (downsample(view.rgb, view.depth), downsample_mask(masks.segment(view)[0]))
        for view in RecordedSequence(folder, camera)
    ]


def carried_on(frames: list[tuple[HalfResFrame, Mask]]) -> list[Mask]:
    """Propagate the first frame's mask to each of the others."""
    propagation = MaskPropagator()
    first, mask = frames[0]
    propagation.update(mask, propagation.advance(first), first)
    masks = []
    for frame, _ in frames[1:]:
        propagation.advance(frame)
        carried = propagation.mask()
        assert carried is not None
        masks.append(carried)
    return masks


def overlap(mask: Mask, truth: Mask) -> tuple[float, float, float]:
    """IoU, share of the truth that is covered, share of the rest that is."""
    both, either, people = (np.count_nonzero(part) for part in (mask & truth, mask | truth, truth))
    return (
        both / max(either, 1),
        both / max(people, 1),
        (either - people) / max(truth.size - people, 1),
    )


def measured(folder: Path, steps: list[int], every: int) -> list[dict[str, Any]]:
    """Return a row for each step. Raises DataError where no mask can be propagated that far."""
    frames, last = halves(folder), max(steps)
    starts = [start for start in range(0, len(frames) - last, every) if frames[start][1].any()]
    if not starts:
        raise DataError(
            f"{folder}: of {len(frames)} frames none with anybody in it has {last} after it"
        )
    found = []
    for start in starts:
        masks = carried_on(frames[start : start + last + 1])
        found.append([overlap(masks[step - 1], frames[start + step][1]) for step in steps])
    means, names = np.mean(found, axis=0), ("iou", "covered", "others")
    return [
        {"sequence": folder.name, "frames": step, **dict(zip(names, row.tolist(), strict=True))}
        for step, row in zip(steps, means, strict=True)
    ]


def main() -> None:
    """Run, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequences", type=Path, nargs="+", required=True, metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[1, 3, 6, 10], help="frames, 1 or more"
    )
    parser.add_argument("--every", type=int, default=4, help="frames from one start to the next")
    arguments = parser.parse_args()
    if min(*arguments.steps, arguments.every) < 1:
        raise SystemExit(
            f"--steps and --every must be 1 or more, not {min(*arguments.steps, arguments.every)}"
        )
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows, lines = (
        [],
        ["| sequence | frames | IoU | people covered | others covered |", "|---|---|---|---|---|"],
    )
    for folder in arguments.sequences:
        try:
            rows += measured(folder, arguments.steps, arguments.every)
        except CohdcError as failure:
            raise SystemExit(str(failure)) from None
        for row in rows[-len(arguments.steps) :]:
            figures = " | ".join(f"{row[name]:.3f}" for name in ("iou", "covered", "others"))
            lines.append(f"| {row['sequence']} | {row['frames']} | {figures} |")
            print(lines[-1], flush=True)
        write_json(arguments.out / "carried_masks.json", rows)
        write_text(arguments.out / "carried_masks.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
