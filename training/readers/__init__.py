"""Datasets of labelled RGB-D frames: subclasses of `labelled.LabelledFrames`, each with a command in `cli.evaluate`."""
