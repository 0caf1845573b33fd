"""`cohdc demo`: render, fine-tune, export, and run SLAM in three ways."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from cohdc_train import __version__
from cohdc_train.demo import steps
from cohdc_train.demo.plan import DEFAULT, FULL, QUICK, DemoPlan
from cohdc_train.demo.progress import DemoSteps
from cohdc_train.errors import CohdcError
from cohdc_train.files import write_json


def demo(
    out: Path = Path("runs/demo"), quick: bool = False, full: bool = False, seed: int = 0
) -> dict[str, Any]:
    """Show on rendered data what a fine-tuned segmenter is worth to SLAM.

    Renders photographs of people and an RGB-D sequence in which a person fills the view, scores
    the shipped network, fine-tunes it, exports it, and tracks the sequence in three ways: plain
    RGB-D SLAM, with depth geometry, with masks and geometry. Writes result.png, demo.webp,
    report.html, summary.json, model.onnx, data/, sequence/, train/, and slam/. Nothing is
    downloaded. A second call with the same options keeps the steps that are done.

    Args:
        out: new or empty folder, or the folder of a former demo.
        quick: fewer photographs and a shorter training.
        full: more photographs and ten minutes of training.
        seed: of rendering, training, and SLAM. The sequence is always the same.

    Returns:
        The content of summary.json: mask AP before and after the fine-tuning, and per run the ATE
        (m) and the share of tracked frames.
    """
    if quick and full:
        raise CohdcError("give --quick or --full, not both")
    plan = QUICK if quick else FULL if full else DEFAULT
    request = {"plan": asdict(plan), "seed": seed, "version": __version__}
    run = DemoSteps(out, request, plan.expected_s)
    summary = _run_steps(run, out, plan, seed)
    print(closing_lines(summary, out))
    return summary


def _run_steps(run: DemoSteps, out: Path, plan: DemoPlan, seed: int) -> dict[str, Any]:
    run.run("render", "Render photographs and a sequence", lambda: steps.render(out, plan, seed))
    before = run.run("shipped", "Score the shipped network", lambda: steps.score_shipped(out))
    after = run.run("train", "Fine-tune it", lambda: steps.train(out, plan, seed))
    run.run("export", "Export and verify model.onnx", lambda: steps.export_model(out))
    slam = run.run("slam", "Run SLAM three times", lambda: steps.run_slam_three_times(out, seed))

    summary = {
        "mask_ap": {"shipped": before["segm_AP"], "fine_tuned": after["segm_AP"]},
        "mask_ap50": {"shipped": before["segm_AP50"], "fine_tuned": after["segm_AP50"]},
        "ate_m": {name: slam[name]["ate_m"]["rmse"] for name in steps.RUNS},
        "coverage": {name: slam[name]["coverage"] for name in steps.RUNS},
        "seed": seed,
    }

    def report() -> dict[str, Any]:
        _write_report(out, summary, slam)
        return {}

    run.run("report", "Draw the result", report)
    summary["seconds"] = dict(run.seconds)
    write_json(out / "summary.json", summary)
    return summary


def closing_lines(summary: dict[str, Any], out: Path) -> str:
    """Return what the demo shows, in a sentence and a table."""
    error, coverage = summary["ate_m"], summary["coverage"]
    ratio = error["plain"] / error["masks"]
    gain = summary["mask_ap"]
    rows = [
        f"  {title:<26}{100 * error[name]:>9.1f} cm{coverage[name]:>13.0%}"
        for name, title in steps.RUNS.items()
    ]
    return "\n".join(
        [
            "",
            "With the network's masks the trajectory error is"
            f" {ratio:.0f} times smaller than with plain RGB-D SLAM.",
            "",
            f"  {'':<26}{'error (ATE)':>12}{'tracked':>13}",
            *rows,
            "",
            f"  mask AP on rooms it never saw: {gain['shipped']:.3f} as shipped,"
            f" {gain['fine_tuned']:.3f} fine-tuned",
            f"  time: {sum(summary['seconds'].values()):.0f} s",
            "",
            f"Look at {out / 'result.png'} and {out / 'report.html'}.",
            f"Your own data: cohdc fit DATA; your own recording: cohdc slam FOLDER --model"
            f" {out / 'model.onnx'} --out runs/mine",
        ]
    )


def _write_report(out: Path, summary: dict[str, Any], slam: dict[str, Any]) -> None:
    from cohdc_train.demo.result_image import draw_result
    from cohdc_train.report import Table, write_report

    draw_result(out, slam)
    gain, gain50 = summary["mask_ap"], summary["mask_ap50"]
    rows = [
        ["as shipped", f"{gain['shipped']:.3f}", f"{gain50['shipped']:.3f}"],
        ["fine-tuned", f"{gain['fine_tuned']:.3f}", f"{gain50['fine_tuned']:.3f}"],
    ]
    write_report(
        out / "report.html",
        "cohdc demo",
        out / "sequence" / "groundtruth.txt",
        {title: out / "slam" / name for name, title in steps.RUNS.items()},
        [out / "result.png"],
        [Table("Network on rooms it never saw", ["network", "mask AP", "mask AP50"], rows)],
    )
