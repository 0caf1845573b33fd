#!/usr/bin/env python3
"""Ablations of the network: HDC's rates, and the CQE head's fusions, targets and uses.

    tools/experiments/ablations.py hdc --data ROOT [ROOT ...] --out DIR [--seeds 0 1 2] [--jobs 2]
        [-- OPTIONS OF cohdc fit]
    tools/experiments/ablations.py cqe --data ROOT [ROOT ...] --out DIR ...

The first ROOT's val split is scored. Every variant has the same data, seeds and budget. Writes
STUDY.md and STUDY.json to DIR; a second call goes on where the first was stopped.
"""

import argparse
import json
import sys
from pathlib import Path

from cohdc_train.bench.training import TrainingJob, format_mean, markdown_table, run_jobs
from cohdc_train.errors import CohdcError

RATES = {
    "(1, 1, 1)": "[1]",
    "(1, 2, 3)": "[1,2,3]",
    "(1, 2, 5)": "[1,2,5]",
}  # of the two deep stages
HDC = {
    name: (
        f"--model.network.rates=[[1],[1],{rates},{rates}]",
    )  # the stages nearest to ImageNet's features keep theirs
    for name, rates in RATES.items()
}
CQE = {
    "off": ("--model.network.cqe=off",),
    "concat, iou": ("--model.network.cqe=concat",),
    "multiply, iou": ("--model.network.cqe=multiply",),
    "add, iou": ("--model.network.cqe=add",),
    "concat, ciou": ("--model.network.cqe_target=ciou",),
    "concat, boundary_iou": ("--model.network.cqe_target=boundary_iou",),
    "concat, min": ("--model.network.cqe_target=min",),
}
PLAIN = {"by score": ("--rescore=false",)}
USES = {
    **PLAIN,
    "rescored": ("--rescore=true",),
    "filter .9": ("--rescore=false", "--min_quality=0.9"),
    "both": ("--rescore=true", "--min_quality=0.9"),
}
SCORES = (
    "segm_AP",
    "segm_AP50",
    "boundary_AP",
    "box_AP",
    "S90_matched",
    "S90_all",
    "quality_spearman",
    "quality_error",
)


def main() -> None:
    """Train, score, print."""
    own, _, fit = " ".join(sys.argv[1:]).partition(" -- ")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=["hdc", "cqe"])
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args(own.split())
    variants = HDC if arguments.study == "hdc" else CQE
    runs = {
        (name, seed): TrainingJob(
            arguments.out
            / f"{arguments.study}_{name}_seed{seed}".replace(" ", "").replace(",", "-"),
            tuple(root.resolve() for root in arguments.data),
            (*options, f"--seed_everything={seed}", *fit.split()),
            PLAIN if arguments.study == "hdc" or name == "off" else USES,
        )
        for seed in arguments.seeds
        for name, options in variants.items()
    }
    try:
        results = dict(zip(runs, run_jobs(list(runs.values()), arguments.jobs), strict=True))
    except CohdcError as error:
        raise SystemExit(str(error)) from None
    rows, kept = [], []
    for name in variants:
        for use in results[name, arguments.seeds[0]]:
            scores = [results[name, seed][use] for seed in arguments.seeds]
            kept += [
                {"variant": name, "use": use, "seed": s, **r}
                for s, r in zip(arguments.seeds, scores, strict=True)
            ]
            rows.append(
                [name, use, *(format_mean([one[score] for one in scores]) for score in SCORES)]
            )
    text = markdown_table(["variant", "masks ranked", *SCORES], rows)
    (arguments.out / f"{arguments.study}.md").write_text(text)
    (arguments.out / f"{arguments.study}.json").write_text(json.dumps(kept, indent=2) + "\n")
    print(text)


if __name__ == "__main__":
    main()
