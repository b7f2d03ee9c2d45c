"""Datasets of labelled RGB-D frames, read one frame at a time."""

from training.readers.bop import BOP
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrame
from training.readers.ocid import OCID
from training.readers.uwis import UWISOccluded

__all__ = ["BOP", "OCID", "FrameFolder", "LabelledFrame", "UWISOccluded"]
