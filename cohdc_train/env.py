"""`cohdc env`: installed versions, what cannot work with them, and the command that fixes it."""

import os
import platform
import subprocess
import sys
from importlib import metadata
from typing import NamedTuple

from cohdc_train.errors import CohdcError

BASE = (
    "numpy",
    "opencv-python-headless",
    "onnxruntime",
    "jsonargparse",
    "pyyaml",
    "scipy",
    "threadpoolctl",
    "matplotlib",
    "pillow",
    "jinja2",
)
TRAIN = (
    "torch",
    "torchvision",
    "lightning",
    "pycocotools",
    "faster-coco-eval",
    "onnx",
    "onnxscript",
    "onnxslim",
    "kornia",
    "rich",
    "tensorboard",
    "embreex",
    "shapely",
)
MALICIOUS = {"lightning": ("2.6.2", "2.6.3")}  # GHSA-w37p-236h-pfx3

# Each probe runs in a process of its own. torchvision's operators only load when they were built
# for the torch that is installed.
_TORCH_PROBE = """
import torch
cuda = "CUDA," if torch.cuda.is_available() else "CUDA; CPU only,"
print("torch devices:", torch.cuda.device_count(), cuda, "built for", torch.version.cuda or "CPU")
import torchvision
torchvision.ops.nms(torch.zeros(1, 4), torch.zeros(1), 0.5)
"""
_CV2_PROBE = "import cv2; cv2.setNumThreads(1)"
_ORT_PROBE = """
import onnxruntime
print("onnxruntime providers:", ", ".join(onnxruntime.get_available_providers()))
"""
_PROBES = {
    "opencv-python-headless": _CV2_PROBE,
    "onnxruntime": _ORT_PROBE,
    "torch": _TORCH_PROBE,
}
_REINSTALL = "pip install --force-reinstall"

Versions = dict[str, str | None]


class Problem(NamedTuple):
    """Something installed that cannot work.

    Attributes:
        description: one line.
        fix: the command that fixes it.
    """

    description: str
    fix: str


def env() -> None:
    """Print the versions of all packages that matter, and what is wrong with them.

    An absent extra is mentioned and is no problem.

    Raises:
        CohdcError: something installed cannot work.
    """
    system = f"{platform.system()} {platform.machine()}"
    print(f"python      {platform.python_version()} ({system}), {_num_cpus()} CPUs")
    versions = {name: _version(name) for name in ("cohdc-train", *BASE, *TRAIN)}
    for name, version in versions.items():
        print(f"{name:<24}{version or 'absent'}")
    if missing := [name for name in TRAIN if versions[name] is None]:
        state = "is absent" if len(missing) == len(TRAIN) else f"lacks {', '.join(missing)}"
        print(
            f"the train extra {state} (slam, predict and evaluate need none of it): "
            "pip install 'cohdc-train[train]'"
        )
    lines, problems = find_problems(versions)
    for line in lines:
        print(line)
    for problem in problems:
        print(f"PROBLEM {problem.description}\n        fix: {problem.fix}")
    if problems:
        first = problems[0]
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise CohdcError(f"{first.description}; fix: {first.fix}{more}")
    print("no problem found")


def find_problems(versions: Versions) -> tuple[list[str], list[Problem]]:
    """Load the packages that break most often, each in a process of its own.

    Args:
        versions: package -> version, None where it is absent.

    Returns:
        The lines that the packages print about themselves, and the problems.
    """
    problems = [*_malicious(versions), *_absent(versions), *_two_opencvs(versions)]
    lines: list[str] = []
    for name, code in _PROBES.items():
        if versions.get(name):
            printed, error = _probe(code)
            lines += printed
            if error:
                problems.append(_describe(name, error, versions))
    return lines, problems


def _malicious(versions: Versions) -> list[Problem]:
    return [
        Problem(f"{name} {versions[name]} was a malicious release", f"{_REINSTALL} '{name}!={bad}'")
        for name, releases in MALICIOUS.items()
        for bad in releases
        if versions.get(name) == bad
    ]


def _absent(versions: Versions) -> list[Problem]:
    absent = " ".join(name for name in BASE if not versions.get(name))
    return [Problem(f"{absent} absent", f"pip install {absent}")] if absent else []


def _two_opencvs(versions: Versions) -> list[Problem]:
    if not versions.get("opencv-python-headless") or not _version("opencv-python"):
        return []
    both = "opencv-python opencv-python-headless"
    fix = f"pip uninstall -y {both} && pip install opencv-python-headless"
    return [Problem("opencv-python and opencv-python-headless overwrite each other's files", fix)]


def _describe(name: str, error: str, versions: Versions) -> Problem:
    """Describe why a package does not load."""
    if name != "torch":
        return Problem(f"{name} does not load: {error}", f"{_REINSTALL} {name}")
    fix = f"{_REINSTALL} torch torchvision"
    if "torchvision" not in error:
        return Problem(f"torch does not load: {error}", fix)
    pair = f"torch {versions['torch']} and torchvision {versions.get('torchvision') or '(absent)'}"
    return Problem(f"{pair} do not match: {error}", f"{fix}, both from the index torch came from")


def _probe(code: str) -> tuple[list[str], str]:
    """Run code in a process of its own.

    Returns:
        The lines it printed, and the last line of its error; "" when it succeeded.
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    printed = done.stdout.splitlines()
    if done.returncode == 0:
        return printed, ""
    error = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return printed, error[-1]


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _num_cpus() -> int:
    """Count the CPUs this process may use, which a container or a task set limits."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
