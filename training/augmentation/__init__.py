"""Varied copies of training views: beyond the paper, off by default, each variation with its own switch.

variations = Variations(illumination=Illumination(), occlusion=Occlusion())
varied = vary(render_view(caster, pose), variations, np.random.default_rng(0))
"""

from training.augmentation.augmentation import Variations, vary
from training.augmentation.illumination import Illumination
from training.augmentation.occlusion import Occlusion
from training.augmentation.segmentation import Segmentation
from training.augmentation.sensor import Sensor

__all__ = ["Illumination", "Occlusion", "Segmentation", "Sensor", "Variations", "vary"]
