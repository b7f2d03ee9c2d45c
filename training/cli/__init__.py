"""The command line `thor2`: one module per command; each parses its options and calls one function."""

import os

# XLA reports the features it expects of cached programs as errors. The variable is read when JAX is imported.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from training.cli import (
    adapt,
    colornet,
    demo,
    doctor,
    enroll,
    evaluate,
    explain,
    fetch,
    forget,
    objects,
    recognize,
    render,
    serve,
    train,
    watch,
)  # noqa: E402
from training.cli.app import app, main  # noqa: E402

__all__ = [
    "adapt",
    "app",
    "colornet",
    "demo",
    "doctor",
    "enroll",
    "evaluate",
    "explain",
    "fetch",
    "forget",
    "main",
    "objects",
    "recognize",
    "render",
    "serve",
    "train",
    "watch",
]
