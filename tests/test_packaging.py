"""Packaging: the built wheel in a clean environment, and the Dockerfiles."""

import json
import os
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from tool_loader import load_tool

from cohdc_train.trajectory.trajectory import Trajectory

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILES = sorted((ROOT / "docker").glob("*.Dockerfile"))


def draw_sequence(folder: Path, frames: int = 12) -> None:
    """Write a TUM folder of a camera that glides past a textured wall 2 m away, 3 cm a frame."""
    size, focal, depth_m, step = (240, 320), 260.0, 2.0, 0.03
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 256, (240, 480), np.uint8), (0, 0), 1.5)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for index in range(frames):
        poses[index, 0, 3] = index * step
        shift = focal * index * step / depth_m
        view = cv2.warpAffine(wall, np.array([[1, 0, -shift], [0, 1, 0]], float), size[::-1])
        images = {
            "rgb": cv2.cvtColor(view, cv2.COLOR_GRAY2BGR),
            "depth": np.full(size, 5000 * depth_m, np.uint16),
        }
        for kind, image in images.items():
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{index / 30:.6f}.png"), image)
            lists[kind].append(f"{index / 30:.6f} {kind}/{index / 30:.6f}.png")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    camera = {
        "fx": focal,
        "fy": focal,
        "cx": 159.5,
        "cy": 119.5,
        "width": 320,
        "height": 240,
        "depth_scale": 5000,
    }
    (folder / "camera.yaml").write_text(json.dumps(camera))  # JSON is YAML
    Trajectory(np.arange(frames) / 30, poses).save_tum(folder / "groundtruth.txt")


