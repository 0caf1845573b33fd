"""Trajectory files and scores: known answers, invariances, agreement with evo."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cohdc_train.errors import DataError
from cohdc_train.trajectory import metrics
from cohdc_train.trajectory.association import associate, match
from cohdc_train.trajectory.evaluate import coverage, evaluate, score
from cohdc_train.trajectory.metrics import (
    align_umeyama,
    all_pairs,
    ate,
    pairs_apart,
    rpe,
    statistics,
)
from cohdc_train.trajectory.trajectory import Trajectory

TUM = Path(__file__).resolve().parents[2] / "shared" / "data" / "tum"
needs_tum = pytest.mark.skipif(not TUM.is_dir(), reason=f"{TUM} is absent")
WALKING = {  # ATE RMSE in meters, from the data's README
    "walking_xyz_a": 0.0144,
    "walking_xyz_b": 0.0159,
    "walking_xyz_c": 0.0202,
    "walking_xyz_d": 0.0325,
    "walking_xyz_e": 0.2476,
    "walking_static_a": 0.0093,
    "walking_rpy_a": 0.0538,
    "walking_rpy_b": 0.3569,
}
SEEDS = st.integers(0, 2**32 - 1)


def rigid(rng: np.random.Generator) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    T[:3, 3] = rng.normal(0, 3, 3)
    return T


def wander(
    rng: np.random.Generator, n: int = 40, rate: float = 10.0, noise: float = 0.0
) -> Trajectory:
    """Make a smooth walk; `noise` disturbs each pose by that many meters and radians."""
    time = np.arange(n) / rate
    phases = np.arange(3)
    poses = np.tile(np.eye(4), (n, 1, 1))
    angles = 0.4 * np.sin(0.7 * time[:, None] + phases) + noise * rng.normal(size=(n, 3))
    poses[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    poses[:, :3, 3] = np.sin(0.9 * time[:, None] + 2 * phases) + noise * rng.normal(size=(n, 3))
    return Trajectory(1000 + time, poses)


# ---- files


def test_written_file_reads_back(tmp_path: Path) -> None:
    trajectory = wander(np.random.default_rng(1))
    trajectory.save_tum(tmp_path / "t.txt")
    back = Trajectory.load_tum(tmp_path / "t.txt")
    assert np.array_equal(back.timestamps, trajectory.timestamps)
    assert np.abs(back.poses - trajectory.poses).max() < 1e-9
    assert [file.name for file in tmp_path.iterdir()] == ["t.txt"]


def test_comments_blank_lines_and_commas_are_read(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text("# a comment\n\n1.0, 1, 2, 3, 0, 0, 0, 2\n  # another\n2.5 4 5 6 0 0 1 0\n")
    trajectory = Trajectory.load_tum(file)
    assert trajectory.timestamps.tolist() == [1.0, 2.5]
    assert np.array_equal(
        trajectory.poses[0], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    )
    assert np.allclose(trajectory.poses[1, :3, :3], np.diag([-1, -1, 1]))


@pytest.mark.parametrize(
    ("text", "place", "fault"),
    [
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", ":2:", "7 numbers"),
        ("1 0 0 0 0 0 0 1\n\n2 x 0 0 0 0 0 1\n", ":3:", "'x'"),
        ("1 0 0 0 0 0 0 0\n", ":1:", "quaternion of length"),
        ("1 0 nan 0 0 0 0 1\n", ":1:", "not finite"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2:", "stamp 1.0 is earlier than 2.0"),
        ("# nothing\n", ":", "no pose"),
    ],
)
def test_bad_file_is_refused_with_its_line(
    tmp_path: Path, text: str, place: str, fault: str
) -> None:
    file = tmp_path / "bad.txt"
    file.write_text(text)
    with pytest.raises(DataError) as error:
        Trajectory.load_tum(file)
    assert str(file) + place in str(error.value)
    assert fault in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"absent\.txt"):
        Trajectory.load_tum(tmp_path / "absent.txt")


def test_repeated_stamps_are_kept_and_said_aloud(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "t.txt"
    file.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    assert len(Trajectory.load_tum(file)) == 3
    assert "1 rows repeat" in caplog.text


def test_wrong_trajectory_is_refused_at_birth() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    for stamps, changed in [
        (np.array([1.0]), poses),
        (np.array([2.0, 1.0]), poses),
        (np.array([1.0, np.nan]), poses),
        (np.array([1.0, 2.0]), 2 * poses),
        (np.array([1.0, 2.0]), poses * np.array([-1, 1, 1, 1])[:, None]),
    ]:
        with pytest.raises(ValueError, match=r"stamp|pose"):
            Trajectory(stamps, changed)


# ---- association


def test_nearest_pairs_are_chosen_first() -> None:
    a, b = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.095, 0.115, 0.19, 0.5])
    assert associate(a, b, 0.02).tolist() == [[1, 0], [2, 2]]
    assert associate(a, b, 0.001).tolist() == []


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_association_is_one_to_one_near_and_increasing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (np.cumsum(rng.uniform(1e-3, 0.1, int(rng.integers(1, 40)))) for _ in range(2))
    pairs = associate(a, b, 0.03)
    assert (np.diff(pairs, axis=0) > 0).all()
    assert (np.abs(a[pairs[:, 0]] - b[pairs[:, 1]]) <= 0.03 + 1e-12).all()
    free_a, free_b = np.delete(a, pairs[:, 0]), np.delete(b, pairs[:, 1])
    assert not (np.abs(free_a[:, None] - free_b) <= 0.03 - 1e-12).any(), (
        "a pair that could be made was not"
    )


def test_repeated_row_is_matched_as_its_stamp() -> None:
    truth = wander(np.random.default_rng(2), n=10)
    estimate = truth.take(np.array([0, 1, 1, 1, 2, 3]))
    matched_truth, matched = match(truth, estimate)
    assert np.array_equal(matched_truth.timestamps, matched.timestamps)
    assert len(matched) == 6


def test_too_few_matches_are_refused() -> None:
    truth = wander(np.random.default_rng(3), n=10)
    late = Trajectory(truth.timestamps + 100, truth.poses)
    with pytest.raises(DataError, match="0 of 10 poses"):
        score(truth, late)


# ---- scores


def test_statistics_of_a_known_list() -> None:
    got = statistics(np.array([1.0, 2.0, 3.0, 6.0]))
    assert got == pytest.approx(
        {
            "rmse": np.sqrt(12.5),
            "mean": 3.0,
            "median": 2.5,
            "std": np.sqrt(3.5),
            "min": 1.0,
            "max": 6.0,
        }
    )


def test_known_ate() -> None:
    corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], float)
    poses, larger = (np.tile(np.eye(4), (4, 1, 1)) for _ in range(2))
    poses[:, :3, 3] = corners
    larger[:, :3, 3] = (
        1.1 * corners
    )  # scale is not aligned away: every corner is off by a tenth of its radius
    errors = ate(Trajectory(np.arange(4.0), poses), Trajectory(np.arange(4.0), larger))
    assert errors == pytest.approx(np.full(4, 0.1 * np.sqrt(2)))


def test_known_drift_is_the_rpe() -> None:
    stamps = np.arange(50) / 10
    still, drifting = (np.tile(np.eye(4), (50, 1, 1)) for _ in range(2))
    still[:, 0, 3] = stamps
    drifting[:, 0, 3] = 1.03 * stamps  # 3 cm a second along the way
    drifting[:, :3, :3] = Rotation.from_euler(
        "x", 2.0 * stamps[:, None], degrees=True
    ).as_matrix()  # 2 deg a second
    scores = score(Trajectory(stamps, still), Trajectory(stamps, drifting))
    assert scores["rpe_1s_m"]["rmse"] == pytest.approx(0.03)
    assert scores["rpe_1s_m"]["std"] == pytest.approx(0, abs=1e-9)
    assert scores["rpe_1s_deg"]["mean"] == pytest.approx(2.0)


def test_all_pairs_are_those_of_tums_tool() -> None:
    rng = np.random.default_rng(5)
    truth, estimate = wander(rng, n=12), wander(rng, n=12, noise=0.05)
    lengths = []
    for i in range(12):
        for j in range(12):
            true_step = np.linalg.inv(truth.poses[i]) @ truth.poses[j]
            step = np.linalg.inv(estimate.poses[i]) @ estimate.poses[j]
            lengths.append(np.linalg.norm((np.linalg.inv(true_step) @ step)[:3, 3]))
    assert score(truth, estimate)["rpe_all_pairs_m"] == pytest.approx(statistics(np.array(lengths)))
    assert min(lengths) == pytest.approx(0), (
        "a pose paired with itself is why that tool prints a minimum of 0"
    )


def test_long_runs_are_sampled_with_a_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "MAX_PAIRS", 20_000)
    n = 150
    rng = np.random.default_rng(6)
    truth, estimate = wander(rng, n=n), wander(rng, n=n, noise=0.02)
    pairs = all_pairs(n)
    assert len(pairs) == 20_000
    assert np.array_equal(pairs, all_pairs(n))
    assert not np.array_equal(pairs, all_pairs(n, seed=1))
    every = np.stack(np.divmod(np.arange(n * n), n), axis=1)
    assert rpe(truth, estimate, pairs)[0].mean() == pytest.approx(
        rpe(truth, estimate, every)[0].mean(), rel=2e-2
    )


def test_pairs_keep_to_one_second() -> None:
    stamps = np.array([0.0, 0.5, 1.02, 1.5, 4.0, 5.2])
    assert pairs_apart(stamps).tolist() == [[0, 2], [1, 3]]


def test_short_run_has_no_rpe_over_a_second() -> None:
    truth = wander(np.random.default_rng(7), n=6)
    assert set(score(truth, truth)) == {"ate_m", "rpe_all_pairs_m"}


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_identical_trajectories_have_no_error(seed: int) -> None:
    truth = wander(np.random.default_rng(seed))
    assert max(row["max"] for row in score(truth, truth).values()) < 1e-6


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_scores_do_not_depend_on_the_world_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, estimate = wander(rng), wander(rng, noise=0.05)
    here, there = (
        score(truth, estimate),
        score(truth.transformed(rigid(rng)), estimate.transformed(rigid(rng))),
    )
    for key, row in here.items():
        assert there[key] == pytest.approx(row, rel=1e-6, abs=1e-9)


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_alignment_recovers_a_rigid_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, T = rng.normal(size=(20, 3)), rigid(rng)
    assert np.allclose(align_umeyama(points, points @ T[:3, :3].T + T[:3, 3]), T, atol=1e-9)


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_no_small_motion_betters_the_alignment(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, estimate = wander(rng), wander(rng, noise=0.1)
    best = np.sqrt(np.mean(ate(truth, estimate) ** 2))
    T = align_umeyama(estimate.positions, truth.positions)
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
    T[:3, 3] += rng.normal(0, 0.01, 3)
    shifted = np.linalg.norm(estimate.transformed(T).positions - truth.positions, axis=1)
    assert np.sqrt(np.mean(shifted**2)) >= best - 1e-12


def test_flat_trajectory_is_not_mirrored() -> None:
    rng = np.random.default_rng(8)
    flat = rng.normal(size=(15, 3)) * [1, 1, 0]
    T = align_umeyama(flat, flat * [-1, 1, 1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert np.allclose(flat @ T[:3, :3].T + T[:3, 3], flat * [-1, 1, 1])


def test_coverage_counts_the_lost_time() -> None:
    truth = wander(np.random.default_rng(9), n=100, rate=100.0)
    assert coverage(truth, truth.take(np.arange(0, 100, 4))) == 1.0
    lost = truth.take(np.r_[0:20, 60:100])
    assert coverage(truth, lost) == pytest.approx(
        (100 - 40 + 5 + 5) / 100, abs=0.011
    )  # 0.05 s on either side count


# ---- the verb


def test_evaluate_prints_and_writes_the_same_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(10)
    truth, estimate = wander(rng), wander(rng, noise=0.02)
    truth.save_tum(tmp_path / "truth.txt")
    estimate.save_tum(tmp_path / "estimate.txt")
    result = evaluate(
        tmp_path / "truth.txt", tmp_path / "estimate.txt", out=tmp_path / "new" / "scores.json"
    )
    stored = json.loads((tmp_path / "new" / "scores.json").read_text())
    names = {"groundtruth": "truth.txt", "estimate": "estimate.txt"}
    assert {key: stored.pop(key) for key in names} == {
        k: str(tmp_path / n) for k, n in names.items()
    }
    assert stored == result
    assert set(stored) == {
        "ate_m",
        "rpe_1s_m",
        "rpe_1s_deg",
        "rpe_all_pairs_m",
        "coverage",
        "pairs",
    }
    assert all(
        set(stored[key]) == {"rmse", "mean", "median", "std", "min", "max"}
        for key in list(stored)[:4]
    )
    assert stored["pairs"] == 40
    printed = capsys.readouterr().out
    assert f"{stored['ate_m']['rmse']:.4f}" in printed
    assert "coverage 100.0 %" in printed


def test_evaluate_names_the_estimate_that_does_not_match(tmp_path: Path) -> None:
    truth = wander(np.random.default_rng(11))
    truth.save_tum(tmp_path / "truth.txt")
    Trajectory(truth.timestamps + 99, truth.poses).save_tum(tmp_path / "late.txt")
    with pytest.raises(DataError, match=r"late\.txt: 0 of 40 poses lie within 0\.02 s"):
        evaluate(tmp_path / "truth.txt", tmp_path / "late.txt")


# ---- real files and evo


@needs_tum
@pytest.mark.parametrize(("name", "expected"), WALKING.items())
def test_stored_walking_estimates(name: str, expected: float) -> None:
    truth = Trajectory.load_tum(TUM / "groundtruth" / f"fr3_{name[:-2]}.txt")
    errors = ate(*match(truth, Trajectory.load_tum(TUM / "trajectories" / f"{name}.txt")))
    assert statistics(errors)["rmse"] == pytest.approx(expected, abs=1e-4)


EVO = """
import json, sys
from evo.core import metrics, sync
from evo.tools import file_interface
result = []
for truth, estimate in zip(sys.argv[2::2], sys.argv[3::2]):
    pair = [file_interface.read_tum_trajectory_file(name) for name in (truth, estimate)]
    truth, estimate = sync.associate_trajectories(*pair, max_diff=0.02)
    row = {}
    angle = metrics.PoseRelation.rotation_angle_deg
    relations = {"m": metrics.PoseRelation.translation_part, "deg": angle}
    step = {"delta": int(sys.argv[1]), "delta_unit": metrics.Unit.frames, "all_pairs": True}
    for unit, relation in relations.items():
        rpe = metrics.RPE(relation, **step)
        rpe.process_data((truth, estimate))
        row["rpe_" + unit] = rpe.get_all_statistics()
    estimate.align(truth)
    ape = metrics.APE(relations["m"])
    ape.process_data((truth, estimate))
    row["ate_m"] = ape.get_all_statistics()
    result.append(row)
