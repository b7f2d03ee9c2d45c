"""The model and its answers."""
