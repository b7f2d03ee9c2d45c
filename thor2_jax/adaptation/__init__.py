"""Adaptation to a camera: estimation of a colour transform from frames without object names."""
