"""Adaptation to a camera: a colour transform, estimated from frames without labels."""
