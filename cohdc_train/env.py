"""`cohdc env`: what is installed, and what about it cannot work, with the command that mends it."""

import os
import platform
import subprocess
import sys
from importlib import metadata
from typing import NamedTuple

from cohdc_train.errors import CohdcError

BASE = (
    *(
        "numpy",
        "opencv-python-headless",
        "onnxruntime",
        "jsonargparse",
        "pyyaml",
        "scipy",
        "threadpoolctl",
    ),
    *("matplotlib", "pillow"),
)
TRAIN = (
    *(
        "torch",
        "torchvision",
        "lightning",
        "pycocotools",
        "faster-coco-eval",
        "onnx",
        "onnxscript",
        "onnxslim",
    ),
    *("kornia", "rich", "tensorboard", "embreex", "shapely"),
)
MALICIOUS = {"lightning": ("2.6.2", "2.6.3")}  # GHSA-w37p-236h-pfx3

# torchvision's operators only load when they were built for the torch that is there; both stay out
# of our process
_TORCH_PROBE = """
import torch
print("torch devices:", torch.cuda.device_count(), "CUDA," if torch.cuda.is_available() else "CUDA; CPU only,", end=" ")
print("built for", torch.version.cuda or "CPU")
import torchvision
torchvision.ops.nms(torch.zeros(1, 4), torch.zeros(1), 0.5)
"""
_CV2_PROBE = "import cv2; cv2.setNumThreads(1)"
_ORT_PROBE = "import onnxruntime; print('onnxruntime providers:', ', '.join(onnxruntime.get_available_providers()))"


class Fault(NamedTuple):
    """Something that cannot work. what: one line; mend: the command that puts it right."""

    what: str
    mend: str


def env() -> None:
    """Print the versions of everything that matters and what is wrong with them.

    Exits with 1 when something installed cannot work; an extra that is absent is said, and is no
    fault.
    """
    print(
        f"python      {platform.python_version()} ({platform.system()} {platform.machine()}), {_cpus()} CPUs"
    )
    versions = {name: _version(name) for name in ("cohdc-train", *BASE, *TRAIN)}
    for name, version in versions.items():
        print(f"{name:<24}{version or 'absent'}")
    if missing := [name for name in TRAIN if versions[name] is None]:
        lack = "is absent" if len(missing) == len(TRAIN) else f"lacks {', '.join(missing)}"
        print(
            f"the train extra {lack} (slam, predict and evaluate need none of it): pip install 'cohdc-train[train]'"
        )
    lines, faults = inspect(versions)
    for line in lines:
        print(line)
    for fault in faults:
        print(f"FAULT {fault.what}\n      mend: {fault.mend}")
    if faults:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise CohdcError(f"{faults[0].what}; mend: {faults[0].mend}{more}")
    print("no fault found")


def inspect(versions: dict[str, str | None]) -> tuple[list[str], list[Fault]]:
    """What the packages say of themselves, and their faults. versions: name -> version, None where
    absent.
    """
    lines: list[str] = []
    faults = [
        Fault(
            f"{name} {version} was a malicious release",
            f"pip install --force-reinstall '{name}!={version}'",
        )
        for name, bad in MALICIOUS.items()
        if (version := versions.get(name)) in bad
    ]
    faults += _absent_from_base(versions)
    if versions.get("opencv-python-headless") and _version("opencv-python"):
        mend = "pip uninstall -y opencv-python opencv-python-headless && pip install opencv-python-headless"
        faults.append(
            Fault("opencv-python and opencv-python-headless overwrite each other's files", mend)
        )
    probes = [
        ("opencv-python-headless", _CV2_PROBE),
        ("onnxruntime", _ORT_PROBE),
        ("torch", _TORCH_PROBE),
    ]
    for name, code in probes:
        if versions.get(name):
            said, error = _probe(code)
            lines += said
            faults += [_fault(name, error, versions)] if error else []
    return lines, faults


def _absent_from_base(versions: dict[str, str | None]) -> list[Fault]:
    absent = [name for name in BASE if not versions.get(name)]
    return (
        [Fault(f"{' '.join(absent)} absent", f"pip install {' '.join(absent)}")] if absent else []
    )


def _fault(name: str, error: str, versions: dict[str, str | None]) -> Fault:
    if name != "torch":
        return Fault(f"{name} does not load: {error}", f"pip install --force-reinstall {name}")
    if "torchvision" not in error:
        return Fault(
            f"torch does not load: {error}", "pip install --force-reinstall torch torchvision"
        )
    what = f"torch {versions['torch']} and torchvision {versions.get('torchvision') or '(absent)'} are no pair: {error}"
    return Fault(
        what,
        "pip install --force-reinstall torch torchvision, both from the index that torch came from",
    )


def _probe(code: str) -> tuple[list[str], str]:
    """Run code in an interpreter of its own: what it printed, and its error's last line ("" when it
    ended well).
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return done.stdout.splitlines(), ""
    return done.stdout.splitlines(), (
        done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    )[-1]


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _cpus() -> int:
    """CPUs this process may use, which a container or a task set limits."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
