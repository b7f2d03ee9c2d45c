"""Checks of the intrinsics against the size of the images."""

import math

from thor2_jax.frames.frames import Intrinsics
from training.diagnosis.findings import Diagnosis

__all__ = ["check_camera"]

MAX_OFF_CENTRE = 0.12
"""Largest distance of the principal point from the centre of the image, as a fraction of its side. Cameras have .03."""

MAX_PIXEL_ASPECT = 1.15
"""Largest ratio of the focal lengths."""

MIN_VIEW, MAX_VIEW = 20.0, 120.0
"""Range of horizontal fields of view of depth cameras, degrees, with a margin."""

ADVICE = "Give the intrinsics of these images: after resizing by a factor, fx, fy, cx and cy are multiplied by it."


def check_camera(diagnosis: Diagnosis, intrinsics: Intrinsics, width: int, height: int) -> bool:
    """Check intrinsics against the size of the colour image in pixels; return whether nothing was found."""
    n_before = len(diagnosis.findings)
    size = intrinsics.width or width, intrinsics.height or height
    cx, cy = intrinsics.cx, intrinsics.cy
    across, down = cx / width - 0.5, cy / height - 0.5
    if size != (width, height):
        diagnosis.add(
            "intrinsics-size",
            f"The intrinsics are for images of {size[0]} x {size[1]} pixels, but color has {width} x {height}.",
            ADVICE,
        )
    elif max(abs(across), abs(down)) > MAX_OFF_CENTRE:
        if max(abs(cy / width - 0.5), abs(cx / height - 0.5)) <= MAX_OFF_CENTRE:
            reason, advice = "cx and cy are exchanged", "Exchange cx and cy (and fx and fy)."
        else:
            reason = f"it suits an image of about {2 * cx:.0f} x {2 * cy:.0f} pixels: K does not fit the image size"
            advice = ADVICE + " After cropping, the left and upper margin are subtracted from cx and cy."
        diagnosis.add(
            "intrinsics-size",
            f"The principal point cx, cy = {cx:g}, {cy:g} is far from the centre of the image of {width} x {height} "
            f"pixels; {reason}.",
            advice,
        )
    aspect = intrinsics.fx / intrinsics.fy
    if not 1 / MAX_PIXEL_ASPECT <= aspect <= MAX_PIXEL_ASPECT:
        diagnosis.add(
            "intrinsics-aspect",
            f"The focal lengths fx, fy = {intrinsics.fx:g}, {intrinsics.fy:g} differ by {100 * abs(aspect - 1):.0f} %; "
            "pixels of depth cameras are square.",
            "Check whether width and height were resized by different factors, and the order of fx, fy, cx, cy.",
        )
    view = math.degrees(2 * math.atan(width / 2 / intrinsics.fx))
    if not MIN_VIEW <= view <= MAX_VIEW:
        diagnosis.add(
            "intrinsics-focal",
            f"fx = {intrinsics.fx:g} pixels means a horizontal field of view of {view:.1f} degrees; depth cameras have "
            f"{MIN_VIEW:.0f} to {MAX_VIEW:.0f}.",
            "fx and fy are in pixels of these images, not in millimetres. " + ADVICE,
        )
    return len(diagnosis.findings) == n_before
