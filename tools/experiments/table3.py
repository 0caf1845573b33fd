#!/usr/bin/env python3
"""The paper's Table 3, any set of its columns, at a stated scale: measured scores beside the
paper's.

    tools/experiments/table3.py --data ROOT --out DIR [--tests 1 2 7 8 9 10] [--seeds 0 1 2]
        [--epochs 0.05] [--side 0.25] [--jobs 2]

--epochs and --side scale the columns' epochs and image sides (anchors with them); the columns'
image counts are scaled so that the largest, 1014 + 180, becomes all there is. What follows `--`
goes to every `cohdc fit`, such as a smaller network. Writes table3.md and table3.json to DIR; a
second call goes on where the first was stopped.
"""

import argparse
import json
import sys
from pathlib import Path

import yaml
from training_runs import ROOT, Run, run_all, spread, table

# Paper, Table 3: mIoU, mAP (IoU > 0.5), mAP (IoU > 0.7) of each test.
PAPER = {
    1: (0.485, 0.569, 0.472),
    2: (0.492, 0.586, 0.488),
    3: (0.535, 0.495, 0.406),
    4: (0.498, 0.565, 0.485),
    5: (0.294, 0.395, 0.289),
    6: (0.545, 0.558, 0.489),
    7: (0.565, 0.573, 0.493),
    8: (0.652, 0.716, 0.575),
    9: (0.429, 0.345, 0.294),
    10: (0.684, 0.725, 0.585),
}
SCORES = ("mIoU", "segm_AP50", "segm_AP70")
LARGEST = {"train": 1014, "val": 180}


def options_of(test: int, arguments: argparse.Namespace, images: dict[str, int]) -> tuple[str, ...]:
    """A column's options of `cohdc fit`, scaled."""
    config = yaml.safe_load((ROOT / f"configs/table3/test{test:02}.yaml").read_text())
    canvas = [round(side * arguments.side) for side in config["data"]["canvas"]]
    anchors = [
        max(1, round(side * arguments.side)) for side in config["model"]["network"]["anchor_scales"]
    ]
    subset = {
        name: max(1, round(count * images[name] / LARGEST[name]))
        for name, count in config["data"]["subset"].items()
    }
    scaled = [
        f"--config={ROOT / f'configs/table3/test{test:02}.yaml'}",
        f"--data.canvas={canvas}",
        f"--data.subset={json.dumps(subset)}",
        f"--model.network.anchor_scales={anchors}",
        f"--trainer.max_epochs={max(1, round(config['trainer']['max_epochs'] * arguments.epochs))}",
    ]
    if "weights" in config["model"]["network"] and arguments.weights:
        scaled.append(f"--model.network.weights={arguments.weights}")
    return (*scaled, *arguments.fit)


def main() -> None:
    """Train, score, print."""
    own, _, fit = " ".join(sys.argv[1:]).partition(" -- ")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tests", type=int, nargs="+", choices=PAPER, default=list(PAPER))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--epochs", type=float, default=1.0)
    parser.add_argument("--side", type=float, default=1.0)
    parser.add_argument(
        "--weights", help="local file in the place of the pre-trained columns' published weights"
    )
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args(own.split(), argparse.Namespace(fit=fit.split()))
    images = {
        name: len(json.loads((arguments.data / f"instances_{name}.json").read_text())["images"])
        for name in LARGEST
    }
    runs = {
        (test, seed): Run(
            arguments.out / f"test{test:02}_seed{seed}",
            (arguments.data.resolve(),),
            (*options_of(test, arguments, images), f"--seed_everything={seed}"),
        )
        for seed in arguments.seeds
        for test in arguments.tests
    }
    results = dict(zip(runs, run_all(list(runs.values()), arguments.jobs), strict=True))
    rows, kept = [], []
    for test in arguments.tests:
        of_test = [results[test, seed]["plain"] for seed in arguments.seeds]
        kept += [
            {"test": test, "seed": s, **r} for s, r in zip(arguments.seeds, of_test, strict=True)
        ]
        measured = [spread([scores[name] for scores in of_test]) for name in SCORES]
        rows.append([f"Test {test}", *measured, *(f"{value:.3f}" for value in PAPER[test])])
    names = ("mIoU", "mAP@.5", "mAP@.7")
    text = table(["", *(f"measured {n}" for n in names), *(f"paper {n}" for n in names)], rows)
    (arguments.out / "table3.md").write_text(text)
    (arguments.out / "table3.json").write_text(json.dumps(kept, indent=2) + "\n")
    print(text)


if __name__ == "__main__":
    main()
