#!/usr/bin/env python3
"""Start weights for ResNet-101 from ResNet-50's: the blocks that both have, and copies.

    tools/experiments/resnet101_start.py RESNET50.pth OUT.pth

ResNet-101 has 17 blocks more in layer3. Each starts as ResNet-50's last block there, its residual
scaled to a tenth, so that the network begins near ResNet-50. These are not ImageNet weights of
ResNet-101, and a table says so.
"""

import sys
from pathlib import Path

import torch

LAST, BLOCKS, SHARE = 5, 23, 0.1


def main() -> None:
    """Read, copy, write."""
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    state = torch.load(Path(sys.argv[1]), map_location="cpu", weights_only=True)
    block = {key: value for key, value in state.items() if key.startswith(f"layer3.{LAST}.")}
    for index in range(LAST + 1, BLOCKS):
        for key, value in block.items():
            name = key.replace(f"layer3.{LAST}.", f"layer3.{index}.")
            state[name] = (
                value * SHARE
                if ".bn3." in name and name.endswith((".weight", ".bias"))
                else value.clone()
            )
    torch.save(state, sys.argv[2])


if __name__ == "__main__":
    main()