print(json.dumps(result))
"""
needs_evo = pytest.mark.skipif(
    importlib.util.find_spec("evo") is None, reason="evo is not installed"
)


def evo_says(home: Path, delta: int, files: list[Path]) -> list[dict[str, dict[str, float]]]:
    """Ask evo, which is GPL and therefore runs in a process of its own."""
    environment = {**os.environ, "HOME": str(home), "MPLBACKEND": "Agg"}
    command = [sys.executable, "-c", EVO, str(delta), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    rows: list[dict[str, dict[str, float]]] = json.loads(done.stdout.splitlines()[-1])
    return rows


@needs_evo
def test_evo_agrees_on_drawn_trajectories(tmp_path: Path) -> None:
    rng = np.random.default_rng(12)
    truth, estimate = wander(rng, n=80), wander(rng, n=80, noise=0.03).transformed(rigid(rng))
    files = [tmp_path / "truth.txt", tmp_path / "estimate.txt"]
    truth.save_tum(files[0])
    estimate.save_tum(files[1])
    (evo,) = evo_says(tmp_path, 10, files)  # 10 frames of 0.1 s are the second
    ours = score(*map(Trajectory.load_tum, files))
    for ours_key, evo_key in [("ate_m", "ate_m"), ("rpe_1s_m", "rpe_m"), ("rpe_1s_deg", "rpe_deg")]:
        assert ours[ours_key] == pytest.approx(
            {name: evo[evo_key][name] for name in ours[ours_key]}, abs=1e-6
        )


@needs_evo
@needs_tum
def test_evo_agrees_on_the_stored_walking_estimates(tmp_path: Path) -> None:
    files = []
    for name in WALKING:
        files += [
            TUM / "groundtruth" / f"fr3_{name[:-2]}.txt",
            TUM / "trajectories" / f"{name}.txt",
        ]
    for (truth, estimate), evo in zip(
        zip(files[::2], files[1::2], strict=True), evo_says(tmp_path, 30, files), strict=True
    ):
        matched = match(Trajectory.load_tum(truth), Trajectory.load_tum(estimate))
        start = np.arange(len(matched[0]) - 30)
        meters, degrees = rpe(*matched, np.stack([start, start + 30], axis=1))
        ours = {"ate_m": ate(*matched), "rpe_m": meters, "rpe_deg": degrees}
        for key, errors in ours.items():
            six = statistics(errors)
            assert six == pytest.approx({name: evo[key][name] for name in six}, abs=1e-6), (
                f"{estimate.name} {key}"
            )
