"""The command line `thor2`: one module per command; each parses its options and calls one function."""

from training.cli import colornet, demo, evaluate, recognize, render, serve, train
from training.cli.app import app, main

__all__ = ["app", "colornet", "demo", "evaluate", "main", "recognize", "render", "serve", "train"]
