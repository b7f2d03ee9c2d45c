"""Baselines that are trained on the same views as a run and evaluated on the same instances."""
