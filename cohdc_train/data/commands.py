"""Verbs of `cohdc data` (no torch)."""

from cohdc_train.data.convert import convert
from cohdc_train.data.doctor.doctor import doctor, stats
from cohdc_train.data.tum_download import tum

COMMANDS = {"stats": stats, "doctor": doctor, "convert": convert, "tum": tum}