class Clean:
    """Fresh environment, used from a folder outside the repository."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        venv.create(folder / "venv", with_pip=True)
        self.bin = folder / "venv" / "bin"
        (folder / "elsewhere").mkdir()

    def run(self, *command: str, expect: int = 0) -> str:
        kept = {
            key: value
            for key, value in os.environ.items()
            if key not in ("PYTHONPATH", "VIRTUAL_ENV")
        }
        done = subprocess.run(
            [str(self.bin / command[0]), *command[1:]],
            cwd=self.folder / "elsewhere",
            env={**kept, "PATH": f"{self.bin}{os.pathsep}{os.environ['PATH']}"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == expect, done.stdout[-2000:] + done.stderr[-4000:]
        return done.stdout + done.stderr


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Clean:
    folder = tmp_path_factory.mktemp("wheel")
    # The source distribution first, and the wheel from it: both hold everything, or this fails.
    build = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("cohdc_train-*.whl")
    environment = Clean(folder)
    environment.run(
        "python", "-m", "pip", "install", "-q", "-c", str(ROOT / "constraints.txt"), str(wheel)
    )
    return environment


@pytest.mark.slow
def test_wheel_runs_outside_the_repository_without_torch(clean: Clean) -> None:
    assert "evaluate" in clean.run("cohdc", "--help")
    code = (
        "import cohdc_train, importlib.util as u; print(cohdc_train.__file__, u.find_spec('torch'))"
    )
    where, torch = clean.run("python", "-c", code).split()
    assert Path(where).is_relative_to(clean.folder)
    assert torch == "None"
    assert "no problem found" in clean.run("cohdc", "env")
    assert "{networks,tum,table3}" in clean.run("cohdc", "bench", "--help")
    message = clean.run("cohdc", "bench", "tum", ".", "--out", "never", expect=1)
    assert message == "cohdc bench: .: no folder with rgb.txt, depth.txt and groundtruth.txt\n"


@pytest.mark.slow
def test_wheel_holds_the_configurations(clean: Clean) -> None:
    names = [
        str(path.relative_to(ROOT / "configs"))
        for path in sorted((ROOT / "configs").rglob("*.yaml"))
    ]
    assert {"slam/freiburg1.yaml", "table3/test10.yaml"} <= set(names)
    show = "print(config_path(name).read_text(), end='')"
    code = f"from cohdc_train.presets import config_path\nfor name in {names}: {show}"
    assert clean.run("python", "-c", code) == "".join(
        (ROOT / "configs" / name).read_text() for name in names
    )


@pytest.mark.slow
def test_wheel_holds_every_file_of_the_package(clean: Clean) -> None:
    (wheel,) = clean.folder.glob("cohdc_train-*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    package = [path for path in (ROOT / "cohdc_train").rglob("*") if path.is_file()]
    wanted = {str(p.relative_to(ROOT)) for p in package if "__pycache__" not in p.parts}
    assert {"cohdc_train/shipped/person.onnx", "cohdc_train/py.typed"} <= wanted
    assert wanted - held == set()


@pytest.mark.slow
def test_wheel_detects_with_a_shipped_network_in_an_empty_folder(clean: Clean) -> None:
    elsewhere = clean.folder / "elsewhere"
    cv2.imwrite(str(elsewhere / "wall.png"), np.full((120, 160, 3), 90, np.uint8))
    clean.run("cohdc", "predict", "wall.png", "--model", "person", "--out", "detected")
    found = json.loads((elsewhere / "detected" / "predictions.json").read_text())
    assert [category["name"] for category in found["categories"]] == ["person"]
    assert "--settings.seed" in clean.run("cohdc", "slam", "--help")


@pytest.mark.slow
def test_source_distribution_holds_what_the_tests_need(clean: Clean) -> None:
    (sdist,) = clean.folder.glob("cohdc_train-*.tar.gz")
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"docs/conf.py", "tests/test_docs.py", "configs/person.yaml", "docker/compose.yaml"}
    assert wanted <= held
    assert not [name for name in held if name.startswith("docs/_build")]


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", ["fit", "validate", "demo", "data", "synth sequence folder", "export run.ckpt"]
)
def test_wheel_names_the_missing_extra(clean: Clean, command: str) -> None:
    (clean.folder / "elsewhere" / "run.ckpt").touch()
    said = clean.run("cohdc", *command.split(), expect=1)
    assert "which is not installed: pip install 'cohdc-train[train]'" in said.splitlines()[-1]
    assert "Traceback" not in said


@pytest.mark.slow
def test_wheel_tracks_and_scores_a_sequence(clean: Clean) -> None:
    elsewhere = clean.folder / "elsewhere"
    draw_sequence(elsewhere / "wall")
    clean.run("cohdc", "slam", "wall", "--out", "run")
    metrics = json.loads((elsewhere / "run" / "metrics.json").read_text())
    assert metrics["coverage"] == 1.0
    assert metrics["ate_m"]["rmse"] < 0.01
    clean.run(
        "cohdc", "evaluate", "wall/groundtruth.txt", "run/trajectory.txt", "--out", "scores.json"
    )
    scores = json.loads((elsewhere / "scores.json").read_text())
    assert scores["ate_m"] == pytest.approx(
        metrics["ate_m"], abs=1e-9
    )  # of what the file rounds, m
    assert scores["pairs"] == 12


# ---- Dockerfiles


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.stem)
def test_dockerfile_copies_what_exists_and_pins(dockerfile: Path) -> None:
    steps = load_tool("../.ci/check_docker").instructions(dockerfile)
    copied = [
        name
        for instruction, argument in steps
        if instruction == "COPY"
        for name in argument.split()[:-1]
    ]
    assert copied
    assert [name for name in copied if not (ROOT / name).exists()] == []
    installs = [
        argument
        for instruction, argument in steps
        if instruction == "RUN" and "pip install" in argument
    ]
    assert installs
    assert all("-c constraints.txt" in argument for argument in installs)
    assert any("[train]" in argument for argument in installs) == ("train" in dockerfile.stem)


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.stem)
def test_dockerfile_ends_as_a_user_without_root_rights(dockerfile: Path) -> None:
    steps = load_tool("../.ci/check_docker").instructions(dockerfile)
    users = [argument for instruction, argument in steps if instruction == "USER"]
    assert users == ["cohdc"]
    assert ("FROM", "python:3.11-slim") in steps


def test_docker_context_holds_what_the_files_copy_and_no_more() -> None:
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    allowed = {line[1:] for line in lines if line.startswith("!")}
    copied = set()
    for dockerfile in DOCKERFILES:
        for instruction, argument in load_tool("../.ci/check_docker").instructions(dockerfile):
            copied |= set(argument.split()[:-1]) if instruction == "COPY" else set()
    assert "*" in lines
    assert copied == allowed


def test_compose_file_names_the_dockerfiles() -> None:
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
    built = {Path(service["build"]["dockerfile"]).name for service in services.values()}
    assert built == {path.name for path in DOCKERFILES}


@pytest.mark.slow
def test_base_installation_has_wheels_for_aarch64(tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    platforms = ("manylinux2014_aarch64", "manylinux_2_27_aarch64", "manylinux_2_28_aarch64")
    install = [sys.executable, "-m", "pip", "install", "--dry-run", "-q", "--ignore-installed"]
    install += ["--target", str(tmp_path), "--only-binary=:all:", "--python-version", "3.11"]
    install += [f"--platform={platform}" for platform in platforms]
    install += ["-c", str(ROOT / "constraints.txt"), *project["dependencies"]]
    done = subprocess.run(install, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def test_checker_follows_a_dockerfile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool = load_tool("../.ci/check_docker")
    monkeypatch.setattr(tool, "ROOT", tmp_path)
    monkeypatch.setattr(tool.venv, "create", lambda folder, with_pip: None)
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "a.txt").write_text("inside")
    (tmp_path / "b.txt").write_text("beside")
    file = tmp_path / "Dockerfile"
    file.write_text(
        "# comment\nFROM x\nCOPY b.txt ./\nCOPY room room\nENV WORD=said\n"
        "RUN apt-get update \\\n && false\n"
        "RUN cat room/a.txt \\\n  b.txt > both && echo $WORD >> both\n"
    )
    (tmp_path / "build").mkdir()
    assert tool.follow(file, tmp_path / "build")["WORD"] == "said"
    assert (tmp_path / "build" / "image" / "both").read_text() == "insidebesidesaid\n"
    file.write_text("FROM x\nRUN false\n")
    (tmp_path / "again").mkdir()
    with pytest.raises(subprocess.CalledProcessError):
        tool.follow(file, tmp_path / "again")


@pytest.mark.slow
def test_slam_dockerfile_installs_in_a_clean_environment() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "check_docker"), "slam"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
