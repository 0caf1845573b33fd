"""Rendered COCO-format sets and TUM-format sequences of people walking in rooms.

Importing the package loads neither torch nor the ray caster.
"""

from cohdc_train.synth.coco import coco
from cohdc_train.synth.compose import compose
from cohdc_train.synth.sequence import sequence

COMMANDS = {"coco": coco, "sequence": sequence, "compose": compose}

__all__ = ["COMMANDS", "coco", "compose", "sequence"]
