"""The command line `thor2`: one module per command; each parses its options and calls one function."""

import importlib
import os

# XLA reports the features it expects of cached programs as errors. The variables are read when JAX is imported.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# Without fusion emitters, programs for CPUs compile in three fifths of the time, and are not slower.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

__all__ = ["app", "main"]

COMMANDS = (
    *("adapt", "colornet", "demo", "doctor", "enroll", "evaluate", "explain", "fetch", "forget", "objects"),
    *("recognize", "render", "serve", "train", "watch"),
)
"""The modules of the commands, in the order of the help; importing one adds its command."""

try:
    from training.cli.app import app, main

    for _name in COMMANDS:
        importlib.import_module(f"training.cli.{_name}")
except KeyboardInterrupt:  # Typer ends a command without a traceback, too.
    raise SystemExit(130) from None
