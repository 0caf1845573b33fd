"""tools/experiments/golden.py: which results count as equal, and which as different."""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from tool_loader import load_tool

Folders = tuple[Path, Path]  # of BASE and of HEAD


@pytest.fixture(scope="module")
def compare() -> ModuleType:
    return load_tool("experiments/golden_compare.py")


@pytest.fixture
def folders(tmp_path: Path) -> Folders:
    """Write two runs that differ in times and version only."""
    for name, seconds in (("base", 1.25), ("head", 9.75)):
        write_run(tmp_path / name, seconds)
    return tmp_path / "base", tmp_path / "head"


def write_run(folder: Path, seconds: float) -> None:
    """Write a toy run whose times and version depend on `seconds`, and its results do not."""
    (folder / "out" / "pictures").mkdir(parents=True)
    (folder / "out" / "trajectory.txt").write_text("1.0 0 0 0 0 0 0 1\n")
    (folder / "out" / "map.png").write_bytes(b"\x89PNG")
    rows = f"stamp,inliers,track_ms,map_ms\n1.0,77,{seconds},{2 * seconds}\n"
    (folder / "out" / "frames.csv").write_text(rows)
    losses = f"step,speed/images_per_s,train/loss\n0,{seconds},2.5\n"
    (folder / "out" / "metrics.csv").write_text(losses)
    scores = {"frames": 1, "fps": 1 / seconds, "ms": {"track": {"p50": seconds}}}
    nested = {"ate_m": {"rmse": 0.01}, "segmenter_ms": {"p50": seconds}}
    (folder / "out" / "metrics.json").write_text(json.dumps(scores | nested))
    parity = {"seconds": seconds, "version": str(seconds), "max_difference": {"boxes": 1e-5}}
    (folder / "out" / "model.onnx.json").write_text(json.dumps(parity))
    (folder / "out" / "config.yaml").write_text(f"out: {folder}\n")
    (folder / "out" / "pictures" / "1.0_after.jpg").write_text(str(seconds))
    (folder / "golden.log").write_text(str(seconds))


def test_times_versions_logs_and_configs_are_ignored(compare: ModuleType, folders: Folders) -> None:
    comparison = compare.compare_folders(*folders)
    assert comparison.different == []
    assert comparison.num_files == 6
    assert comparison.digest == compare.compare_folders(folders[1], folders[0]).digest


def test_drawn_images_are_compared_only_on_request(compare: ModuleType, folders: Folders) -> None:
    comparison = compare.compare_folders(*folders, with_images=True)
    assert comparison.different == ["out/pictures/1.0_after.jpg"]


def replaced(old: str, new: str) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return edit


@pytest.mark.parametrize(
    ("name", "edit"),
    [
        ("trajectory.txt", replaced("1.0 0", "1.0 1")),
        ("map.png", lambda path: path.write_bytes(b"\x89PNg")),
        ("frames.csv", replaced("77", "78")),
        ("frames.csv", replaced("inliers", "num_inliers")),
        ("metrics.csv", replaced("2.5", "2.500001")),
        ("metrics.json", replaced("0.01", "0.010000000000000002")),
        ("metrics.json", replaced('"frames"', '"num_frames"')),
        ("model.onnx.json", replaced("1e-05", "1.1e-05")),
    ],
)
def test_a_changed_result_is_found(
    compare: ModuleType, folders: Folders, name: str, edit: Callable[[Path], None]
) -> None:
    before = compare.compare_folders(*folders).digest
    edit(folders[1] / "out" / name)
    assert compare.compare_folders(*folders).different == [f"out/{name}"]
    assert compare.compare_folders(folders[1], folders[0]).digest != before


def test_a_missing_and_an_added_file_are_found(compare: ModuleType, folders: Folders) -> None:
    (folders[1] / "out" / "map.png").rename(folders[1] / "out" / "top_view.png")
    different = compare.compare_folders(*folders).different
    assert different == ["out/map.png (missing in HEAD)", "out/top_view.png (only in HEAD)"]


def test_weights_of_checkpoints_are_compared(compare: ModuleType, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    contents = {"base": 1.0, "head": 1.0, "other": 1.0 + 2**-23}
    for index, (name, value) in enumerate(contents.items()):
        (tmp_path / name).mkdir()
        weights = {"bias": torch.tensor([value]), "steps": torch.tensor(3)}
        checkpoint = {"state_dict": weights, "hyper_parameters": {"lr": 0.1}, "loops": index}
        torch.save(checkpoint, tmp_path / name / "last.ckpt")
    base = tmp_path / "base"
    assert compare.compare_folders(base, tmp_path / "head").different == []
    assert compare.compare_folders(base, tmp_path / "other").different == ["last.ckpt"]


def test_options_get_the_names_that_the_checkout_knows() -> None:
    checkout = load_tool("experiments/golden_checkout.py")
    command = ["slam", "--cloud", "true", "--features", "800", "--seed", "0"]
    old = "usage: cohdc slam [--cloud [{true,false}]]\n  --features FEATURES  --seed SEED"
    new = "--dense_cloud DENSE_CLOUD --settings.features.max_keypoints N --seed SEED"
    assert checkout.translate(command, old) == command
    renamed = ["--dense_cloud", "true", "--settings.features.max_keypoints", "800"]
    assert checkout.translate(command, new) == ["slam", *renamed, "--seed", "0"]
    assert checkout.translate(["fit", "--pictures=false"], "--figures F") == [
        *("fit", "--figures=false")
    ]
    newest = new.replace("--seed", "--settings.seed")
    command = ["slam", "--sequence", "walk", *command[1:]]
    translated = ["slam", "walk", *renamed, "--settings.seed", "0"]
    assert checkout.translate(command, newest) == translated


def test_a_class_is_found_where_the_checkout_has_it() -> None:
    flow = load_tool("experiments/golden_flow.py")
    assert flow.first_of("json.no_such_module:dumps", "json:no_name", "json:dumps") is json.dumps
    with pytest.raises(ImportError, match="none of json:no_name"):
        flow.first_of("json:no_name")
