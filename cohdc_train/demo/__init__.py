"""`cohdc demo`: from rendered photographs to a trajectory that only masks can save."""

from cohdc_train.demo.command import demo

__all__ = ["demo"]
