"""Varied copies of training views: beyond the paper, off by default, each variation with its own switch.

variations = Variations(illumination=Illumination(), occlusion=Occlusion())
varied = vary(render_view(caster, pose), variations, np.random.default_rng(0))
"""

from training.variations.illumination import Illumination
from training.variations.occlusion import Occlusion
from training.variations.segmentation import Segmentation
from training.variations.sensor import Sensor
from training.variations.variations import Variations, vary

__all__ = ["Illumination", "Occlusion", "Segmentation", "Sensor", "Variations", "vary"]
