"""THOR2 (Samani and Banerjee, 2024) in JAX: coloured point clouds to TOPS and TOPS2, RGB-D frames to object names.

Names are imported when they are first used, so that importing the package does not import JAX.
"""

import importlib.metadata
import pkgutil
from typing import TYPE_CHECKING, Any

from thor2_jax.config import DESCRIPTOR_VERSION as DESCRIPTOR_VERSION
from thor2_jax.config import DescriptorConfig as DescriptorConfig
from thor2_jax.config import Relaxation as Relaxation
from thor2_jax.errors import InputError as InputError

if TYPE_CHECKING:
    from thor2_jax.descriptor.describe import describe as describe
    from thor2_jax.descriptor.describe import describe_aligned as describe_aligned
    from thor2_jax.descriptor.describe import describe_strips as describe_strips
    from thor2_jax.descriptor.describe import diagrams as diagrams
    from thor2_jax.descriptor.describe import strips as strips
    from thor2_jax.descriptor.view_normalization import align as align
    from thor2_jax.descriptor.view_normalization import mirror as mirror
    from thor2_jax.descriptor.view_normalization import turn as turn
    from thor2_jax.descriptor.view_normalization import view_normalize as view_normalize
    from thor2_jax.explanation.explain import Explanation as Explanation
    from thor2_jax.explanation.explain import explain as explain
    from thor2_jax.frames.frames import Intrinsics as Intrinsics
    from thor2_jax.frames.frames import RGBDFrame as RGBDFrame
    from thor2_jax.frames.frames import read_frame as read_frame
    from thor2_jax.model.model import ColorTransform as ColorTransform
    from thor2_jax.model.recognition import Recognition as Recognition
    from thor2_jax.recognizer import Recognizer as Recognizer
    from thor2_jax.segmentation.segmenters import segment as segment
    from thor2_jax.segmentation.segmenters import segmented as segmented
    from thor2_jax.tracking.tracker import TrackedRecognition as TrackedRecognition
    from thor2_jax.tracking.tracker import Tracker as Tracker
    from thor2_jax.transformers import Tops2Transformer as Tops2Transformer
    from thor2_jax.transformers import TopsTransformer as TopsTransformer
    from thor2_jax.types import Descriptors as Descriptors
    from thor2_jax.types import Diagrams as Diagrams
    from thor2_jax.types import Parameters as Parameters
    from thor2_jax.types import PointClouds as PointClouds
    from thor2_jax.types import Strips as Strips
else:
    _MODULES = {
        "descriptor.describe": ("describe", "describe_aligned", "describe_strips", "diagrams", "strips"),
        "descriptor.view_normalization": ("align", "mirror", "turn", "view_normalize"),
        "explanation.explain": ("Explanation", "explain"),
        "frames.frames": ("Intrinsics", "RGBDFrame", "read_frame"),
        "model.model": ("ColorTransform",),
        "model.recognition": ("Recognition",),
        "recognizer": ("Recognizer",),
        "segmentation.segmenters": ("segment", "segmented"),
        "tracking.tracker": ("TrackedRecognition", "Tracker"),
        "transformers": ("Tops2Transformer", "TopsTransformer"),
        "types": ("Descriptors", "Diagrams", "Parameters", "PointClouds", "Strips"),
    }
    _PATHS = {name: f"thor2_jax.{module}:{name}" for module, names in _MODULES.items() for name in names}
    __all__ = sorted([*_PATHS, "DESCRIPTOR_VERSION", "DescriptorConfig", "InputError", "Relaxation"])
    _SUBMODULES = {"capacity", "client", "export", "persistence", "plot", "testing"}
    _PATHS |= {name: f"thor2_jax.{name}:" for name in _SUBMODULES | {each.partition(".")[0] for each in _MODULES}}

    def __getattr__(name: str) -> Any:
        if name not in _PATHS:
            raise AttributeError(f"module 'thor2_jax' has no attribute {name!r}")
        globals()[name] = pkgutil.resolve_name(_PATHS[name])
        return globals()[name]

    def __dir__() -> list[str]:
        return sorted({*globals(), *_PATHS})


__version__ = "0.1.0"

NEWEST_SERIES = (0, 10)
"""Newest series of jax that the tests have run on. pyproject.toml has this rule, too, but an upgrade may ignore it."""

for _package in ("jax", "jaxlib"):
    _version = importlib.metadata.version(_package)
    if _version == "0.10.2" or tuple(map(int, _version.split(".")[:2])) > NEWEST_SERIES:
        raise ImportError(
            f"{_package} {_version} is not supported: 0.10.2 computes rotations of more than 32,768 points wrongly on "
            "CPU (https://github.com/jax-ml/jax/issues/39103), and series after 0.10 are not tested; install the "
            "versions in constraints.txt, or another 0.10"
        )
